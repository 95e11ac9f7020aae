"""Whether what comes in can be true: pictures, lanes and the car's answer to its steering."""

"""The lane as a pair of parabolas, and the plane of the ground that it lies on."""

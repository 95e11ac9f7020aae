"""A person who drives: a button that has to be held, gamepad and keyboard, and what they want of the car."""

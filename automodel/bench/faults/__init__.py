"""Faults built into simulated drives: what can break, when, and whether the car stops in time."""

"""Deliberate mistakes in what keeps the car safe, each of which a test must find: `python -m tests.mutations`."""

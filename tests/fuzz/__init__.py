"""Damaged files at every parser, through the command line: `python -m tests.fuzz [--target NAME] [--count N]`."""

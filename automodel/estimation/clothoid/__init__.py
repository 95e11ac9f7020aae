"""The lane as a pair of clothoids (Smith 2024)."""

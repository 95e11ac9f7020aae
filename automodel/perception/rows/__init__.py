"""Lines found on a few image rows."""

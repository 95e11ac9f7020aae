"""The lane fitted to the points of both lines (the windows pipeline)."""

"""The lane as a fit of both lines (the windows pipeline)."""

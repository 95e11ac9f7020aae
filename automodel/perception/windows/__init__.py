"""Lines followed by windows in the bird's-eye view."""

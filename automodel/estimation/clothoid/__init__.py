"""The lane as a pair of clothoids (Smith, active contour thesis)."""

"""From an image to markings and line points."""

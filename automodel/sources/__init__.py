"""Sources of frames: cameras and files."""

"""Calibration that measures its own error."""

"""Simulated tracks, cameras and cars."""

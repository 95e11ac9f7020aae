"""Vehicles that answer real bytes without hardware."""

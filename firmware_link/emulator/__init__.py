"""Emulated boards with the real wire formats."""

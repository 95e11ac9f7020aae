"""The lane in metres from a camera, the car's pose in it, and a safe command."""

__version__ = "0.1.0"

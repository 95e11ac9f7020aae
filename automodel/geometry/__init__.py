"""Coordinate frames, the camera, the ground plane and the bird's-eye view."""

from automodel.geometry.birdseye import BirdsEye, View
from automodel.geometry.camera import CameraModel
from automodel.geometry.ground import GroundCamera, cam_from_body_rotation
from automodel.geometry.se2 import SE2, wrap_angle

__all__ = ["SE2", "BirdsEye", "CameraModel", "GroundCamera", "View", "cam_from_body_rotation", "wrap_angle"]

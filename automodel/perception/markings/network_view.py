"""The view that the marking network for the bird's-eye view looks at."""

from __future__ import annotations

from automodel.geometry import View
from automodel.perception.markings.unet import BIRDSEYE, SIZES


def network_view(near_m: float, ahead_m: float, half_width_m: float) -> View:
    """The ground from `near_m` on, `ahead_m` deep, at the network's size."""
    width, height = SIZES[BIRDSEYE]
    return View(
        x_near_m=near_m,
        x_far_m=near_m + ahead_m,
        half_width_m=half_width_m,
        m_per_px=2.0 * half_width_m / width,
        m_per_row=ahead_m / height,
    )

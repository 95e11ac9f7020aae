"""What is asked of a start from nothing, and what it answers."""

from __future__ import annotations

from dataclasses import dataclass

from automodel.estimation.clothoid.clothoid_tracker import ArcLane


@dataclass(frozen=True, slots=True, kw_only=True)
class LaneGuess:
    """An arc of a lane at the reference point: offset [m] and the lane's heading [rad] in the body frame.

    It fits best `sure_m` of way ahead of the reference point, where it was seen. `pair` tells whether both lines spoke
    for it; `edge` is how sharp markings are in the picture, as `Judged` has it. `fitted`: it was fitted to many
    rows' ridges on both lines, and is right to some hundredths of a lane's width.
    """

    offset_m: float
    heading_rad: float
    width_m: float
    curvature_per_m: float
    sure_m: float
    pair: bool
    edge: float
    fitted: bool = False

    def rough(self, fitted_share: float) -> ArcLane:
        """The lane for a tracker to start with; `fitted_share` is what is left of its sigmas where it was fitted."""
        return ArcLane(
            offset_m=self.offset_m,
            heading_rad=self.heading_rad,
            width_m=self.width_m,
            curvature_per_m=self.curvature_per_m,
            sure_m=self.sure_m,
            share=fitted_share if self.fitted else 1.0,
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class StartConfig:
    """What lanes are tried; lengths in lane widths; (largest, how many)."""

    lane_width_m: float
    marking_m: float
    reference_x_m: float
    contrast: float = 12.0
    rows: int = 16
    ahead: float = 2.0  # how far ahead of the nearest ground in sight the rows reach
    headings_rad: tuple[float, int] = (0.7, 19)
    curvatures: tuple[float, int] = (0.73, 13)  # shares of the tightest bend's
    radius_lanes: float = 1.1  # of that bend
    lateral: tuple[float, int] = (1.4, 57)
    widths: tuple[float, float] = (0.7, 1.43)  # the narrowest and the widest: 0.7 and 1 / 0.7
    pair_rows: int = 3  # rows that show each line of a pair, at least
    single_rows: int = 6  # and a single line

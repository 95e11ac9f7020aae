"""The figures of seed 001 (Cudrano et al. 2020), section VI, Table I, beside ours under the conditions that it names.

How far they can be compared:

- The paper's truth is an RTK GPS and a mapped centerline, whose heading errors are of about the size that it reports;
  ours is exact.
- The paper drove four rides of whole laps, some dry and some in rain, and does not say which. Here each ride is driven
  in both, and both stand beside the same figure of the paper.
- Its track A (Lainate, 1.5 km) is not public: `tracks/circuit.toml` has its length, its kinds of bends and its widths.
  Track B is Monza.
- Its offset errors are 5 to 10 % of the lane's width, which it gives for both tracks together.
"""

from __future__ import annotations

from collections.abc import Sequence

from automodel.config import CameraConfig, CarConfig, Extrinsics, Intrinsics, LaneConfig, PipelineConfig, VehicleConfig
from automodel.evaluation.accuracy import AccuracyMeter

Row = dict[str, object]

# MAE of heading [deg] and offset [m], availability [%] by track and driving style
PAPER = {
    ("A", "centred"): (2.892, 0.820, 99.71),
    ("B", "centred"): (1.642, 0.453, 99.91),
    ("A", "oscillating"): (3.862, 0.946, 100.00),
    ("B", "racing"): (3.120, 0.581, 95.92),
}
PAPER_OFFSET_PCT = (5.0, 10.0)  # of the lane's width, over all rides
RIDES = (*PAPER, ("B", "oscillating"), ("A", "racing"))  # the paper's four first
LIGHTS = ("dry", "wet")
ODOMETRIES = ("encoder", "command", "none")
FIGURES = ("heading_mae_deg", "offset_mae_m", "availability_pct")


def full_scale_car(pipeline: PipelineConfig) -> CarConfig:
    """The paper's conditions: a ZED's left picture, 672 x 376 at 100 Hz, from behind the windscreen of a car.

    The car's pose is that of its centre of mass. The lane's width is a start value for tracks of 9 to 12 m.
    """
    lens = Intrinsics(fx_px=350.0, fy_px=350.0, cx_px=335.5, cy_px=187.5)  # 88 degrees across
    place = Extrinsics(x_m=1.65, z_m=1.35, pitch_rad=0.08)
    return CarConfig(
        vehicle=VehicleConfig(
            wheelbase_m=2.65,
            reference_x_m=1.25,
            width_m=1.80,
            front_overhang_m=0.90,
            rear_overhang_m=0.80,
            ticks_per_m=50.0,
        ),
        camera=CameraConfig(width_px=672, height_px=376, rate_hz=100.0, intrinsics=lens, extrinsics=place),
        lane=LaneConfig(width_m=10.0, marking_width_m=0.15),
        pipeline=pipeline,
    )


def ride_row(ride: tuple[str, str, str], seer: tuple[str, str], meter: AccuracyMeter) -> Row:
    """A row of Table I: `ride` is (track, style, light), `seer` is (pipeline, odometry); None where nothing is known.

    The tails that the paper does not give (99th percentiles) are ours alone.
    """
    track, style, light = ride
    figures = meter.row()
    paper = PAPER.get((track, style), (None, None, None))
    row: Row = {"track": track, "style": style, "light": light, "pipeline": seer[0], "odometry": seer[1]}
    row["frames"] = figures["frames"]
    for name, said in zip(FIGURES, paper, strict=True):
        row |= {name: figures[name], f"paper_{name}": said}
    return row | {name: value for name, value in figures.items() if name not in row}


def cost_rows(rows: Sequence[Row]) -> list[Row]:
    """What other odometry costs: for each ride and pipeline the figures of every odometry, side by side."""
    found: dict[tuple[object, ...], Row] = {}
    for row in rows:
        place = {name: row[name] for name in ("track", "style", "light", "pipeline")}
        found.setdefault(tuple(place.values()), place)
    for name in FIGURES:  # figure by figure, so that what is compared stands together
        for row in rows:
            key = (row["track"], row["style"], row["light"], row["pipeline"])
            found[key][f"{row['odometry']}_{name}"] = row[name]
    return list(found.values())

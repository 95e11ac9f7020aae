"""`automodel replay`: the lane in something that was recorded."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from automodel.cli.options import ABOVE_ZERO, FILE, PIPELINE, check_outputs, finite

if TYPE_CHECKING:
    from automodel.assembly.replay import ReplayOptions


@click.command("replay")
@click.argument("source", type=FILE)
@click.option("--car", "car_file", type=FILE, help="car.toml (default: the recording's own).")
@click.option("--motion", "motion_file", type=FILE, help="motion.csv: t_s,speed_mps,yaw_rate_radps.")
@click.option("--pipeline", "pipelines", multiple=True, type=PIPELINE, help="May be given several times.")
@click.option("--csv", "csv_file", type=FILE, help="Write poses.csv here (per pipeline).")
@click.option("--video", "video_file", type=FILE, help="Write an MP4 with the overlay here.")
@click.option(
    "--rate",
    "rate_hz",
    type=click.FloatRange(0, 1000, min_open=True),
    callback=finite,
    help="Frames a second, for sources that do not say.",
)
@click.option("--guess", is_flag=True, help="Guess the car.toml from the images, write NAME.car.toml and the overlay.")
@click.option("--lane-width-m", type=ABOVE_ZERO, callback=finite, help="--guess: the lane's width, which scales all.")
@click.option(
    "--view-deg",
    type=click.FloatRange(10, 150),
    callback=finite,
    help="--guess: the horizontal field of view of the camera.",
)
@click.option("--json", "as_json", is_flag=True, help="Figures as JSON on stdout.")
def command(as_json: bool, guess: bool, lane_width_m: float | None, view_deg: float | None, **given: Any) -> int:
    """Lane poses of SOURCE: a recording (.mcap), a video, a folder of images or a donkeycar tub (v2).

    Of a camera that nothing is known of: automodel replay VIDEO --guess.
    """
    from automodel.assembly.replay import COLUMNS, ReplayOptions, replay
    from automodel.console.tables import show

    options = ReplayOptions(**given)
    if guess:
        options = _guessed(options)
    elif lane_width_m is not None or view_deg is not None:
        raise click.UsageError("--lane-width-m and --view-deg are for --guess; otherwise car.toml says both")
    inputs: dict[str, Path | None] = {"SOURCE": options.source, "--motion": options.motion_file}
    outputs = {"--csv": options.csv_file, "--video": options.video_file}
    (outputs if guess else inputs)["--guess" if guess else "--car"] = options.car_file
    check_outputs(outputs, inputs)
    if guess:
        from automodel.assembly.guess import guess_car_file

        assert options.car_file is not None
        view_rad = None if view_deg is None else math.radians(view_deg)
        guess_car_file(options.source, options.car_file, lane_width_m, view_rad, options.rate_hz)
    show("replay", replay(options), as_json, COLUMNS)
    return 0


def _guessed(options: ReplayOptions) -> ReplayOptions:
    """With the names of what --guess writes: NAME.car.toml and NAME.overlay.mp4, in the working folder."""
    if options.car_file is not None:
        raise click.UsageError("--guess writes a car.toml; leave out --car")
    name = options.source.resolve().stem
    video = options.video_file or Path(f"{name}.overlay.mp4")
    return dataclasses.replace(options, car_file=Path(f"{name}.car.toml"), video_file=video, guessed=True)

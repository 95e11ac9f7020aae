"""`automodel replay`: the lane in something that was recorded."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from automodel.cli.options import FILE, PIPELINE, check_outputs, finite


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
@click.option("--json", "as_json", is_flag=True, help="Figures as JSON on stdout.")
def command(as_json: bool, **given: Any) -> int:
    """Lane poses of SOURCE: a recording (.mcap), a video, a folder of images or a donkeycar tub (v2)."""
    from automodel.assembly.replay import COLUMNS, ReplayOptions, replay
    from automodel.console.tables import show

    options = ReplayOptions(**given)
    inputs: dict[str, Path | None] = {
        "SOURCE": options.source, "--car": options.car_file, "--motion": options.motion_file
    }  # fmt: skip
    check_outputs({"--csv": options.csv_file, "--video": options.video_file}, inputs)
    show("replay", replay(options), as_json, COLUMNS)
    return 0

"""`automodel export`: a recording as CSV and video."""

from __future__ import annotations

from pathlib import Path

import click

from automodel.cli.options import FILE, check_outputs
from automodel.config import ConfigError, parse_car
from automodel.console.messages import say
from automodel.console.progress import progress
from automodel.recording.export import export_csv, export_video
from automodel.recording.reader import Recording


@click.command("export")
@click.argument("recording", type=FILE)
@click.option("--csv", "csv_file", type=FILE, help="Write poses.csv here.")
@click.option("--video", type=FILE, help="Write an MP4 with the overlay here.")
def command(recording: Path, csv_file: Path | None, video: Path | None) -> int:
    """Write a RECORDING's estimates as CSV, and its frames with overlay as video."""
    if csv_file is None and video is None:
        raise click.UsageError("nothing to do: give --csv FILE, --video FILE or both", click.get_current_context())
    check_outputs({"--csv": csv_file, "--video": video}, {"RECORDING": recording})
    run = Recording(recording)
    if csv_file is not None:
        with progress("export csv", run.counts.get("frames")) as bar:
            rows = export_csv(run, csv_file, lambda _: bar())
        say(f"{csv_file}: {rows} rows")
    if video is not None:
        try:
            car = parse_car(run.car_text, f"{recording} (car.toml)")
        except ConfigError as error:
            raise ConfigError(f"{error}; the recording was made by another version") from None
        with progress("export video", run.counts.get("frames")) as bar:
            frames = export_video(run, video, car, lambda _: bar())
        say(f"{video}: {frames} frames")
    return 0

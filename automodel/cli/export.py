"""`automodel export`: a recording as CSV, as video and for Foxglove."""

from __future__ import annotations

import math
from pathlib import Path

import click

from automodel.cli.options import FILE, FROM, TO, check_outputs
from automodel.config import ConfigError, parse_car
from automodel.console.messages import say
from automodel.console.progress import progress
from automodel.output_files import output_text
from automodel.recording.export import WHOLE_S, export_csv, export_foxglove, export_video
from automodel.recording.reader import Recording


@click.command("export")
@click.argument("recording", type=FILE)
@click.option("--csv", "csv_file", type=FILE, help="Write poses.csv here.")
@click.option("--video", type=FILE, help="Write an MP4 with the overlay here.")
@click.option("--foxglove", type=FILE, help="Write an .mcap for Foxglove here, and its layout beside it.")
@FROM
@TO
def command(
    recording: Path,
    csv_file: Path | None,
    video: Path | None,
    foxglove: Path | None,
    from_s: float,
    to_s: float | None,
) -> int:
    """Write a RECORDING's estimates as CSV, its frames with overlay as video, and both as scenes for Foxglove.

    Example:

    automodel export lap.mcap --csv driven.csv --video driven.mp4
    """
    if csv_file is None and video is None and foxglove is None:
        raise click.UsageError("nothing to do: give --csv, --video or --foxglove FILE", click.get_current_context())
    span_s = (from_s, math.inf if to_s is None else to_s)
    if foxglove is not None and span_s != WHOLE_S:
        raise click.UsageError("--from and --to are for --csv and --video; Foxglove has a time line of its own")
    layout = None if foxglove is None else foxglove.with_suffix(".layout.json")
    outputs = {"--csv": csv_file, "--video": video, "--foxglove": foxglove, "--foxglove (layout)": layout}
    check_outputs(outputs, {"RECORDING": recording})
    run = Recording(recording)
    if csv_file is not None:
        with progress("export csv", run.counts.get("frames")) as bar:
            rows = export_csv(run, csv_file, lambda _: bar(), span_s)
        say(f"{csv_file}: {rows} rows")
    if video is None and foxglove is None:
        return 0
    try:
        car = parse_car(run.car_text, f"{recording} (car.toml)")
    except ConfigError as error:
        raise ConfigError(f"{error}; the recording was made by another version") from None
    if video is not None:
        with progress("export video", run.counts.get("frames")) as bar:
            frames = export_video(run, video, car, lambda _: bar(), span_s)
        say(f"{video}: {frames} frames")
    if foxglove is not None and layout is not None:
        from automodel.recording.foxglove import layout_file

        with progress("export foxglove", run.counts.get("frames")) as bar:
            messages = export_foxglove(run, foxglove, car, lambda _: bar())
        with output_text(layout) as file:
            file.write(layout_file().read_text(encoding="utf-8"))
        say(f"{foxglove}: {messages} messages for Foxglove; there, import the layout {layout}")
    return 0

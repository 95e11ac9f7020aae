"""`automodel report`: runs as one page."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from automodel.cli.options import FILE, FROM, PIPELINE, RATE, TO, check_outputs

COLUMNS = (
    "pipeline", "availability_pct", "disagreement_median_m", "offset_bound_median_m", "misled_pct", "p50_ms", "frames"
)  # fmt: skip


@click.command("report")
@click.argument("sources", metavar="RUN...", type=FILE, nargs=-1, required=True)
@click.option("--html", "html_file", type=FILE, required=True, help="The page to write.")
@click.option("--pipeline", "pipelines", multiple=True, type=PIPELINE, help="Also on its frames; several times.")
@click.option("--car", "car_file", type=FILE, help="car.toml (default: the recording's own).")
@click.option("--motion", "motion_file", type=FILE, help="motion.csv of the one RUN.")
@click.option("--truth", "truth_file", type=FILE, help="truth.csv of the one RUN.")
@RATE
@FROM
@TO
@click.option("--json", "as_json", is_flag=True, help="Figures as JSON on stdout.")
def command(as_json: bool, to_s: float | None, **given: Any) -> int:
    """One page (HTML, nothing else needed) about each RUN: a recording, video, folder of images or tub.

    Map, offset with its bound, heading, speed, status, time a frame, events, the worst moments with pictures; several
    pipelines on the same frames side by side. Example:

    automodel report run.mcap --pipeline windows --html report.html
    """
    import math

    from automodel.assembly.report import ReportOptions, report
    from automodel.console.messages import say
    from automodel.console.tables import show
    from automodel.viewer.run_trace import metrics

    options = ReportOptions(to_s=math.inf if to_s is None else to_s, **given)
    if len(options.sources) > 1 and (options.truth_file or options.motion_file):
        raise click.UsageError("--truth and --motion belong to one RUN; give one")
    inputs: dict[str, Path | None] = {
        "--car": options.car_file, "--motion": options.motion_file, "--truth": options.truth_file
    }  # fmt: skip
    inputs |= {f"RUN {number}": path for number, path in enumerate(options.sources, 1)}
    check_outputs({"--html": options.html_file}, inputs)
    runs = report(options)
    show("report", [row for run in runs for row in metrics(run)], as_json, COLUMNS)
    say(f"{options.html_file}: written")
    return 0

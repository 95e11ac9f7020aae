"""`automodel view`: a run in the browser."""

from __future__ import annotations

import contextlib
import math
from pathlib import Path
from typing import Any

import click

from automodel.cli.options import FILE, FROM, PIPELINE, RATE, TO
from automodel.config.extras import need_extra


@click.command("view")
@click.argument("run", metavar="RUN", type=FILE)
@click.option("--pipeline", "pipelines", multiple=True, type=PIPELINE, help="Also on its frames; several times.")
@click.option("--car", "car_file", type=FILE, help="car.toml (default: the recording's own).")
@click.option("--motion", "motion_file", type=FILE, help="motion.csv: t_s,speed_mps,yaw_rate_radps.")
@click.option(
    "--port", type=click.IntRange(0, 65535), default=0, help="Of the page, on this machine.  [default: any free one]"
)
@RATE
@FROM
@TO
def command(run: Path, port: int, pipelines: tuple[str, ...], to_s: float | None, **given: Any) -> int:
    """RUN (a recording, video, folder of images or tub) in the browser: play, step, scrub, jump to the next event.

    Several pipelines on the same frames are switched with a key. A key of car.toml can be changed on the page: the
    pipeline runs again, and what differs stands beside it. Only this machine can open the page, by the token in its
    address. Example:

    automodel view run.mcap --pipeline windows --pipeline contour
    """
    need_extra("view", "aiohttp")
    from automodel.web.film import Footage, look_through
    from automodel.web.view import serve

    viewed = look_through(Footage(path=run, to_s=math.inf if to_s is None else to_s, **given), pipelines)
    with contextlib.closing(viewed.film):
        serve(viewed, port)
    return 0

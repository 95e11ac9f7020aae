"""`automodel replay`: the lane in something that was recorded."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from automodel.cli.options import ABOVE_ZERO, FILE, FROM, PIPELINE, RATE, SWEEP, TO, check_outputs, finite

if TYPE_CHECKING:
    from automodel.assembly.replay import ReplayOptions
    from automodel.console.workers import Sweep


@click.command("replay")
@click.argument("sources", metavar="[SOURCE]...", type=FILE, nargs=-1)
@click.option("--car", "car_file", type=FILE, help="car.toml (default: the recording's own).")
@click.option("--motion", "motion_file", type=FILE, help="motion.csv: t_s,speed_mps,yaw_rate_radps.")
@click.option("--pipeline", "pipelines", multiple=True, type=PIPELINE, help="May be given several times.")
@click.option("--csv", "csv_file", type=FILE, help="Write poses.csv here (per pipeline).")
@click.option("--video", "video_file", type=FILE, help="Write the overlay here: .mp4, or .webp to animate a page.")
@click.option("--stages", is_flag=True, help="--video: what each stage of the pipeline found (stereo).")
@RATE
@click.option("--guess", is_flag=True, help="Guess the car.toml from the images, write NAME.car.toml and the overlay.")
@click.option("--lane-width-m", type=ABOVE_ZERO, callback=finite, help="--guess: the lane's width, which scales all.")
@click.option(
    "--view-deg",
    type=click.FloatRange(10, 150),
    callback=finite,
    help="--guess: the horizontal field of view of the camera.",
)
@click.option("--can", "can_log", type=FILE, help="A recorded CAN bus: its motion, beside SOURCE or alone.")
@click.option("--dbc", type=FILE, multiple=True, help="--can: message definitions; may be given several times.")
@click.option("--mapping", type=FILE, help="--can: car.toml whose [link.can] says what the signals are.")
@click.option("--motion-csv", type=FILE, default=Path("motion.csv"), show_default=True, help="--can: written here.")
@FROM
@TO
@SWEEP
@click.option("--json", "as_json", is_flag=True, help="Figures as JSON on stdout.")
def command(
    as_json: bool,
    guess: bool,
    lane_width_m: float | None,
    view_deg: float | None,
    to_s: float | None,
    sources: tuple[Path, ...],
    sweep: Sweep,
    **given: Any,
) -> int:
    """Lane poses of SOURCE: a recording (.mcap), a video, a folder of images or a donkeycar tub (v2).

    Several, or a folder of recordings and videos, run on all cores. Two videos or folders of images with the car.toml
    of two cameras are a pair, LEFT RIGHT. Of a camera that nothing is known of: automodel
    replay VIDEO --guess.

    Example:

    automodel replay drive.mp4 --car car.toml --csv poses.csv --video overlay.mp4
    """
    from automodel.assembly.replay import COLUMNS, ReplayOptions, replay, replay_all, sources_in
    from automodel.console.tables import show

    right = _right_of(sources, given["car_file"])
    found = list(sources) if right else sources_in(sources)
    swept = (len(found) > 1 and right is None) or sweep.keep is not None or sweep.scheduler is not None
    if swept and (guess or given["can_log"] or given["motion_file"]):
        raise click.UsageError("--guess, --can and --motion are for one SOURCE on this machine")
    if swept and right:
        raise click.UsageError("LEFT RIGHT are one source; --keep and --scheduler are for several")
    given["source"], given["right"] = found[0] if found else None, right
    if not _from_can(given, as_json):
        return 0
    options = ReplayOptions(to_s=math.inf if to_s is None else to_s, **given)
    if guess:
        options = _guessed(options)
    elif lane_width_m is not None or view_deg is not None:
        raise click.UsageError("--lane-width-m and --view-deg are for --guess; otherwise car.toml says both")
    if options.stages and options.video_file is None:
        raise click.UsageError("--stages is drawn into a video; give --video as well")
    inputs: dict[str, Path | None] = {
        " ".join(["SOURCE", str(number)][: len(found)]): path for number, path in enumerate(found, 1)
    }
    inputs |= {"--motion": options.motion_file}
    outputs = {"--csv": options.csv_file, "--video": options.video_file}
    (outputs if guess else inputs)["--guess" if guess else "--car"] = options.car_file
    check_outputs(outputs, inputs)
    if swept:
        rows, failed = replay_all(found, options, sweep)
        show("replay", rows, as_json, COLUMNS)
        return 2 if failed else 0
    if guess:
        from automodel.assembly.guess import guess_car_file

        assert options.car_file is not None
        view_rad = None if view_deg is None else math.radians(view_deg)
        guess_car_file(options.source, options.car_file, lane_width_m, view_rad, options.rate_hz)
    show("replay", replay(options), as_json, COLUMNS)
    return 0


def _right_of(sources: tuple[Path, ...], car_file: Path | None) -> Path | None:
    """The second of two sources, neither a recording, where car.toml has two cameras; None otherwise."""
    if len(sources) != 2 or car_file is None or any(path.suffix.lower() == ".mcap" for path in sources):
        return None
    from automodel.config import load_car

    if load_car(car_file).camera.right is None:
        return None
    left, right = sources
    if left.resolve() == right.resolve():
        raise click.UsageError(f"LEFT and RIGHT are both {left}; give the right camera's pictures as well")
    return right


def _guessed(options: ReplayOptions) -> ReplayOptions:
    """With the names of what --guess writes: NAME.car.toml and NAME.overlay.mp4, in the working folder."""
    if options.car_file is not None:
        raise click.UsageError("--guess writes a car.toml; leave out --car")
    name = options.source.resolve().stem
    video = options.video_file or Path(f"{name}.overlay.mp4")
    return dataclasses.replace(options, car_file=Path(f"{name}.car.toml"), video_file=video, guessed=True)


def _from_can(given: dict[str, Any], as_json: bool) -> bool:
    """Take the options of --can out of `given` and do what they ask for; whether there is a SOURCE to replay as well.

    The motion of the bus then becomes that of the replay.
    """
    log, dbc, mapping, motion_csv = (given.pop(name) for name in ("can_log", "dbc", "mapping", "motion_csv"))
    source, motion_file = given["source"], given["motion_file"]
    if log is None:
        if source is None:
            raise click.UsageError("SOURCE is missing; without images give --can LOG")
        if dbc or mapping is not None:
            raise click.UsageError("--dbc and --mapping belong to --can LOG")
        return True
    if mapping is None:
        raise click.UsageError("--can needs --mapping: a car.toml whose [link.can] says what the signals are")
    if source is not None and motion_file is not None:
        raise click.UsageError("--can and --motion: both tell the motion; give one")
    from automodel.assembly.can_replay import BUS_COLUMNS, MESSAGE_COLUMNS, CanReplayOptions, replay_can
    from automodel.console.tables import show_tables

    inputs = {"--can": log, "--mapping": mapping, "SOURCE": source} | {f"--dbc {path}": path for path in dbc}
    check_outputs({"--motion-csv": motion_csv}, inputs)
    tables = replay_can(CanReplayOptions(log=log, mapping=mapping, dbc=dbc, motion_csv=motion_csv))
    if source is None:
        show_tables("replay", tables, as_json, {"bus": BUS_COLUMNS, "messages": MESSAGE_COLUMNS})
        return False
    given["motion_file"] = motion_csv
    return True

"""`automodel bench`: accuracy against the simulator's truth, speed by stage, and faults."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import click
from click.core import ParameterSource

from automodel.assembly.parts import car_of
from automodel.cli.options import ABOVE_ZERO, FILE, check_outputs, finite
from automodel.config import PIPELINE_NAMES, CarConfig, ConfigError
from automodel.console.tables import show
from automodel.sim.trajectory import STYLES

TRACKS = ("tmr", "oval", "chicane")
TABLES = ("windows-paper", "centerline-paper")
UPDATE_LAWS = ("gauss_newton", "gradient_descent")  # of contour
LOOKS = ("clean", "competition", "varied")
PAPERS_TRACKS = {"a": "A", "circuit": "A", "b": "B", "monza": "B"}  # of centerline-paper
OF_CENTERLINE_PAPER = ("monza", "lights", "odometries", "stretches", "full")  # options for that table alone


@click.group("bench")
def command() -> None:
    """Measure a pipeline; every figure can be had as JSON."""


@command.command("accuracy")
@click.option("--car", "car_file", type=FILE, help="car.toml (default: the simulated car).")
@click.option("--pipeline", "pipelines", multiple=True, type=click.Choice(PIPELINE_NAMES), help="Default: all.")
@click.option("--track", "tracks", multiple=True, help=f"Name or file.  [default: {', '.join(TRACKS)}]")
@click.option("--style", "styles", multiple=True, type=click.Choice(STYLES), help="Driving style.  [default: all]")
@click.option(
    "--seeds", type=click.IntRange(1), default=1, show_default=True, help="How many seeds of light and noise."
)
@click.option("--seed", "first_seed", type=click.IntRange(0), default=0, show_default=True, help="The first seed.")
@click.option("--look", type=click.Choice(LOOKS), default="competition", show_default=True, help="Floor and light.")
@click.option("--direction", type=click.Choice(["forward", "reverse"]), default="forward", show_default=True)
@click.option("--speed", "speed_mps", type=ABOVE_ZERO, callback=finite, default=1.0, show_default=True)
@click.option("--table", type=click.Choice(TABLES), help="The tables of a pipeline's paper instead, on its tracks.")
@click.option("--monza", type=FILE, help="centerline-paper: Monza.csv.  [default: in $AUTOMODEL_DATA/racetracks]")
@click.option("--light", "lights", multiple=True, type=click.Choice(["dry", "wet"]), help="centerline-paper.  [all]")
@click.option(
    "--odometry",
    "odometries",
    multiple=True,
    type=click.Choice(["encoder", "command", "none"]),
    help="centerline-paper: where the car's motion comes from.  [encoder]",
)
@click.option("--stretches", type=click.IntRange(1), default=6, show_default=True, help="centerline-paper: a drive.")
@click.option("--full", is_flag=True, help="centerline-paper: whole laps (20 minutes a drive on Monza).")
@click.option("--plot", type=FILE, help="Estimate against truth over time, as PNG.")
@click.option("--jobs", type=click.IntRange(1), help="Processes (default: one a core).")
@click.option("--json", "as_json", is_flag=True, help="Figures as JSON on stdout.")
def accuracy(
    car_file: Path | None,
    pipelines: tuple[str, ...],
    tracks: tuple[str, ...],
    styles: tuple[str, ...],
    seeds: int,
    first_seed: int,
    table: str | None,
    plot: Path | None,
    jobs: int | None,
    as_json: bool,
    **more: Any,
) -> int:
    """Prescribed drives over tracks in several styles and lights: errors of heading and offset, availability."""
    from automodel.bench.accuracy import Case, measure

    circuits = {name: more.pop(name) for name in OF_CENTERLINE_PAPER}
    check_outputs({"--plot": plot}, {"--car": car_file, "--monza": circuits["monza"]})
    car = car_of(car_file)
    if table == "centerline-paper":
        circuits |= {"pipelines": pipelines, "tracks": tracks, "styles": styles, "seed": first_seed}
        _circuit_tables(car, circuits, jobs, plot, as_json)
        return 0
    _refuse(OF_CENTERLINE_PAPER, "{} is for --table centerline-paper alone")
    if table == "windows-paper":
        _paper_tables(car, first_seed, more, jobs, as_json)
        return 0
    cases = [
        Case(pipeline=pipeline, track=track, style=style, seed=seed, **more)
        for pipeline in pipelines or PIPELINE_NAMES
        for track in tracks or TRACKS
        for style in styles or STYLES
        for seed in range(first_seed, first_seed + seeds)
    ]
    rows = measure(car, cases, jobs, plot)
    show("bench accuracy", rows, as_json)
    return 0


def _refuse(names: Iterable[str], why: str) -> None:
    """Refuse the first of these parameters that was given on the command line; `why` has a place for its option."""
    context = click.get_current_context()
    for name in names:
        if context.get_parameter_source(name) is not ParameterSource.DEFAULT:
            option = next(p.opts[0] for p in context.command.params if p.name == name)
            raise click.UsageError(why.format(option))


def _circuit_tables(car: CarConfig, chosen: dict[str, Any], jobs: int | None, plot: Path | None, as_json: bool) -> None:
    """Both circuits in the paper's styles, dry and wet; what has no meaning there is refused."""
    from automodel.bench.centerline_paper import Wanted, show_tables

    _refuse(("seeds", "look", "direction", "speed_mps"), "--table has its own drives: leave out {}")
    if chosen["full"]:
        _refuse(("stretches",), "--full drives whole laps: leave out {}")
    letters = [PAPERS_TRACKS.get(name.lower()) for name in chosen["tracks"]]
    if None in letters:
        raise click.UsageError(f"--track {chosen['tracks'][letters.index(None)]}: this table has circuit and Monza")
    wanted = Wanted(
        tracks=tuple(letter for letter in letters if letter is not None),
        styles=chosen["styles"],
        lights=chosen["lights"],
        monza=chosen["monza"],
        stretches=None if chosen["full"] else chosen["stretches"],
        seed=chosen["seed"],
    )
    odometries = dict.fromkeys(chosen["odometries"] or ("encoder",))
    pipelines = dict.fromkeys(chosen["pipelines"] or (car.pipeline.name,))
    seers = [(name, odometry) for name in pipelines for odometry in odometries]
    show_tables(car, seers, wanted, jobs, plot, as_json)


def _paper_tables(car: CarConfig, seed: int, drive: dict[str, Any], jobs: int | None, as_json: bool) -> None:
    """Both directions of tmr, centred; what would choose other drives is refused."""
    from automodel.bench.accuracy import Case
    from automodel.bench.windows_paper import show_tables

    names = ("pipelines", "tracks", "styles", "seeds", "direction", "plot")
    _refuse(names, "--table has its own drives: leave out {}")
    cases = [
        Case(pipeline="windows", track="tmr", style="centred", seed=seed, **{**drive, "direction": direction})
        for direction in ("forward", "reverse")
    ]
    show_tables(car, cases, jobs, as_json)


@command.command("speed")
@click.option("--car", "car_file", type=FILE, help="car.toml (default: the simulated car).")
@click.option("--pipeline", "pipelines", multiple=True, type=click.Choice(PIPELINE_NAMES), help="Default: all.")
@click.option("--frames", type=click.IntRange(10), default=300, show_default=True)
@click.option("--threads", type=click.IntRange(1), default=1, show_default=True, help="Threads that OpenCV may use.")
@click.option("--json", "as_json", is_flag=True, help="Figures as JSON on stdout.")
def speed(car_file: Path | None, pipelines: tuple[str, ...], frames: int, threads: int, as_json: bool) -> int:
    """Milliseconds a frame, by stage, on rendered frames of tmr."""
    from automodel.bench.speed import measure_speed

    car = car_of(car_file)
    rows = [row for name in pipelines or PIPELINE_NAMES for row in measure_speed(car, name, frames, threads)]
    show("bench speed", rows, as_json)
    return 0


@command.command("latency")
@click.option("--car", "car_file", type=FILE, help="car.toml (default: the simulated car).")
@click.option("--pipeline", type=click.Choice(PIPELINE_NAMES), help="Which paper sees the lane.")
@click.option(
    "--link",
    type=click.Choice(["emulated", "avr"]),
    default="emulated",
    show_default=True,
    help="The board; avr is the firmware on a simulated ATmega328P (needs avr-gcc and simavr).",
)
@click.option("--frames", type=click.IntRange(10), default=300, show_default=True)
@click.option("--commands", type=click.IntRange(10), default=200, show_default=True)
@click.option("--json", "as_json", is_flag=True, help="Figures as JSON on stdout.")
def latency(car_file: Path | None, pipeline: str | None, link: str, frames: int, commands: int, as_json: bool) -> int:
    """Milliseconds from a frame to its command on the wire, and from there to the servo's pulse."""
    from automodel.bench.latency import measure_latency

    car = car_of(car_file, pipeline)
    if car.link.kind != "arduino":
        raise ConfigError(f"{car_file}: [link] kind {car.link.kind!r}: only a board with our firmware can be measured")
    show("bench latency", measure_latency(car, link, frames, commands), as_json)
    return 0


@command.command("tusimple")
@click.option("--root", type=FILE, required=True, help="Folder with label_data.json and clips/.")
@click.option("--car", "car_file", type=FILE, help="car.toml of the camera.  [default: found in the pictures]")
@click.option("--pipeline", "pipelines", multiple=True, type=click.Choice(PIPELINE_NAMES), help="Default: all.")
@click.option("--predictions", type=FILE, help="Write what was found here, in TuSimple's form (per pipeline).")
@click.option(
    "--figures", type=FILE, help="Write the pictures with labels and predictions here, as PNG (per pipeline)."
)
@click.option("--json", "as_json", is_flag=True, help="Figures as JSON on stdout.")
def tusimple(
    root: Path,
    car_file: Path | None,
    pipelines: tuple[str, ...],
    predictions: Path | None,
    figures: Path | None,
    as_json: bool,
) -> int:
    """Labelled highway pictures (TuSimple): its metric for the ego lines and for all, and the error of the middle."""
    from automodel.bench.tusimple import LABELS, bench

    inputs = {"--car": car_file, "the labels": root / LABELS}
    check_outputs({"--predictions": predictions, "--figures": figures}, inputs)
    car = car_of(car_file) if car_file is not None else None
    names = tuple(dict.fromkeys(pipelines)) or PIPELINE_NAMES
    bench(root, car, names, (predictions, figures), as_json)
    return 0


@command.command("contour-paper")
@click.option("--car", "car_file", type=FILE, help="car.toml (default: the simulated car).")
@click.option("--track", default="chicane", show_default=True, help="Name or file of a track with bends.")
@click.option("--style", type=click.Choice(STYLES), default="centred", show_default=True, help="Driving style.")
@click.option("--law", "laws", multiple=True, type=click.Choice(UPDATE_LAWS), help="Update law.  [default: both]")
@click.option("--seeds", type=click.IntRange(1), default=1, show_default=True, help="How many drives.")
@click.option("--seed", "first_seed", type=click.IntRange(0), default=0, show_default=True, help="The first seed.")
@click.option("--speed", "speed_mps", type=ABOVE_ZERO, callback=finite, default=2.0, show_default=True)
@click.option("--seconds", type=ABOVE_ZERO, callback=finite, help="Of each drive.  [default: a lap]")
@click.option("--figure", type=FILE, help="The figures over the frame rate, as PNG.")
@click.option("--jobs", type=click.IntRange(1), help="Processes (default: one a core).")
@click.option("--json", "as_json", is_flag=True, help="Figures as JSON on stdout.")
def contour_paper(
    car_file: Path | None,
    laws: tuple[str, ...],
    seeds: int,
    first_seed: int,
    figure: Path | None,
    jobs: int | None,
    as_json: bool,
    **drive: Any,
) -> int:
    """What the speed is worth to `contour` in bends: told, wrong by 20 % and not told, at 5 to 60 frames/s."""
    from automodel.bench.contour_paper import ClaimDrive, bench

    check_outputs({"--figure": figure}, {"--car": car_file})
    car = car_of(car_file)
    chosen = tuple(dict.fromkeys(laws)) or UPDATE_LAWS
    cases = [ClaimDrive(laws=chosen, seed=seed, **drive) for seed in range(first_seed, first_seed + seeds)]
    bench(car, cases, jobs, figure, as_json)
    return 0


@command.command("faults")
@click.option("--only", "names", multiple=True, metavar="FAULT", help="This one; may be given several times.  [all]")
@click.option("--runs", type=click.IntRange(1), default=300, show_default=True, help="In all, shared out evenly.")
@click.option("--seed", type=click.IntRange(0), default=0, show_default=True)
@click.option(
    "--pipeline",
    type=click.Choice([*PIPELINE_NAMES, "truth"]),
    default="windows",
    show_default=True,
    help="What sees the lane; truth reads it from the simulator, without pictures.",
)
@click.option("--jobs", type=click.IntRange(1), help="Processes (default: one a core).")
@click.option("--list", "listed", is_flag=True, help="Name the faults, and what the car must do.")
@click.option("--json", "as_json", is_flag=True, help="Figures as JSON on stdout.")
def faults(
    names: tuple[str, ...], runs: int, seed: int, pipeline: str, jobs: int | None, listed: bool, as_json: bool
) -> int:
    """Faults of every part, built into runs of the simulated car at random times: does it stop, and only then?

    On virtual time: the same seed gives the same figures. Exit code 1 where the car did not do what it must.
    """
    from automodel.bench.faults.measure import chosen_faults, list_faults, measure_faults

    wanted = chosen_faults(names)
    if listed:
        list_faults(wanted, as_json)
        return 0
    rows, violations = measure_faults(wanted, runs, seed, pipeline, jobs)
    show("bench faults", rows, as_json)
    return 1 if violations else 0

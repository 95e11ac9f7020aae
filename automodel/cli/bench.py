"""`automodel bench`: measurements of pipelines, of the loop and of the safety functions."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
from click.core import ParameterSource

from automodel import __version__
from automodel.assembly.parts import car_of
from automodel.cli.options import ABOVE_ZERO, FILE, PIPELINE, SWEEP, check_outputs, finite
from automodel.config import PIPELINE_NAMES, CarConfig, ConfigError
from automodel.config.parts import PAIR_PIPELINES
from automodel.console.messages import say
from automodel.console.tables import show, show_tables
from automodel.perception.markings.unet import BIRDSEYE, SIZES
from automodel.sim.random_worlds import KINDS
from automodel.sim.trajectory import STYLES

if TYPE_CHECKING:
    from automodel.console.workers import Sweep

CIRCUITS = ("monza", "lights", "odometries", "stretches", "full")  # options for --table centerline-paper alone
ROADS = ["street" if kind == "circuit" else kind for kind in KINDS]  # of bench guess
WORLDS = ("kinds", "frames", "worst")  # options for --world random alone
REFUSED = {  # by --table: the options that would choose other drives
    None: (),
    "windows-paper": ("pipelines", "tracks", "styles", "seeds", "direction", "plot"),
    "centerline-paper": ("seeds", "look", "direction", "speed_mps"),
}

CAR = click.option("--car", "car_file", type=FILE, help="car.toml (default: the simulated car).")
SEVERAL = click.option("--pipeline", "pipelines", multiple=True, type=PIPELINE, help="Default: all.")
JSON = click.option("--json", "as_json", is_flag=True, help="Results as JSON on stdout.")
CSV = click.option("--csv", "csv_file", type=FILE, help="Results as CSV, with commit, seed and machine.")
FIRST_SEED = click.option(
    "--seed", "first_seed", type=click.IntRange(0), default=0, show_default=True, help="The first seed."
)


@click.group("bench")
def command() -> None:
    """Measure a pipeline; all results are available as JSON."""


@command.command("accuracy")
@CAR
@SEVERAL
@click.option("--track", "tracks", multiple=True, help="Name or file.  [default: tmr, oval, chicane]")
@click.option("--style", "styles", multiple=True, type=click.Choice(STYLES), help="Driving style.  [default: all]")
@click.option(
    "--seeds", type=click.IntRange(1), default=1, show_default=True, help="How many seeds of light and noise."
)
@FIRST_SEED
@click.option("--look", type=click.Choice(["clean", "competition", "varied"]), default="competition",
              show_default=True, help="Floor and light.")  # fmt: skip
@click.option("--direction", type=click.Choice(["forward", "reverse"]), default="forward", show_default=True)
@click.option("--speed", "speed_mps", type=ABOVE_ZERO, callback=finite, default=1.0, show_default=True)
@click.option("--table", type=click.Choice([name for name in REFUSED if name]),
              help="The tables of a pipeline's paper instead, on its tracks.")  # fmt: skip
@click.option("--monza", type=FILE, help="centerline-paper: Monza.csv.  [default: in $AUTOMODEL_DATA/racetracks]")
@click.option("--light", "lights", multiple=True, type=click.Choice(["dry", "wet"]), help="centerline-paper.  [all]")
@click.option("--odometry", "odometries", multiple=True, type=click.Choice(["encoder", "command", "none"]),
              help="centerline-paper: where the car's motion comes from.  [encoder]")  # fmt: skip
@click.option("--stretches", type=click.IntRange(1), default=6, show_default=True, help="centerline-paper: a drive.")
@click.option("--full", is_flag=True, help="centerline-paper: whole laps (20 minutes a drive on Monza).")
@click.option("--world", type=click.Choice(["random"]), help="Worlds that are drawn anew for each seed instead.")
@click.option("--kind", "kinds", multiple=True, type=click.Choice(list(KINDS)),
              help="--world random: of these kinds in turn.  [each seed's own]")  # fmt: skip
@click.option("--frames", type=click.IntRange(2), default=300, show_default=True, help="--world random: of each world.")
@click.option("--save-worst", "worst", type=FILE, metavar="DIR",
              help="--world random: the worst frame of each row, as PNG.")  # fmt: skip
@click.option("--plot", type=FILE, help="Estimate and truth over time, as PNG; --world random: errors over bounds.")
@SWEEP
@CSV
@JSON
def accuracy(
    car_file: Path | None,
    table: str | None,
    world: str | None,
    plot: Path | None,
    sweep: Sweep,
    csv_file: Path | None,
    as_json: bool,
    **chosen: Any,
) -> int:
    """Prescribed drives over tracks in several styles and lights: errors of heading and offset, availability.

    Example:

    automodel bench accuracy --world random --seeds 20 --pipeline windows
    """
    from automodel.bench import accuracy, centerline_paper, windows_paper

    check_outputs({"--plot": plot, "--csv": csv_file}, {"--car": car_file, "--monza": chosen["monza"]})
    car = car_of(car_file)
    if world is not None:
        _refuse(("table", "tracks", "styles", "look", "direction", "speed_mps", *CIRCUITS, "full"),
                "--world random has its own drives: leave out {}")  # fmt: skip
        return _random_worlds(car, plot, sweep, csv_file, as_json, **chosen)
    _refuse(WORLDS, "{} is for --world random alone")
    _refuse(REFUSED[table], "--table has its own drives: leave out {}")
    if table != "centerline-paper":
        _refuse(CIRCUITS, "{} is for --table centerline-paper alone")
    if chosen["full"]:
        _refuse(("stretches",), "--full drives whole laps: leave out {}")
        chosen["stretches"] = None
    seeds = range(chosen["first_seed"], chosen["first_seed"] + chosen["seeds"])
    names = ("pipelines", "tracks", "styles", "look", "direction", "speed_mps")
    choice = accuracy.Choice(seeds=seeds, **{name: chosen[name] for name in names})
    if table == "centerline-paper":
        circuits = centerline_paper.CircuitChoice(**{name: chosen[name] for name in CIRCUITS if name != "full"})
        tables = centerline_paper.measure(car, choice, circuits, sweep, plot)
        columns = {"rides": centerline_paper.COLUMNS}
    elif table == "windows-paper":
        tables, columns = windows_paper.measure(car, choice, sweep), {}
    else:
        rows = accuracy.measure(car, choice, sweep, plot)
        _write(csv_file, rows, choice.seeds[0])
        show("bench accuracy", rows, as_json, accuracy.COLUMNS)
        return 0
    _write(csv_file, [{"table": name, **row} for name, rows in tables.items() for row in rows], choice.seeds[0])
    show_tables("bench accuracy", tables, as_json, columns)
    return 0


def _write(csv_file: Path | None, rows: Sequence[Mapping[str, Any]], seed: int) -> None:
    """Write rows as CSV with what they were measured with; rows that have their own seed keep it."""
    if csv_file is None:
        return
    from automodel.bench.machine import described, this_machine
    from automodel.console.kept import commit
    from automodel.console.tables import write_csv

    origin = {"automodel": __version__, "commit": commit(), "machine": described(this_machine())}
    write_csv(csv_file, [{"seed": seed, **row, **origin} for row in rows])


def _random_worlds(
    car: CarConfig, plot: Path | None, sweep: Sweep, csv_file: Path | None, as_json: bool, **chosen: Any
) -> int:
    from automodel.bench.random_worlds import COLUMNS, WorldChoice, measure

    seeds = range(chosen["first_seed"], chosen["first_seed"] + chosen["seeds"])
    choice = WorldChoice(seeds=seeds, **{name: chosen[name] for name in ("pipelines", *WORLDS)})
    rows = measure(car, choice, sweep, plot)
    _write(csv_file, rows, seeds[0])
    show("bench accuracy", rows, as_json, COLUMNS)
    return 0


def _refuse(names: Iterable[str], why: str) -> None:
    """Refuse the first of these parameters that was given on the command line; `why` has a place for its option."""
    context = click.get_current_context()
    for name in names:
        if context.get_parameter_source(name) is not ParameterSource.DEFAULT:
            option = next(p.opts[0] for p in context.command.params if p.name == name)
            raise click.UsageError(why.format(option))


@command.command("sensitivity")
@CAR
@SEVERAL
@click.option("--only", multiple=True, metavar="PATTERN", help="Numbers whose path has this, such as windows.line_ or"
              " 'clothoid*walk'; may be given several times.  [all]")  # fmt: skip
@click.option("--seeds", type=click.IntRange(1), default=8, show_default=True, help="How many random worlds.")
@FIRST_SEED
@click.option("--frames", type=click.IntRange(2), default=90, show_default=True, help="Of each drive.")
@click.option("--list", "listed", is_flag=True, help="Name the numbers, and the pipelines that they are part of.")
@SWEEP
@CSV
@JSON
def sensitivity(
    car_file: Path | None,
    pipelines: tuple[str, ...],
    only: tuple[str, ...],
    seeds: int,
    first_seed: int,
    frames: int,
    listed: bool,
    sweep: Sweep,
    csv_file: Path | None,
    as_json: bool,
) -> int:
    """What each tuned number of the stages matters: moved by -50, -20, +20 and +50 %, over short and varied drives.

    Example:

    automodel bench sensitivity --list
    """
    from automodel.bench.sensitivity import COLUMNS, SensitivityChoice, measure
    from automodel.bench.sensitivity import listing as numbers

    choice = SensitivityChoice(
        only=only, pipelines=pipelines, seeds=range(first_seed, first_seed + seeds), frames=frames
    )
    if listed:
        show("bench sensitivity", numbers(choice), as_json, ("number", "value", "pipelines", "meaning"))
    else:
        check_outputs({"--csv": csv_file}, {"--car": car_file})
        rows = measure(car_of(car_file), choice, sweep)
        _write(csv_file, rows, first_seed)
        show("bench sensitivity", rows, as_json, COLUMNS)
    return 0


@command.command("speed")
@CAR
@SEVERAL
@click.option("--frames", type=click.IntRange(10), default=300, show_default=True)
@click.option("--threads", type=click.IntRange(1), default=1, show_default=True, help="Threads that OpenCV may use.")
@JSON
def speed(car_file: Path | None, pipelines: tuple[str, ...], frames: int, threads: int, as_json: bool) -> int:
    """Milliseconds a frame, by stage, on rendered frames of tmr.

    Example:

    automodel bench speed --pipeline contour --json
    """
    from automodel.bench.machine import described, this_machine
    from automodel.bench.speed import COLUMNS, measure

    rows, machine = measure(car_of(car_file), pipelines, frames, threads), this_machine()
    show("bench speed", rows, as_json, COLUMNS, machine)
    if not as_json:
        say(described(machine))
    return 0


@command.command("network")
@click.option("--model", type=FILE, help="An ONNX file.  [default: the one that ships for the size]")
@click.option("--size", type=click.Choice(list(SIZES)), default=BIRDSEYE, show_default=True,
              help="The picture that the network sees, or the road from above.")  # fmt: skip
@click.option("--images", type=click.IntRange(1), default=100, show_default=True, help="Drawn images of each class.")
@FIRST_SEED
@click.option("--root", type=FILE, help="Labelled highway images instead: a folder with label_data.json and clips/.")
@JSON
def network(model: Path | None, size: str, images: int, first_seed: int, root: Path | None, as_json: bool) -> int:
    """The network for markings on drawn images by class: thin, wide and horizontal lines, dark tape, lamps, blur.

    Shares 0..1 at a probability of one half: marks near a label, labels near a mark (3 px), and their F1. With --root:
    marks far from all labels, labelled rows and lanes with marks on them, in %.

    Example:

    automodel bench network --model trained/marking_birdseye.onnx
    """
    from automodel.bench import labelled_masks
    from automodel.perception.markings.unet import MarkingNetwork, UnetConfig
    from automodel.training.classes import COLUMNS, measure

    finder = MarkingNetwork(UnetConfig(model="" if model is None else str(model), size=size))
    if root is not None:
        show("bench network", [labelled_masks.measure(root, finder)], as_json, labelled_masks.COLUMNS)
    else:
        show("bench network", measure(finder, images, first_seed), as_json, COLUMNS)
    return 0


@command.command("latency")
@CAR
@click.option("--pipeline", type=PIPELINE, help="Which paper's pipeline finds the lane.")
@click.option("--link", type=click.Choice(["emulated", "avr"]), default="emulated", show_default=True,
              help="The board; avr is the firmware on a simulated ATmega328P (needs avr-gcc and simavr).")  # fmt: skip
@click.option("--frames", type=click.IntRange(10), default=300, show_default=True)
@click.option("--commands", type=click.IntRange(10), default=200, show_default=True)
@JSON
def latency(car_file: Path | None, pipeline: str | None, link: str, frames: int, commands: int, as_json: bool) -> int:
    """Milliseconds from a frame to its command on the wire, and from there to the servo's pulse.

    Example:

    automodel bench latency --pipeline contour
    """
    from automodel.assembly.simulated_car import has_our_firmware
    from automodel.bench.latency import COLUMNS, measure
    from automodel.bench.machine import described, this_machine

    car = car_of(car_file, pipeline)
    if not has_our_firmware(car):
        raise ConfigError(f"{car_file}: [link] kind {car.link.kind!r}: only a board with our firmware can be measured")
    rows, machine = measure(car, link, frames, commands), this_machine()
    show("bench latency", rows, as_json, COLUMNS, machine)
    if not as_json:
        say(described(machine))
    return 0


@command.command("page")
@CAR
@click.option("--pipeline", type=PIPELINE, help="Which paper's pipeline finds the lane.")
@click.option("--duration", "duration_s", type=click.IntRange(10), default=60, show_default=True,
              help="Of each drive [s].")  # fmt: skip
@click.option("--rounds", type=click.IntRange(0), default=3, show_default=True,
              help="Drives without and with the page; 0: one with it.")  # fmt: skip
@click.option("--pages", type=click.IntRange(1, 8), default=4, show_default=True, help="How many are open.")
@click.option("--stops", type=click.IntRange(0), default=20, show_default=True, help="STOPs in a drive of their own.")
@JSON
def page(
    car_file: Path | None, pipeline: str | None, duration_s: int, rounds: int, pages: int, stops: int, as_json: bool
) -> int:
    """What the web page of a run costs the loop, how soon its STOP is on the wire, and whether memory grows.

    In real time, so that the machine should have nothing else to do.

    Example:

    automodel bench page --pipeline contour
    """
    from automodel.bench.machine import described, this_machine
    from automodel.config.extras import need_extra

    need_extra("bench page", "aiohttp")
    from automodel.bench.page import COLUMNS, measure

    car = car_of(car_file, pipeline)
    if car.camera.source != "sim" or car.link.port != "sim":
        raise ConfigError(f"{car_file}: names a real car; bench page drives the simulated one")
    rows, machine = measure(car, duration_s, rounds, pages, stops), this_machine()
    show("bench page", rows, as_json, COLUMNS, machine)
    if not as_json:
        say(described(machine))
    return 0


@command.command("tusimple")
@click.option("--root", type=FILE, required=True, help="Folder with label_data.json and clips/.")
@click.option("--car", "car_file", type=FILE, help="car.toml of the camera.  [default: found in the images]")
@SEVERAL
@click.option("--predictions", type=FILE, help="Write the lanes found here, in TuSimple's form (per pipeline).")
@click.option("--figures", type=FILE, help="Write the images with labels and predictions here, as PNG (per pipeline).")
@JSON
def tusimple(
    root: Path,
    car_file: Path | None,
    pipelines: tuple[str, ...],
    predictions: Path | None,
    figures: Path | None,
    as_json: bool,
) -> int:
    """Labelled highway images (TuSimple): its metric for the ego lines and for all, and the error of the middle.

    Example:

    automodel bench tusimple --root tusimple/test_set
    """
    from automodel.bench.tusimple import COLUMNS, LABELS, measure

    inputs = {"--car": car_file, "the labels": root / LABELS}
    check_outputs({"--predictions": predictions, "--figures": figures}, inputs)
    car = car_of(car_file) if car_file is not None else None
    show("bench tusimple", measure(root, car, pipelines, predictions, figures), as_json, COLUMNS)
    return 0


@command.command("contour-paper")
@CAR
@click.option("--track", default="chicane", show_default=True, help="Name or file of a track with bends.")
@click.option("--style", type=click.Choice(STYLES), default="centred", show_default=True, help="Driving style.")
@click.option("--law", "laws", multiple=True, type=click.Choice(["gauss_newton", "gradient_descent"]),
              help="Update law.  [default: both]")  # fmt: skip
@click.option("--seeds", type=click.IntRange(1), default=1, show_default=True, help="How many drives.")
@FIRST_SEED
@click.option("--speed", "speed_mps", type=ABOVE_ZERO, callback=finite, default=2.0, show_default=True)
@click.option("--seconds", type=ABOVE_ZERO, callback=finite, help="Of each drive.  [default: a lap]")
@click.option("--figure", type=FILE, help="The results over the frame rate, as PNG.")
@SWEEP
@CSV
@JSON
def contour_paper(
    car_file: Path | None,
    seeds: int,
    first_seed: int,
    figure: Path | None,
    sweep: Sweep,
    csv_file: Path | None,
    as_json: bool,
    **drive: Any,
) -> int:
    """What knowing the speed is worth to `contour` in bends: right, wrong by 20 % and unknown, at 5 to 60 frames/s.

    Example:

    automodel bench contour-paper
    """
    from automodel.bench.contour_paper import COLUMNS, LAWS, ClaimDrive, measure

    check_outputs({"--figure": figure, "--csv": csv_file}, {"--car": car_file})
    drive["laws"] = tuple(dict.fromkeys(drive["laws"])) or LAWS
    drives = [ClaimDrive(seed=seed, **drive) for seed in range(first_seed, first_seed + seeds)]
    rows = measure(car_of(car_file), drives, sweep, figure)
    _write(csv_file, rows, first_seed)
    show("bench contour-paper", rows, as_json, COLUMNS)
    return 0


@command.command("stereo-paper")
@SEVERAL
@click.option("--light", "lights", multiple=True, type=click.Choice(["day", "night"]), help="[default: both]")
@click.option("--bounce", "bounces", multiple=True, type=click.FloatRange(0.0, 2.0), callback=finite,
              help="Pitch of the car on its springs, in degrees either way.  [default: 0 and 1]")  # fmt: skip
@click.option("--sway", "sway_deg", type=click.FloatRange(0.0, 2.0), callback=finite, default=0.0, show_default=True,
              help="Roll of the car on its springs, in degrees either way, and 2 cm of heave for each.")  # fmt: skip
@click.option("--hills/--flat", default=None, help="Slopes and vertical curves.  [default: flat, and hills by day]")
@click.option("--traffic/--empty", "in_traffic", default=None,
              help="Other vehicles, which hide lines.  [default: none, and some by day]")  # fmt: skip
@click.option("--seconds", type=click.FloatRange(1.0, 25.0), callback=finite, default=25.0, show_default=True)
@click.option("--seed", type=click.IntRange(0), default=0, show_default=True, help="Of floor, noise and odometry.")
@SWEEP
@CSV
@JSON
def stereo_paper(
    pipelines: tuple[str, ...],
    lights: tuple[str, ...],
    bounces: tuple[float, ...],
    sway_deg: float,
    hills: bool | None,
    in_traffic: bool | None,
    seconds: float,
    seed: int,
    sweep: Sweep,
    csv_file: Path | None,
    as_json: bool,
) -> int:
    """The highway sequence of the paper behind `stereo`, simulated: its figures, ours, and the monocular pipelines'.

    Example:

    automodel bench stereo-paper --light day --pipeline stereo
    """
    from automodel.bench.stereo_paper import BOUNCES_DEG, COLUMNS, LIGHTS, Ride, measure

    check_outputs({"--csv": csv_file}, {})
    names = pipelines or (*PAIR_PIPELINES, *PIPELINE_NAMES)
    ride = Ride(
        light="day",
        bounce_deg=0.0,
        sway_deg=sway_deg,
        hills=bool(hills),
        traffic=bool(in_traffic),
        pipelines=names,
        seed=seed,
        seconds=seconds,
    )
    rides = [
        dataclasses.replace(ride, light=light, bounce_deg=bounce)
        for light in lights or LIGHTS
        for bounce in bounces or BOUNCES_DEG
    ]
    if not (lights or bounces) and hills is None and in_traffic is None:
        rides += [dataclasses.replace(ride, hills=True), dataclasses.replace(ride, traffic=True)]
    rows = measure(rides, sweep)
    _write(csv_file, rows, seed)
    show("bench stereo-paper", rows, as_json, COLUMNS)
    return 0


@command.command("stereo-calibration")
@click.option("--seeds", type=click.IntRange(1), default=10, show_default=True, help="How many rigs and drives.")
@FIRST_SEED
@click.option("--road", type=click.Choice(["highway", "straight"]), default="highway", show_default=True)
@click.option("--bounce", "bounce_deg", type=click.FloatRange(0.0, 2.0), callback=finite, default=0.0,
              show_default=True, help="Pitch of the car on its springs, in degrees either way.")  # fmt: skip
@SWEEP
@CSV
@JSON
def stereo_calibration(
    seeds: int,
    first_seed: int,
    road: str,
    bounce_deg: float,
    sweep: Sweep,
    csv_file: Path | None,
    as_json: bool,
) -> int:
    """What calibrate stereo --from-lanes finds of random cameras in mirrors: errors beside those that it states.

    Example:

    automodel bench stereo-calibration --seeds 10 --bounce 1
    """
    from automodel.bench.stereo_calibration import COLUMNS, SUMMARY, RigDrive, measure

    check_outputs({"--csv": csv_file}, {})
    seeds_of = range(first_seed, first_seed + seeds)
    tables = measure([RigDrive(seed=seed, road=road, bounce_deg=bounce_deg) for seed in seeds_of], sweep)
    _write(csv_file, tables["drives"], first_seed)
    show_tables("bench stereo-calibration", tables, as_json, {"drives": COLUMNS, "all": SUMMARY})
    return 0


@command.command("lane-changes")
@click.option("--changes", type=click.IntRange(0), default=100, show_default=True, help="Lane changes, at least.")
@click.option("--minutes", type=click.FloatRange(0.0), callback=finite, default=10.0, show_default=True,
              help="Of weaving without a change, at least.")  # fmt: skip
@FIRST_SEED
@SWEEP
@CSV
@JSON
def lane_changes(
    changes: int, minutes: float, first_seed: int, sweep: Sweep, csv_file: Path | None, as_json: bool
) -> int:
    """Whether `stereo` takes each of many lane changes once, and none while the car weaves, on rendered images.

    Exit code 1 where one was missed or false. Example:

    automodel bench lane-changes --changes 20 --minutes 2
    """
    from automodel.bench.lane_changes import COLUMNS, SUMMARY, cases_of, measure

    check_outputs({"--csv": csv_file}, {})
    tables = measure(cases_of(changes, minutes, first_seed), sweep)
    _write(csv_file, tables["drives"], first_seed)
    show_tables("bench lane-changes", tables, as_json, {"drives": COLUMNS, "all": SUMMARY})
    return int(any(row["missed"] or row["false"] for row in tables["all"]))


@command.command("cluster")
@click.option("--cases", type=click.IntRange(4), default=200, show_default=True, help="Drives, of a seed each.")
@click.option("--frames", type=click.IntRange(2), default=10, show_default=True, help="Of each drive.")
@JSON
def cluster(cases: int, frames: int, as_json: bool) -> int:
    """A sweep in one process, in two, and on two Dask workers one of which is killed: equal results, overhead a case.

    Exit code 1 where the results differ. Example:

    automodel bench cluster --cases 200
    """
    from automodel.bench.cluster import COLUMNS, ClusterChoice, measure

    rows = measure(ClusterChoice(cases=cases, frames=frames))
    show("bench cluster", rows, as_json, COLUMNS)
    return 0 if all(row["equal"] and not row["lost"] for row in rows) else 1


@command.command("guess")
@click.option("--lens", type=click.Choice(["given", "unknown"]), default="given", show_default=True,
              help="Whether the camera's field of view is given, as by replay --view-deg.")  # fmt: skip
@click.option("--seeds", type=click.IntRange(1), default=20, show_default=True, help="How many worlds and cameras.")
@FIRST_SEED
@click.option("--kind", "kinds", multiple=True, type=click.Choice(ROADS), help="Of these kinds.  [each seed's own]")
@SWEEP
@CSV
@JSON
def guess(
    lens: str,
    seeds: int,
    first_seed: int,
    kinds: tuple[str, ...],
    sweep: Sweep,
    csv_file: Path | None,
    as_json: bool,
) -> int:
    """What replay --guess finds of random cameras on drawn drives: errors of pitch and height, refusals.

    Example:

    automodel bench guess --seeds 20 --lens unknown
    """
    from automodel.bench.guess import COLUMNS, SUMMARY, GuessChoice, measure

    check_outputs({"--csv": csv_file}, {})
    choice = GuessChoice(seeds=range(first_seed, first_seed + seeds), kinds=kinds, lens=lens)
    tables = measure(CarConfig(), choice, sweep)
    _write(csv_file, tables["worlds"], first_seed)
    show_tables("bench guess", tables, as_json, {"worlds": COLUMNS, "all": SUMMARY})
    return 0


@command.command("faults")
@click.option("--only", "names", multiple=True, metavar="FAULT", help="This one; may be given several times.  [all]")
@click.option("--runs", type=click.IntRange(1), default=300, show_default=True, help="In all, shared out evenly.")
@click.option("--seed", type=click.IntRange(0), default=0, show_default=True)
@click.option("--pipeline", type=click.Choice([*PIPELINE_NAMES, *PAIR_PIPELINES, "truth"]), default="windows",
              show_default=True, help="What finds the lane; truth reads it from the simulator.")  # fmt: skip
@click.option("--link", type=click.Choice(["arduino", "avr", "can"]), default="arduino", show_default=True,
              help="The emulated board; the firmware on a simulated chip; the full-size car's CAN bus.")  # fmt: skip
@click.option("--real-time", is_flag=True, help="automodel run in a process of its own, by the real clock.")
@SWEEP
@CSV
@click.option("--list", "listed", is_flag=True, help="Name the faults, and what the car must do.")
@JSON
def faults(
    names: tuple[str, ...],
    runs: int,
    seed: int,
    pipeline: str,
    link: str,
    real_time: bool,
    sweep: Sweep,
    csv_file: Path | None,
    listed: bool,
    as_json: bool,
) -> int:
    """Faults of every part, built into runs of the simulated car at random times: does it stop, and only then?

    On virtual time, where the same seed gives the same results, but with --real-time. Exit code 1 where the car did not
    do what it must.

    Example:

    automodel bench faults --runs 73 --pipeline contour
    """
    if listed:
        from automodel.bench.faults.catalogue import listing

        show("bench faults", listing(names, real_time), as_json, ("fault", "kind", "must", "what"))
        return 0
    from automodel.bench.faults.measure import COLUMNS, TRUTH, measure

    check_outputs({"--csv": csv_file}, {})
    columns: tuple[str, ...] = COLUMNS
    if real_time:
        from automodel.bench.faults.real_time import REAL_COLUMNS, measure_real

        if pipeline == TRUTH or link != "arduino":
            raise ConfigError("--real-time: drives a pipeline that looks at images, with the emulated board")
        rows, columns = measure_real(names, runs, seed, pipeline, sweep), REAL_COLUMNS
    else:
        rows = measure(names, runs, seed, pipeline, sweep, link)
    _write(csv_file, rows, seed)
    show("bench faults", rows, as_json, columns)
    return 1 if any(row["violations"] for row in rows) else 0

"""The figures of seed 001 (Cudrano et al. 2020), section VI, Table I, beside ours under the conditions that it names.

How far they can be compared:

- The paper's truth is an RTK GPS and a mapped centerline, whose heading errors are of about the size that it reports;
  ours is exact.
- The paper drove four rides of whole laps, some dry and some in rain, and does not say which. Here each ride is driven
  in both, and both stand beside the same figure of the paper.
- Its track A (Lainate, 1.5 km) is not public: `tracks/circuit.toml` has its length, its kinds of bends and its widths.
  Track B is Monza.
- Its offset errors are 5 to 10 % of the lane's width, which it gives for both tracks together.

Drives two circuits at full scale for Table I of seed 001 (`bench accuracy --table centerline-paper`).
"""

from __future__ import annotations

import functools
import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from automodel.assembly.parts import make_pipeline
from automodel.assembly.simulated_car import renderer
from automodel.bench.accuracy import AccuracyMeter, TruePose
from automodel.config import (
    CameraConfig,
    CarConfig,
    ConfigError,
    Extrinsics,
    Intrinsics,
    LaneConfig,
    PipelineConfig,
    VehicleConfig,
)
from automodel.console.messages import say
from automodel.console.progress import progress
from automodel.console.tables import show
from automodel.console.workers import spread
from automodel.signals import Frame, Motion, MotionSource
from automodel.sim.appearance import Appearance
from automodel.sim.track import Track
from automodel.sim.track_files import load_track, read_racetrack
from automodel.sim.track_sections import BrokenLines, RoadsideSection
from automodel.sim.trajectory import STYLES, CircuitDrive, CommandedMotion, DrivenPose, Odometer, pick_stretches
from automodel.sim.truth import TruthFollower
from automodel.types import FloatArray

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


COMMAND = "bench accuracy"
TRACK_A = "circuit"
MONZA = Path("racetracks") / "Monza.csv"
MONZA_KERBS = RoadsideSection(kerb_radius_m=60.0)
STRETCH_M = 150.0
STRETCH_S = 10.0  # of a stretch at most: the oscillating drives are slow
RUN_IN_S = 1.0  # before each stretch: the pipeline has just been reset, and finds the lane
COLUMNS = (
    "track", "style", "light", "pipeline", "odometry", "frames", "heading_mae_deg", "paper_heading_mae_deg",
    "offset_mae_m", "paper_offset_mae_m", "offset_mae_pct", "availability_pct", "paper_availability_pct",
    "false_lane_pct",
)  # fmt: skip
Seer = tuple[str, str]  # pipeline, odometry


@dataclass(frozen=True, slots=True, kw_only=True)
class Ride:
    """One of the table's drives: the track's letter and file, style and light, and how much of the lap is driven."""

    letter: str
    file: str
    style: str
    light: str
    seed: int
    stretches: int | None  # None: the whole lap

    def draw(self, index: int) -> int:
        """The seed of what changes from stretch to stretch; dry and wet have the same."""
        key = (self.seed, index, ord(self.letter), STYLES.index(self.style))
        return int(np.random.default_rng(key).integers(1 << 31))


@functools.lru_cache(maxsize=2)
def circuit(file: str, seed: int) -> Track:
    """A track with kerbs and broken lines, with which the shipped one comes and others are given."""
    if file == TRACK_A:
        return load_track(file)
    return read_racetrack(file, BrokenLines(seed=seed), MONZA_KERBS)


def times(way: CircuitDrive, ride: Ride) -> Iterator[tuple[float, float]]:
    """Begin and end [s] of each stretch that is driven."""
    if ride.stretches is None:
        yield 0.0, way.lap_s
        return
    for middle_m in pick_stretches(way.lane, ride.stretches, STRETCH_M, ride.seed):
        before, middle, after = (way.time_at(middle_m + d) for d in (-0.5 * STRETCH_M, 0.0, 0.5 * STRETCH_M))
        before, after = before - way.lap_s * (before > middle), after + way.lap_s * (after < middle)
        yield max(before, middle - 0.5 * STRETCH_S), min(after, middle + 0.5 * STRETCH_S)


def believed(way: CircuitDrive, car: CarConfig, odometry: str, seed: int, t_s: FloatArray) -> Iterator[Motion]:
    """What the car believes of its motion at times (n,), each over the way since the frame before."""
    between = t_s - 0.5 / car.camera.rate_hz
    t_ns = [round(frame * 1e9 / car.camera.rate_hz) for frame in range(len(t_s))]
    if odometry == "encoder":
        yield from map(Odometer(seed).motion, way.poses(between), t_ns)
    elif odometry == "command":
        told = CommandedMotion(car.vehicle.wheelbase_m, seed)
        yield from map(told.motion, way.poses(between + told.LAG_S), t_ns)
    else:
        for t in t_ns:
            yield Motion(t_ns=t, speed_mps=0.0, yaw_rate_radps=0.0, source=MotionSource.NONE)


def drive(car: CarConfig, seers: Sequence[Seer], ride: Ride) -> list[AccuracyMeter]:
    """The estimates of every seer compared with the truth; all of them see the same pictures."""
    way = CircuitDrive(circuit(ride.file, ride.seed).lane(), ride.style, car.vehicle.width_m, ride.seed)
    follower = TruthFollower(way.lane, car.vehicle.reference_x_m)
    watching = [(make_pipeline(name, car), AccuracyMeter()) for name, _ in seers]
    for index, (begin_s, end_s) in enumerate(times(way, ride)):
        follower.reset()
        for pipeline, _ in watching:
            pipeline.reset()
        count = round((end_s - begin_s + RUN_IN_S) * car.camera.rate_hz)
        t_s = begin_s - RUN_IN_S + np.arange(count) / car.camera.rate_hz
        poses = way.poses(t_s)
        motions = zip(*(believed(way, car, name, ride.draw(index), t_s) for _, name in seers), strict=True)
        for frame, pose, told in zip(frames(car, ride, index, poses), poses, motions, strict=True):
            truth = follower.step(pose.x_m, pose.y_m, pose.yaw_rad)
            true = TruePose(offset_m=truth.offset_m, heading_rad=truth.heading_rad, width_m=truth.width_m)
            for (pipeline, meter), motion in zip(watching, told, strict=True):
                estimate = pipeline.step(frame, motion)
                if frame.index >= RUN_IN_S * car.camera.rate_hz:
                    meter.add(len(meter.t_s) / car.camera.rate_hz, estimate, true)
    return [meter for _, meter in watching]


def frames(car: CarConfig, ride: Ride, index: int, poses: Sequence[DrivenPose]) -> Iterator[Frame]:
    """The pictures of one stretch, in a light of its own."""
    camera = renderer(circuit(ride.file, ride.seed), car, Appearance.random(ride.draw(index), style=ride.light))
    for frame, pose in enumerate(poses):
        image = camera.render(pose.x_m, pose.y_m, pose.yaw_rad, pose.speed_mps, pose.yaw_rate_radps, frame)
        yield Frame(t_ns=round(frame * 1e9 / car.camera.rate_hz), index=frame, image=image)


@dataclass(frozen=True, slots=True, kw_only=True)
class Wanted:
    """Which drives of the table are made; an empty choice is all of them, `stretches` None whole laps."""

    tracks: tuple[str, ...] = ()
    styles: tuple[str, ...] = ()
    lights: tuple[str, ...] = ()
    monza: Path | None = None
    stretches: int | None = 6
    seed: int = 0


def find_monza(given: Path | None) -> Path | None:
    """The centreline of Monza: as given, or where the data lies; None where it is not there."""
    if given is not None:
        return given
    root = Path(os.environ.get("AUTOMODEL_DATA") or Path("..") / "shared" / "data")
    return root / MONZA if (root / MONZA).is_file() else None


def rides(wanted: Wanted) -> list[Ride]:
    """The drives in the table's order; raises ConfigError where none is left."""
    files: dict[str, str] = {"A": TRACK_A}
    monza = find_monza(wanted.monza)
    if monza is not None:
        files["B"] = str(monza)
    elif wanted.tracks != ("A",):
        say(f"track B is left out: there is no {MONZA} in $AUTOMODEL_DATA or ../shared/data; give it with --monza FILE")
    chosen = [
        Ride(letter=a, file=files[a], style=style, light=light, seed=wanted.seed, stretches=wanted.stretches)
        for a, style in RIDES
        for light in wanted.lights or LIGHTS
        if a in files and a in (wanted.tracks or files) and style in (wanted.styles or STYLES)
    ]
    if not chosen:
        raise ConfigError("--table centerline-paper: no drive is left; choose other tracks or styles")
    return chosen


def show_tables(
    car: CarConfig, seers: Sequence[Seer], wanted: Wanted, jobs: int | None, plot: Path | None, as_json: bool
) -> None:
    """Drive, and print Table I; where there is more than one odometry, a second table says what it costs.

    Of `car` the pipeline's settings count. As JSON both tables are one list of rows, each with the name of its table.
    """
    car, chosen = full_scale_car(car.pipeline), rides(wanted)
    for name in {name for name, _ in seers}:
        make_pipeline(name, car)  # what it cannot work with is said before any work
    say_what(chosen)
    meters: list[list[AccuracyMeter]] = []
    jobs = min(jobs or os.cpu_count() or 1, len(chosen))
    with progress(COMMAND, len(chosen)) as bar:
        for found in spread(functools.partial(drive, car, tuple(seers)), chosen, jobs):
            meters.append(found)
            bar()
    pairs = [
        (ride, seer, meter)
        for ride, found in zip(chosen, meters, strict=True)
        for seer, meter in zip(seers, found, strict=True)
    ]
    rows = [ride_row((ride.letter, ride.style, ride.light), seer, meter) for ride, seer, meter in pairs]
    costs = cost_rows(rows) if len({odometry for _, odometry in seers}) > 1 else []
    if plot is not None:
        from automodel.viewer.plots import plot_accuracy

        names = [f"track {r.letter}, {r.style}, {r.light}, {name}, {odometry}" for r, (name, odometry), _ in pairs]
        plot_accuracy(plot, [(n, m.t_s, m.estimated, m.true) for n, (_, _, m) in zip(names, pairs, strict=True)])
    if as_json:
        tables = {"rides": rows, "odometry": costs}
        keys = dict.fromkeys(key for part in tables.values() for row in part for key in row)
        show(COMMAND, [{"table": name, **keys, **row} for name, part in tables.items() for row in part], True)
        return
    show(COMMAND, rows, False, COLUMNS)
    show(COMMAND, costs, False)


def say_what(chosen: Sequence[Ride]) -> None:
    """What is driven, and what the paper's figures are; raises ConfigError for a track that is none of a car's size."""
    for letter, file in dict.fromkeys((ride.letter, ride.file) for ride in chosen):
        lane = circuit(file, chosen[0].seed).lane()
        width = lane.width_m(np.arange(0.0, lane.centerline.length_m))
        if lane.centerline.length_m < 4.0 * STRETCH_M or width.min() < 5.0:
            raise ConfigError(
                f"{file}: {lane.centerline.length_m:.0f} m long and {width.min():.1f} m wide at its narrowest; a"
                f" circuit of {4.0 * STRETCH_M:.0f} m or more that is 5 m wide or more is wanted"
            )
        say(
            f"track {letter}: {Path(file).stem}, {lane.centerline.length_m:.0f} m, {width.min():.1f} to"
            f" {width.max():.1f} m wide"
        )
    count, way = chosen[0].stretches, "whole laps"
    if count is not None:
        way = f"{count} stretch{'es' * (count > 1)} a ride, the sharpest bends among them"
        way += f", each up to {STRETCH_M:.0f} m and {STRETCH_S:.0f} s"
    say(f"driven: {way}; the {RUN_IN_S:.0f} s before, from the pipeline's reset on, is not counted")
    low, high = PAPER_OFFSET_PCT
    say(f"the paper's offsets are wrong by {low:.0f} to {high:.0f} % of the lane's width; it drove four of these rides")

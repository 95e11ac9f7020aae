"""`bench accuracy --table centerline-paper`: Table I (section VI) of Cudrano et al. 2020, beside its own figures.

How far they can be compared:

- The paper's truth is an RTK GPS and a mapped centerline, whose heading errors are of about the size that it reports;
  ours is exact.
- The paper drove four rides of whole laps, some dry and some in rain, and does not say which. Here each ride is driven
  in both, and both stand beside the same figure of the paper.
- Its track A (Lainate, 1.5 km) is not public: `tracks/circuit.toml` has its length, its kinds of bends and its widths.
  Track B is Monza.
- Its offset errors are 5 to 10 % of the lane's width, which it gives for both tracks together.
"""

from __future__ import annotations

import functools
import itertools
import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from automodel.assembly.parts import make_pipeline
from automodel.assembly.simulated_car import renderer
from automodel.bench.accuracy import AccuracyMeter, Choice, Row
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
from automodel.console.workers import Sweep, Tick, spread
from automodel.signals import Frame, Motion, MotionSource
from automodel.sim.appearance import Appearance
from automodel.sim.track import Track
from automodel.sim.track_files import load_track, read_racetrack
from automodel.sim.track_sections import BrokenLines, RoadsideSection
from automodel.sim.trajectory import STYLES, CircuitDrive, CommandedMotion, DrivenPose, Odometer, pick_stretches
from automodel.sim.truth import TruthFollower
from automodel.types import FloatArray

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
METRICS = ("heading_mae_deg", "offset_mae_m", "availability_pct")
COLUMNS = (
    "track", "style", "light", "pipeline", "odometry", "heading_mae_deg", "paper_heading_mae_deg", "offset_mae_m",
    "paper_offset_mae_m", "availability_pct", "paper_availability_pct", "false_lane_pct", "misled_pct",
    "bound_exceeded_pct", "offset_mae_pct", "frames",
)  # fmt: skip
TRACK_A = "circuit"
MONZA = Path("racetracks") / "Monza.csv"
LETTERS = {"a": "A", "circuit": "A", "b": "B", "monza": "B"}  # what a user may call the tracks
MONZA_KERBS = RoadsideSection(kerb_radius_m=60.0)
STRETCH_M = 150.0
STRETCH_S = 10.0  # of a stretch at most: the oscillating drives are slow
RUN_IN_S = 1.0  # before each stretch: the pipeline has just been reset, and finds the lane

Seer = tuple[str, str]  # pipeline, odometry


def full_scale_car(pipeline: PipelineConfig) -> CarConfig:
    """The paper's conditions: a ZED's left image, 672 x 376 at 100 Hz, from behind the windscreen of a car.

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


def ride_row(ride: tuple[str, str, str], seer: Seer, meter: AccuracyMeter) -> Row:
    """A row of Table I: `ride` is (track, style, light); None where nothing is known.

    The paper does not give the tails of the distributions (99th percentiles).
    """
    track, style, light = ride
    metrics = meter.row()
    paper = PAPER.get((track, style), (None, None, None))
    row: Row = {"track": track, "style": style, "light": light, "pipeline": seer[0], "odometry": seer[1]}
    row["frames"] = metrics["frames"]
    for name, printed in zip(METRICS, paper, strict=True):
        row |= {name: metrics[name], f"paper_{name}": printed}
    return row | {name: value for name, value in metrics.items() if name not in row}


def cost_rows(rows: Sequence[Row]) -> list[Row]:
    """What other odometry costs: for each ride and pipeline the metrics of every odometry, side by side."""
    found: dict[tuple[object, ...], Row] = {}
    for row in rows:
        place = {name: row[name] for name in ("track", "style", "light", "pipeline")}
        found.setdefault(tuple(place.values()), place)
    for name in METRICS:  # metric by metric, so that what is compared stands together
        for row in rows:
            key = (row["track"], row["style"], row["light"], row["pipeline"])
            found[key][f"{row['odometry']}_{name}"] = row[name]
    return list(found.values())


@dataclass(frozen=True, slots=True, kw_only=True)
class Ride:
    """One of the table's drives: the track's letter and file, style and light, and how many stretches of the lap."""

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


def spans_s(drive: CircuitDrive, ride: Ride) -> Iterator[tuple[float, float]]:
    """Start and end [s] of each stretch that is driven."""
    if ride.stretches is None:
        yield 0.0, drive.lap_s
        return
    for middle_m in pick_stretches(drive.lane, ride.stretches, STRETCH_M, ride.seed):
        before, middle, after = (drive.time_at(middle_m + d) for d in (-0.5 * STRETCH_M, 0.0, 0.5 * STRETCH_M))
        before, after = before - drive.lap_s * (before > middle), after + drive.lap_s * (after < middle)
        yield max(before, middle - 0.5 * STRETCH_S), min(after, middle + 0.5 * STRETCH_S)


def motions(drive: CircuitDrive, car: CarConfig, odometry: str, seed: int, t_s: FloatArray) -> Iterator[Motion]:
    """The motion that the car has at times (n,) by this odometry, each over the distance since the frame before."""
    between = t_s - 0.5 / car.camera.rate_hz
    t_ns = [round(frame * 1e9 / car.camera.rate_hz) for frame in range(len(t_s))]
    if odometry == "encoder":
        yield from map(Odometer(seed).motion, drive.poses(between), t_ns)
    elif odometry == "command":
        commanded = CommandedMotion(car.vehicle.wheelbase_m, seed)
        yield from map(commanded.motion, drive.poses(between + commanded.LAG_S), t_ns)
    else:
        for t in t_ns:
            yield Motion(t_ns=t, speed_mps=0.0, yaw_rate_radps=0.0, source=MotionSource.NONE)


def measure_ride(car: CarConfig, seers: Sequence[Seer], ride: Ride, tick: Tick) -> list[AccuracyMeter]:
    """The estimates of every pipeline and odometry compared with the truth; all of them get the same frames."""
    drive = CircuitDrive(circuit(ride.file, ride.seed).lane(), ride.style, car.vehicle.width_m, ride.seed)
    follower = TruthFollower(drive.lane, car.vehicle.reference_x_m)
    measured = [(make_pipeline(name, car), AccuracyMeter()) for name, _ in seers]
    stretches = list(spans_s(drive, ride))
    for index, (start_s, end_s) in enumerate(stretches):
        follower.reset()
        for pipeline, _ in measured:
            pipeline.reset()
        count = round((end_s - start_s + RUN_IN_S) * car.camera.rate_hz)
        t_s = start_s - RUN_IN_S + np.arange(count) / car.camera.rate_hz
        poses = drive.poses(t_s)
        moved = zip(*(motions(drive, car, name, ride.draw(index), t_s) for _, name in seers), strict=True)
        for frame, pose, motion in zip(frames(car, ride, index, poses), poses, moved, strict=True):
            truth = follower.step(pose.x_m, pose.y_m, pose.yaw_rad)
            for (pipeline, meter), own_motion in zip(measured, motion, strict=True):
                estimate = pipeline.step(frame, own_motion)
                if frame.index >= RUN_IN_S * car.camera.rate_hz:
                    meter.add(len(meter.t_s) / car.camera.rate_hz, estimate, truth)
            tick(1.0 / (count * len(stretches)))
    return [meter for _, meter in measured]


def frames(car: CarConfig, ride: Ride, index: int, poses: Sequence[DrivenPose]) -> Iterator[Frame]:
    """The frames of one stretch, in a light of its own."""
    camera = renderer(circuit(ride.file, ride.seed), car, Appearance.random(ride.draw(index), style=ride.light))
    for frame, pose in enumerate(poses):
        image = camera.render(pose.x_m, pose.y_m, pose.yaw_rad, pose.speed_mps, pose.yaw_rate_radps, frame)
        yield Frame(t_ns=round(frame * 1e9 / car.camera.rate_hz), index=frame, image=image)


@dataclass(frozen=True, slots=True, kw_only=True)
class CircuitChoice:
    """What the table alone has to choose: lights and odometries (empty: all, and encoder), stretches a ride.

    `stretches` is None for whole laps, `monza` the file of Monza's centreline where it is not with the data.
    """

    lights: tuple[str, ...] = ()
    odometries: tuple[str, ...] = ()
    stretches: int | None = 6
    monza: Path | None = None


def find_monza(given: Path | None) -> Path | None:
    """The centreline of Monza: as given, or where the data lies; None where it is not there."""
    if given is not None:
        return given
    root = Path(os.environ.get("AUTOMODEL_DATA") or Path("..") / "shared" / "data")
    return root / MONZA if (root / MONZA).is_file() else None


def rides(choice: Choice, circuits: CircuitChoice) -> list[Ride]:
    """The drives in the table's order; raises ConfigError for another track, and where no drive is left."""
    tracks = [LETTERS.get(name.lower(), "") for name in choice.tracks]
    if "" in tracks:
        raise ConfigError(f"--track {choice.tracks[tracks.index('')]}: this table has circuit and Monza")
    files: dict[str, str] = {"A": TRACK_A}
    monza = find_monza(circuits.monza)
    if monza is not None:
        files["B"] = str(monza)
    elif set(tracks) != {"A"}:
        say(f"track B is left out: there is no {MONZA} in $AUTOMODEL_DATA or ../shared/data; give it with --monza FILE")
    chosen = [
        Ride(letter=a, file=files[a], style=style, light=light, seed=choice.seeds[0], stretches=circuits.stretches)
        for a, style in RIDES
        for light in circuits.lights or LIGHTS
        if a in files and a in (tracks or files) and style in (choice.styles or STYLES)
    ]
    if not chosen:
        raise ConfigError("--table centerline-paper: no drive is left; choose other tracks or styles")
    return chosen


def measure(
    car: CarConfig, choice: Choice, circuits: CircuitChoice, sweep: Sweep, plot: Path | None
) -> dict[str, list[Row]]:
    """Drive; gives the rows of Table I ("rides"), and where there are several odometries, what they cost ("odometry").

    Of `car` the pipeline's settings count, of `choice` pipelines (default: the car's), tracks, styles and first seed.
    """
    pipelines, odometries = choice.pipelines or (car.pipeline.name,), circuits.odometries or ODOMETRIES[:1]
    seers = list(itertools.product(dict.fromkeys(pipelines), dict.fromkeys(odometries)))
    car, chosen = full_scale_car(car.pipeline), rides(choice, circuits)
    for name in pipelines:
        make_pipeline(name, car)  # raises for what it cannot work with before any work
    say_what(chosen)
    found = [
        (ride, seer, meter)
        for ride, of_ride in spread("bench accuracy", functools.partial(measure_ride, car, seers), chosen, sweep)
        for seer, meter in zip(seers, of_ride, strict=True)
    ]
    rows = [ride_row((ride.letter, ride.style, ride.light), seer, meter) for ride, seer, meter in found]
    if plot is not None:
        from automodel.viewer.plots import plot_accuracy

        names = [f"track {r.letter}, {r.style}, {r.light}, {name}, {odometry}" for r, (name, odometry), _ in found]
        plot_accuracy(plot, [(n, m.t_s, m.estimated, m.true) for n, (_, _, m) in zip(names, found, strict=True)])
    return {"rides": rows, "odometry": cost_rows(rows) if len(set(odometries)) > 1 else []}


def say_what(chosen: Sequence[Ride]) -> None:
    """Say what is driven; raises ConfigError for a track that is too small for a full-size car."""
    for letter, file in dict.fromkeys((ride.letter, ride.file) for ride in chosen):
        lane = circuit(file, chosen[0].seed).lane()
        width, length_m = lane.width_m(np.arange(0.0, lane.centerline.length_m)), lane.centerline.length_m
        if length_m < 4.0 * STRETCH_M or width.min() < 5.0:
            raise ConfigError(
                f"{file}: expected a circuit of at least {4.0 * STRETCH_M:.0f} m, 5 m wide or wider; got"
                f" {length_m:.0f} m, {width.min():.1f} m wide at its narrowest"
            )
        say(f"track {letter}: {Path(file).stem}, {length_m:.0f} m, {width.min():.1f} to {width.max():.1f} m wide")
    count, driven = chosen[0].stretches, "whole laps"
    if count is not None:
        driven = f"{count} stretch{'es' * (count > 1)} a ride, the sharpest bends among them"
        driven += f", each up to {STRETCH_M:.0f} m and {STRETCH_S:.0f} s"
    say(f"driven: {driven}; the {RUN_IN_S:.0f} s before, from the pipeline's reset on, is not counted")
    low, high = PAPER_OFFSET_PCT
    say(f"the paper's offset errors are {low:.0f} to {high:.0f} % of the lane's width; it drove four of these rides")

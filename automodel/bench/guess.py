"""`bench guess`: `replay --guess` on drawn drives whose camera is known, a camera of its own in every world.

Each seed has a random world (`sim.random_worlds`) and a random camera, and `IMAGES` images of a drive in it. The lane's
width is always given, as it scales everything: the median of the true widths at the images. `lens="given"` gives the
field of view as well; with "unknown" it has to be guessed, and pitch and heading are in proportion to it.

A row is right where pitch and height are within `PITCH_DEG` and `HEIGHT_PCT`, and refused where no car.toml was
written. It is misled where it is wrong by more than `SURE` of its own sigmas: then it is wrong and says that it is not.
"""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from automodel.assembly.simulated_car import renderer
from automodel.bench.accuracy import Row
from automodel.bench.centerline_paper import full_scale_car
from automodel.bench.random_worlds import build_world
from automodel.config import CameraConfig, CarConfig, Extrinsics, Intrinsics, LaneConfig
from automodel.console.workers import Sweep, Tick, spread
from automodel.sim.random_worlds import RandomWorld, kind_of, random_world
from automodel.sim.truth import TruthFollower
from automodel.types import Image
from calibration.guess import STREET_M, GuessedCar, guess_car

IMAGES, RATE_HZ = 40, 2.0  # 20 s of a drive; replay looks at 40 to 80 images
PITCH_DEG, HEIGHT_PCT = 0.5, 5.0
SURE = 3.0  # sigmas
STREET = "street"  # instead of a race circuit, whose lanes are wider than any camera of a car was meant for
COLUMNS = (
    "seed", "result", "pitch_error_deg", "pitch_sigma_deg", "height_error_pct", "height_sigma_pct", "yaw_error_deg",
    "roll_error_deg", "view_deg", "pitch_deg", "height_lanes", "refusal", "world",
)  # fmt: skip
SUMMARY = ("lens", "worlds", "refused", "answered", "right", "right_pct", "misled", "pitch_mae_deg", "height_mae_pct")


@dataclass(frozen=True, slots=True, kw_only=True)
class GuessChoice:
    """Which worlds, of which kinds (each seed's own where there are none), and whether the lens is given."""

    seeds: range = range(20)
    kinds: tuple[str, ...] = ()
    lens: str = "given"

    def cases(self) -> list[tuple[int, str]]:
        """Seed and kind of each world."""
        kinds = [self.kinds[seed % len(self.kinds)] if self.kinds else kind_of(seed) for seed in self.seeds]
        return [(seed, STREET if kind == "circuit" else kind) for seed, kind in zip(self.seeds, kinds, strict=True)]


def _world(car: CarConfig, seed: int, kind: str) -> RandomWorld:
    """The world of a seed; a street is a plain road of a street's lanes, with a full-size car."""
    if kind != STREET:
        return build_world(car, seed, kind)
    full = full_scale_car(car.pipeline)
    return random_world(
        seed, "plain", dataclasses.replace(full, lane=LaneConfig(width_m=STREET_M, marking_width_m=0.12))
    )


def random_camera(seed: int, lane_width_m: float, street: bool) -> CameraConfig:
    """A camera as cars and car kits have it, of the field of view of usual cameras.

    A full-size car on a `street` has it behind the windscreen, looking nearly ahead; a scale car on a mast, looking
    down.
    """
    rng = np.random.default_rng((seed, 0x6775))
    width, height = ((640, 360), (640, 480), (480, 270))[int(rng.integers(3))]
    focal_px = 0.5 * width / math.tan(0.5 * math.radians(rng.uniform(50.0, 80.0)))
    k1 = 0.0 if rng.uniform() < 0.5 else rng.uniform(-0.3, 0.0)
    lens = Intrinsics(
        fx_px=focal_px,
        fy_px=focal_px,
        cx_px=0.5 * (width - 1),
        cy_px=0.5 * (height - 1),
        distortion=(k1, 0.0, 0.0, 0.0, 0.0),
    )
    place = Extrinsics(
        x_m=0.5 * lane_width_m,
        y_m=0.0,
        z_m=lane_width_m * (rng.uniform(0.3, 0.45) if street else rng.uniform(0.35, 0.8)),
        pitch_rad=math.radians(rng.uniform(1.0, 9.0) if street else rng.uniform(6.0, 25.0)),
        yaw_rad=math.radians(rng.uniform(-2.0, 2.0)),
        roll_rad=math.radians(rng.uniform(-2.0, 2.0)),
    )
    return CameraConfig(width_px=width, height_px=height, intrinsics=lens, extrinsics=place)


def filmed_drive(world: RandomWorld, tick: Tick) -> tuple[list[Image], float]:
    """The images of a drive in the world, and the median width [m] of the lane in which they were taken."""
    nod_max_rad = 0.0 if world.nod is None else world.nod.amplitude_rad
    eye = renderer(world.track, world.car, world.look, nod_max_rad)
    follower = TruthFollower(world.lane, world.car.vehicle.reference_x_m, world.start_s_m)
    t_s = np.arange(IMAGES) / RATE_HZ
    images, widths_m = [], []
    for index, (t, pose) in enumerate(zip(t_s.tolist(), world.poses(t_s), strict=True)):
        nod_rad = world.nod_rad(t)
        images.append(eye.render(pose.x_m, pose.y_m, pose.yaw_rad, pose.speed_mps, pose.yaw_rate_radps, index, nod_rad))
        widths_m.append(follower.step(pose.x_m, pose.y_m, pose.yaw_rad).width_m)
        tick(0.5 / IMAGES)
    return images, float(np.median(widths_m))


def measure_world(car: CarConfig, choice: GuessChoice, case: tuple[int, str], tick: Tick) -> Row:
    """The row of one world."""
    seed, kind = case
    plain = _world(car, seed, kind)
    camera = random_camera(seed, plain.car.lane.width_m, kind == STREET)
    camera = dataclasses.replace(camera, rate_hz=plain.car.camera.rate_hz)
    world = dataclasses.replace(plain, car=dataclasses.replace(plain.car, camera=camera))
    images, width_m = filmed_drive(world, tick)
    view_rad = 2.0 * math.atan(0.5 * camera.width_px / camera.intrinsics.fx_px)
    place = camera.extrinsics
    row: Row = dict.fromkeys(COLUMNS)
    row |= {"seed": seed, "view_deg": math.degrees(view_rad), "pitch_deg": math.degrees(place.pitch_rad)}
    row |= {"height_lanes": place.z_m / width_m, "world": f"{kind} {world.style}" + " nod" * (world.nod is not None)}
    try:
        guess = guess_car(images, RATE_HZ, width_m, view_rad if choice.lens == "given" else None)
    except ValueError as error:
        row |= {"result": "refused", "refusal": str(error)}
    else:
        row |= _errors(guess, place)
    tick(0.5)
    return row


def _errors(guess: GuessedCar, true: Extrinsics) -> Row:
    """The errors of a guess with their sigmas, and what it is worth."""
    found, sigma = guess.car.camera.extrinsics, guess.sigma
    row: Row = {
        f"{name}_error_deg": math.degrees(getattr(found, f"{name}_rad") - getattr(true, f"{name}_rad"))
        for name in ("pitch", "yaw", "roll")
    }
    row["pitch_sigma_deg"] = math.degrees(sigma["pitch_rad"])
    row["height_error_pct"] = 100.0 * (found.z_m / true.z_m - 1.0)
    row["height_sigma_pct"] = 100.0 * sigma["z_m"] / found.z_m
    limits = (("pitch_error_deg", "pitch_sigma_deg", PITCH_DEG), ("height_error_pct", "height_sigma_pct", HEIGHT_PCT))
    wrong = [(abs(row[error]), row[own]) for error, own, most in limits if abs(row[error]) > most]
    sure = any(error > SURE * own for error, own in wrong)
    return row | {"result": "misled" if sure else "wrong" if wrong else "right"}


def measure(car: CarConfig, choice: GuessChoice, sweep: Sweep) -> dict[str, list[Row]]:
    """The tables "worlds", a row each, and "all". Of `car` only the pipeline's settings count."""
    work = functools.partial(measure_world, car, choice)
    rows = [row for _, row in spread("bench guess", work, choice.cases(), sweep)]
    return {"worlds": rows, "all": [summary(rows, choice.lens)] if rows else []}


def summary(rows: Sequence[Row], lens: str) -> Row:
    """How many guesses are right, over all worlds that were not refused; None where none was answered."""
    answered = [row for row in rows if row["result"] != "refused"]
    right = [row for row in answered if row["result"] == "right"]
    row: Row = {"lens": lens, "worlds": len(rows), "refused": len(rows) - len(answered), "answered": len(answered)}
    row |= {"right": len(right), "right_pct": 100.0 * len(right) / len(answered) if answered else None}
    row["misled"] = sum(row["result"] == "misled" for row in answered)
    for name, column in (("pitch_mae_deg", "pitch_error_deg"), ("height_mae_pct", "height_error_pct")):
        row[name] = float(np.mean([abs(each[column]) for each in answered])) if answered else None
    return row

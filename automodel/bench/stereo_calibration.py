"""`bench stereo-calibration`: `calibrate stereo --from-lanes` on simulated drives, whose right camera is known.

Each seed has cameras of its own in a full-size car's mirrors, neither parallel nor alike, about 2 m apart, and drives
`SECONDS` of the highway of `sim.highway`. car.toml's place of the right camera is wrong by `START_RAD` in each angle
and `START_M` in each coordinate, with random signs; its lens is wrong as a calibrated lens is. The left camera is
exact, as the calibration takes it to be. On the road "straight" the car drives straight on between two solid lines.

A row's z is an error in its own stated sigmas. The simulator pitches each camera about its own centre.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from automodel.assembly.simulated_car import renderers
from automodel.bench.accuracy import Row
from automodel.bench.stereo_paper import LIGHTS, RATE_HZ, SPEED_MPS, mirror_car
from automodel.config import CarConfig, Extrinsics, Intrinsics
from automodel.console.workers import Sweep, Tick, spread
from automodel.geometry import CameraModel
from automodel.signals import Motion
from automodel.sim.highway import Highway, HighwayDrive, LaneChange
from automodel.sim.random_worlds import Nod
from automodel.sim.trajectory import Odometer
from automodel.types import Image
from calibration.ground import NAMES
from calibration.lane_sights import Drive
from calibration.stereo_lanes import LENS_FOCAL, LENS_PX, calibrate_stereo_from_lanes
from calibration.views import CalibrationError

SECONDS = 25.0
START_RAD, START_M = math.radians(2.0), 0.05
ROADS = ("highway", "straight")
ERRORS = tuple(f"{name[:-2]}_mm" if name.endswith("_m") else f"{name[:-4]}_deg" for name in NAMES)
COLUMNS = (
    "seed", "road", "pitching_deg", *ERRORS, "worst_z", "unknown", "refusal", "stretches", "line_px", "dash_end_px",
)  # fmt: skip
SUMMARY = (
    "number", "drives", "refused", "error_rms", "error_max", "sigma_mean", "z_rms", "beyond_2_sigma", "beyond_3_sigma",
)  # fmt: skip


@dataclass(frozen=True, slots=True, kw_only=True)
class RigDrive:
    """A drive with a random pair of cameras; `bounce_deg`: its pitch on its springs, either way."""

    seed: int
    road: str = "highway"
    bounce_deg: float = 0.0
    seconds: float = SECONDS


def random_rig(seed: int) -> tuple[CarConfig, Extrinsics, Intrinsics]:
    """A car with its true cameras, and what car.toml says of the right one: place and lens."""
    rng, car = np.random.default_rng((seed, 0x7269)), mirror_car()
    right = car.camera.right
    assert right is not None
    places, lenses = [], []
    for eye in car.camera.eyes:
        place = [getattr(eye.extrinsics, name) for name in NAMES]
        place += np.concatenate((rng.uniform(-0.05, 0.05, 3), np.radians(rng.uniform(-2.0, 2.0, 3))))
        places.append(Extrinsics(**dict(zip(NAMES, np.asarray(place).tolist(), strict=True))))
        focal_px = eye.intrinsics.fx_px * rng.uniform(0.9, 1.1)
        lenses.append(dataclasses.replace(eye.intrinsics, fx_px=focal_px, fy_px=focal_px))
    true = dataclasses.replace(right, extrinsics=places[1], intrinsics=lenses[1])
    camera = dataclasses.replace(car.camera, extrinsics=places[0], intrinsics=lenses[0], right=true)
    off = rng.choice((-1.0, 1.0), 6) * ([START_M] * 3 + [START_RAD] * 3)
    start = {name: getattr(places[1], name) + float(away) for name, away in zip(NAMES, off, strict=True)}
    share, u, v = rng.normal(0.0, (LENS_FOCAL, LENS_PX, LENS_PX)).tolist()
    told = dataclasses.replace(
        lenses[1],
        fx_px=lenses[1].fx_px * (1.0 + share),
        fy_px=lenses[1].fy_px * (1.0 + share),
        cx_px=lenses[1].cx_px + u,
        cy_px=lenses[1].cy_px + v,
    )
    return dataclasses.replace(car, camera=camera), Extrinsics(**start), told


def pairs_of(case: RigDrive, car: CarConfig) -> Iterator[tuple[Image, Image, Motion]]:
    """Both images of each moment of the drive, and the measured motion since the one before."""
    straight = case.road == "straight"
    highway = Highway(lanes=1, bend_per_m=1e-7) if straight else Highway()
    track, lanes = highway.build()
    changes = () if straight else (LaneChange(from_s=12.5),)
    path = HighwayDrive(lanes[0], SPEED_MPS, changes, wander_m=0.0 if straight else 0.15)
    nod = Nod(amplitude_rad=math.radians(case.bounce_deg), rate_hz=1.5, phase_rad=float(case.seed))
    look = dataclasses.replace(LIGHTS["day"], noise_seed=case.seed, floor_seed=case.seed, wear_seed=case.seed)
    eyes, odometer = renderers(track, car, look, nod.amplitude_rad), Odometer(case.seed)
    for index in range(round(min(case.seconds, path.lasts_s) * RATE_HZ)):
        t_s = index / RATE_HZ
        pose, nod_rad = path.pose(t_s), nod.at(t_s)
        place = pose.x_m, pose.y_m, pose.yaw_rad, pose.speed_mps, pose.yaw_rate_radps
        left, right = (eye.render(*place, index, nod_rad=nod_rad) for eye in eyes)
        yield left, right, odometer.motion(path.pose(max(t_s - 0.5 / RATE_HZ, 0.0)), round(t_s * 1e9))


def driven(case: RigDrive, car: CarConfig, tick: Tick) -> Drive:
    """The stretches of the drive."""
    drive = Drive(car.lane.width_m)
    for index, (left, right, motion) in enumerate(pairs_of(case, car)):
        drive.add(str(index), left, right, motion)
        tick(0.6 / (case.seconds * RATE_HZ))
    return drive


def measure_drive(case: RigDrive, tick: Tick) -> Row:
    """The row of one drive: errors of the right camera, and the largest of them in its stated sigma."""
    car, start, lens = random_rig(case.seed)
    drive = driven(case, car, tick)
    row: Row = {**dict.fromkeys(COLUMNS), "seed": case.seed, "road": case.road, "pitching_deg": case.bounce_deg}
    right = car.camera.right
    assert right is not None
    try:
        found = calibrate_stereo_from_lanes(
            drive.windows, car, CameraModel(lens, car.camera.width_px, car.camera.height_px), start
        )
    except CalibrationError as error:
        return row | {"refusal": str(error)}
    finally:
        tick(0.4)
    for name, column in zip(NAMES, ERRORS, strict=True):
        off, sigma = getattr(found.extrinsics, name) - getattr(right.extrinsics, name), found.std[name]
        unit = 1e3 if column.endswith("_mm") else math.degrees(1.0)
        row |= {column: unit * off, f"{column}_sigma": unit * sigma, f"{column}_z": off / sigma}
    row["worst_z"] = max(abs(row[f"{column}_z"]) for column in ERRORS)
    row |= {"unknown": " ".join(found.unknown), "stretches": found.windows}
    return row | {"line_px": found.ridge_px, "dash_end_px": found.end_px}


def measure(cases: Sequence[RigDrive], sweep: Sweep) -> dict[str, list[Row]]:
    """The tables "drives", a row each, and "all", a row for each of the right camera's numbers."""
    rows = [row for _, row in spread("bench stereo-calibration", measure_drive, cases, sweep)]
    return {"drives": rows, "all": list(summary(rows))}


def summary(rows: Sequence[Row]) -> Iterator[Row]:
    """Of each number: the root mean square and the largest of its errors, the mean sigma stated, and how often it is
    exceeded twice and three times."""
    answered = [row for row in rows if row["refusal"] is None]
    for column in ERRORS if answered else ():
        error, sigma, z = (np.array([row[f"{column}{what}"] for row in answered]) for what in ("", "_sigma", "_z"))
        yield {
            "number": column,
            "drives": len(rows),
            "refused": len(rows) - len(answered),
            "error_rms": float(np.sqrt(np.mean(error**2))),
            "error_max": float(np.abs(error).max()),
            "sigma_mean": float(sigma.mean()),
            "z_rms": float(np.sqrt(np.mean(z**2))),
            "beyond_2_sigma": int((np.abs(z) > 2.0).sum()),
            "beyond_3_sigma": int((np.abs(z) > 3.0).sum()),
        }

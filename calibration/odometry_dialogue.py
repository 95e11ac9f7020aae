"""`calibrate odometry`: runs along a straight, driven, pushed or counted before."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

import click
import numpy as np
from numpy.typing import NDArray

from automodel.config import CarConfig, ConfigError
from automodel.console.keys import ArmKey, has_terminal
from automodel.console.messages import say
from automodel.console.tables import show
from automodel.sim.plant import PlantConfig
from automodel.sim.randomised_plant import randomised_motor
from calibration.car_file import write_values
from calibration.drive import PlanFollower, Rig, RigMaker, follow_plan, nobody, plant_of, run_chain, straight_plan
from calibration.odometry import (
    MeasuredRun,
    MotorTable,
    OdometryError,
    SteadySpeed,
    TicksPerMetre,
    fit_motor,
    fit_ticks,
    steady_speed,
)
from calibration.pictures import picture_folder, write_pictures
from calibration.plots import odometry_picture
from firmware_link.pulses import PulseTable


@dataclass(frozen=True, slots=True, kw_only=True)
class OdometryOptions:
    """What the command line says; `seed` draws the motor of a simulated car."""

    car_file: Path | None
    distance_m: float
    push: bool
    runs: int
    speeds: tuple[float, ...]
    counted: tuple[int, ...]
    seed: int
    out: Path | None
    as_json: bool
    dry_run: bool


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class DrivenRun:
    """One driven run: its distance, the motor's pulse [us], and wheel `ticks` (n,) at `t_ns` (n,)."""

    measured: MeasuredRun
    pulse_us: float
    t_ns: NDArray[np.int64]
    ticks: NDArray[np.int64]


def calibrate_odometry(car: CarConfig, options: OdometryOptions, open_rig: RigMaker) -> int:
    """Measure, fit and write; returns the exit code. On DriveEnded, ValueError and OSError car.toml is unchanged."""
    simulated = car.link.port == "sim"
    if options.push and simulated:
        raise ConfigError("--push: nobody can push a simulated car")
    truth = randomised_motor(options.seed, plant_of(car, options.seed)) if simulated and not options.counted else None
    if truth is None and not options.counted and not has_terminal():
        raise ConfigError("no terminal: distances are typed in; run it in one (ssh -t), or give --ticks")
    fastest = max(options.speeds)
    if fastest > car.safety.speed_max_mps:
        raise ConfigError(f"--speeds {fastest}: above [safety] speed_max_mps = {car.safety.speed_max_mps}")
    driven: list[DrivenRun] = []
    if options.counted:
        runs = [MeasuredRun(ticks=n, distance_m=options.distance_m) for n in options.counted]
    elif options.push:
        runs = _push(car, options, open_rig)
    else:
        driven = _drive(car, options, open_rig, truth)
        runs = [run.measured for run in driven]
    ticks = fit_ticks(runs)
    motor, steady = _motor(car, driven, ticks.ticks_per_m)
    _write(options, ticks, motor, steady, runs)
    show("calibrate odometry", [_row(ticks, motor, truth)], options.as_json)
    return 0


def _drive(car: CarConfig, options: OdometryOptions, open_rig: RigMaker, truth: PlantConfig | None) -> list[DrivenRun]:
    """One run for each speed; a person types in its distance, the simulator gives it."""
    runs: list[DrivenRun] = []
    with ExitStack() as leaving:
        pressed = nobody
        if truth is None:
            pressed = leaving.enter_context(ArmKey("press Enter to arm; Enter or Ctrl-C stop")).pressed
        rig = leaving.enter_context(open_rig(car, plant=truth))
        for number, speed in enumerate(sorted(options.speeds), 1):
            say(f"run {number} of {len(options.speeds)}: about {options.distance_m:g} m at {speed:g} m/s")
            before_m = rig.plant.state.distance_m if rig.plant is not None else 0.0
            _drive_straight(rig, options.distance_m, speed, pressed)
            if rig.plant is not None:
                distance = round(rig.plant.state.distance_m - before_m, 3)
            else:
                above_zero = click.FloatRange(0, min_open=True)
                distance = click.prompt("measured distance of the rear axle [m]", type=above_zero, err=True)
            runs.append(_driven_run(rig, distance))
    return runs


def _drive_straight(rig: Rig, distance_m: float, speed_mps: float, pressed: Callable[[], bool]) -> None:
    def far_enough() -> bool:
        rolled = rig.board.rolled
        return bool(rolled) and rolled[-1].ticks - rolled[0].ticks >= distance_m * rig.car.vehicle.ticks_per_m

    plan = straight_plan(distance_m, speed_mps)
    follow_plan(rig, PlanFollower(plan, rig.car, float, straight=True, far_enough=far_enough), pressed)


def _driven_run(rig: Rig, distance_m: float) -> DrivenRun:
    rolled = rig.board.rolled
    motor = np.array([pin.motor_us for pin in rig.board.pins])
    pulses, counts = np.unique(motor[motor != motor[0]], return_counts=True)
    if len(pulses) == 0:
        raise OdometryError("the board never drove the motor; is --speeds above 0 in the motor's table?")
    return DrivenRun(
        measured=MeasuredRun(ticks=rolled[-1].ticks - rolled[0].ticks, distance_m=distance_m),
        pulse_us=float(pulses[int(np.argmax(counts))]),
        t_ns=rig.board.host_ns([row.board_ns for row in rolled]),
        ticks=np.array([row.ticks for row in rolled]),
    )


def _push(car: CarConfig, options: OdometryOptions, open_rig: RigMaker) -> list[MeasuredRun]:
    """Count while a person pushes; the motor stays in neutral and the board disarmed."""
    marks: list[int] = []
    with ArmKey(f"push {options.distance_m:g} m: Enter at the start, Enter at the end") as key, open_rig(car) as rig:

        def stop() -> bool:
            if key.pressed() and rig.board.rolled:
                marks.append(rig.board.rolled[-1].ticks)
                number, ended = (len(marks) + 1) // 2, len(marks) % 2 == 0
                say(f"run {number} of {options.runs}: " + (f"{marks[-1] - marks[-2]} ticks" if ended else "push"))
            return len(marks) == 2 * options.runs

        standing = PlanFollower(straight_plan(options.distance_m, 1.0), car, float)
        run_chain(rig, standing, arm=nobody, stop=stop)
    distance_m = options.distance_m
    return [MeasuredRun(ticks=b - a, distance_m=distance_m) for a, b in zip(marks[::2], marks[1::2], strict=True)]


def _motor(
    car: CarConfig, runs: Sequence[DrivenRun], ticks_per_m: float
) -> tuple[MotorTable | None, list[SteadySpeed]]:
    """The motor's table, None unless the car was driven at two speeds at least, and the speeds."""
    steady = [
        SteadySpeed(pulse_us=run.pulse_us, speed_mps=steady_speed(run.t_ns, run.ticks, ticks_per_m)) for run in runs
    ]
    if len({s.pulse_us for s in steady}) < 2:
        return None, steady
    old = car.link.motor
    reverse = [(p, v) for p, v in zip(old.pulse_us, old.speed_mps, strict=True) if v < 0]
    return fit_motor(steady, PulseTable(old.pulse_us, old.speed_mps).zero_us, reverse), steady


def _write(
    options: OdometryOptions,
    ticks: TicksPerMetre,
    motor: MotorTable | None,
    steady: Sequence[SteadySpeed],
    runs: Sequence[MeasuredRun],
) -> None:
    """The picture, then car.toml."""
    if options.car_file is None and options.out is None:
        return
    folder = picture_folder(options.out, options.car_file or Path("car.toml"))
    write_pictures(folder, {"odometry": odometry_picture(runs, ticks, steady, motor)})
    if options.car_file is None:
        return
    values: dict[str, Mapping[str, object]] = {"vehicle": {"ticks_per_m": round(ticks.ticks_per_m, 2)}}
    share = 100.0 * ticks.scatter_per_m / ticks.ticks_per_m
    residual = f"{ticks.runs} runs scatter {ticks.scatter_per_m:.2f} ticks a metre ({share:.1f} %)"
    if motor is not None:
        values["link.motor"] = {"pulse_us": motor.pulse_us, "speed_mps": motor.speed_mps}
        residual += f"; speeds within {motor.rms_mps:.3f} m/s"
    how = "counted" if options.counted else "pushed" if options.push else "driven"
    method = f"{ticks.runs} runs of about {options.distance_m:g} m, {how}"
    write_values(options.car_file, values, residual=residual, method=method, dry_run=options.dry_run)


def _row(ticks: TicksPerMetre, motor: MotorTable | None, truth: PlantConfig | None) -> dict[str, object]:
    """The results; the errors are known in simulation only."""
    return {
        "ticks_per_m": ticks.ticks_per_m,
        "sd_per_m": ticks.sd_per_m,
        "scatter_per_m": ticks.scatter_per_m,
        "runs": ticks.runs,
        "band_us": None if motor is None else motor.band_us,
        "speed_rms_mps": None if motor is None else motor.rms_mps,
        "ticks_error_pct": None if truth is None else 100.0 * (ticks.ticks_per_m / truth.ticks_per_m - 1.0),
        "speed_error_mps": None if truth is None or motor is None else worst_speed_error_mps(motor, truth),
    }


def worst_speed_error_mps(motor: MotorTable, truth: PlantConfig) -> float:
    """The largest difference [m/s] between a motor's table and the simulated motor, where it drives forward."""
    driven = [p for p, v in zip(motor.pulse_us, motor.speed_mps, strict=True) if v > 0]
    pulses = np.linspace(driven[0], driven[-1], 500)
    true = np.interp(pulses, truth.motor.pulse_us, truth.motor.speed_mps)
    return float(np.abs(np.interp(pulses, motor.pulse_us, motor.speed_mps) - true).max())

"""`calibrate odometry`: runs along a straight, pushed or driven; fits; writes."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import click
import numpy as np
from numpy.typing import NDArray

from automodel.assembly.calibration_rigs import LoggedRig, car_to_calibrate, plant_of, real_rig, simulated_rig
from automodel.cli.options import ABOVE_ZERO
from automodel.config import CarConfig, ConfigError
from automodel.console.keys import ArmKey, has_terminal
from automodel.console.messages import say
from automodel.console.tables import show
from automodel.sim.plant import PlantConfig
from automodel.sim.randomised_plant import randomised_motor
from calibration.calibration_drive import PlanFollower, follow_plan, nobody, run_chain
from calibration.calibration_output import picture_folder, write_pictures, write_values
from calibration.drive_plan import straight_plan
from calibration.odometry import (
    MotorTable,
    OdometryError,
    SteadySpeed,
    TicksPerMetre,
    Way,
    fit_motor,
    fit_ticks,
    steady_speed,
)
from calibration.plots import odometry_picture
from firmware_link.pulses import PulseTable


@dataclass(frozen=True, slots=True, kw_only=True)
class OdometryOptions:
    """What the command line says."""

    car_file: Path | None
    distance_m: float
    push: bool
    runs: int
    speeds: tuple[float, ...]
    counted: tuple[int, ...]
    simulated: bool
    seed: int
    out: Path | None
    as_json: bool
    dry_run: bool


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Run:
    """One driven run: the way, the motor's pulse [us], and ticks over time."""

    way: Way
    pulse_us: float
    t_ns: NDArray[np.int64]
    ticks: NDArray[np.int64]


def calibrate_odometry(options: OdometryOptions) -> int:
    """Measure, fit and write; the exit code. Raises DriveEnded, ValueError, OSError, with car.toml as it was."""
    by_board = not options.counted
    car, simulated = car_to_calibrate(options.car_file, options.simulated, options.dry_run, by_board=by_board)
    if options.push and simulated:
        raise ConfigError("--push: nobody can push a simulated car")
    truth = randomised_motor(options.seed, plant_of(car, options.seed)) if simulated and not options.counted else None
    if truth is None and not options.counted and not has_terminal():
        raise ConfigError("no terminal: distances are typed in; run it in one (ssh -t), or give --ticks")
    fast = max(options.speeds)
    if fast > car.safety.speed_max_mps:
        raise ConfigError(f"--speeds {fast}: above [safety] speed_max_mps = {car.safety.speed_max_mps}")
    runs: list[Run] = []
    if options.counted:
        ways = [Way(ticks=n, distance_m=options.distance_m) for n in options.counted]
    elif options.push:
        ways = _pushed(car, options)
    else:
        runs = _driven(car, options, truth)
        ways = [run.way for run in runs]
    ticks = fit_ticks(ways)
    motor, steady = _motor(car, runs, ticks.ticks_per_m)
    _finish(options, ticks, motor, steady, ways)
    show("calibrate odometry", [_row(ticks, motor, truth)], options.as_json)
    return 0


def _driven(car: CarConfig, options: OdometryOptions, truth: PlantConfig | None) -> list[Run]:
    """One run for each speed; a person says how far it went, or the simulated world does."""
    runs: list[Run] = []
    key: ArmKey | None = None
    with contextlib.ExitStack() as leaving:
        if truth is not None:
            rig = simulated_rig(car, truth, options.seed, camera=False)
        else:
            key = leaving.enter_context(ArmKey("press Enter to arm; Enter or Ctrl-C stop"))
            rig = real_rig(car, camera=False, auto_arm=False, leaving=leaving)
        for number, speed in enumerate(sorted(options.speeds), 1):
            say(f"run {number} of {len(options.speeds)}: about {options.distance_m:g} m at {speed:g} m/s")
            before_m = rig.plant.state.distance_m if rig.plant is not None else 0.0
            _drive(rig, car, options.distance_m, speed, key.pressed if key is not None else nobody)
            if rig.plant is not None:
                distance = round(rig.plant.state.distance_m - before_m, 3)
            else:
                distance = click.prompt("measured way of the rear axle [m]", type=ABOVE_ZERO, err=True)
            runs.append(_run(rig, distance))
    return runs


def _drive(rig: LoggedRig, car: CarConfig, distance_m: float, speed_mps: float, pressed: Callable[[], bool]) -> None:
    def far_enough() -> bool:
        rolled = rig.board.rolled
        return bool(rolled) and rolled[-1].ticks - rolled[0].ticks >= distance_m * car.vehicle.ticks_per_m

    plan = straight_plan(distance_m, speed_mps)
    follower = PlanFollower(plan, car, float, straight=True, far_enough=far_enough)
    follow_plan(rig.rig, car, follower, pressed)


def _run(rig: LoggedRig, distance_m: float) -> Run:
    rolled, pins = rig.board.rolled, rig.board.pins
    motor = np.array([pin.motor_us for pin in pins])
    pulses, counts = np.unique(motor[motor != motor[0]], return_counts=True)
    if len(pulses) == 0:
        raise OdometryError("the board never drove the motor; is --speeds above 0 in the motor's table?")
    return Run(
        way=Way(ticks=rolled[-1].ticks - rolled[0].ticks, distance_m=distance_m),
        pulse_us=float(pulses[int(np.argmax(counts))]),
        t_ns=rig.board.host_ns([row.board_ns for row in rolled]),
        ticks=np.array([row.ticks for row in rolled]),
    )


def _pushed(car: CarConfig, options: OdometryOptions) -> list[Way]:
    """Count while a person pushes; the motor stays in neutral and the board disarmed."""
    marks: list[int] = []
    with contextlib.ExitStack() as leaving:
        key = leaving.enter_context(ArmKey(f"push {options.distance_m:g} m: Enter at the start, Enter at the end"))
        rig = real_rig(car, camera=False, auto_arm=False, leaving=leaving)

        def stop() -> bool:
            if key.pressed() and rig.board.rolled:
                marks.append(rig.board.rolled[-1].ticks)
                number, ended = (len(marks) + 1) // 2, len(marks) % 2 == 0
                say(f"run {number} of {options.runs}: " + (f"{marks[-1] - marks[-2]} ticks" if ended else "push"))
            return len(marks) == 2 * options.runs

        standing = PlanFollower(straight_plan(options.distance_m, 1.0), car, float)
        run_chain(rig.rig, car, standing, arm=nobody, stop=stop)
    return [Way(ticks=b - a, distance_m=options.distance_m) for a, b in zip(marks[::2], marks[1::2], strict=True)]


def _motor(car: CarConfig, runs: Sequence[Run], ticks_per_m: float) -> tuple[MotorTable | None, list[SteadySpeed]]:
    """The motor's table, None where the car was not driven at two speeds at least."""
    steady = [
        SteadySpeed(pulse_us=run.pulse_us, speed_mps=steady_speed(run.t_ns, run.ticks, ticks_per_m)) for run in runs
    ]
    if len({s.pulse_us for s in steady}) < 2:
        return None, steady
    old = car.link.motor
    reverse = [(p, v) for p, v in zip(old.pulse_us, old.speed_mps, strict=True) if v < 0]
    return fit_motor(steady, PulseTable(old.pulse_us, old.speed_mps).zero_us, reverse), steady


def _finish(
    options: OdometryOptions,
    ticks: TicksPerMetre,
    motor: MotorTable | None,
    steady: Sequence[SteadySpeed],
    ways: Sequence[Way],
) -> None:
    """The picture, then car.toml."""
    if options.car_file is None and options.out is None:
        return
    folder = picture_folder(options.out, options.car_file or Path("car.toml"))
    for path in write_pictures(folder, {"odometry": odometry_picture(ways, ticks, steady, motor)}):
        say(str(path))
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
    """The figures; those that need the simulator's truth are empty on a real car."""
    row: dict[str, object] = {
        "ticks_per_m": ticks.ticks_per_m,
        "sd_per_m": ticks.sd_per_m,
        "scatter_per_m": ticks.scatter_per_m,
        "runs": ticks.runs,
        "band_us": None if motor is None else motor.band_us,
        "speed_rms_mps": None if motor is None else motor.rms_mps,
        "ticks_error_pct": None,
        "speed_error_mps": None,
    }
    if truth is not None:
        row["ticks_error_pct"] = 100.0 * (ticks.ticks_per_m / truth.ticks_per_m - 1.0)
    if truth is not None and motor is not None:
        row["speed_error_mps"] = worst_speed_error_mps(motor, truth)
    return row


def worst_speed_error_mps(motor: MotorTable, truth: PlantConfig) -> float:
    """The largest difference between a motor's table and what the simulated motor truly does, where it drives ahead."""
    driven = [p for p, v in zip(motor.pulse_us, motor.speed_mps, strict=True) if v > 0]
    pulses = np.linspace(driven[0], driven[-1], 500)
    true = np.interp(pulses, truth.motor.pulse_us, truth.motor.speed_mps)
    return float(np.abs(np.interp(pulses, motor.pulse_us, motor.speed_mps) - true).max())

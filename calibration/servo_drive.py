"""`calibrate servo --auto`: the car drives slow bends and measures its own servo."""

from __future__ import annotations

import math
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from automodel.config import CarConfig, ConfigError
from automodel.console.keys import ArmKey, has_terminal
from automodel.console.messages import say
from automodel.console.tables import show
from automodel.geometry import GroundCamera
from automodel.signals import Frame, VehicleState
from automodel.sim.plant import PlantConfig
from automodel.sim.randomised_plant import randomised_servo
from automodel.sources.images import with_channels
from automodel.types import Image
from calibration.actuator import Actuator, fit_actuator
from calibration.car_file import write_values
from calibration.drive import PlanFollower, Rig, RigMaker, follow_plan, nobody, plant_of, servo_plan
from calibration.odometry import speeds
from calibration.pictures import picture_folder, write_pictures
from calibration.plots import servo_picture
from calibration.servo import ServoError, ServoLog, ServoTable, fit_table, without_bias
from calibration.visual_odometry import floor_view, motion_of
from firmware_link.pulses import PulseTable

WIRE_S = 0.022  # from a command to the pulse at the pin: 2 ms of wire, and the servo frame of 20 ms that is under way
VIEW_NS = 49_000_000  # between two views of the floor that are kept


@dataclass(frozen=True, slots=True, kw_only=True)
class AutoOptions:
    """What the command line says of a drive; `seed` draws the servo of a simulated car."""

    car_file: Path | None
    seed: int
    speed_mps: float
    camera: bool
    arm: bool
    out: Path | None
    dry_run: bool
    as_json: bool


def calibrate_by_driving(car: CarConfig, options: AutoOptions, open_rig: RigMaker) -> int:
    """Drive, fit and write; returns the exit code. On DriveEnded, ValueError and OSError car.toml is unchanged."""
    simulated = car.link.port == "sim"
    if not simulated and not options.arm and not has_terminal():
        raise ConfigError("no terminal to arm from; run it in one (ssh -t), or give --arm")
    folder = None
    if options.car_file is not None or options.out is not None:
        folder = picture_folder(options.out, options.car_file or Path("car.toml"))
    if options.speed_mps > car.safety.speed_max_mps:
        raise ConfigError(f"--speed {options.speed_mps}: above [safety] speed_max_mps = {car.safety.speed_max_mps}")
    truth = randomised_servo(options.seed, plant_of(car, options.seed, gyro=not options.camera)) if simulated else None
    with ExitStack() as leaving:
        pressed = nobody
        if truth is None:
            pressed = leaving.enter_context(ArmKey("press Enter to arm; Enter or Ctrl-C stop")).pressed
        rig = leaving.enter_context(open_rig(car, plant=truth, camera=options.camera, auto_arm=options.arm))
        log = driven_log(rig, options, pressed)
    wheelbase_m = car.vehicle.wheelbase_m
    log = without_bias(log)
    table = fit_table(log, wheelbase_m)
    actuator = fit_actuator(log, table, wheelbase_m)
    if folder is not None:
        write_pictures(folder, {"servo": servo_picture(log, table, actuator, wheelbase_m)})
    if options.car_file is not None:
        _write(options.car_file, table, actuator, options)
    show("calibrate servo", [_row(table, actuator, truth)], options.as_json)
    return 0


def driven_log(rig: Rig, options: AutoOptions, pressed: Callable[[], bool]) -> ServoLog:
    """Drive the sweep and return its log; raises DriveEnded, ServoError, FloorError, OSError."""
    car = rig.car
    believed = PulseTable(car.link.servo.pulse_us, car.link.servo.steering_rad)
    ends = sorted(believed.pulse_us(sign * car.safety.steering_max_rad) for sign in (-1.0, 1.0))
    plan = servo_plan(ends[0], ends[1], options.speed_mps)

    def check(state: VehicleState) -> str | None:
        if state.yaw_rate_radps is None and not options.camera:
            return "the board reports no yaw rate: no gyro is fitted; give --yaw camera"
        return None

    floor = FloorLog(car) if options.camera else None
    follower = PlanFollower(plan, car, believed.value, check=check)
    say(f"{plan.duration_s:.0f} s at {options.speed_mps:g} m/s, {ends[0]:.0f} .. {ends[1]:.0f} us")
    follow_plan(rig, follower, pressed, look=None if floor is None else floor.look)
    return log_of(rig, floor)


class FloorLog:
    """Keeps bird's-eye views of the floor while the car drives."""

    def __init__(self, car: CarConfig) -> None:
        self.floor = floor_view(GroundCamera.from_config(car.camera))
        self.views: list[Image] = []
        self.t_ns: list[int] = []

    def look(self, frame: Frame) -> None:
        """Keep the view of a frame, unless the last one kept is too recent."""
        if self.t_ns and frame.t_ns - self.t_ns[-1] < VIEW_NS:
            return
        self.views.append(self.floor.warp(with_channels(frame.image, False)))
        self.t_ns.append(frame.t_ns)


def log_of(rig: Rig, floor: FloorLog | None) -> ServoLog:
    """The drive as the board reported it, its motion from `floor` where given; raises ServoError without motion."""
    board = rig.board
    rolled = [row for row in board.rolled if floor is not None or row.yaw_rate_radps is not None]
    if len(rolled) < 2:
        raise ServoError("the board reported too little motion; check the cable")
    ticks = np.array([row.ticks for row in rolled])
    t_ns = board.host_ns([row.board_ns for row in rolled])
    speed = speeds(t_ns, ticks / rig.car.vehicle.ticks_per_m)
    yaw_rate = np.array([row.yaw_rate_radps or 0.0 for row in rolled])
    counted, window_s = np.ptp(ticks) > 0, 0.0
    if floor is not None:
        seen = motion_of(floor.views, floor.t_ns, floor.floor)
        speed = np.interp(seen.t_ns, t_ns, speed) if counted else seen.speed_mps
        t_ns, yaw_rate, window_s = seen.t_ns, seen.yaw_rate_radps, float(np.median(np.diff(floor.t_ns))) * 1e-9
    elif not counted:
        raise ServoError("no wheel ticks were counted: check battery, motor and wheel sensor")
    return ServoLog(
        pulse_t_ns=board.host_ns([pins.board_ns for pins in board.pins]),
        pulse_us=np.array([pins.servo_us for pins in board.pins]),
        t_ns=t_ns,
        yaw_rate_radps=yaw_rate,
        speed_mps=speed,
        window_s=window_s,
    )


def _write(car_file: Path, table: ServoTable, actuator: Actuator, options: AutoOptions) -> None:
    rate = actuator.rate_max_radps
    residual = (
        f"scatter {math.degrees(table.rms_rad):.2f} deg; play {math.degrees(table.play_rad):.1f} deg; "
        f"dead time {1e3 * actuator.delay_s:.0f} ms, lag {1e3 * actuator.lag_s:.0f} ms, "
        + (f"at most {rate:.1f} rad/s" if rate is not None else f"{actuator.rate_seen_radps:.1f} rad/s or more")
    )
    write_values(
        car_file,
        {
            "link.servo": {"pulse_us": table.pulse_us, "steering_rad": table.steering_rad},
            "control": {"actuator_delay_s": round(actuator.total_s + WIRE_S, 3)},
        },
        residual=residual,
        method=f"a drive at {options.speed_mps:g} m/s, yaw rate from the {'camera' if options.camera else 'gyro'}",
        dry_run=options.dry_run,
    )


def _row(table: ServoTable, actuator: Actuator, truth: PlantConfig | None) -> dict[str, object]:
    """The results; the errors are known in simulation only."""
    low, high = sorted((table.steering_rad[0], table.steering_rad[-1]))
    return {
        "centre_us": table.centre_us,
        "left_deg": math.degrees(high),
        "right_deg": -math.degrees(low),
        "play_deg": math.degrees(table.play_rad),
        "rms_deg": math.degrees(table.rms_rad),
        "sd_max_deg": math.degrees(max(table.sd_rad)),
        "dead_ms": 1e3 * actuator.delay_s,
        "dead_sd_ms": 1e3 * actuator.delay_sd_s,
        "lag_ms": 1e3 * actuator.lag_s,
        "rate_radps": actuator.rate_max_radps,
        "holds": table.holds,
        "strays": len(table.strays),
        "max_error_deg": None if truth is None else math.degrees(worst_error_rad(table, truth)),
        "dead_error_ms": None if truth is None else 1e3 * (actuator.delay_s - truth.servo_dead_s),
    }


def worst_error_rad(table: ServoTable, truth: PlantConfig) -> float:
    """The largest difference [rad] between a table and the simulated servo, over the table's range."""
    pulses = np.linspace(table.pulse_us[0], table.pulse_us[-1], 1000)
    true = np.interp(pulses, truth.servo.pulse_us, truth.servo.steering_rad) + truth.servo_bias_rad
    return float(np.abs(table.angle_rad(pulses) - true).max())

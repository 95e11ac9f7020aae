"""`calibrate servo --auto`: drives, fits, writes."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from automodel.assembly.calibration_rigs import LoggedRig, car_to_calibrate, plant_of, real_rig, simulated_rig
from automodel.config import CarConfig, ConfigError
from automodel.console.keys import ArmKey, has_terminal
from automodel.console.messages import say
from automodel.console.tables import show
from automodel.geometry import GroundCamera
from automodel.signals import Frame, VehicleState
from automodel.sim.plant import PlantConfig
from automodel.sim.randomised_plant import randomised_servo
from automodel.types import Image
from calibration.actuator import Actuator, fit_actuator
from calibration.calibration_drive import PlanFollower, follow_plan, nobody
from calibration.calibration_output import picture_folder, write_pictures, write_values
from calibration.drive_plan import servo_plan
from calibration.ground_motion import floor_view, motion_of
from calibration.odometry import speeds
from calibration.plots import servo_picture
from calibration.servo import ServoError, ServoTable, fit_table
from calibration.servo_log import ServoLog, without_bias
from firmware_link.pulses import PulseTable

LOOP_AND_WIRE_S = 0.025  # from a frame to the pulse at the pin: loop, wire, and half a servo frame of 20 ms
VIEW_NS = 49_000_000  # between two pictures of the floor that are kept


@dataclass(frozen=True, slots=True, kw_only=True)
class AutoOptions:
    """What the command line says of a drive."""

    car_file: Path | None
    simulated: bool
    seed: int
    speed_mps: float
    camera: bool
    arm: bool
    out: Path | None
    dry_run: bool
    as_json: bool


def calibrate_by_driving(options: AutoOptions) -> int:
    """Drive, fit and write; the exit code. Raises DriveEnded, ValueError, OSError, with car.toml as it was."""
    car, simulated = car_to_calibrate(options.car_file, options.simulated, options.dry_run)
    if not simulated and not options.arm and not has_terminal():
        raise ConfigError("no terminal to arm from; run it in one (ssh -t), or give --arm")
    folder = None
    if options.car_file is not None or options.out is not None:
        folder = picture_folder(options.out, options.car_file or Path("car.toml"))
    if options.speed_mps > car.safety.speed_max_mps:
        raise ConfigError(f"--speed {options.speed_mps}: above [safety] speed_max_mps = {car.safety.speed_max_mps}")
    truth = randomised_servo(options.seed, plant_of(car, options.seed, gyro=not options.camera)) if simulated else None
    with contextlib.ExitStack() as leaving:
        if truth is not None:
            rig = simulated_rig(car, truth, options.seed, options.camera)
            log = driven_log(rig, car, options, nobody)
        else:
            key = leaving.enter_context(ArmKey("press Enter to arm; Enter or Ctrl-C stop"))
            rig = real_rig(car, options.camera, options.arm, leaving)
            log = driven_log(rig, car, options, key.pressed)
    wheelbase_m = car.vehicle.wheelbase_m
    log = without_bias(log)
    table = fit_table(log, wheelbase_m)
    actuator = fit_actuator(log, table, wheelbase_m)
    if folder is not None:
        for path in write_pictures(folder, {"servo": servo_picture(log, table, actuator, wheelbase_m)}):
            say(str(path))
    if options.car_file is not None:
        _write(options.car_file, table, actuator, options)
    show("calibrate servo", [_row(table, actuator, truth)], options.as_json)
    return 0


def driven_log(rig: LoggedRig, car: CarConfig, options: AutoOptions, pressed: Callable[[], bool]) -> ServoLog:
    """Drive the sweep and give what was logged; raises DriveEnded, ServoError, FloorError, OSError."""
    believed = PulseTable(car.link.servo.pulse_us, car.link.servo.steering_rad)
    ends = sorted(believed.pulse_us(sign * car.safety.steering_max_rad) for sign in (-1.0, 1.0))
    plan = servo_plan(ends[0], ends[1], options.speed_mps)

    def check(state: VehicleState) -> str | None:
        if state.yaw_rate_radps is None and not options.camera:
            return "the board says no yaw rate: no gyro is fitted; give --yaw camera"
        return None

    floor = FloorLog(car) if options.camera else None
    follower = PlanFollower(plan, car, believed.value, check=check)
    say(f"{plan.duration_s:.0f} s at {options.speed_mps:g} m/s, {ends[0]:.0f} .. {ends[1]:.0f} us")
    follow_plan(rig.rig, car, follower, pressed, look=None if floor is None else floor.look)
    return log_of(rig, car, floor)


class FloorLog:
    """Keeps bird's-eye views of the floor while the car drives."""

    def __init__(self, car: CarConfig) -> None:
        self.floor = floor_view(GroundCamera.from_config(car.camera))
        self.views: list[Image] = []
        self.t_ns: list[int] = []

    def look(self, frame: Frame) -> None:
        """Keep the floor of a frame, if the last one that was kept is old enough."""
        if self.t_ns and frame.t_ns - self.t_ns[-1] < VIEW_NS:
            return
        image = frame.image if frame.image.ndim == 2 else np.asarray(cv2.cvtColor(frame.image, cv2.COLOR_BGR2GRAY))
        self.views.append(self.floor.warp(image.astype(np.uint8, copy=False)))
        self.t_ns.append(frame.t_ns)


def log_of(rig: LoggedRig, car: CarConfig, floor: FloorLog | None) -> ServoLog:
    """What the board said, and the camera saw, as the estimators want it; raises ServoError without wheel ticks."""
    board = rig.board
    rolled = [row for row in board.rolled if floor is not None or row.yaw_rate_radps is not None]
    if len(rolled) < 2:
        raise ServoError("the board said too little of how the car moved; check the cable")
    ticks = np.array([row.ticks for row in rolled])
    t_ns = board.host_ns([row.board_ns for row in rolled])
    speed = speeds(t_ns, ticks / car.vehicle.ticks_per_m)
    yaw_rate = np.array([row.yaw_rate_radps or 0.0 for row in rolled])
    counted, window_s = np.ptp(ticks) > 0, 0.0
    if floor is not None:
        seen = motion_of(floor.views, floor.t_ns, floor.floor)
        speed = np.interp(seen.t_ns, t_ns, speed) if counted else seen.speed_mps
        t_ns, yaw_rate, window_s = seen.t_ns, seen.yaw_rate_radps, float(np.median(np.diff(floor.t_ns))) * 1e-9
    elif not counted:
        raise ServoError("the wheels did not turn, or nothing counts them: check battery, motor and wheel sensor")
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
            "control": {"actuator_delay_s": round(actuator.total_s + LOOP_AND_WIRE_S, 3)},
        },
        residual=residual,
        method=f"a drive at {options.speed_mps:g} m/s, yaw rate from the {'camera' if options.camera else 'gyro'}",
        dry_run=options.dry_run,
    )


def _row(table: ServoTable, actuator: Actuator, truth: PlantConfig | None) -> dict[str, object]:
    """The figures; those that need the simulator's truth are empty on a real car."""
    low, high = sorted((table.steering_rad[0], table.steering_rad[-1]))
    row: dict[str, object] = {
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
        "max_error_deg": None,
        "dead_error_ms": None,
    }
    if truth is not None:
        row["max_error_deg"] = math.degrees(worst_error_rad(table, truth))
        row["dead_error_ms"] = 1e3 * (actuator.delay_s - truth.servo_dead_s)
    return row


def worst_error_rad(table: ServoTable, truth: PlantConfig) -> float:
    """The largest difference between a table and what the simulated servo truly does, over the table's range."""
    pulses = np.linspace(table.pulse_us[0], table.pulse_us[-1], 1000)
    true = np.interp(pulses, truth.servo.pulse_us, truth.servo.steering_rad) + truth.servo_bias_rad
    return float(np.abs(table.angle_rad(pulses) - true).max())

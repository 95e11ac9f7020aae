"""The doctor's examination of a car, check by check: machine, board, camera, lane, disk, car.toml."""

from __future__ import annotations

import contextlib
import dataclasses
import datetime
import math
from collections.abc import Callable, Generator, Iterator

from automodel.assembly.parts import is_live_camera, lacks_device, left_alone, make_camera, make_link
from automodel.assembly.simulated_car import Simulation, board_of, lock_step
from automodel.config import CalibrationRecord, CarConfig, Intrinsics
from automodel.doctor.board import Board, Consent, board_findings, can_finding, servo_finding
from automodel.doctor.board_computer import computer_findings
from automodel.doctor.camera import AnyFrame, camera_findings, lane_finding, left_frame
from automodel.doctor.can_bus import can_bus_findings
from automodel.doctor.findings import Finding, fail, okay, skip, warn
from automodel.doctor.latency import latency_finding
from automodel.doctor.machine import disk_finding, machine_findings
from automodel.interfaces import Source, VehicleLink
from automodel.runtime.clocks import MonotonicClock, SleepingClock
from firmware_link.can_port import PythonCanPort

FRESH_DAYS = 180
COMMANDS = {  # calibration record -> (the command that makes it, what is wrong without it)
    "camera": ("automodel calibrate camera", "angles and distances are wrong towards the image borders"),
    "ground": ("automodel calibrate ground", "all distances are wrong"),
    "stereo": ("automodel calibrate stereo", "the right camera sees the lane elsewhere than the left one"),
    "servo": ("automodel calibrate servo", "the car steers at another angle than commanded"),
    "odometry": ("automodel calibrate odometry", "speed and distance are wrong"),
}
NARROW_RAD, WIDE_RAD = math.radians(25.0), math.radians(150.0)  # fields of view of cameras that see lanes
ASPECT_OFF = 0.02
IMX219_MODES = {  # of NVIDIA's driver since JetPack 4.4: width, height [px], most frames/s, share of the sensor's width
    0: (3280, 2464, 21, 1.0),
    1: (3280, 1848, 28, 1.0),
    2: (1920, 1080, 30, 0.585),
    3: (1640, 1232, 30, 1.0),
    4: (1280, 720, 60, 0.78),
    5: (1280, 720, 120, 0.78),
}
CENTRE_OFF = 0.12  # share of the image size by which the principal point may be off the middle


def examine(car: CarConfig, consent: Consent | None, light: str | None = None) -> Generator[Finding, None, None]:
    """All findings, in order, as they come; without `consent` nothing moves.

    `light` blinks for the camera's latency: "screen", or an LED.
    """
    yield from machine_findings(car)
    yield from computer_findings()
    frames: list[AnyFrame] = []
    yield from _device_findings(car, consent, frames)
    if light is not None:
        yield latency_finding(car, lambda: make_camera(left_alone(car), any_mode=True), light)
    yield disk_finding(car, left_frame(frames[-1]).image if frames else None)
    yield judge_lens(car)
    if car.camera.right is not None:
        right = dataclasses.replace(car, camera=car.camera.eyes[1])
        yield dataclasses.replace(judge_lens(right), name="right lens")
    yield judge_mode(car)
    yield judge_steering(car)
    yield from judge_records(car, datetime.date.today())


def _device_findings(car: CarConfig, consent: Consent | None, frames: list[AnyFrame]) -> Iterator[Finding]:
    """Board, camera and lane; the newest frames of the camera are put into `frames`.

    The board comes first: nobody listens to it during the camera's checks, which it would report as a fault.
    """
    source, port = car.camera.source, car.link.port
    if (source == "sim") != (port == "sim"):
        what = f'[camera] source is "{source}" and [link] port "{port}"'
        yield fail("car.toml", what, 'set both to "sim", or neither')
        return
    if source != "sim" and not is_live_camera(car):
        do = '"csi" or "usb" drives; for a recording see automodel replay'
        yield warn("car.toml", f'[camera] source "{source}" is not a camera', do)
    if lacks_device(car):
        what = f'[camera] source "{source}" is one camera, and the pipeline {car.pipeline.name} sees through two'
        yield fail("car.toml", what, "set [camera.right] device to the right one's number")
    with contextlib.ExitStack() as leaving:
        open_camera, link, clock = _devices(car, leaving)
        if isinstance(link, Board):
            answers = yield from board_findings(car, link, clock)
            if consent is None:
                yield skip("servo", "not moved", "--move turns it, and asks first")
            elif answers:
                yield servo_finding(car, link, clock, consent)
            else:
                yield skip("servo", "not moved: the board does not answer")
        elif car.link.kind == "can":
            yield from _bus_findings(car, clock)
        else:
            yield skip("board", f'not checked: no checks are known for [link] kind = "{car.link.kind}"')
        if car.link.kind != "can":
            yield can_finding()
        link.close()
        yield from camera_findings(car, open_camera, frames)
        if frames:
            yield lane_finding(car, frames)


def _bus_findings(car: CarConfig, clock: SleepingClock) -> Iterator[Finding]:
    if car.link.port == "sim":
        yield skip("CAN bus", "the simulated one; automodel bench faults --link can tries its faults")
        return
    port = PythonCanPort(car.link.can.interface, car.link.port, car.link.can.bitrate)
    yield from can_bus_findings(car, port, clock)


def _devices(car: CarConfig, leaving: contextlib.ExitStack) -> tuple[Callable[[], Source], VehicleLink, SleepingClock]:
    """How to open the camera, the link, and the clock of both: the car's, or a simulated car's in virtual time."""
    if car.link.port == "sim":
        simulated = lock_step(car, Simulation(link=board_of(car)), lambda scene: None)
        leaving.callback(simulated.close)
        leaving.callback(simulated.link.close)
        return lambda: simulated.source, simulated.link, simulated.clock
    link = make_link(car)
    leaving.callback(link.close)
    return lambda: make_camera(car, any_mode=True), link, MonotonicClock()


def judge_records(car: CarConfig, today: datetime.date) -> list[Finding]:
    """One finding for each calibration: whether it was done, and when."""
    if car.camera.source == "sim":
        return [skip("calibration", "the simulated car is exactly as in car.toml")]
    made = [what for what in COMMANDS if what != "stereo" or car.camera.right is not None]
    return [_record(what, getattr(car.calibration, what), today) for what in made]


def _record(what: str, record: CalibrationRecord | None, today: datetime.date) -> Finding:
    name = f"{what} calibration"
    command, wrong = COMMANDS[what]
    if record is None:
        return warn(name, f"never calibrated: {wrong}", command)
    days = (today - record.date).days
    done = f"{record.date} by {record.method}: {record.residual}"
    if days < 0:
        return warn(name, f"{done}; that day is in the future", "set this machine's clock, or calibrate again")
    if days > FRESH_DAYS:
        return warn(name, f"{done}; {days} days ago", f"{command}, or drive on if nothing was touched since")
    return okay(name, done)


def judge_lens(car: CarConfig) -> Finding:
    """Whether the intrinsics are plausible for images of this size."""
    name, camera, lens = "lens", car.camera, car.camera.intrinsics
    if camera.source != "sim" and lens == Intrinsics():
        return warn(name, "[camera.intrinsics] are still the simulated camera's", COMMANDS["camera"][0])
    view = 2.0 * math.atan(0.5 * camera.width_px / lens.fx_px)
    off_u = abs(lens.cx_px - 0.5 * (camera.width_px - 1)) / camera.width_px
    off_v = abs(lens.cy_px - 0.5 * (camera.height_px - 1)) / camera.height_px
    do = f"calibrate at {camera.width_px}x{camera.height_px}: {COMMANDS['camera'][0]}"
    if max(off_u, off_v) > CENTRE_OFF:
        where = f"{lens.cx_px:.0f}, {lens.cy_px:.0f}"
        return warn(name, f"its centre {where} is far off the middle: calibrated at another image size?", do)
    if not NARROW_RAD < view < WIDE_RAD:
        return warn(name, f"field of view {math.degrees(view):.0f} deg: calibrated at another image size?", do)
    if not 0.9 < lens.fx_px / lens.fy_px < 1.1:
        differ = f"fx {lens.fx_px:.0f} and fy {lens.fy_px:.0f} px differ"
        return warn(name, f"{differ}: right only where the camera squeezes its images", do)
    return okay(name, f"field of view {math.degrees(view):.0f} deg, centre {lens.cx_px:.0f}, {lens.cy_px:.0f}")


def judge_mode(car: CarConfig) -> Finding:
    """Whether the lens was calibrated in the camera's mode, and the mode is one that is sure and fits."""
    name, camera, record = "camera mode", car.camera, car.calibration.camera
    if camera.source == "sim":
        return skip(name, "a simulated camera has one only")
    if car.other_mode is not None:
        do = f"set [camera] back, or {COMMANDS['camera'][0]}: the car does not drive like this"
        return fail(name, f"{camera.mode}, and the lens was calibrated for {car.other_mode}", do)
    if car.other_right_mode is not None:
        do = f"set [camera.right] back, or {COMMANDS['stereo'][0]}: the car does not drive like this"
        what = f"{camera.eyes[1].mode}, and the right camera was calibrated for {car.other_right_mode}"
        return fail(name, what, do)
    what = camera.mode + ("" if record is None or record.mode else "; the calibration does not say for which")
    if camera.source == "csi" and camera.sensor_mode < 0:
        do = "set [camera] sensor_mode: which part of the sensor is read would follow from size and rate"
        return warn(name, what, do)
    known = IMX219_MODES.get(camera.sensor_mode) if camera.source == "csi" else None
    if known is None:
        return okay(name, what)
    width_px, height_px, most_hz, share = known
    what += f"; of an IMX219 {width_px}x{height_px}, up to {most_hz} Hz, {share:.0%} of its width"
    if camera.rate_hz > most_hz:
        return warn(name, what, f"[camera] rate_hz = {most_hz}, or another sensor_mode (4 has 60 Hz)")
    if abs(camera.width_px * height_px / (camera.height_px * width_px) - 1.0) > ASPECT_OFF:
        return warn(name, what, "the picture is stretched: choose a size of the same shape as the mode's")
    return okay(name, what)


def judge_steering(car: CarConfig) -> Finding:
    """Whether the servo's table reaches the steering limit."""
    name, servo = "servo table", car.link.servo
    left, right = max(servo.steering_rad), -min(servo.steering_rad)
    what = f"{left:.2f} rad left to {right:.2f} right, {servo.pulse_us[0]:g} to {servo.pulse_us[-1]:g} us"
    limit = car.safety.steering_max_rad
    if min(left, right) < 0.98 * limit:
        do = f"set [safety] steering_max_rad to {min(left, right):.2f}: the controller relies on the angles it commands"
        return warn(name, f"{what}; the limits allow {limit:.2f}", do)
    return okay(name, what)

"""What car.toml says of its calibrations: there, fresh, and in accord with the rest of the file."""

from __future__ import annotations

import datetime
import math

from automodel.config import CalibrationRecord, CarConfig, Intrinsics
from automodel.doctor.findings import Finding, okay, skip, warn

FRESH_DAYS = 180
COMMANDS = {  # record -> (the command, what is wrong without it)
    "camera": ("automodel calibrate camera", "bends and distances are wrong towards the picture's edges"),
    "ground": ("automodel calibrate ground", "all metres are wrong"),
    "servo": ("automodel calibrate servo", "the car steers by another angle than it means"),
    "odometry": ("automodel calibrate odometry", "speed and way are wrong"),
}
NARROW_RAD, WIDE_RAD = math.radians(25.0), math.radians(150.0)  # fields of view of cameras that lanes are seen with
CENTRE_OFF = 0.12  # share of the picture's size by which the lens's centre may lie off its middle


def judge_records(car: CarConfig, today: datetime.date) -> list[Finding]:
    """One finding a calibration."""
    if car.camera.source == "sim":
        return [skip("calibration", "the simulated car is built as car.toml says")]
    return [_record(what, getattr(car.calibration, what), today) for what in COMMANDS]


def _record(what: str, record: CalibrationRecord | None, today: datetime.date) -> Finding:
    name = f"{what} calibration"
    command, wrong = COMMANDS[what]
    if record is None:
        return warn(name, f"never calibrated: {wrong}", command)
    days = (today - record.date).days
    told = f"{record.date} by {record.method}: {record.residual}"
    if days < 0:
        return warn(name, f"{told}; that day has not come yet", "set this machine's clock, or calibrate again")
    if days > FRESH_DAYS:
        return warn(name, f"{told}; {days} days ago", f"{command}, or drive on if nothing was touched since")
    return okay(name, told)


def judge_lens(car: CarConfig) -> Finding:
    """Whether the intrinsics can be those of a lens before a sensor of that many pixels."""
    name, camera, lens = "lens", car.camera, car.camera.intrinsics
    if camera.source != "sim" and lens == Intrinsics():
        return warn(name, "[camera.intrinsics] are still the simulated camera's", COMMANDS["camera"][0])
    view = 2.0 * math.atan(0.5 * camera.width_px / lens.fx_px)
    off_u = abs(lens.cx_px - 0.5 * (camera.width_px - 1)) / camera.width_px
    off_v = abs(lens.cy_px - 0.5 * (camera.height_px - 1)) / camera.height_px
    do = f"calibrate at {camera.width_px}x{camera.height_px}: {COMMANDS['camera'][0]}"
    if max(off_u, off_v) > CENTRE_OFF:
        where = f"{lens.cx_px:.0f}, {lens.cy_px:.0f}"
        return warn(name, f"its centre {where} lies far off the middle: made for another picture size?", do)
    if not NARROW_RAD < view < WIDE_RAD:
        return warn(name, f"it sees {math.degrees(view):.0f} deg across: made for another picture size?", do)
    if not 0.9 < lens.fx_px / lens.fy_px < 1.1:
        return warn(name, f"fx {lens.fx_px:.0f} and fy {lens.fy_px:.0f} px differ: pixels are square", do)
    return okay(name, f"sees {math.degrees(view):.0f} deg across, centre {lens.cx_px:.0f}, {lens.cy_px:.0f}")


def judge_steering(car: CarConfig) -> Finding:
    """Whether the servo's table reaches as far as the limits let the car steer."""
    name, servo = "servo table", car.link.servo
    left, right = max(servo.steering_rad), -min(servo.steering_rad)
    what = f"{left:.2f} rad left to {right:.2f} right, {servo.pulse_us[0]:g} to {servo.pulse_us[-1]:g} us"
    wanted = car.safety.steering_max_rad
    if min(left, right) < 0.98 * wanted:
        do = f"set [safety] steering_max_rad to {min(left, right):.2f}: the controller counts on what it asks for"
        return warn(name, f"{what}; the limits allow {wanted:.2f}", do)
    return okay(name, what)

"""The machine itself: packages, OpenCV's build, disk, clock."""

from __future__ import annotations

import datetime
import re
from collections.abc import Mapping, Sequence

from automodel.config import CameraConfig, RecordingConfig
from automodel.doctor.findings import Finding, fail, okay, warn

LITTLE_MIN, SCARCE_MIN = 2.0, 15.0  # minutes of recording that the disk has room for
SPARE = 2.0  # times the recording's bytes a second that the disk should take
MONOTONIC_STEP_S = 1e-3  # of the clock, at most
_CHIEF = ("numpy", "opencv-python-headless", "onnxruntime", "pyserial")
_PICTURE_SHARE = {"png": 0.6, "jpeg": 0.15}  # of its pixels' bytes, where no picture was there to measure


def wanted_packages(requirements: Sequence[str]) -> dict[str, str]:
    """Name -> least version, of the requirements that hold on every machine: those without a condition."""
    plain = (re.fullmatch(r"\s*([\w.-]+)\s*>=\s*([\d.]+)\s*", line) for line in requirements)
    return {match[1]: match[2] for match in plain if match}


def judge_packages(wanted: Mapping[str, str], installed: Mapping[str, str | None]) -> Finding:
    """Python packages: name -> least version, and name -> the version that is there, None where there is none."""
    name = "packages"
    missing = [package for package in wanted if installed.get(package) is None]
    if missing:
        return fail(name, f"missing: {', '.join(missing)}", f"pip install {' '.join(missing)}")
    old = [p for p, least in wanted.items() if _numbers(installed[p] or "") < _numbers(least)]
    if old:
        told = ", ".join(f"{package} {installed[package]} (wanted: {wanted[package]})" for package in old)
        return fail(name, f"too old: {told}", f"pip install --upgrade {' '.join(old)}")
    chief = ", ".join(f"{package} {installed[package]}" for package in _CHIEF if package in installed)
    return okay(name, f"all {len(wanted)} are there: {chief}")


def _numbers(version: str) -> tuple[int, ...]:
    """The leading numbers of a version, zeros at their end left out: 1.26.0 is as old as 1.26."""
    match = re.match(r"\d+(\.\d+)*", version)
    numbers = [int(part) for part in match[0].split(".")] if match else []
    while numbers and numbers[-1] == 0:
        numbers.pop()
    return tuple(numbers)


def judge_opencv(version: str, build: str, source: str) -> Finding:
    """What OpenCV was built with (`cv2.getBuildInformation()`), for the camera `source` of car.toml."""
    name = "opencv"
    parts = {part: _built_with(build, part) for part in ("v4l/v4l2", "FFMPEG")}
    what = f"{version}; " + ", ".join(f"{part} {'yes' if there else 'no'}" for part, there in parts.items())
    do = "pip install --force-reinstall opencv-python-headless"
    if source == "usb" and not parts["v4l/v4l2"]:
        return fail(name, f"{what}: it cannot open a USB camera", do)
    if not parts["FFMPEG"]:
        return warn(name, f"{what}: it reads no videos", do)
    return okay(name, what)


def _built_with(build: str, part: str) -> bool:
    return re.search(rf"^\s*{re.escape(part)}:\s+YES", build, re.MULTILINE) is not None


def judge_gstreamer(launcher: bool, jetson_source: bool, source: str) -> Finding:
    """`launcher`: gst-launch-1.0 is there; `jetson_source`: nvarguscamerasrc is; `source` is car.toml's camera."""
    name = "gstreamer"
    said = f"gst-launch-1.0 {'yes' if launcher else 'no'}, nvarguscamerasrc {'yes' if jetson_source else 'no'}"
    if source != "csi":
        return okay(name, f"{said}; only a CSI camera needs them")
    if not launcher:
        return fail(name, said, "apt-get install gstreamer1.0-tools")
    if not jetson_source:
        return fail(name, said, "a CSI camera needs a Jetson with NVIDIA's own system (JetPack); use a USB camera")
    return okay(name, said)


def judge_clock(wall: datetime.date, built: datetime.date, step_s: float, backwards: int) -> Finding:
    """The clocks: wall time [date] against the day when the program came here, and the monotonic one as sampled."""
    name = "clock"
    if backwards or step_s > MONOTONIC_STEP_S:
        what = f"the monotonic clock went back {backwards} times, its steps are {step_s * 1e3:g} ms"
        return fail(name, what, "update the kernel; without a clock nothing is safe")
    if wall < built:
        do = "let it find the network once (timedatectl set-ntp true), or set it by hand (date -s)"
        return warn(name, f"the calendar says {wall}, before this program was installed ({built})", do)
    return okay(name, f"{wall}; the monotonic clock rises in steps of {step_s * 1e9:g} ns")


def recording_bytes_per_s(camera: CameraConfig, recording: RecordingConfig, picture_bytes: int | None) -> float:
    """What a run writes [byte/s]; `picture_bytes` of one compressed picture, None where none was measured."""
    if picture_bytes is None:
        raw = camera.width_px * camera.height_px * (3 if camera.colour else 1)
        picture_bytes = round(raw * _PICTURE_SHARE[recording.image])
    return picture_bytes * camera.rate_hz


def judge_disk(folder: str, free_bytes: int, written_bytes_per_s: float, needed_bytes_per_s: float) -> Finding:
    """Room and speed [byte/s] of the disk that recordings go to."""
    name = "disk"
    minutes = free_bytes / needed_bytes_per_s / 60.0
    speed, needed = written_bytes_per_s * 1e-6, needed_bytes_per_s * 1e-6
    what = f"{folder}: {free_bytes * 1e-9:.1f} GB free, {_time(minutes)} of recording at {needed:.1f} MB/s; "
    what += f"writes {speed:.0f} MB/s"
    if minutes < LITTLE_MIN:
        return fail(name, what, "make room: a full disk ends the recording (old recordings, apt-get clean)")
    if speed < needed:
        do = 'recordings lose frames: another disk, or [recording] image = "jpeg"'
        return fail(name, what, do)
    if minutes < SCARCE_MIN:
        return warn(name, what, "make room, or set [recording] directory to another disk")
    if speed < SPARE * needed:
        return warn(name, what, 'little to spare: another disk, or [recording] image = "jpeg"')
    return okay(name, what)


def _time(minutes: float) -> str:
    return f"{minutes:.0f} min" if minutes < 120 else f"{minutes / 60:.0f} h"

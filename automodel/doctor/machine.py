"""Checks the machine: Python, packages, OpenCV, GStreamer, the network and its provider, clocks, disk."""

from __future__ import annotations

import datetime
import importlib.metadata
import itertools
import os
import platform
import re
import shutil
import statistics
import subprocess
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2

import automodel
from automodel.config import CameraConfig, CarConfig, RecordingConfig
from automodel.doctor.findings import Finding, bounded, fail, okay, skip, warn
from automodel.perception.markings.unet import MarkingNetwork, UnetConfig, drawn_lines, offered_providers
from automodel.recording.codec import ImageCodec
from automodel.runtime.cores import denied, usable_cores
from automodel.types import Image

LITTLE_MIN, SCARCE_MIN = 2.0, 15.0  # free space in minutes of recording: FAIL, WARN
SPARE = 2.0  # ratio of the disk's speed to the recording's
MONOTONIC_STEP_S = 1e-3  # coarsest resolution of the clock
_CHIEF = ("numpy", "opencv-python-headless", "onnxruntime", "pyserial")
_IMAGE_SHARE = {"png": 0.6, "jpeg": 0.2}  # compressed size over raw size, without a measured image


def judge_scheduling(cores: int, denied: Sequence[str]) -> Finding:
    """What of `runtime.cores` the system does not let a run do on so many cores."""
    if cores < 2:
        return skip("scheduling", "a single core, which the loop shares with everything else")
    if not denied:
        return okay("scheduling", "the loop has a core, goes before other processes, and is never swapped out")
    do = "write '@dialout - nice -15' and '@dialout - memlock unlimited' into /etc/security/limits.d/automodel.conf"
    return warn("scheduling", "; ".join(denied), f"{do}, and log in anew")


def needed_extras(car: CarConfig) -> frozenset[str]:
    """The extras of the package that this car cannot drive without."""
    network = car.pipeline.name == "centerline" and car.pipeline.centerline.markings == "unet"
    return frozenset(["centerline"] * network + ["can"] * (car.link.kind == "can"))


def wanted_packages(requirements: Sequence[str], extras: frozenset[str] = frozenset()) -> dict[str, str]:
    """Name -> least version of the requirements that hold on every machine, and of those of some `extras`."""
    pattern = r"\s*([\w.-]+)\s*>=\s*([\d.]+)\s*(?:;\s*extra\s*==\s*[\"'](\w+)[\"']\s*)?"
    plain = (re.fullmatch(pattern, line) for line in requirements)
    return {match[1]: match[2] for match in plain if match and (match[3] is None or match[3] in extras)}


def judge_packages(wanted: Mapping[str, str], installed: Mapping[str, str | None]) -> Finding:
    """Python packages: name -> least version, and name -> installed version, None where it is missing."""
    name = "packages"
    missing = [package for package in wanted if installed.get(package) is None]
    if missing:
        return fail(name, f"missing: {', '.join(missing)}", f"pip install {' '.join(missing)}")
    old = [p for p, least in wanted.items() if _numbers(installed[p] or "") < _numbers(least)]
    if old:
        versions = ", ".join(f"{package} {installed[package]} (at least {wanted[package]})" for package in old)
        return fail(name, f"too old: {versions}", f"pip install --upgrade {' '.join(old)}")
    chief = ", ".join(f"{package} {installed[package]}" for package in _CHIEF if package in installed)
    return okay(name, f"all {len(wanted)} are installed: {chief}")


def _numbers(version: str) -> tuple[int, ...]:
    """The leading numbers of a version without trailing zeros: 1.26.0 is 1.26."""
    match = re.match(r"\d+(\.\d+)*", version)
    numbers = [int(part) for part in match[0].split(".")] if match else []
    while numbers and numbers[-1] == 0:
        numbers.pop()
    return tuple(numbers)


def judge_opencv(version: str, build: str, source: str) -> Finding:
    """The features of OpenCV (`cv2.getBuildInformation()`) for the camera `source` of car.toml."""
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
    """`launcher`: gst-launch-1.0 is installed; `jetson_source`: nvarguscamerasrc is; `source` is car.toml's camera."""
    name = "gstreamer"
    said = f"gst-launch-1.0 {'yes' if launcher else 'no'}, nvarguscamerasrc {'yes' if jetson_source else 'no'}"
    if source != "csi":
        return okay(name, f"{said}; only a CSI camera needs them")
    if not launcher:
        return fail(name, said, "apt-get install gstreamer1.0-tools")
    if not jetson_source:
        return fail(name, said, "a CSI camera needs a Jetson with NVIDIA's system (JetPack); use a USB camera")
    return okay(name, said)


def judge_clock(wall: datetime.date, built: datetime.date, step_s: float, backwards: int) -> Finding:
    """The calendar against the day of installation, and samples of the monotonic clock."""
    name = "clock"
    if backwards or step_s > MONOTONIC_STEP_S:
        what = f"the monotonic clock went back {backwards} times, its resolution is {step_s * 1e3:g} ms"
        return fail(name, what, "update the kernel: all timeouts depend on this clock")
    if wall < built:
        do = "connect to a network once (timedatectl set-ntp true), or set the clock by hand (date -s)"
        return warn(name, f"the calendar says {wall}, before this program was installed ({built})", do)
    return okay(name, f"{wall}; resolution of the monotonic clock {step_s * 1e9:g} ns")


def recording_bytes_per_s(camera: CameraConfig, recording: RecordingConfig, image_bytes: int | None) -> float:
    """The rate of a recording [byte/s]; `image_bytes` of one compressed image, None where it was not measured."""
    if image_bytes is None:
        raw = camera.width_px * camera.height_px * (3 if camera.colour else 1)
        image_bytes = round(raw * _IMAGE_SHARE[recording.image])
    return image_bytes * camera.rate_hz


def judge_disk(folder: str, free_bytes: int, written_bytes_per_s: float, needed_bytes_per_s: float) -> Finding:
    """Free space and speed [byte/s] of the disk for recordings."""
    name = "disk"
    minutes = free_bytes / needed_bytes_per_s / 60.0
    speed, needed = written_bytes_per_s * 1e-6, needed_bytes_per_s * 1e-6
    what = f"{folder}: {free_bytes * 1e-9:.1f} GB free, {_time(minutes)} of recording at {needed:.1f} MB/s; "
    what += f"writes {speed:.0f} MB/s"
    if minutes < LITTLE_MIN:
        return fail(name, what, "free space: a full disk ends the recording (old recordings, apt-get clean)")
    if speed < needed:
        do = "recordings lose frames: use another disk, or a lower [recording] jpeg_quality"
        return fail(name, what, do)
    if minutes < SCARCE_MIN:
        return warn(name, what, "free space, or set [recording] directory to another disk")
    if speed < SPARE * needed:
        return warn(name, what, "hardly fast enough: use another disk, or a lower [recording] jpeg_quality")
    return okay(name, what)


def _time(minutes: float) -> str:
    return f"{minutes:.0f} min" if minutes < 120 else f"{minutes / 60:.0f} h"


_OTHER_OPENCV = ("opencv-python", "opencv-contrib-python", "opencv-contrib-python-headless")
_IMAGES = 7  # through the network, for its median time
_NETWORK_S = 120.0  # TensorRT compiles for minutes
_DISK_BYTES = 8_000_000
_JETSON = Path("/etc/nv_tegra_release")


def machine_findings(car: CarConfig) -> Iterator[Finding]:
    """All checks that need no car."""
    source = car.camera.source
    yield okay("python", f"{platform.python_version()}, {platform.machine()}, {os.cpu_count()} cores")
    yield judge_scheduling(usable_cores(), denied())
    yield bounded(
        "packages", lambda: _packages(car), 10.0, "make a new virtual environment: python3 -m venv, pip install"
    )
    yield judge_opencv(cv2.__version__, cv2.getBuildInformation(), source)
    yield bounded(
        "gstreamer", lambda: _gstreamer(source), 20.0, "gst-inspect-1.0 nvarguscamerasrc hangs: restart the machine"
    )
    yield from _network_findings(car)
    yield _clock()


def disk_finding(car: CarConfig, image: Image | None) -> Finding:
    """The disk for recordings; `image` is one of the camera's, None where there is none."""

    def look() -> Finding:
        folder = _existing_folder(Path(car.recording.directory))
        size = None if image is None else len(ImageCodec(car.recording).encode(0, image))
        needed = recording_bytes_per_s(car.camera, car.recording, size)
        return judge_disk(str(folder), shutil.disk_usage(folder).free, _written_per_s(folder), needed)

    return bounded("disk", look, 20.0, "set [recording] directory to a folder that can be written")


def _packages(car: CarConfig) -> Finding:
    try:
        requirements = importlib.metadata.requires("automodel") or []
    except importlib.metadata.PackageNotFoundError:
        return skip("packages", "automodel is not installed by pip: its requirements are unknown", "pip install .")
    wanted = wanted_packages(requirements, needed_extras(car))
    return judge_packages(wanted, {package: _version_of(package) for package in wanted})


def _version_of(package: str) -> str | None:
    """The version that is installed; any OpenCV is one, the Jetson's own too."""
    names = (package, *_OTHER_OPENCV) if package.startswith("opencv") else (package,)
    for name in names:
        try:
            return importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            continue
    return cv2.__version__ if package.startswith("opencv") else None


def _gstreamer(source: str) -> Finding:
    launcher = shutil.which("gst-launch-1.0") is not None
    inspect = shutil.which("gst-inspect-1.0")
    jetson = False
    if inspect is not None:
        asked = subprocess.run([inspect, "nvarguscamerasrc"], capture_output=True, timeout=15.0, check=False)
        jetson = asked.returncode == 0
    return judge_gstreamer(launcher, jetson, source)


@dataclass(frozen=True, slots=True, kw_only=True)
class _Tried:
    """The result of running the network: providers offered, the one used and its notice, times [s]."""

    offered: tuple[str, ...]
    provider: str
    notice: str
    started_s: float
    image_s: float


def _network_findings(car: CarConfig) -> Iterator[Finding]:
    options = car.pipeline.centerline
    if car.pipeline.name != "centerline" or options.markings != "unet":
        yield skip("network", f"pipeline {car.pipeline.name} uses none as configured")
        return
    config = UnetConfig(model=options.model, size=options.network, providers=options.providers, threads=options.threads)
    do = "see [pipeline.centerline] model and providers; TensorRT compiles for minutes: leave it out of providers"
    tried = bounded("network", lambda: _try_network(config), _NETWORK_S, do)
    if isinstance(tried, Finding):
        yield tried
        return
    yield _provider_finding(tried, options.providers)
    what = f"{options.network}, self-test passed, ready in {tried.started_s:.2f} s, "
    what += f"{tried.image_s * 1e3:.1f} ms an image"
    if tried.image_s * car.camera.rate_hz > 1.0:
        every = f"a frame comes every {1e3 / car.camera.rate_hz:.1f} ms"
        do = f'set [pipeline.centerline] network = "birdseye", or [pipeline] name = "contour": {every}'
        yield warn("network", what, do)
    else:
        yield okay("network", what)


def _provider_finding(tried: _Tried, asked: tuple[str, ...]) -> Finding:
    what = f"installed are {', '.join(tried.offered)}; {tried.notice}"
    before = tried.offered[: tried.offered.index(tried.provider)] if tried.provider in tried.offered else ()
    if any(provider in asked for provider in before):
        return warn(
            "providers", what, "correct what it reports, or leave that provider out of [pipeline.centerline] providers"
        )
    if tried.provider == "cpu" and _JETSON.exists():
        return warn("providers", what, "install NVIDIA's onnxruntime for this JetPack: its GPU is several times faster")
    return okay("providers", what)


def _try_network(config: UnetConfig) -> _Tried:
    start = time.perf_counter()
    network = MarkingNetwork(config)
    ready = time.perf_counter()
    image, _ = drawn_lines(network.width_px, network.height_px)
    times = []
    for _ in range(_IMAGES):
        before = time.perf_counter()
        network.step(image)
        times.append(time.perf_counter() - before)
    return _Tried(
        offered=tuple(offered_providers()),
        provider=network.provider,
        notice=network.notice,
        started_s=ready - start,
        image_s=statistics.median(times),
    )


def _clock() -> Finding:
    reads = [time.monotonic_ns() for _ in range(1000)]
    backwards = sum(b < a for a, b in itertools.pairwise(reads))
    installed = datetime.date.fromtimestamp(Path(automodel.__file__).stat().st_mtime)
    step_s = time.get_clock_info("monotonic").resolution
    return judge_clock(datetime.date.today(), installed, step_s, backwards)


def _existing_folder(folder: Path) -> Path:
    """The folder, or the nearest one above it that exists: the doctor creates none."""
    folder = folder.absolute()
    while not folder.is_dir() and folder != folder.parent:
        folder = folder.parent
    return folder


def _written_per_s(folder: Path) -> float:
    """The speed [byte/s] of a synced write to a temporary file."""
    data = os.urandom(_DISK_BYTES)
    with tempfile.TemporaryFile(dir=folder) as file:
        start = time.perf_counter()
        file.write(data)
        file.flush()
        os.fsync(file.fileno())
        return _DISK_BYTES / max(time.perf_counter() - start, 1e-9)

"""Looks at the machine: Python, packages, OpenCV, GStreamer, the network and what runs it, clocks, the disk."""

from __future__ import annotations

import datetime
import importlib.metadata
import itertools
import os
import platform
import shutil
import statistics
import subprocess
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2

import automodel
from automodel.cli.doctor_bounds import bounded
from automodel.config import CarConfig
from automodel.doctor.findings import Finding, okay, skip, warn
from automodel.doctor.machine import (
    judge_clock,
    judge_disk,
    judge_gstreamer,
    judge_opencv,
    judge_packages,
    recording_bytes_per_s,
    wanted_packages,
)
from automodel.perception.self_test import drawn_lines
from automodel.perception.unet import PROVIDERS, MarkingNetwork, UnetConfig
from automodel.recording.images import ImageCodec
from automodel.types import Image

_OTHER_OPENCV = ("opencv-python", "opencv-contrib-python", "opencv-contrib-python-headless")
_PICTURES = 7  # through the network, for its time
_NETWORK_S = 120.0  # TensorRT compiles for minutes
_DISK_BYTES = 8_000_000
_JETSON = Path("/etc/nv_tegra_release")


def machine_findings(car: CarConfig) -> Iterator[Finding]:
    """What does not need the car."""
    source = car.camera.source
    yield okay("python", f"{platform.python_version()}, {platform.machine()}, {os.cpu_count()} cores")
    yield bounded("packages", _packages, 10.0, "make a new virtual environment: python3 -m venv, pip install")
    yield judge_opencv(cv2.__version__, cv2.getBuildInformation(), source)
    yield bounded("gstreamer", lambda: _gstreamer(source), 20.0, "gst-inspect-1.0 nvarguscamerasrc hangs: restart")
    yield from _network_findings(car)
    yield _clock()


def disk_finding(car: CarConfig, picture: Image | None) -> Finding:
    """Room and speed of the disk for recordings; `picture` is one of the camera's, None where there is none."""

    def look() -> Finding:
        folder = _standing_folder(Path(car.recording.directory))
        size = None if picture is None else len(ImageCodec(car.recording).encode(0, picture))
        needed = recording_bytes_per_s(car.camera, car.recording, size)
        return judge_disk(str(folder), shutil.disk_usage(folder).free, _written_per_s(folder), needed)

    return bounded("disk", look, 20.0, "make [recording] directory a folder that can be written")


def _packages() -> Finding:
    try:
        requirements = importlib.metadata.requires("automodel") or []
    except importlib.metadata.PackageNotFoundError:
        return skip("packages", "automodel is not installed by pip: nothing says which it wants", "pip install .")
    wanted = wanted_packages(requirements)
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
    """The network as it ran."""

    offered: tuple[str, ...]
    provider: str
    told: str
    started_s: float
    picture_s: float


def _network_findings(car: CarConfig) -> Iterator[Finding]:
    options = car.pipeline.centerline
    if car.pipeline.name != "centerline" or options.markings != "unet":
        yield skip("network", f"pipeline {car.pipeline.name} as set needs none")
        return
    config = UnetConfig(model=options.model, size=options.network, providers=options.providers, threads=options.threads)
    do = "see [pipeline.centerline] model and providers; TensorRT compiles for minutes: leave it out of providers"
    tried = bounded("network", lambda: _try_network(config), _NETWORK_S, do)
    if isinstance(tried, Finding):
        yield tried
        return
    yield _provider_finding(tried, options.providers)
    what = f"{options.network}, self-test passed, ready in {tried.started_s:.2f} s, "
    what += f"{tried.picture_s * 1e3:.1f} ms a picture"
    if tried.picture_s * car.camera.rate_hz > 1.0:
        do = f'[pipeline.centerline] network = "256x128": frames come each {1e3 / car.camera.rate_hz:.1f} ms'
        yield warn("network", what, do)
    else:
        yield okay("network", what)


def _provider_finding(tried: _Tried, asked: tuple[str, ...]) -> Finding:
    what = f"onnxruntime offers {', '.join(tried.offered)}; {tried.told}"
    before = tried.offered[: tried.offered.index(tried.provider)] if tried.provider in tried.offered else ()
    if any(provider in asked for provider in before):
        return warn(
            "providers", what, "mend what it says, or leave that provider out of [pipeline.centerline] providers"
        )
    if tried.provider == "cpu" and _JETSON.exists():
        return warn("providers", what, "install NVIDIA's onnxruntime for this JetPack: its GPU is several times faster")
    return okay("providers", what)


def _try_network(config: UnetConfig) -> _Tried:
    import onnxruntime

    start = time.perf_counter()
    network = MarkingNetwork(config)
    ready = time.perf_counter()
    picture, _ = drawn_lines(network.width_px, network.height_px)
    times = []
    for _ in range(_PICTURES):
        begin = time.perf_counter()
        network.step(picture)
        times.append(time.perf_counter() - begin)
    there = onnxruntime.get_available_providers()
    return _Tried(
        offered=tuple(name for name, provider in PROVIDERS.items() if provider in there),
        provider=network.provider,
        told=network.told,
        started_s=ready - start,
        picture_s=statistics.median(times),
    )


def _clock() -> Finding:
    reads = [time.monotonic_ns() for _ in range(1000)]
    backwards = sum(b < a for a, b in itertools.pairwise(reads))
    installed = datetime.date.fromtimestamp(Path(automodel.__file__).stat().st_mtime)
    step_s = time.get_clock_info("monotonic").resolution
    return judge_clock(datetime.date.today(), installed, step_s, backwards)


def _standing_folder(folder: Path) -> Path:
    """The folder, or the one above it that is there: the doctor makes none."""
    folder = folder.absolute()
    while not folder.is_dir() and folder != folder.parent:
        folder = folder.parent
    return folder


def _written_per_s(folder: Path) -> float:
    """Bytes a second that reach the disk; nothing stays behind."""
    data = os.urandom(_DISK_BYTES)
    with tempfile.TemporaryFile(dir=folder) as file:
        begin = time.perf_counter()
        file.write(data)
        file.flush()
        os.fsync(file.fileno())
        return _DISK_BYTES / max(time.perf_counter() - begin, 1e-9)

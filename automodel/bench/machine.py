"""The machine that a measurement was made on, so that the figures of two machines can be compared."""

from __future__ import annotations

import importlib.metadata
import os
import platform
from pathlib import Path
from typing import Any

_PACKAGES = ("numpy", "opencv-python-headless", "onnxruntime", "numba", "scipy")
_MODEL = Path("/proc/device-tree/model")  # a Jetson, a Raspberry Pi
_CPUINFO = Path("/proc/cpuinfo")
_FREQUENCY = Path("/sys/devices/system/cpu/cpu0/cpufreq")


def this_machine() -> dict[str, Any]:
    """Names and versions; None for what this machine does not say.

    `cores_usable` are those that the process may run on, `load_1min` the mean number of processes that wanted a core.
    """
    return {
        "model": _text(_MODEL) or _cpu_name(_text(_CPUINFO)) or None,
        "architecture": platform.machine(),
        "cores": os.cpu_count(),
        "cores_usable": len(os.sched_getaffinity(0)),
        "governor": _text(_FREQUENCY / "scaling_governor"),
        "max_mhz": _mhz(_text(_FREQUENCY / "scaling_max_freq")),
        "load_1min": round(os.getloadavg()[0], 2),
        "kernel": platform.release(),
        "python": platform.python_version(),
        **{package: _version(package) for package in _PACKAGES},
    }


def described(machine: dict[str, Any]) -> str:
    """The chief of it in one line, for people."""
    clock = "" if machine["max_mhz"] is None else f", up to {machine['max_mhz']:.0f} MHz"
    governor = "" if machine["governor"] is None else f", governor {machine['governor']}"
    return (
        f"{machine['model'] or machine['architecture']}, {machine['cores_usable']} of {machine['cores']} cores"
        f"{clock}{governor}, load {machine['load_1min']:g}, Python {machine['python']}, numpy {machine['numpy']}"
    )


def _text(path: Path) -> str | None:
    try:
        return path.read_text(errors="replace").strip("\0\n ") or None
    except OSError:
        return None


def _cpu_name(cpuinfo: str | None) -> str | None:
    """The processor in /proc/cpuinfo; ARM kernels say it as "Hardware", if at all."""
    for line in (cpuinfo or "").splitlines():
        key, _, value = line.partition(":")
        if key.strip() in ("model name", "Hardware", "Model") and value.strip():
            return value.strip()
    return None


def _mhz(khz: str | None) -> float | None:
    return float(khz) / 1000.0 if khz is not None and khz.isdigit() else None


def _version(package: str) -> str | None:
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return None

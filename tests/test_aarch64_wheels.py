"""Every dependency has a wheel for the boards: nothing is compiled on a Jetson or a Raspberry Pi.

glibc 2.27 is that of the old Jetson Nano (JetPack 4.6), 2.35 that of an Orin Nano (JetPack 6); a newer system takes the
wheels of an older one. pip resolves for them on any machine; nothing is installed.
"""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

from automodel.config.toml_reader import parse_toml

ROOT = Path(__file__).resolve().parents[1]
PROJECT = parse_toml((ROOT / "pyproject.toml").read_text(), "pyproject.toml")["project"]
ON_A_CAR = ("web", "foxglove", "openvino")
OLDEST = 17  # of glibc's minor versions that wheels for aarch64 are built for


def requirements() -> list[str]:
    """What a car may need: the dependencies and the extras, without those that name others."""
    extras = PROJECT["optional-dependencies"]
    return [*PROJECT["dependencies"], *(line for name in ON_A_CAR for line in extras[name])]


def pip(*words: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "pip", "--disable-pip-version-check", "--retries", "1", *words]
    return subprocess.run(command, capture_output=True, text=True, timeout=280)


@pytest.fixture(scope="module")
def index() -> None:
    """Skips where pip reaches no package index: it would have this machine's numpy."""
    done = pip("install", "--dry-run", "--quiet", "--ignore-installed", "--no-deps", "numpy")
    if done.returncode != 0:
        pytest.skip("pip reaches no package index: what there is for the boards cannot be looked up")


def resolved(folder: Path, glibc_minor: int, python: str, wanted: list[str]) -> dict[str, str]:
    """Name -> wheel that pip would install on such a board; raises AssertionError where it finds none."""
    platforms = [f"manylinux_2_{minor}_aarch64" for minor in range(OLDEST, glibc_minor + 1)]
    tags = [word for tag in (*platforms, "manylinux2014_aarch64") for word in ("--platform", tag)]
    report = folder / "report.json"
    done = pip(
        "install", "--dry-run", "--quiet", "--ignore-installed", "--no-compile", "--report", str(report),
        "--target", str(folder / "nowhere"), "--only-binary=:all:", "--python-version", python, *tags, *wanted,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    wheels = json.loads(report.read_text())["install"]
    return {wheel["metadata"]["name"].lower(): wheel["download_info"]["url"].rsplit("/", 1)[1] for wheel in wheels}


@pytest.mark.slow
@pytest.mark.parametrize(("python", "glibc_minor"), [("3.10", 27), ("3.12", 35)])
def test_there_are_wheels_for_the_boards(index: None, glibc_minor: int, python: str, tmp_path: Path) -> None:
    wheels = resolved(tmp_path, glibc_minor, python, requirements())
    for name in ("numpy", "opencv-python-headless", "onnxruntime", "scipy", "numba", "llvmlite", "mcap", "cantools"):
        assert name in wheels
    assert not (tmp_path / "nowhere").exists()
    for wheel in wheels.values():
        assert wheel.endswith(("none-any.whl", "aarch64.whl")), wheel


@pytest.mark.slow
def test_there_are_wheels_beside_an_older_numpy(index: None, tmp_path: Path) -> None:
    """Raspberry Pi OS 12: its picamera2 was built for numpy 1."""
    wheels = resolved(tmp_path, 36, "3.11", [*requirements(), "numpy<2"])
    assert wheels["numpy"].startswith("numpy-1.")
    assert "opencv-python-headless" in wheels


@pytest.mark.slow
def test_what_has_no_wheel_is_found(index: None, tmp_path: Path) -> None:
    with pytest.raises(AssertionError, match="onnxruntime"):
        resolved(tmp_path, 27, "3.10", ["onnxruntime>=1.24"])  # the last for Python 3.10 is 1.23

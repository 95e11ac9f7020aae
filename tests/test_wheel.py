"""The wheel carries all that is needed: it runs where the checkout is not."""

from __future__ import annotations

import functools
import json
import os
import shutil
import subprocess
import sys
import sysconfig
import venv
import zipfile
from pathlib import Path

import pytest

pytestmark = pytest.mark.slow
ROOT = Path(__file__).resolve().parents[1]
BUILT_FROM = ("automodel", "firmware_link", "calibration", "tracks", "pyproject.toml", "README.md", "LICENSE")


def call(*command: object, cwd: Path, **more: str) -> str:
    """stdout of a command that succeeds, without the environment's own ways to find modules but with `more`."""
    environment = {k: v for k, v in os.environ.items() if not k.startswith(("PYTHON", "PIP_", "VIRTUAL_ENV", "NUMBA_"))}
    words = [str(word) for word in command]
    done = subprocess.run(words, cwd=cwd, env=environment | more, capture_output=True, text=True)
    assert done.returncode == 0, f"{' '.join(words)}\n{done.stdout}\n{done.stderr}"
    return done.stdout


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The wheel, built from a copy so that nothing of the build stays in the checkout."""
    folder = tmp_path_factory.mktemp("wheel")
    for name in BUILT_FROM:
        if (ROOT / name).is_dir():
            shutil.copytree(ROOT / name, folder / "tree" / name, ignore=shutil.ignore_patterns("__pycache__"))
        else:
            shutil.copy(ROOT / name, folder / "tree" / name)
    build = [sys.executable, "-m", "pip", "wheel", "--no-deps", "--no-build-isolation", "--quiet"]
    call(*build, "--wheel-dir", folder, folder / "tree", cwd=folder)
    (built,) = folder.glob("automodel-*.whl")
    shutil.rmtree(folder / "tree")
    return built


@pytest.fixture(scope="module")
def python(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A fresh environment's interpreter: the wheel is installed there, its dependencies are seen where they are."""
    folder = tmp_path_factory.mktemp("venv")
    venv.create(folder, with_pip=False, symlinks=True)
    interpreter = folder / "bin" / "python"
    own = Path(call(interpreter, "-c", "import sysconfig; print(sysconfig.get_path('purelib'))", cwd=folder).strip())
    call(sys.executable, "-m", "pip", "install", "--no-deps", "--quiet", "--target", own, wheel, cwd=folder)
    # A path in a .pth file comes after the environment's own, and the .pth files in it are not read.
    (own / "dependencies.pth").write_text(sysconfig.get_path("purelib") + "\n")
    return interpreter


def test_the_wheel_holds_the_three_packages_and_the_tracks(wheel: Path) -> None:
    names = zipfile.ZipFile(wheel).namelist()
    for wanted in (
        "tracks/tmr.toml",
        "tracks/oval.toml",
        "tracks/chicane.toml",
        "tracks/README.md",
        "automodel/py.typed",
        "automodel/cli/kits/nano-arduino.toml",
        "automodel/recording/foxglove_layout.json",
        "firmware_link/arduino.py",
        "calibration/__init__.py",
    ):
        assert wanted in names
    tops = {name.split("/")[0] for name in names if ".dist-info" not in name}
    assert tops == {"automodel", "firmware_link", "calibration", "tracks"}


def test_an_installed_wheel_drives(python: Path, tmp_path: Path) -> None:
    """The default pipeline finds its network; and in real time, the world's process its modules."""
    for module in ("automodel.cli.main", "firmware_link.arduino", "calibration", "tracks"):
        file = call(python, "-c", f"import {module} as module; print(module.__file__)", cwd=tmp_path).strip()
        assert Path(file).is_relative_to(python.parents[1])
    run = functools.partial(call, python, "-m", "automodel", "run", "--track", "oval", "--json", cwd=tmp_path)
    (row,) = json.loads(run("--duration", "3"))["rows"]
    assert (row["left_lane"], row["stops"]) == (0, 0)
    assert 0.0 < row["max_abs_offset_m"] < 0.1
    (row,) = json.loads(run("--realtime", "--duration", "0.3"))["rows"]
    assert row["stops"] == 0
    solves = "import numpy; from automodel.geometry.elimination import solve; solve(numpy.eye(2), numpy.eye(2))"
    call(python, "-c", solves, cwd=tmp_path, XDG_CACHE_HOME=str(tmp_path / "cache"))
    # Machine code among the modules would keep the package's folder alive when pip removes it.
    assert [path.name for path in tmp_path.iterdir()] == ["cache"]
    assert list((tmp_path / "cache" / "automodel").rglob("*.nbi"))
    assert {file.suffix for file in python.parents[1].rglob("automodel/**/__pycache__/*")} == {".pyc"}


def test_the_console_script_is_there(wheel: Path) -> None:
    archive = zipfile.ZipFile(wheel)
    (entry,) = (name for name in archive.namelist() if name.endswith("entry_points.txt"))
    assert "automodel = automodel.cli.main:main" in archive.read(entry).decode()

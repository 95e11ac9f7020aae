"""Compiled functions give what they give as Python, and their machine code lies in the user's cache folder only."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from automodel import compiled as module
from automodel.compiled import compiled
from automodel.config.parts import PIPELINES

ROOT = Path(__file__).resolve().parents[1]
POSTERIOR = """
import logging
import numpy as np
from automodel.estimation.clothoid.solvers import posterior
logging.basicConfig(level=logging.INFO, format="%(message)s")
print(posterior(np.diag([3.0, 1.0]), np.array([[1.0, 0.5], [0.5, 2.0]])).tolist())
"""
DRIVE = """
import dataclasses, gc, sys
import numpy as np
from numba.core.dispatcher import Dispatcher
from automodel.assembly.parts import make_pipeline
from automodel.sim.track_files import load_track
from tests.support.rendered_drives import CAR, RenderedDrive
from tests.support.stereo_drives import StereoDrive, stereo_car
def loaded():
    known = [each for each in gc.get_objects() if isinstance(each, Dispatcher)]
    ours = [each for each in known if each.py_func.__module__.startswith(STAGES)]
    return {each.py_func.__qualname__: len(each.signatures) for each in ours}
class InColour:
    def step(self, frame, motion):
        eyes = ("left", "right") if hasattr(frame, "left") else ("image",)
        images = {eye: np.repeat(getattr(frame, eye)[..., None], 3, axis=2) for eye in eyes}
        return pipeline.step(dataclasses.replace(frame, **images), motion)
STAGES = tuple(f"automodel.{stage}." for stage in ("perception", "estimation", "tracking", "pipelines"))
name = sys.argv[1]
drive, car = (StereoDrive, stereo_car()) if name == "stereo" else (RenderedDrive, CAR)
pipeline = make_pipeline(name, car)
before = loaded()
for each in (pipeline, InColour()):
    drive(track=load_track("oval"), car=car, pipeline=each, rate_hz=20.0).run(0.8, 2.6)
after = loaded()
print(sorted(name for name in after if after[name] != before.get(name, 0)), len(after) > 10)
"""
COMPILING = "compiling (once, takes one or two minutes, on a small board several)\n"


def run(tree: Path = ROOT, **environment: object) -> subprocess.CompletedProcess[str]:
    """Compute a posterior in a fresh process, with the package of `tree`."""
    kept = {name: value for name, value in os.environ.items() if not name.startswith(("NUMBA_", "XDG_"))}
    env = kept | {name: str(value) for name, value in environment.items()} | {"PYTHONPATH": str(tree)}
    command = [sys.executable, "-c", POSTERIOR]
    return subprocess.run(command, capture_output=True, text=True, env=env, check=True, cwd=tree)


@pytest.mark.parametrize("pipeline", PIPELINES.names)
def test_no_frame_waits_for_a_function_to_be_compiled(pipeline: str) -> None:
    """What a frame calls is compiled, or loaded, when the pipeline is built: grey ones and those in colour."""
    command = [sys.executable, "-c", DRIVE, pipeline]
    done = subprocess.run(command, capture_output=True, text=True, check=True, cwd=ROOT)
    assert done.stdout == "[] True\n"


def machine_code(folder: Path) -> set[Path]:
    return set(folder.rglob("*.nb[ic]"))


def test_a_compiled_function_gives_the_same() -> None:
    def total(values: np.ndarray, most: float) -> float:
        result = 0.0
        for i in range(len(values)):
            result += min(values[i], most)
        return result

    values = np.array([1.0, 7.0, 3.0])
    assert compiled(total)(values, 4.0) == total(values, 4.0) == pytest.approx(8.0)


def test_a_function_without_a_file_is_compiled_all_the_same() -> None:
    known: dict[str, object] = {}
    exec("def twice(x):\n    return 2 * x\n", known)
    assert compiled(known["twice"])(4) == 8  # type: ignore[type-var, operator]


def test_machine_code_is_kept_in_the_users_cache_folder_and_nowhere_else(tmp_path: Path) -> None:
    before = machine_code(ROOT)
    first = run(XDG_CACHE_HOME=tmp_path)
    (folder,) = tmp_path.iterdir()
    assert folder.name == "automodel"
    solvers = module._version(ROOT / "automodel" / "estimation" / "clothoid" / "solvers.py")
    assert f"solvers-{solvers}" in {version.name for version in folder.iterdir()}
    kept = machine_code(folder)
    assert kept
    second = run(XDG_CACHE_HOME=tmp_path)
    assert second.stdout == first.stdout
    assert (first.stderr, second.stderr) == (COMPILING, "")
    assert machine_code(tmp_path) == kept
    assert machine_code(ROOT) == before


def test_numbas_own_setting_for_the_folder_is_respected(tmp_path: Path) -> None:
    run(NUMBA_CACHE_DIR=tmp_path / "numba", XDG_CACHE_HOME=tmp_path / "cache")
    assert machine_code(tmp_path / "numba")
    assert not (tmp_path / "cache").exists()


def test_where_nothing_can_be_written_it_is_compiled_all_the_same(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    before = machine_code(ROOT)
    done = run(XDG_CACHE_HOME=tmp_path / "file", HOME=tmp_path / "file")
    assert done.stderr == COMPILING
    assert machine_code(ROOT) == before
    # as plain Python it gives the same
    assert np.allclose(eval(done.stdout), eval(run(NUMBA_DISABLE_JIT=1).stdout), rtol=1e-12)


def test_where_its_folder_cannot_be_made_it_is_compiled_all_the_same(tmp_path: Path) -> None:
    solvers = module._version(ROOT / "automodel" / "estimation" / "clothoid" / "solvers.py")
    (tmp_path / f"solvers-{solvers}").touch()
    assert run(NUMBA_CACHE_DIR=tmp_path).stderr == COMPILING


def test_what_is_kept_goes_by_the_source_not_by_its_place(tmp_path: Path) -> None:
    """Another environment with the same source need not compile again; one in which a number is another one must."""
    copy = tmp_path / "copy"
    shutil.copytree(ROOT / "automodel", copy / "automodel", ignore=shutil.ignore_patterns("__pycache__"))
    first = run(XDG_CACHE_HOME=tmp_path / "cache")
    second = run(copy, XDG_CACHE_HOME=tmp_path / "cache")
    assert (first.stderr, second.stderr, second.stdout) == (COMPILING, "", first.stdout)
    solvers = copy / "automodel" / "estimation" / "clothoid" / "solvers.py"
    solvers.write_text(solvers.read_text() + "# other\n")
    assert run(copy, XDG_CACHE_HOME=tmp_path / "cache").stderr == COMPILING


@pytest.mark.parametrize(
    ("imports", "changed"),
    [
        ("from automodel.b import NUMBER, OTHER", True),
        ("from automodel.b import (\n    NUMBER,\n    OTHER,\n)", True),
        ("from automodel import b", True),
        ("import automodel.b as numbers", True),
        ("from automodel.c import NUMBER", True),  # which imports b
        ("from automodel.d import function", False),
    ],
)
def test_what_a_module_imports_is_part_of_its_version(
    imports: str, changed: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A compiled function keeps the numbers of other modules: also of those that compile nothing."""
    monkeypatch.setattr(module, "_PACKAGE", tmp_path)
    (tmp_path / "a.py").write_text(f'"""Text."""\n\nimport numpy as np\n{imports}\n')
    (tmp_path / "c.py").write_text("from automodel.b import NUMBER\n")
    (tmp_path / "d.py").write_text("def function():\n    from automodel.b import NUMBER\n")
    versions = []
    for number in (1, 2):
        (tmp_path / "b.py").write_text(f"NUMBER = OTHER = {number}\n")
        module._version.cache_clear()
        module._module.cache_clear()
        versions.append(module._version(tmp_path / "a.py"))
    assert (versions[0] != versions[1]) == changed


def test_a_changed_module_is_another_version(tmp_path: Path) -> None:
    for name, source in (("a", "A = 1\n"), ("b", "A = 2\n"), ("c", "A = 1\n")):
        (tmp_path / f"{name}.py").write_text(source)
    first, second, third = (module._version(tmp_path / f"{name}.py") for name in "abc")
    assert first != second
    assert first == third

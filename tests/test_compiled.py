"""Compiled functions give what they give as Python, and their machine code lies in the user's cache folder only."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from automodel import compiled as module
from automodel.compiled import compiled

ROOT = Path(__file__).resolve().parents[1]
POSTERIOR = """
import logging
import numpy as np
from automodel.estimation.clothoid.solvers import posterior
logging.basicConfig(level=logging.INFO, format="%(message)s")
print(posterior(np.diag([3.0, 1.0]), np.array([[1.0, 0.5], [0.5, 2.0]])).tolist())
"""
DRIVE = """
import gc
from numba.core.dispatcher import Dispatcher
from automodel.assembly.parts import make_pipeline
from automodel.sim.track_files import load_track
from tests.support.rendered_drives import CAR, RenderedDrive
def loaded():
    known = [each for each in gc.get_objects() if isinstance(each, Dispatcher)]
    stages = ("automodel.perception", "automodel.estimation")
    ours = [each for each in known if each.py_func.__module__.startswith(stages)]
    return {each.py_func.__qualname__: len(each.signatures) for each in ours}
pipeline = make_pipeline("windows", CAR)
before = loaded()
RenderedDrive(track=load_track("oval"), pipeline=pipeline, rate_hz=20.0).run(0.8, 2.6)
after = loaded()
print(sorted(name for name in after if after[name] != before.get(name, 0)), len(after) > 10)
"""
COMPILING = "compiling (once, takes one or two minutes, on a small board several)\n"


def run(**environment: object) -> subprocess.CompletedProcess[str]:
    """Compute a posterior in a fresh process."""
    kept = {name: value for name, value in os.environ.items() if not name.startswith(("NUMBA_", "XDG_"))}
    env = kept | {name: str(value) for name, value in environment.items()}
    return subprocess.run([sys.executable, "-c", POSTERIOR], capture_output=True, text=True, env=env, check=True)


def test_no_frame_waits_for_a_function_to_be_compiled() -> None:
    """What a frame calls is compiled, or loaded, when the pipeline is built."""
    done = subprocess.run([sys.executable, "-c", DRIVE], capture_output=True, text=True, check=True, cwd=ROOT)
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
    (version,) = folder.iterdir()
    assert (folder.name, version.name) == ("automodel", module._version())
    kept = machine_code(version)
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


def test_a_changed_compiled_module_is_another_version(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "_PACKAGE", tmp_path)
    versions = []
    for source in ("@compiled\nA = 1\n", "@compiled\nA = 2\n"):
        (tmp_path / "a.py").write_text(source)
        (tmp_path / "b.py").write_text(source.replace("@", "#"))
        versions.append(module._version())
    (tmp_path / "b.py").write_text("B = 3\n")
    versions.append(module._version())
    assert versions[0] != versions[1] == versions[2]

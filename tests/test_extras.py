"""A car with no more than its pipeline and its link need: it drives, and what needs more says what is missing."""

from __future__ import annotations

import importlib.util
import subprocess
import sys
from pathlib import Path

import pytest

from automodel.config.extras import INSTALLED_BY, need_extra
from automodel.config.toml_reader import ConfigError, parse_toml

ROOT = Path(__file__).resolve().parents[1]
PROJECT = parse_toml((ROOT / "pyproject.toml").read_text(), "pyproject.toml")["project"]
WITHOUT = """
import importlib.abc, sys
class Missing(importlib.abc.MetaPathFinder):
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in {hidden!r}:
            raise ModuleNotFoundError(f"No module named {{name!r}}", name=name)
sys.meta_path.insert(0, Missing())
import importlib.util
found = importlib.util.find_spec
importlib.util.find_spec = lambda name, package=None: None if name in {hidden!r} else found(name, package)
from automodel.cli.main import run
sys.exit(run({words!r}))
"""


def without_extras(folder: Path, *words: str) -> subprocess.CompletedProcess[str]:
    """The command in a process that finds nothing of what may be left out."""
    code = WITHOUT.format(hidden={*INSTALLED_BY, "msgpack"}, words=list(words))
    return subprocess.run([sys.executable, "-c", code], cwd=folder, capture_output=True, text=True, timeout=280)


@pytest.mark.parametrize("pipeline", ["windows", "contour"])
def test_a_car_drives_without_any_extra(pipeline: str, tmp_path: Path) -> None:
    words = ("run", "--pipeline", pipeline, "--duration", "1", "--record", "run.mcap")
    done = without_extras(tmp_path, *words)
    assert (done.returncode, "Traceback" in done.stderr) == (0, False), done.stderr
    done = without_extras(tmp_path, "replay", "run.mcap", "--csv", "poses.csv")
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "poses.csv").stat().st_size > 1000


@pytest.mark.parametrize(
    ("words", "line"),
    [
        (
            "run",
            "pipeline centerline: the network needs onnxruntime, which is not installed: pip install 'onnxruntime'",
        ),
        ("run --car can.toml", "CAN needs cantools, which is not installed: pip install 'cantools'"),
        ("view x.mcap", "view needs aiohttp, which is not installed: pip install 'automodel[web]'"),
    ],
)
def test_what_needs_an_extra_says_which(words: str, line: str, tmp_path: Path) -> None:
    (tmp_path / "x.mcap").write_text("")
    (tmp_path / "can.toml").write_text('[link]\nkind = "can"\n[pipeline]\nname = "contour"\n')
    done = without_extras(tmp_path, *words.split())
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr.splitlines()[-1] == f"automodel: {line}"


def test_an_import_that_nobody_looked_for_is_told_too(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys) -> None:
    from automodel.cli import main

    def broken(**given: object) -> None:
        raise ModuleNotFoundError("No module named 'onnxruntime'", name="onnxruntime")

    monkeypatch.setattr(main.cli, "main", broken)
    assert main.run([]) == 2
    assert capsys.readouterr().err == (
        "automodel: this needs onnxruntime, which is not installed: pip install 'onnxruntime'\n"
    )


def test_what_is_named_is_what_the_package_asks_for(monkeypatch: pytest.MonkeyPatch) -> None:
    for module, named in INSTALLED_BY.items():
        extra = named.partition("[")[2].rstrip("]")
        lines = PROJECT["optional-dependencies"][extra] if extra else PROJECT["dependencies"]
        wanted = {"can": "python-can", "foxglove": "foxglove-sdk"}.get(module, module)
        assert any(line.startswith(wanted) for line in lines), module
    need_extra("nothing", "numpy")
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(ConfigError, match=r"automodel\[web\]"):
        need_extra("x", "aiohttp")

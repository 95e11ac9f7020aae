"""Imports point down (DESIGN): who may know whom."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]

# layer -> what it may import of ours; a package may always import itself
GROUND = {"automodel.signals", "automodel.reading", "automodel.config", "automodel.curves", "automodel.geometry"}
ALLOWED: dict[str, set[str]] = {
    "automodel.reading": set(),
    "automodel.config": {"automodel.reading"},
    "automodel.curves": set(),
    "automodel.signals": {"automodel.curves"},
    "automodel.geometry": {"automodel.config"},
    "automodel.interfaces": {"automodel.signals"},
    "automodel.clocks": set(),
    "automodel.estimation": GROUND,
    "automodel.perception": GROUND | {"automodel.estimation"},
    "automodel.pipelines": GROUND | {"automodel.estimation", "automodel.perception", "automodel.interfaces"},
    "automodel.control": GROUND | {"automodel.estimation", "automodel.interfaces"},
    "automodel.sources": GROUND | {"automodel.interfaces"},
    "automodel.recording": GROUND | {"automodel.interfaces", "automodel.sources", "automodel.viewer", "automodel"},
    "automodel.viewer": GROUND,
    "automodel.sim": GROUND | {"automodel.clocks", "automodel.sources"},
    "automodel.evaluation": GROUND | {"automodel.estimation", "automodel.interfaces"},
    "automodel.safety": {"automodel.signals", "automodel.config", "automodel.clocks"},
    "automodel.loop": {"automodel.signals", "automodel.config", "automodel.clocks", "automodel.interfaces"},
    "automodel.interrupts": set(),
    "firmware_link": {"automodel.signals", "automodel.config", "automodel.geometry"},
    "calibration": {"automodel.signals", "automodel.config", "automodel.geometry"},
}
RUNNER_LAYER = {"automodel.runner", "automodel.supervised_link"}
RUNNER_KNOWS = GROUND | {
    "automodel.interfaces",
    "automodel.clocks",
    "automodel.safety",
    "automodel.loop",
    "automodel.interrupts",
    "automodel.estimation",
    "automodel.sources.errors",
}


def module_of(path: Path) -> str:
    parts = path.relative_to(ROOT).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def imports_of(path: Path) -> set[str]:
    found: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            found.add(node.module)
    return {name for name in found if name.split(".")[0] in ("automodel", "firmware_link", "calibration")}


def layer_of(module: str) -> str | None:
    names = [name for name in (*ALLOWED, *RUNNER_LAYER) if module == name or module.startswith(name + ".")]
    return max(names, key=len, default=None)


def sources() -> list[Path]:
    return sorted(p for top in ("automodel", "firmware_link", "calibration") for p in (ROOT / top).rglob("*.py"))


@pytest.mark.parametrize("path", sources(), ids=module_of)
def test_imports_point_down(path: Path) -> None:
    module = module_of(path)
    if module.startswith("automodel.cli") or module in ("automodel", "automodel.__main__"):
        return  # the commands know everything
    layer = layer_of(module)
    assert layer is not None, f"{module} belongs to no layer: add it to the table"
    allowed = RUNNER_KNOWS if layer in RUNNER_LAYER else ALLOWED[layer]
    peers = RUNNER_LAYER if layer in RUNNER_LAYER else set()
    for name in imports_of(path):
        ok = any(name == a or (a != "automodel" and name.startswith(a + ".")) for a in {layer, *allowed, *peers})
        assert ok, f"{module} imports {name}, which lies above or beside it"


def test_no_pipeline_imports_another() -> None:
    for path in (ROOT / "automodel" / "pipelines").glob("*.py"):
        if path.stem != "__init__":
            others = {n for n in imports_of(path) if n.startswith("automodel.pipelines.") and n != module_of(path)}
            assert not others, f"{path.name} imports {others}"


def test_the_rule_can_fail(tmp_path: Path) -> None:
    bad = tmp_path / "bad.py"
    bad.write_text("from automodel.cli import main\nimport numpy\n", encoding="utf-8")
    assert imports_of(bad) == {"automodel.cli"}

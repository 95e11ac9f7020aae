"""Imports point down (DESIGN): who may know whom."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]

# layer -> what it may import of ours; a package may always import itself
GROUND = {
    "automodel.config.toml_reader",
    "automodel.signals",
    "automodel.types",
    "automodel.compiled",
    "automodel.config",
    "automodel.curves",
    "automodel.geometry",
}
ALLOWED: dict[str, set[str]] = {
    "automodel.types": set(),
    "automodel.config.toml_reader": set(),
    "automodel.compiled": set(),
    "automodel.config": {"automodel.types", "automodel.config.toml_reader"},
    "automodel.curves": {"automodel.types"},
    "automodel.signals": {"automodel.curves", "automodel.types"},
    "automodel.geometry": {"automodel.types", "automodel.config", "automodel.compiled"},
    "automodel.interfaces": {"automodel.signals"},
    "automodel.runtime.clocks": set(),
    "automodel.runtime.os_signals": set(),
    "automodel.estimation": GROUND,
    "automodel.perception": GROUND | {"automodel.estimation"},
    "automodel.pipelines": GROUND | {"automodel.estimation", "automodel.perception", "automodel.interfaces"},
    "automodel.control": GROUND | {"automodel.estimation", "automodel.interfaces"},
    "automodel.sources": GROUND | {"automodel.interfaces"},
    "automodel.recording": GROUND | {"automodel.interfaces", "automodel.sources", "automodel.viewer", "automodel"},
    "automodel.viewer": GROUND,
    "automodel.sim": GROUND | {"automodel.runtime.clocks", "automodel.runtime.os_signals", "automodel.sources"},
    "automodel.checks": {"automodel.types", "automodel.signals", "automodel.config"},
    "automodel.faults": {
        "automodel.types",
        "automodel.signals",
        "automodel.curves",
        "automodel.interfaces",
        "automodel.runtime.clocks",
        "automodel.sources.errors",
    },
    "automodel.evaluation": GROUND | {"automodel.estimation", "automodel.interfaces"},
    "automodel.training": GROUND | {"automodel.perception"},
    "automodel.doctor": GROUND,
    "automodel.runtime.safety": {"automodel.signals", "automodel.config", "automodel.runtime.clocks"},
    "automodel.runtime.loop": {
        "automodel.signals",
        "automodel.config",
        "automodel.runtime.clocks",
        "automodel.interfaces",
    },
    "firmware_link": {"automodel.types", "automodel.signals", "automodel.config", "automodel.geometry"},
    "calibration": {
        "automodel.types",
        "automodel.signals",
        "automodel.config",
        "automodel.geometry",
        "automodel.config.toml_reader",
    },
}
RUNNER_LAYER = {  # one thing in several files: its modules know each other, and what they drive by interface only
    "automodel.runtime.runner",
    "automodel.runtime.run_types",
    "automodel.runtime.run_log",
    "automodel.runtime.supervised_link",
    "automodel.runtime.supervised_source",
}
RUNNER_KNOWS = GROUND | {
    "automodel.interfaces",
    "automodel.runtime.clocks",
    "automodel.runtime.safety",
    "automodel.runtime.loop",
    "automodel.runtime.os_signals",
    "automodel.estimation",
    "automodel.sources.errors",
}

SHARED_BY_PIPELINES = {"automodel.pipelines.stages"}


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


def wrong_imports(module: str, imported: set[str]) -> set[str]:
    """Those of `imported` that lie above or beside the layer of `module`."""
    if module.startswith("automodel.cli.") or module in ("automodel", "automodel.__main__", "automodel.cli"):
        return set()  # the commands know everything
    layer = layer_of(module)
    assert layer is not None, f"{module} belongs to no layer: add it to the table"
    if layer in RUNNER_LAYER:
        known = RUNNER_LAYER | RUNNER_KNOWS
    else:
        known = {layer} | ALLOWED[layer]
    return {n for n in imported if not any(n == k or (k != "automodel" and n.startswith(k + ".")) for k in known)}


def other_pipelines(module: str, imported: set[str]) -> set[str]:
    """The pipelines that a pipeline imports; the package itself names them all."""
    if not module.startswith("automodel.pipelines.") or module in SHARED_BY_PIPELINES:
        return set()
    pipelines = {name for name in imported if name.startswith("automodel.pipelines")}
    return pipelines - SHARED_BY_PIPELINES - {module}


@pytest.mark.parametrize("path", sources(), ids=module_of)
def test_imports_point_down(path: Path) -> None:
    module, imported = module_of(path), imports_of(path)
    assert not wrong_imports(module, imported), f"{module} imports what lies above or beside it"
    assert not other_pipelines(module, imported), f"{module} imports another pipeline"


def test_shared_parts_of_pipelines_are_no_pipelines() -> None:
    for module in SHARED_BY_PIPELINES:
        path = ROOT.joinpath(*module.split(".")).with_suffix(".py")
        assert not {name for name in imports_of(path) if name.startswith("automodel.pipelines")}


def test_the_layers_exist() -> None:
    modules = {module_of(path) for path in sources()}
    for layer in (*ALLOWED, *RUNNER_LAYER, *SHARED_BY_PIPELINES):
        assert layer in modules, f"{layer} is in the table and nowhere else"


@pytest.mark.parametrize(
    ("module", "imported"),
    [
        ("automodel.signals", "automodel.config"),
        ("automodel.curves.theta", "automodel.signals"),
        ("automodel.perception.windows", "automodel.pipelines.windows"),
        ("automodel.control.limits", "automodel.perception"),
        ("automodel.recording.writer", "automodel.runtime.runner"),
        ("automodel.runtime.runner", "automodel.pipelines"),
        ("automodel.runtime.run_log", "automodel.recording.writer"),
        ("automodel.runtime.run_types", "automodel.sources.video"),
        ("automodel.sim.world", "firmware_link.arduino"),
        ("automodel.runtime.safety", "automodel.runtime.runner"),
        ("automodel.runtime.loop", "automodel.runtime.run_types"),
        ("firmware_link.arduino", "automodel.runtime.runner"),
        ("automodel.sources.usb", "automodel.cli.main"),
        ("automodel.runtime.input_checks", "automodel.runtime.loop"),
        ("automodel.bench.faults.plan", "automodel.sim.track"),
        ("automodel.bench.faults.wire", "firmware_link.messages"),
    ],
)
def test_the_rule_can_fail(module: str, imported: str) -> None:
    assert wrong_imports(module, {imported}) == {imported}


def test_the_pipeline_rule_can_fail() -> None:
    assert other_pipelines("automodel.pipelines.contour", {"automodel.pipelines.windows", "automodel.config"})
    assert other_pipelines("automodel.pipelines.contour", {"automodel.pipelines"})  # through the table of all
    assert not other_pipelines("automodel.pipelines", {"automodel.pipelines.windows"})


def test_imports_are_found(tmp_path: Path) -> None:
    file = tmp_path / "some.py"
    file.write_text("from automodel.cli import main\ndef f():\n    import firmware_link.pulses as p\nimport numpy\n")
    assert imports_of(file) == {"automodel.cli", "firmware_link.pulses"}

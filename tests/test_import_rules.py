"""Imports point down, and never in a circle: who may know whom. The order is that of automodel/README.md."""

from __future__ import annotations

import ast
from collections.abc import Iterable
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]

GROUND = {
    "automodel.types",
    "automodel.compiled",
    "automodel.config",
    "automodel.curves",
    "automodel.geometry",
    "automodel.output_files",
    "automodel.signals",
}
VISION = GROUND | {"automodel.interfaces", "automodel.estimation", "automodel.perception"}
PARTS = VISION | {
    "automodel",  # its version
    "automodel.tracking",
    "automodel.pipelines",
    "automodel.control",
    "automodel.runtime",
    "automodel.sources",
    "automodel.viewer",
    "automodel.recording",
    "automodel.sim",
    "automodel.console",
    "automodel.manual",
    "automodel.service",
    "firmware_link",
    "calibration",
}
# package or module -> what it may import of ours; it may always import itself
ALLOWED: dict[str, set[str]] = {
    "automodel.types": set(),
    "automodel.compiled": set(),
    "automodel.config": {"automodel.types"},
    "automodel.curves": {"automodel.types"},
    "automodel.geometry": {"automodel.types", "automodel.compiled", "automodel.config", "automodel.curves"},
    "automodel.signals": {"automodel.types", "automodel.curves"},
    "automodel.output_files": {"automodel.config"},
    "automodel.interfaces": {"automodel.signals"},
    "automodel.estimation": GROUND,
    "automodel.perception": GROUND,
    "automodel.tracking": GROUND
    | {"automodel.perception", "automodel.estimation.road", "automodel.estimation.checked_odometry"},
    "automodel.pipelines": VISION | {"automodel.tracking"},
    "automodel.control": GROUND | {"automodel.interfaces"},
    "automodel.runtime": GROUND | {"automodel.interfaces", "automodel.sources.errors"},
    "automodel.runtime.clocks": set(),
    "automodel.runtime.os_signals": set(),
    "automodel.runtime.standstill": {"automodel.signals"},
    "automodel.runtime.safety": {
        "automodel.signals",
        "automodel.config",
        "automodel.runtime.clocks",
        "automodel.runtime.standstill",
    },
    "automodel.runtime.loop": {
        "automodel.signals",
        "automodel.interfaces",
        "automodel.runtime.clocks",
        "automodel.runtime.eye_check",
    },
    "automodel.runtime.eye_check": {"automodel.types", "automodel.signals", "automodel.runtime.input_checks"},
    "automodel.runtime.input_checks": {"automodel.types", "automodel.signals", "automodel.config"},
    "automodel.sources": GROUND | {"automodel.interfaces"},
    "automodel.viewer": GROUND,
    "automodel.recording": GROUND | {"automodel", "automodel.interfaces", "automodel.sources", "automodel.viewer"},
    "automodel.sim": GROUND | {"automodel.runtime.clocks", "automodel.runtime.os_signals", "automodel.sources.errors"},
    "automodel.console": {
        "automodel",
        "automodel.config",
        "automodel.output_files",
        "automodel.interfaces",
        "automodel.signals",
        "automodel.runtime.os_signals",
    },
    "automodel.service": {
        "automodel.config",
        "automodel.console.messages",
        "automodel.output_files",
        "automodel.runtime.run_types",
        "automodel.signals",
    },
    "automodel.manual": {"automodel.config", "automodel.signals", "automodel.runtime.run_types"},
    "firmware_link": {"automodel.types", "automodel.signals", "automodel.config", "automodel.geometry"},
    "calibration": PARTS - {"automodel.pipelines", "automodel.perception"}
    | {
        "automodel.perception.markings.ridge",
        "automodel.perception.markings.marking_width",
        "automodel.perception.stereo.points",
        "automodel.perception.stereo.stripes",
    },
    "automodel.assembly": PARTS,
    "automodel.doctor": PARTS | {"automodel.assembly"},
    "automodel.bench": PARTS | {"automodel.assembly", "automodel.web"},
    "automodel.training": PARTS,
    "automodel.web": PARTS | {"automodel.assembly"},
    "automodel.cli": PARTS
    | {"automodel.assembly", "automodel.doctor", "automodel.bench", "automodel.training", "automodel.web"},
    "automodel": {"automodel.assembly", "automodel.config", "automodel.signals", "automodel.cli"},
}


def module_of(path: Path) -> str:
    parts = path.relative_to(ROOT).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def sources() -> list[Path]:
    return sorted(p for top in ("automodel", "firmware_link", "calibration") for p in (ROOT / top).rglob("*.py"))


MODULES = {module_of(path): path for path in sources()}


def imports_of(path: Path) -> set[str]:
    """The modules and packages of ours that a file imports, lazily or not."""
    found: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            within = {f"{node.module}.{alias.name}" for alias in node.names}
            modules = within & MODULES.keys()
            found |= modules
            if modules != within:
                found.add(node.module)
    return {name for name in found if name.split(".")[0] in ("automodel", "firmware_link", "calibration")}


def covered(name: str, by: Iterable[str]) -> bool:
    """Whether one of `by` is the module `name` or a package that it lies in; "automodel" stands for itself alone."""
    return any(name == one or (one != "automodel" and name.startswith(one + ".")) for one in by)


def layer_of(module: str) -> str | None:
    return max((name for name in ALLOWED if covered(module, [name])), key=len, default=None)


def wrong_imports(module: str, imported: set[str]) -> set[str]:
    """Those of `imported` that `module` must not know."""
    layer = layer_of("automodel" if module == "automodel.__main__" else module)
    assert layer is not None, f"{module} belongs to no layer: add it to the table"
    return {name for name in imported if not covered(name, {layer} | ALLOWED[layer])}


def other_pipelines(module: str, imported: set[str]) -> set[str]:
    """The pipelines that a pipeline imports; they share the stage clock and the start of a lane."""
    if not module.startswith("automodel.pipelines."):
        return set()
    pipelines = {name for name in imported if name.startswith("automodel.pipelines")}
    return pipelines - {"automodel.pipelines.stages", module}


def circle(graph: dict[str, set[str]]) -> list[str]:
    """Modules that import each other in a circle, empty where there is none."""
    done: set[str] = set()

    def walk(module: str, path: list[str]) -> list[str]:
        if module in path:
            return path[path.index(module) :]
        if module not in done:
            for other in sorted(graph.get(module, ())):
                if found := walk(other, [*path, module]):
                    return found
            done.add(module)
        return []

    return next((found for module in graph if (found := walk(module, []))), [])


@pytest.mark.parametrize("module", MODULES)
def test_imports_point_down(module: str) -> None:
    imported = imports_of(MODULES[module])
    assert not wrong_imports(module, imported), f"{module} imports what lies above or beside it"
    assert not other_pipelines(module, imported), f"{module} imports another pipeline"


def test_no_circle() -> None:
    graph = {module: imports_of(path) - {module, "automodel"} for module, path in MODULES.items()}
    assert not circle(graph)


def test_the_layers_exist() -> None:
    assert not [layer for layer in ALLOWED if layer not in MODULES], "in the table and nowhere else"


@pytest.mark.parametrize(
    ("module", "imported"),
    [
        ("automodel.signals", "automodel.config"),
        ("automodel.curves.polynomials", "automodel.signals"),
        ("automodel.perception.windows.sliding_windows", "automodel.pipelines.windows"),
        ("automodel.perception.windows.sliding_windows", "automodel.estimation.polynomial.lane_fit"),
        ("automodel.control.limits", "automodel.perception"),
        ("automodel.recording.writer", "automodel.runtime.runner"),
        ("automodel.manual.operator", "automodel.web.remote"),
        ("automodel.runtime.runner", "automodel.pipelines"),
        ("automodel.runtime.run_log", "automodel.recording.writer"),
        ("automodel.runtime.run_types", "automodel.sources.files"),
        ("automodel.runtime.safety", "automodel.runtime.runner"),
        ("automodel.runtime.loop", "automodel.runtime.run_types"),
        ("automodel.runtime.input_checks", "automodel.runtime.loop"),
        ("automodel.sim.world", "firmware_link.arduino"),
        ("automodel.sources.cameras", "automodel.cli.main"),
        ("automodel.assembly.parts", "automodel.cli.options"),
        ("firmware_link.arduino", "automodel.runtime.runner"),
        ("calibration.servo", "automodel.assembly.parts"),
    ],
)
def test_the_rule_can_fail(module: str, imported: str) -> None:
    assert wrong_imports(module, {imported}) == {imported}


def test_the_pipeline_rule_can_fail() -> None:
    assert other_pipelines("automodel.pipelines.contour", {"automodel.pipelines.windows", "automodel.config"})
    assert other_pipelines("automodel.pipelines.contour", {"automodel.pipelines"})  # through the table of all
    assert not other_pipelines("automodel.pipelines.contour", {"automodel.pipelines.stages", "automodel.config"})


def test_a_circle_is_found() -> None:
    assert circle({"a": {"b"}, "b": {"c"}, "c": {"b"}}) == ["b", "c"]
    assert circle({"a": {"b", "c"}, "b": {"c"}, "c": set()}) == []


def test_imports_are_found(tmp_path: Path) -> None:
    file = tmp_path / "some.py"
    file.write_text("from automodel.cli import main\ndef f():\n    import firmware_link.pulses as p\nimport numpy\n")
    assert imports_of(file) == {"automodel.cli.main", "firmware_link.pulses"}

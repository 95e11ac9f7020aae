"""The tuned numbers of the stages: where they stand, and how one of them is moved for a while.

A number is moved in the source that Python imports, not on disk: the module is imported anew with another value, and
with it all modules that import it. So a stage need not know about it, and what is derived from a number follows it.
"""

from __future__ import annotations

import ast
import contextlib
import fnmatch
import functools
import importlib.abc
import importlib.machinery
import importlib.util
import re
import sys
import tokenize
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import CodeType, ModuleType
from typing import Any

from automodel.config import PIPELINE_NAMES

PACKAGE = Path(__file__).parents[1]
STAGES = ("perception", "estimation", "tracking", "pipelines")
NOT_TUNED = {  # modules and names whose numbers say what something is, not how well it works
    "perception.markings.onnx_check": "the format of an ONNX file",
    "perception.markings.onnx_cost._*": "the format of an ONNX file",
    "perception.markings.unet": "the networks that ship, limits of files, a test at construction",
    "perception.markings.ridge_noise.QUARTILE": "the normal distribution",
    "perception.markings.reflections.LEAST": "numerical tolerance",
    "perception.markings.reflections.MOST_NATS": "numerical tolerance",
    "perception.markings.ridge.RidgeFilter.LEVEL": "the scale of an image",
    "perception.stereo.matching._FAR_M": "infinitely far",
    "perception.stereo.matching._ON_PX": "numerical tolerance",
    "perception.stereo.matching._STEP": "numerical tolerance",
    "perception.stereo.stage_views": "a drawing",
    "perception.markings.faint_lines._BINS": "resolution of a histogram",
    "perception.rows.brightness": "channels, and the weights of grey",
    "estimation.image_motion.ImageMotion.MARGIN_PX": "how far OpenCV's corner detector reads beyond a corner",
    "estimation.clothoid.solvers.MOST_STEPS": "the end of an iteration that does not converge",
    "estimation.clothoid.solvers.CONVERGED": "numerical tolerance",
    "estimation.polynomial.lane_tracker.NO_MEMORY": "the shape of an empty array",
    "estimation.theta.heading_polynomial.ORDER": "coefficients of a cubic",
    "estimation.theta.heading_polynomial._*": "quadrature and its tolerance",
    "estimation.theta.line_spline.FAR_M": "numerical tolerance",
    "estimation.theta.line_spline._PIECES": "the cubic B-spline",
    "estimation.theta.pose_filter._LINES": "rows of the measurement",
    "estimation.theta.pose_filter._DIRECTION": "rows of the measurement",
    "estimation.theta.pose_filter._WIDTH": "rows of the measurement",
    "estimation.theta.pose_filter.LanePoseFilter._FLOOR": "numerical tolerance",
    "estimation.theta.theta_rls.ThetaRls._DAMPING": "numerical tolerance",
    "estimation.theta.tracked_line.LEAST_NEWS": "numerical tolerance",
    "tracking.road_profile._SHIFTS": "places in an array",
    "tracking.evidence.NO_NEWS": "numerical tolerance",
    "tracking.evidence.CERTAIN": "numerical tolerance",
    "tracking.evidence.ROUNDS": "the end of an iteration that does not converge",
    "tracking.evidence.LEAST_STEP": "numerical tolerance",
    "tracking.evidence.NARROWER": "the steps of an iteration, which may be ten times as wide or as narrow",
    "tracking.evidence.LINEAR": "numerical tolerance",
    "estimation.clothoid.clothoid_pair.ClothoidPair.PHASES": "resolution of a table",
    "perception.stereo.stripes._KNOTS": "resolution of a table",
    "perception.markings.onnx_cost.MAX*": "limits of files",
    "perception.rows.row_ridges.LINE": "rows of an array",
    "perception.windows.line_windows.LineWindows.TRIES": "the end of an iteration that does not converge",
    "tracking.lane_change.PASSED": "the paper's",
    "pipelines.windows.Windows.MAX_SKEW_RAD": "the paper's",
    "pipelines.contour.Contour.ROUNDS": "the end of an iteration that does not converge",
    "pipelines.stereo.Stereo.cameras": "what the pipeline is",
    "pipelines.*.NO_POINTS": "the shape of an empty array",
    "tracking.stories.LEFT*": "where lines lie, in lane widths",
    "tracking.stories.RIGHT*": "where lines lie, in lane widths",
}


@dataclass(frozen=True, slots=True, kw_only=True)
class TunedNumber:
    """A numeric literal at module or class level: `path` is its module, class, name, and place where it has several.

    `meaning` is what the source says of it: the comment beside it, else its entry in the class's docstring.
    """

    path: str  # "perception.windows.line_windows.LineWindows.FLANK[1]"
    value: float
    module: str  # "automodel.perception.windows.line_windows"
    line: int
    column: int
    whole: bool
    in_class: bool
    meaning: str

    def moved(self, share: float) -> float | None:
        """The value times 1 + share, rounded where it is a whole number; None where that is the value itself."""
        value = round(self.value * (1.0 + share)) if self.whole else self.value * (1.0 + share)
        return None if value == self.value else value


def tuned_numbers(only: Sequence[str] = ()) -> list[TunedNumber]:
    """All tuned numbers whose path fits one of the patterns `only` (none: all), in the order of the files.

    A tuned number is a numeric literal in the value of an assignment at module or class level of one of `STAGES`. No
    tuned numbers are: the members of an enumeration, also of one by `range`; 0, which stands for "off" or "nothing
    yet"; whole numbers in an expression of other names, which is arithmetic (`2 * REACH + 1`); and what `NOT_TUNED`
    names, each with its reason.
    """
    found = [number for module in _sources() for number in _numbers_of(module)]
    exempt = [pattern for name in NOT_TUNED for pattern in (name, f"{name}.*", f"{name}[[]*")]
    wanted = [f"*{pattern}*" for pattern in only] or ["*"]
    return [
        number
        for number in found
        if any(fnmatch.fnmatchcase(number.path, pattern) for pattern in wanted)
        and not any(fnmatch.fnmatchcase(number.path, pattern) for pattern in exempt)
    ]


@functools.cache
def _sources() -> dict[str, Path]:
    """The modules of `STAGES` and their files."""
    files = [path for stage in STAGES for path in sorted((PACKAGE / stage).rglob("*.py"))]
    modules = {}
    for path in files:
        parts = ("automodel", *path.relative_to(PACKAGE).with_suffix("").parts)
        modules[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = path
    return modules


@functools.cache
def _tree(module: str) -> ast.Module:
    return ast.parse(_sources()[module].read_text(encoding="utf-8"))


def _numbers_of(module: str) -> Iterator[TunedNumber]:
    tree, short = _tree(module), module.removeprefix("automodel.")
    classes = [node for node in ast.walk(tree) if isinstance(node, ast.ClassDef) and not _is_enum(node)]
    comments = _comments(module)
    texts: dict[str | None, str] = {node.name: ast.get_docstring(node) or "" for node in classes}
    for owner, body in ((None, tree.body), *((node.name, node.body) for node in classes)):
        for statement in body:
            if not isinstance(statement, ast.Assign | ast.AnnAssign) or statement.value is None:
                continue
            if ast.unparse(statement.value).startswith("range("):
                continue
            target = statement.targets[0] if isinstance(statement, ast.Assign) else statement.target
            lines = range(statement.lineno, (statement.end_lineno or statement.lineno) + 1)
            comment = " ".join(comments[line] for line in lines if line in comments)
            for name, literal in _named(target, statement.value):
                path = ".".join(part for part in (short, owner, name) if part)
                yield TunedNumber(
                    path=path,
                    value=literal.value,
                    module=module,
                    line=literal.lineno,
                    column=literal.col_offset,
                    whole=isinstance(literal.value, int),
                    in_class=owner is not None,
                    meaning=comment or _described(name.partition("[")[0], texts.get(owner, "")),
                )


@functools.cache
def _comments(module: str) -> dict[int, str]:
    """The comments of a module that stand beside code, by line."""
    with tokenize.open(_sources()[module]) as stream:
        tokens = [token for token in tokenize.generate_tokens(stream.readline) if token.type == tokenize.COMMENT]
    return {token.start[0]: token.string.lstrip("# ") for token in tokens if token.line.strip() != token.string}


def _described(name: str, docstring: str) -> str:
    """The first sentence about `name` in a docstring, "" where there is none."""
    found = re.search(rf"`{re.escape(name)}`[^.]*\.", docstring)
    return " ".join(found.group().replace("`", "").split()) if found else ""


def _is_enum(node: ast.ClassDef) -> bool:
    return any(ast.unparse(base).endswith("Enum") for base in node.bases)


def _named(target: ast.expr, value: ast.expr) -> Iterator[tuple[str, Any]]:
    """The literals of an assignment, each with its name: `A, B = 1, 2` are A and B, `A = 1, 2` are A[0] and A[1]."""
    if isinstance(target, ast.Tuple) and isinstance(value, ast.Tuple):
        for one, its in zip(target.elts, value.elts, strict=True):
            yield from _named(one, its)
        return
    name = ast.unparse(target if not isinstance(target, ast.Tuple) else target.elts[0])
    names = any(isinstance(node, ast.Name) and node.id.isupper() for node in ast.walk(value))
    literals = [node for node in ast.walk(value) if isinstance(node, ast.Constant) and type(node.value) in (int, float)]
    literals = [node for node in literals if node.value and not (names and isinstance(node.value, int))]
    literals.sort(key=lambda node: (node.lineno, node.col_offset))
    for at, literal in enumerate(literals):
        yield (name if len(literals) == 1 else f"{name}[{at}]"), literal


@functools.cache
def _imported(module: str) -> frozenset[str]:
    """The modules of `STAGES` that a module of them imports."""
    found: set[str] = set()
    for node in ast.walk(_tree(module)):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            found |= {node.module, *(f"{node.module}.{alias.name}" for alias in node.names)}
    return frozenset(found & _sources().keys())


@functools.cache
def users(module: str) -> frozenset[str]:
    """A module of `STAGES` and all of them that import it, directly or through others."""
    found = {module}
    while more := {one for one in _sources() if _imported(one) & found} - found:
        found |= more
    return frozenset(found)


def pipelines_of(number: TunedNumber) -> tuple[str, ...]:
    """The pipelines that import the number's module."""
    return tuple(name for name in PIPELINE_NAMES if f"automodel.pipelines.{name}" in users(number.module))


class _MovedLoader(importlib.machinery.SourceFileLoader):
    """Loads a module with another value of one literal."""

    def __init__(self, number: TunedNumber, value: float) -> None:
        super().__init__(number.module, str(_sources()[number.module]))
        self._number, self._value = number, value

    def get_code(self, fullname: str) -> CodeType:
        """The module's code; what Python keeps of it on disk is neither read nor written."""
        tree = ast.parse(_sources()[fullname].read_text(encoding="utf-8"))
        for node in ast.walk(tree):
            place = getattr(node, "lineno", 0), getattr(node, "col_offset", 0)
            if isinstance(node, ast.Constant) and place == (self._number.line, self._number.column):
                node.value = self._value
        code: CodeType = compile(tree, self.get_filename(fullname), "exec", dont_inherit=True)
        return code


class _MovedFinder(importlib.abc.MetaPathFinder):
    """Finds the module of a moved number, and nothing else."""

    def __init__(self, number: TunedNumber, value: float) -> None:
        self._module, self._loader = number.module, _MovedLoader(number, value)

    def find_spec(self, fullname: str, path: object = None, target: object = None) -> Any:
        """The module's spec, None for other modules."""
        return importlib.util.spec_from_loader(fullname, self._loader) if fullname == self._module else None


@contextlib.contextmanager
def moved(number: TunedNumber, value: float) -> Iterator[None]:
    """Within it, stages that are imported by name, as pipelines are made, have this value of the number.

    What was imported before, and what is made within, keeps the value that it was imported with.
    """
    anew = users(number.module)
    kept: dict[str, ModuleType] = {name: sys.modules.pop(name) for name in anew if name in sys.modules}
    finder = _MovedFinder(number, value)
    sys.meta_path.insert(0, finder)
    frozen = not number.in_class and any("@compiled" in _sources()[name].read_text() for name in anew)
    try:
        with _compiled_anew() if frozen else contextlib.nullcontext():
            yield
    finally:
        sys.meta_path.remove(finder)
        for name in anew:
            sys.modules.pop(name, None)
            if name in kept:
                sys.modules[name] = kept[name]
                parent, _, own = name.rpartition(".")
                setattr(sys.modules[parent], own, kept[name])


def _compiled_anew() -> contextlib.AbstractContextManager[None]:
    from automodel.compiled import compiled_anew  # imports numba, which takes long

    return compiled_anew()

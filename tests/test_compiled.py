"""Compiled functions give what they give as Python, and need no place on disk."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest

from automodel.compiled import compiled


def test_a_compiled_function_gives_the_same() -> None:
    def total(values: np.ndarray, most: float) -> float:
        result = 0.0
        for i in range(len(values)):
            result += min(values[i], most)
        return result

    values = np.array([1.0, 7.0, 3.0])
    assert compiled(total)(values, 4.0) == total(values, 4.0) == pytest.approx(8.0)


def test_where_nothing_can_be_kept_it_is_compiled_all_the_same() -> None:
    known: dict[str, object] = {}
    exec("def twice(x):\n    return 2 * x\n", known)  # has no file, so no place beside it
    assert compiled(known["twice"])(4) == 8  # type: ignore[type-var, operator]


def test_without_the_compiler_contour_sees_the_same() -> None:
    program = (
        "import numpy as np\nfrom automodel.estimation.clothoid.solvers import posterior\n"
        "print(posterior(np.diag([3.0, 1.0]), np.array([[1.0, 0.5], [0.5, 2.0]])).tolist())"
    )
    said = [
        subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, env=env, check=True).stdout
        for env in ({"NUMBA_DISABLE_JIT": "1"}, {})
    ]
    assert said[0]
    assert np.allclose(eval(said[0]), eval(said[1]), rtol=1e-12)

"""What importing a pipeline loads: nothing slow that it does not use."""

from __future__ import annotations

import subprocess
import sys

import pytest


@pytest.mark.parametrize("name", ["centerline", "windows"])
def test_pipelines_do_not_load_libraries_that_they_do_not_use(name: str) -> None:
    heavy = {"onnxruntime", "filterpy", "scipy.linalg"}
    code = f"import sys, automodel.pipelines.{name}; sys.exit(bool({heavy} & set(sys.modules)))"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0

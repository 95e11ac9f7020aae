"""Compiles the loops of all pipelines into the user's cache folder, for the tests that follow."""

from __future__ import annotations

from automodel.assembly.parts import make_pipeline
from automodel.config import CarConfig
from automodel.config.parts import PIPELINES
from tests.support.stereo_drives import stereo_car

if __name__ == "__main__":
    for name in PIPELINES.names:
        make_pipeline(name, stereo_car() if name == "stereo" else CarConfig())

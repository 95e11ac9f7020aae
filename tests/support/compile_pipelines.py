"""Compiles the loops of all pipelines into the user's cache folder, for the tests that follow."""

from __future__ import annotations

from automodel.assembly.parts import make_pipeline
from automodel.config import CarConfig
from automodel.config.parts import PAIR_PIPELINES, PIPELINES
from tests.support.masked_drives import line, road
from tests.support.stereo_drives import StereoDrive, stereo_car

if __name__ == "__main__":
    for name in PIPELINES.names:
        if name not in PAIR_PIPELINES:
            make_pipeline(name, CarConfig())
    StereoDrive(track=road(line(3.0)), car=stereo_car()).run(0.3, 0.5)  # some of its loops wait for the first pairs

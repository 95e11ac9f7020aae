"""Compiles the loops of all pipelines into the user's cache folder, for the tests that follow.

Where that is being done already, it waits for it.
"""

from __future__ import annotations

import fcntl
import tempfile
from pathlib import Path

from automodel.assembly.parts import make_pipeline
from automodel.config import CarConfig
from automodel.config.parts import PAIR_PIPELINES, PIPELINES
from tests.support.stereo_drives import stereo_car

if __name__ == "__main__":
    with (Path(tempfile.gettempdir()) / "automodel-compiles").open("w") as alone:
        fcntl.flock(alone, fcntl.LOCK_EX)
        for name in PIPELINES.names:
            make_pipeline(name, stereo_car() if name in PAIR_PIPELINES else CarConfig())

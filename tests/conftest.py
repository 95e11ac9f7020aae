from __future__ import annotations

import os
from pathlib import Path

import pytest

# As many tests run at a time as there are cores: what one of them gains by a second core the others lose, and more.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import cv2  # after the environment, which numpy reads when it is imported

cv2.setNumThreads(1)


@pytest.fixture(scope="session")
def data_root() -> Path:
    """The folder with the real recordings; skips where it is absent."""
    given = os.environ.get("AUTOMODEL_DATA")
    root = Path(given) if given else Path(__file__).resolve().parents[2] / "shared" / "data"
    if not root.is_dir():
        pytest.skip(f"no real recordings at {root}; set AUTOMODEL_DATA to the folder that holds them")
    return root

from __future__ import annotations

import os
from pathlib import Path

import pytest


@pytest.fixture(scope="session")
def data_root() -> Path:
    """The folder with the real recordings; skips where it is absent."""
    given = os.environ.get("AUTOMODEL_DATA")
    root = Path(given) if given else Path(__file__).resolve().parents[2] / "shared" / "data"
    if not root.is_dir():
        pytest.skip(f"no real recordings at {root}; set AUTOMODEL_DATA to the folder that holds them")
    return root

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from automodel.config import RecordingConfig
from automodel.recording.writer import McapRecorder
from tests.support.recorded_values import CAR_TEXT, record_turn


@pytest.fixture
def recorded_run(tmp_path: Path) -> Callable[[int], Path]:
    def make(turns: int) -> Path:
        path = tmp_path / "run.mcap"
        recorder = McapRecorder(path, CAR_TEXT, RecordingConfig(image="png"))
        for index in range(turns):
            record_turn(recorder, index)
        recorder.close()
        assert recorder.error is None
        assert recorder.dropped_frames == 0
        return path

    return make

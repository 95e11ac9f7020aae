"""Random rigs and what the table of a calibration's errors says."""

from __future__ import annotations

import math

import numpy as np
import pytest

from automodel.bench.stereo_calibration import (
    COLUMNS,
    ERRORS,
    START_M,
    START_RAD,
    RigDrive,
    measure_drive,
    random_rig,
    summary,
)
from calibration.ground import NAMES


def test_a_rig_is_wide_not_parallel_and_told_wrong_by_what_is_said() -> None:
    for seed in range(5):
        car, start, lens = random_rig(seed)
        left, right = (eye.extrinsics for eye in car.camera.eyes)
        assert 1.7 < math.dist((left.x_m, left.y_m, left.z_m), (right.x_m, right.y_m, right.z_m)) < 2.2
        assert abs(left.yaw_rad - right.yaw_rad) > math.radians(1.0)
        off = [abs(getattr(start, name) - getattr(right, name)) for name in NAMES]
        assert off == pytest.approx([START_M] * 3 + [START_RAD] * 3)
        true = car.camera.eyes[1].intrinsics
        assert 0.0 < abs(lens.fx_px / true.fx_px - 1.0) < 5e-3
        assert 0.0 < math.hypot(lens.cx_px - true.cx_px, lens.cy_px - true.cy_px) < 2.0
    assert random_rig(1)[1] != random_rig(2)[1]


def test_the_summary_counts_errors_in_their_sigmas_and_leaves_refused_drives_out() -> None:
    rows = [{**dict.fromkeys(COLUMNS), "refusal": None} for _ in range(4)]
    for row, error in zip(rows, (1.0, -2.0, 5.0, 7.0), strict=True):
        row |= {f"{column}{what}": value for column in ERRORS for what, value in
                (("", error), ("_sigma", 2.0), ("_z", error / 2.0))}  # fmt: skip
    rows.append({**dict.fromkeys(COLUMNS), "refusal": "too short"})
    found = list(summary(rows))
    assert [row["number"] for row in found] == list(ERRORS)
    assert found[0]["refused"] == 1
    assert found[0]["error_rms"] == pytest.approx(float(np.sqrt(np.mean(np.square((1.0, 2.0, 5.0, 7.0))))))
    assert (found[0]["error_max"], found[0]["beyond_2_sigma"], found[0]["beyond_3_sigma"]) == (7.0, 2, 1)
    assert list(summary(rows[-1:])) == []


def test_a_drive_that_is_too_short_is_a_row_with_the_reason() -> None:
    row = measure_drive(RigDrive(seed=0, seconds=1.0), lambda share: None)
    assert row["x_mm"] is None
    assert "stretches of the drive, expected 4" in str(row["refusal"])

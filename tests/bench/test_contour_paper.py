"""`bench contour-paper`: reported speeds, what counts as a loss, which iterations are counted."""

from __future__ import annotations

import math

import numpy as np
import pytest

from automodel.bench.contour_paper import SPEEDS, ClaimMeter
from automodel.curves import line
from automodel.signals import LaneEstimate, LanePose, LaneStatus, Motion, MotionSource
from automodel.sim.truth import Truth

TRUTH = Truth(offset_m=0.02, heading_rad=0.1, width_m=0.4, curvature_per_m=0.0, s_m=0.0, lap=0)
LOST = LaneEstimate(t_ns=0, status=LaneStatus.LOST)


def seen(offset_m: float = 0.02, heading_rad: float = 0.1, status: LaneStatus = LaneStatus.TRACKING) -> LaneEstimate:
    pose = LanePose(
        offset_m=offset_m, heading_rad=heading_rad, width_m=0.4, curvature_per_m=0.0, covariance=np.zeros((3, 3))
    )
    return LaneEstimate(t_ns=0, status=status, pose=pose, centerline=line(0.0, 0.0, 0.0, 1.0))


def metered(*frames: tuple[LaneEstimate, bool], counts: bool = True) -> ClaimMeter:
    meter = ClaimMeter()
    for estimate, searched in frames:
        meter.add(estimate, TRUTH, 3, searched, counts)
    return meter


@pytest.mark.parametrize(("speed", "speed_mps"), [("told", 2.0), ("+20 %", 2.4), ("-20 %", 1.6)])
def test_a_wrong_speed_leaves_the_yaw_rate(speed: str, speed_mps: float) -> None:
    said = SPEEDS[speed](Motion(t_ns=7, speed_mps=2.0, yaw_rate_radps=0.5))
    assert (said.t_ns, said.yaw_rate_radps, said.source) == (7, 0.5, MotionSource.MEASURED)
    assert said.speed_mps == pytest.approx(speed_mps)


def test_without_the_speed_nothing_is_known() -> None:
    said = SPEEDS["none"](Motion(t_ns=7, speed_mps=2.0, yaw_rate_radps=0.5))
    assert (said.t_ns, said.known, said.speed_mps, said.yaw_rate_radps) == (7, False, 0.0, 0.0)


def test_a_run_of_bad_frames_is_one_loss() -> None:
    false = seen(offset_m=0.02 + 0.26 * 0.4)
    row = metered((seen(), True), (seen(), False), (LOST, True), (seen(), True), (false, False), (seen(), False)).row()
    assert (row["frames"], row["losses"], row["lost"], row["searched"], row["false"]) == (5, 1, 1, 2, 1)
    assert row["losses_per_1000"] == pytest.approx(200.0)
    two = metered((seen(), True), (LOST, True), (seen(), False), (false, False), (seen(), False))
    assert two.row()["losses"] == 2


def test_frames_before_the_first_estimate_do_not_count() -> None:
    row = metered((LOST, True), (LOST, True), (seen(), True), (seen(), False)).row()
    assert (row["frames"], row["losses"], row["lost"], row["searched"]) == (1, 0, 0, 0)


def test_a_loss_that_began_outside_a_bend_is_not_the_bends() -> None:
    meter = metered((seen(), True), (LOST, True), counts=False)
    meter.add(LOST, TRUTH, 0, True, True)
    row = meter.row()
    assert (row["frames"], row["losses"], row["lost"]) == (1, 0, 1)


def test_errors_are_means_and_turn_over_at_pi() -> None:
    turned = seen(offset_m=0.03, heading_rad=0.1 + math.radians(4.0) - math.tau)
    row = metered((seen(), True), (turned, False), (seen(offset_m=-0.01, heading_rad=0.1), False)).row()
    assert row["heading_mae_deg"] == pytest.approx(2.0)
    assert row["offset_mae_m"] == pytest.approx(0.02)


def test_iterations_are_those_of_frames_that_were_followed() -> None:
    meter = metered((seen(), True))
    for count, searched in ((1, False), (5, False), (100, True)):
        meter.add(seen(), TRUTH, count, searched, True)
    assert meter.row()["iterations"] == pytest.approx(3.0)


def test_coasting_is_no_loss_and_has_no_iterations() -> None:
    meter = metered((seen(), True), (seen(), False))
    meter.add(seen(status=LaneStatus.COASTING), TRUTH, 1, False, True)
    row = meter.row()
    assert (row["frames"], row["losses"], row["coasting"], row["iterations"]) == (2, 0, 1, 3.0)


def test_drives_add_up_and_none_has_no_figures() -> None:
    one, two = metered((seen(), True), (LOST, True)), metered((seen(), True), (seen(), False), (LOST, False))
    one.include(two)
    row = one.row()
    assert (row["frames"], row["losses"], row["lost"], row["iterations"]) == (3, 2, 2, 3.0)
    empty = ClaimMeter().row()
    assert list(empty) == list(row)
    assert (empty["frames"], empty["iterations"], empty["losses_per_1000"], empty["offset_mae_m"]) == (0, *[None] * 3)

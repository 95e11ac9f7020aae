"""The TuSimple metric against cases counted by hand and against its definition, point by point."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest

from automodel.bench.tusimple import centre_error_pct, ego_lines, lines_px, parse_labels, score
from automodel.config.toml_reader import ConfigError
from automodel.curves import TabulatedCurve
from automodel.signals import LaneEstimate, LaneLine, LaneStatus
from tests.support.highway_pictures import camera_model, mounted

ROWS = np.arange(240.0, 440.0, 10.0)  # twenty of them


def upright(u: float) -> np.ndarray:
    return np.full(20, u)


def slanted(u: float) -> np.ndarray:
    return u + ROWS  # 45 degrees


def scored(predicted: list[np.ndarray], label: list[np.ndarray], width_px: int = 1280):
    return score(np.array(predicted).reshape(-1, 20), np.array(label).reshape(-1, 20), ROWS, width_px)


def test_the_label_itself_is_perfect() -> None:
    lanes = [upright(300.0), slanted(500.0)]
    result = scored(lanes, lanes)
    assert (result.accuracy, result.fp, result.fn) == (1.0, 0.0, 0.0)


@pytest.mark.parametrize(
    ("lane", "width_px", "limit"),
    [
        (upright(400.0), 1280, 20.0),
        (upright(200.0), 512, 8.0),
        (slanted(400.0), 1280, 20.0 * math.sqrt(2.0)),
        (slanted(0.0), 512, 8.0 * math.sqrt(2.0)),
    ],
)
def test_the_tolerance_grows_with_the_angle_and_the_picture(lane, width_px: int, limit: float) -> None:
    assert scored([lane + 0.999 * limit], [lane], width_px).accuracy == 1.0
    assert scored([lane - 0.999 * limit], [lane], width_px).accuracy == 1.0
    assert scored([lane + 1.001 * limit], [lane], width_px).accuracy == 0.0


@pytest.mark.parametrize(("wrong", "matched"), [(0, True), (3, True), (4, False)])  # 17 of 20 rows are 0.85
def test_a_lane_is_matched_from_85_percent_on(wrong: int, matched: bool) -> None:
    predicted = upright(300.0)
    predicted[:wrong] += 50.0
    result = scored([predicted], [upright(300.0)])
    assert result.accuracy == pytest.approx((20 - wrong) / 20)
    assert (result.fp, result.fn) == ((0.0, 0.0) if matched else (1.0, 1.0))


def test_where_the_label_has_no_point_none_is_right() -> None:
    label, predicted = upright(300.0), upright(300.0)
    label[:5] = np.nan
    assert scored([predicted], [label]).accuracies == (0.75,)
    predicted[:5] = np.nan
    assert scored([predicted], [label]).accuracies == (1.0,)
    predicted[:7] = np.nan
    assert scored([predicted], [label]).accuracies == (0.9,)


def test_lanes_that_are_not_there_and_lanes_that_are_missed() -> None:
    label = [upright(300.0), upright(600.0), upright(900.0)]
    result = scored([upright(301.0), upright(450.0)], label)
    assert result.accuracy == pytest.approx(1.0 / 3.0)
    assert (result.fp, result.fn) == (0.5, pytest.approx(2.0 / 3.0))
    nothing = scored([], label)
    assert (nothing.accuracy, nothing.fp, nothing.fn) == (0.0, 0.0, 1.0)
    assert scored([upright(300.0)], []).fp == 1.0


def test_the_worst_of_five_lanes_is_forgiven() -> None:
    label = [upright(100.0 * k) for k in range(1, 6)]
    assert scored(label[:4], label).accuracy == 1.0
    assert scored(label[:4], label).fn == 0.0
    assert scored(label[:3], label).accuracy == 0.75
    assert scored(label[:3], label).fn == 0.25


def by_definition(predicted, label, rows, width_px: int) -> tuple[float, float, float]:
    """The benchmark's program, in plain loops over Python numbers."""
    scale = width_px / 1280.0
    best = []
    for lane in label:
        known = [(row, u) for row, u in zip(rows, lane, strict=True) if not math.isnan(u)]
        slope = 0.0
        if len(known) > 1:
            mean_row, mean_u = (sum(values) / len(known) for values in zip(*known, strict=True))
            slope = sum((r - mean_row) * (u - mean_u) for r, u in known) / sum((r - mean_row) ** 2 for r, _ in known)
        limit = 20.0 * scale / math.cos(math.atan(slope))
        shares = [0.0]
        for other in predicted:
            pairs = [[-100.0 * scale if math.isnan(u) else u for u in both] for both in zip(other, lane, strict=True)]
            shares.append(sum(abs(a - b) < limit for a, b in pairs) / len(rows))
        best.append(max(shares))
    matched = sum(share >= 0.85 for share in best)
    missed, total = len(best) - matched, sum(best)
    if len(best) > 4:
        total, missed = total - min(best), max(missed - 1, 0)
    count = max(min(len(best), 4), 1)
    return total / count, (len(predicted) - matched) / len(predicted) if predicted else 0.0, missed / count


def test_random_lanes_score_as_defined() -> None:
    rng = np.random.default_rng(5)
    for _ in range(200):
        k, j = rng.integers(1, 6), rng.integers(0, 6)
        label = [rng.uniform(50, 450) + rng.uniform(-3, 3) * (ROWS - 300.0) * 0.4 for _ in range(k)]
        predicted = [label[rng.integers(k)] + rng.normal(0, 6) + rng.normal(0, 2, 20) for _ in range(j)]
        for lane in (*label, *predicted):
            lane[: rng.integers(0, 8)] = np.nan
            lane[20 - rng.integers(0, 5) :] = np.nan
        found = scored(predicted, label, 512)
        wanted = by_definition([p.tolist() for p in predicted], [lane.tolist() for lane in label], ROWS.tolist(), 512)
        assert (found.accuracy, found.fp, found.fn) == pytest.approx(wanted)


def test_ego_lines_are_those_beside_the_middle_of_the_lowest_row() -> None:
    far_left, left, right = 400.0 - 2.0 * (ROWS - 200.0), 400.0 - 0.8 * (ROWS - 200.0), 400.0 + 0.9 * (ROWS - 200.0)
    left[12:] = np.nan  # it leaves the picture: carried on straight
    lanes = np.array([far_left, right, left])
    found = ego_lines(lanes, ROWS, 400.0)
    assert found[0] is not None
    np.testing.assert_array_equal(found[0], left)
    np.testing.assert_array_equal(found[1], right)
    assert ego_lines(lanes[:1], ROWS, 400.0)[1] is None
    assert ego_lines(np.full((1, 20), np.nan), ROWS, 400.0) == (None, None)


def test_the_middle_s_error_is_measured_in_the_lane_s_width() -> None:
    left, right = 300.0 - (ROWS - 200.0), 300.0 + (ROWS - 200.0)
    width = right - left
    assert centre_error_pct([left, right], [left, right]) == 0.0
    both = [left + 0.03 * width, right + 0.03 * width]
    assert centre_error_pct(both, [left, right]) == pytest.approx(3.0)
    assert centre_error_pct([left, right + 0.03 * width], [left, right]) == pytest.approx(1.5)
    assert centre_error_pct([left - 10.0, right + 10.0], [left, right]) == pytest.approx(0.0)
    assert centre_error_pct([left], [left, right]) is None
    assert centre_error_pct([left, np.full(20, np.nan)], [left, right]) is None


def test_an_estimate_s_lines_are_where_a_pinhole_sees_them() -> None:
    camera = mounted(camera_model(), pitch_rad=0.0, z_m=1.5)

    def line(y: float) -> LaneLine:
        curve = TabulatedCurve([0.0, 20.0], [[0.0, y], [20.0, y]], [0.0, 0.0], [0.0, 0.0])
        return LaneLine(curve=curve, points_m=np.empty((0, 2)), seen=True)

    estimate = LaneEstimate(t_ns=0, status=LaneStatus.TRACKING, left=line(1.9), right=line(-1.7))
    rows = np.array([100.0, 150.0, 160.0, 200.0, 280.0])
    found = lines_px(estimate, camera, rows, 3.7)
    depth = rows - 143.5  # f z / x: a point y to the left lies y / z of it beside the middle
    for lane, y in zip(found, (1.9, -1.7), strict=True):
        wanted = 255.5 - depth * y / 1.5
        np.testing.assert_allclose(
            lane[2:], wanted[2:], atol=0.01
        )  # the first is sky, the second beyond the last metre
        assert np.isnan(lane[:2]).all()
    assert lines_px(LaneEstimate(t_ns=0, status=LaneStatus.LOST), camera, rows, 3.7).shape == (0, 5)
    wide = lines_px(
        LaneEstimate(t_ns=0, status=LaneStatus.TRACKING, left=line(9.0), right=line(-1.7)), camera, rows, 3.7
    )
    assert np.isnan(wide[0, -1])  # outside the picture


GOOD = {"raw_file": "a.jpg", "lanes": [[-2, 10, 20], [-2, -2, -2]], "h_samples": [100, 110, 120]}


def test_labels_are_read_with_their_gaps() -> None:
    (label,) = parse_labels("\n" + json.dumps(GOOD) + "\n\n", "labels")
    assert label.raw_file == "a.jpg"
    np.testing.assert_array_equal(label.rows, [100.0, 110.0, 120.0])
    np.testing.assert_array_equal(label.lanes, [[np.nan, 10.0, 20.0]])  # a lane without points is none


@pytest.mark.parametrize(
    ("line", "why"),
    [
        ('{"raw_file": "a.jpg", "lanes"', "labels:2: not JSON"),
        ("[1, 2]", "labels:2: expected a JSON object"),
        (json.dumps({**GOOD, "raw_file": 3}), "raw_file: of the wrong kind"),
        (json.dumps({"raw_file": "a", "lanes": []}), "h_samples: missing"),
        (json.dumps({**GOOD, "h_samples": [100, 120, 110]}), "h_samples: expected rising numbers"),
        (json.dumps({**GOOD, "h_samples": [100, "x", 120]}), "h_samples: expected rising numbers"),
        (json.dumps({**GOOD, "lanes": [[1, 2]]}), "lane 1 has 2 points for 3 h_samples"),
        (json.dumps({**GOOD, "lanes": [[1, 2, None]]}), "lane 1 is not a list of numbers"),
        (json.dumps({**GOOD, "lanes": [3]}), "lane 1 is not a list of numbers"),
        (json.dumps(GOOD), "a.jpg is labelled twice"),
    ],
)
def test_a_wrong_label_is_refused_by_line(line: str, why: str) -> None:
    with pytest.raises(ConfigError) as caught:
        parse_labels(json.dumps(GOOD) + "\n" + line, "labels")
    assert why in str(caught.value)


def test_no_labels_at_all_are_refused() -> None:
    with pytest.raises(ConfigError, match="got no labels"):
        parse_labels("\n", "labels")

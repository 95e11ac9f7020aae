"""Curves against closed forms and independent derivations."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.special import fresnel

from automodel.curves import (
    Curve,
    DeferredGraphCurve,
    GraphCurve,
    JoinedCurve,
    OffsetCurve,
    ReversedCurve,
    SplineCurve,
    TabulatedCurve,
    ThetaCurve,
    arc,
    clothoid,
    line,
)


def stadium() -> JoinedCurve:
    """Two straights of 3 m, two left half circles of 1.2 m, from (0, 0) heading along x."""
    turn = math.pi * 1.2
    return JoinedCurve(
        [line(0, 0, 0, 3), arc(3, 0, 0, 1 / 1.2, turn), line(3, 2.4, math.pi, 3), arc(0, 2.4, math.pi, 1 / 1.2, turn)],
        closed=True,
    )


def eight() -> JoinedCurve:
    """A figure of eight: its two passes cross at right angles at the origin."""
    r = 1.0
    three_quarters = 1.5 * math.pi * r
    return JoinedCurve(
        [
            line(-1, 0, 0, 2),
            arc(1, 0, 0, 1 / r, three_quarters),  # about (1, 1), ends at (0, 1) heading down
            line(0, 1, 1.5 * math.pi, 2),
            arc(0, -1, 1.5 * math.pi, -1 / r, three_quarters),  # about (-1, -1), ends at (-1, 0) heading along x
        ],
        closed=True,
    )


def wavy(x_m: float) -> ThetaCurve:
    return ThetaCurve(x_m, -0.5, (0.4, -0.6, 0.9, -0.2), 2.5)


SAMPLES = np.linspace(0.0, 2.5, 201)
CURVES: dict[str, Curve] = {
    "line": line(1.0, 2.0, 0.7, 3.0),
    "arc": arc(-1.0, 0.5, 2.0, -0.8, 4.0),
    "clothoid": clothoid(0.0, 0.0, -0.4, -1.0, 1.5, 2.0),
    "theta": wavy(0.0),
    "graph": GraphCurve((0.1, -0.3, 0.8, 0.2), -0.5, 1.0),
    "spline": SplineCurve([(0, 0), (1, 0.4), (2, -0.2), (3, 0.3), (4, 0.0)]),
    "closed spline": SplineCurve([(2, 0), (1.4, 1.3), (0, 1.8), (-1.8, 0.4), (0.2, -1.0)], closed=True),
    "joined": stadium(),
    "offset": OffsetCurve(clothoid(0.0, 0.0, 0.2, 0.1, 0.9, 3.0), 0.4),
    "varying offset": OffsetCurve(arc(0.0, 0.0, 0.2, 0.4, 3.0), lambda s: 0.2 + 0.1 * np.sin(s)),
    "reversed": ReversedCurve(wavy(0.0)),
    "offset of joined": OffsetCurve(stadium(), -0.2),
    "tabulated": TabulatedCurve(
        SAMPLES, wavy(0.0).position(SAMPLES), wavy(0.0).heading(SAMPLES), wavy(0.0).curvature(SAMPLES)
    ),
}


@pytest.mark.parametrize("name", CURVES)
def test_tangent_speed_and_curvature_agree_with_differences(name: str) -> None:
    curve = CURVES[name]
    h = 1e-4
    s = np.linspace(0.02, curve.length_m - 0.02, 57)
    joints = np.asarray(curve.breaks_m())
    if len(joints):  # differences across a jump of curvature prove nothing
        s = s[np.abs(s[:, None] - joints).min(axis=1) > 2 * h]
    derivative = (curve.position(s + h) - curve.position(s - h)) / (2 * h)
    assert np.hypot(*derivative.T) == pytest.approx(np.ones(len(s)), abs=5e-4 if "spline" in name else 1e-6)
    heading = curve.heading(s)
    assert derivative == pytest.approx(np.stack((np.cos(heading), np.sin(heading)), axis=-1), abs=5e-4)
    turn = (curve.heading(s + h) - curve.heading(s - h)) / (2 * h)
    assert curve.curvature(s) == pytest.approx(turn, abs=1e-2 if name == "tabulated" else 1e-3)


@pytest.mark.parametrize("name", CURVES)
def test_shapes_follow_the_arc_length_given(name: str) -> None:
    curve = CURVES[name]
    assert curve.position(0.3).shape == (2,)
    assert curve.position(np.full((2, 3), 0.3)).shape == (2, 3, 2)
    assert np.shape(curve.heading(0.3)) == ()
    assert curve.heading(np.full((2, 3), 0.3)).shape == (2, 3)
    assert curve.curvature(np.full((2, 3), 0.3)).shape == (2, 3)
    assert curve.position(np.full((2, 3), 0.3))[1, 2] == pytest.approx(curve.position(0.3))


@pytest.mark.parametrize("name", CURVES)
def test_projection_undoes_offset_position(name: str) -> None:
    curve = CURVES[name]
    rng = np.random.default_rng(5)
    for s, d in zip(rng.uniform(0.05, 0.95, 20) * curve.length_m, rng.uniform(-0.08, 0.08, 20), strict=True):
        found_s, found_d = curve.project(curve.offset_position(s, d))
        assert found_s == pytest.approx(s, abs=1e-6)
        assert found_d == pytest.approx(d, abs=1e-7)


def test_clothoid_is_fresnels_integral() -> None:
    rate = 0.8  # curvature = rate * s
    curve = clothoid(0.0, 0.0, 0.0, 0.0, rate * 3.0, 3.0)
    s = np.linspace(0.0, 3.0, 31)
    scale = math.sqrt(math.pi / rate)
    sine, cosine = fresnel(s / scale)
    assert curve.position(s) == pytest.approx(np.stack((scale * cosine, scale * sine), axis=-1), abs=1e-12)
    assert curve.curvature(s) == pytest.approx(rate * s)


def test_arc_lies_on_its_circle() -> None:
    curve = arc(2.0, 1.0, 0.0, -0.5, 7.0)  # right turn about (2, -1)
    s = np.linspace(0.0, 7.0, 20)
    expected = np.stack((2.0 + 2.0 * np.sin(s / 2), -1.0 + 2.0 * np.cos(s / 2)), axis=-1)
    assert curve.position(s) == pytest.approx(expected, abs=1e-12)


def test_theta_curve_matches_a_fine_sum() -> None:
    curve = wavy(0.3)
    s = (np.arange(200_000) + 0.5) * 2.5 / 200_000
    theta = 0.4 - 0.6 * s + 0.9 * s**2 - 0.2 * s**3
    end = np.array([0.3, -0.5]) + 2.5 / 200_000 * np.array([np.cos(theta).sum(), np.sin(theta).sum()])
    assert curve.position(2.5) == pytest.approx(end, abs=1e-9)


@pytest.mark.parametrize("offset", [-0.6, 0.3])
def test_offset_of_an_arc_is_an_arc(offset: float) -> None:
    curve = OffsetCurve(arc(0.0, 0.0, 0.0, 0.5, 3.0), offset)  # about (0, 2); to the left is nearer to the centre
    radius = 2.0 - offset
    assert curve.length_m == pytest.approx(1.5 * radius)
    s = np.linspace(0.0, curve.length_m, 17)
    expected = np.stack((radius * np.sin(s / radius), 2.0 - radius * np.cos(s / radius)), axis=-1)
    assert curve.position(s) == pytest.approx(expected, abs=1e-9)
    assert curve.curvature(s) == pytest.approx(np.full(17, 1 / radius))
    assert curve.heading(s) == pytest.approx(s / radius)


def test_offset_curve_counts_its_own_arc_length_over_joints() -> None:
    lane = OffsetCurve(stadium(), 0.2)
    assert lane.length_m == pytest.approx(6.0 + 2 * math.pi * 1.0, abs=1e-9)
    assert lane.breaks_m() == pytest.approx([3.0, 3.0 + math.pi, 6.0 + math.pi], abs=1e-9)
    assert lane.position(3.0 + 0.5 * math.pi) == pytest.approx([4.0, 1.2], abs=1e-9)
    for s in (0.1, 3.3, 7.7, 12.0):
        assert lane.s_of(lane.base_s(s)) == pytest.approx(s, abs=1e-9)


def test_offset_curve_goes_on_beyond_open_ends_at_its_own_pace() -> None:
    curve = OffsetCurve(arc(0.0, 0.0, 0.0, 0.5, 3.0), 0.5)
    for s in (-0.2, curve.length_m + 0.3):
        assert curve.position(s) == pytest.approx([1.5 * math.sin(s / 1.5), 2.0 - 1.5 * math.cos(s / 1.5)], abs=1e-9)


def test_offset_that_reaches_the_centre_of_curvature_is_refused() -> None:
    with pytest.raises(ValueError, match=r"folds back at s = "):
        OffsetCurve(arc(0.0, 0.0, 0.0, 0.5, 3.0), 2.1)


def test_varying_offset_of_a_line_is_the_graph_of_the_offset() -> None:
    curve = OffsetCurve(line(0.0, 0.0, 0.0, 4.0), lambda s: 0.3 * s)
    assert curve.length_m == pytest.approx(4.0 * math.hypot(1.0, 0.3))
    assert curve.heading(2.0) == pytest.approx(math.atan(0.3))
    assert curve.position(curve.length_m) == pytest.approx([4.0, 1.2])


def test_spline_of_a_circle() -> None:
    angle = np.arange(48) / 48 * 2 * math.pi
    curve = SplineCurve(2.0 * np.stack((np.cos(angle), np.sin(angle)), axis=-1), closed=True)
    assert curve.length_m == pytest.approx(4 * math.pi, rel=1e-5)
    s = np.linspace(0.0, curve.length_m, 101)
    expected = 2.0 * np.stack((np.cos(s / 2), np.sin(s / 2)), axis=-1)
    assert curve.position(s) == pytest.approx(expected, abs=5e-5)
    assert curve.curvature(s) == pytest.approx(np.full(101, 0.5), abs=2e-3)
    assert curve.heading(s) == pytest.approx(s / 2 + math.pi / 2, abs=5e-4)
    assert curve.heading(3.1 + 2 * curve.length_m) == pytest.approx(float(curve.heading(3.1)) + 4 * math.pi)


def test_spline_runs_by_arc_length_between_far_points() -> None:
    curve = SplineCurve([(0, 0), (5, 0), (5, 5), (0, 5)], closed=True)
    s = np.linspace(0.0, curve.length_m, 4001)
    steps = np.hypot(*np.diff(curve.position(s), axis=0).T) / (s[1] - s[0])
    assert np.abs(steps - 1.0).max() < 1e-3


def test_open_spline_goes_straight_on() -> None:
    curve = SplineCurve([(0, 0), (1, 0.4), (2, -0.2), (3, 0.3)])
    for end, s in ((0.0, -0.7), (curve.length_m, curve.length_m + 0.7)):
        theta = float(curve.heading(end))
        expected = curve.position(end) + (s - end) * np.array([math.cos(theta), math.sin(theta)])
        assert curve.position(s) == pytest.approx(expected)
        assert curve.curvature(s) == 0.0


def test_graph_curve_has_the_arc_length_of_a_parabola() -> None:
    a, x = 0.7, 1.5  # y = a x^2: s = x/2 sqrt(1 + 4 a^2 x^2) + asinh(2 a x) / (4 a)
    curve = GraphCurve((0.0, 0.0, a), 0.0, x)
    exact = 0.5 * x * math.sqrt(1 + 4 * a * a * x * x) + math.asinh(2 * a * x) / (4 * a)
    assert curve.length_m == pytest.approx(exact, abs=1e-10)
    half = 0.75
    s = 0.5 * half * math.sqrt(1 + 4 * a * a * half * half) + math.asinh(2 * a * half) / (4 * a)
    assert curve.x_of(s) == pytest.approx(half, abs=1e-10)
    assert curve.heading(s) == pytest.approx(math.atan(2 * a * half))
    assert curve.curvature(s) == pytest.approx(2 * a / (1 + (2 * a * half) ** 2) ** 1.5)


def test_graph_curve_inverts_arc_length_beyond_its_ends() -> None:
    curve = GraphCurve((0.2, 0.5), 0.0, 2.0)
    assert curve.x_of([-0.5, curve.length_m + 0.5]) == pytest.approx(
        [-0.5 / math.hypot(1, 0.5), 2.0 + 0.5 / math.hypot(1, 0.5)]
    )


def test_a_deferred_graph_curve_is_made_once_when_it_is_used() -> None:
    made = []

    def make() -> tuple[np.ndarray, float, float]:
        made.append(1)
        return np.array([0.1, -0.3, 0.8]), -0.5, 1.0

    deferred, curve = DeferredGraphCurve(make), GraphCurve((0.1, -0.3, 0.8), -0.5, 1.0)
    assert not made
    s = np.linspace(-0.1, 1.9, 9)
    np.testing.assert_array_equal(deferred.position(s), curve.position(s))
    np.testing.assert_array_equal(deferred.curvature(s), curve.curvature(s))
    assert deferred.length_m == curve.length_m
    assert made == [1]
    with pytest.raises(AttributeError, match="colour"):
        deferred.colour  # noqa: B018


def test_joined_curve_is_continuous_over_joints_and_laps() -> None:
    curve = stadium()
    assert curve.length_m == pytest.approx(6.0 + 2.4 * math.pi)
    for s in [*curve.breaks_m(), 0.0, curve.length_m]:
        assert curve.position(s + 1e-9) == pytest.approx(curve.position(s - 1e-9), abs=1e-8)
        assert curve.heading(s + 1e-9) == pytest.approx(float(curve.heading(s - 1e-9)), abs=1e-8)
    s = np.array([-2.0, 0.5, 9.0])
    assert curve.position(s + curve.length_m) == pytest.approx(curve.position(s), abs=1e-9)
    assert curve.heading(s + 2 * curve.length_m) == pytest.approx(curve.heading(s) + 4 * math.pi)
    assert curve.curvature([1.0, 3.1]) == pytest.approx([0.0, 1 / 1.2])


def test_joined_curve_takes_up_headings_a_turn_apart() -> None:
    curve = JoinedCurve([line(0, 0, 0, 1), line(1, 0, 2 * math.pi, 1)])
    assert curve.heading([0.5, 1.5]) == pytest.approx([0.0, 0.0])


def test_reversed_curve_runs_back() -> None:
    base = wavy(0.0)
    curve = ReversedCurve(base)
    assert curve.position(0.4) == pytest.approx(base.position(base.length_m - 0.4))
    away = np.remainder(curve.heading(0.4) - base.heading(base.length_m - 0.4), 2 * math.pi)
    assert away == pytest.approx(math.pi)
    assert curve.curvature(0.4) == pytest.approx(-float(base.curvature(base.length_m - 0.4)))
    assert curve.project(base.offset_position(1.0, 0.1)) == pytest.approx((base.length_m - 1.0, -0.1))


def test_reversed_curve_turns_breaks_round() -> None:
    assert ReversedCurve(stadium()).breaks_m() == pytest.approx(stadium().length_m - stadium().breaks_m()[::-1])


def test_projection_at_a_crossing_stays_on_its_branch() -> None:
    curve = eight()
    second = 2.0 + 1.5 * math.pi + 1.0  # arc length of the second pass over the origin
    point = (0.06, 0.05)
    assert curve.project(point, near_s_m=1.0) == pytest.approx((1.06, 0.05), abs=1e-9)
    assert curve.project(point, near_s_m=second) == pytest.approx((second - 0.05, 0.06), abs=1e-9)


def test_projection_near_the_seam_of_a_closed_curve() -> None:
    curve = stadium()
    for s in (0.01, curve.length_m - 0.01, curve.length_m - 0.003):
        point = curve.offset_position(s, 0.15)
        for near in (None, 0.0, curve.length_m - 0.05):
            found_s, found_d = curve.project(point, near_s_m=near)
            assert found_s == pytest.approx(s, abs=1e-9)
            assert found_d == pytest.approx(0.15, abs=1e-9)


def test_projection_beyond_open_ends_is_clamped() -> None:
    curve = line(0.0, 0.0, 0.0, 2.0)
    assert curve.project((2.5, 0.3)) == pytest.approx((2.0, 0.3))
    assert curve.project((-0.5, -0.3)) == pytest.approx((0.0, -0.3))


@pytest.mark.parametrize(
    "make",
    [
        lambda: line(0, 0, 0, 0.0),
        lambda: line(0, 0, math.nan, 1.0),
        lambda: arc(0, 0, 0, 1.0, -1.0),
        lambda: GraphCurve((1.0, math.inf), 0, 1),
        lambda: GraphCurve((1.0,), 1, 1),
        lambda: SplineCurve([(0, 0), (1, 1)]),
        lambda: SplineCurve([(0, 0), (0, 0), (1, 1)]),
        lambda: SplineCurve([(0, 0), (math.nan, 0), (1, 1)]),
        lambda: JoinedCurve([]),
        lambda: TabulatedCurve([0.0, 0.0], [(0, 0), (1, 0)], [0, 0], [0, 0]),
    ],
)
def test_impossible_curves_are_refused(make: object) -> None:
    with pytest.raises(ValueError, match=r"expected|finite|repeats|rise"):
        make()  # type: ignore[operator]


def test_tabulated_curve_goes_on_along_its_end_circles() -> None:
    s = np.linspace(0.0, 1.0, 30)
    base = arc(0.0, 0.0, 0.3, 0.8, 1.0)
    curve = TabulatedCurve(s, base.position(s), base.heading(s), base.curvature(s))
    for beyond in (-0.4, 1.4):
        centre = np.array([-math.sin(0.3), math.cos(0.3)]) / 0.8
        angle = 0.3 + 0.8 * beyond
        assert curve.position(beyond) == pytest.approx(centre + np.array([math.sin(angle), -math.cos(angle)]) / 0.8)
        assert curve.heading(beyond) == pytest.approx(angle)

"""The clothoid pair against headings and positions that are integrated in many small steps."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from automodel.estimation.clothoid.clothoid_pair import ClothoidPair, PairShape, Parameter
from automodel.types import FloatArray

Complexes = NDArray[np.complex128]
REFERENCE, SPACING = 0.17, 0.25
NODES = np.geomspace(0.3, 1.4, 15)
PHASES = [0.0, 0.08, 0.125, 0.2499]
BENDS = {
    "straight": np.zeros(8),
    "arc": np.full(8, 1.1),
    "into an arc": np.array([0.0, 0.0, 0.3, 0.9, 1.2, 1.2, 1.2, 1.2]),
    "s": np.array([-1.0, -0.8, -0.2, 0.4, 0.9, 1.0, 0.2, -0.5]),
}


def pair(nodes: FloatArray = NODES, spacing: float = SPACING) -> ClothoidPair:
    return ClothoidPair(nodes, spacing, REFERENCE)


def parameters(bend: str, count: int) -> FloatArray:
    return np.concatenate(((0.06, -0.2, 0.44, 0.07), BENDS[bend][:count]))


def integrated(
    x: FloatArray, phase: float, reach: FloatArray, fine: int = 40_001
) -> tuple[Complexes, FloatArray, FloatArray]:
    """Centerline, heading and curvature at the arc lengths `reach`, by the midpoint rule from the foot on."""
    s = np.linspace(0.0, reach.max(), fine)
    stations = np.arange(len(x) - Parameter.CURVATURE) * SPACING - phase
    middle = 0.5 * (s[1:] + s[:-1])
    step = np.diff(s)
    theta = x[1] + np.concatenate(([0.0], np.cumsum(step * np.interp(middle, stations, x[Parameter.CURVATURE :]))))
    path = np.concatenate(([0.0], np.cumsum(step * np.exp(0.5j * (theta[1:] + theta[:-1])))))
    place = REFERENCE - 1j * x[0] * np.exp(1j * x[1]) + path
    at = np.interp(reach, s, place.real) + 1j * np.interp(reach, s, place.imag)
    return at, np.interp(reach, s, theta), np.interp(reach, stations, x[Parameter.CURVATURE :])


@pytest.mark.parametrize("phase", PHASES)
@pytest.mark.parametrize("bend", BENDS)
def test_nodes_lie_where_fine_integration_puts_them(bend: str, phase: float) -> None:
    dense = np.linspace(0.02, 1.4, 120)
    tested = pair(dense)
    x = parameters(bend, tested.stations)
    shape = tested.shape(x, phase)
    place, theta, _ = integrated(x, phase, dense)
    assert np.abs(shape.place - place).max() < 4e-4
    assert np.angle(shape.along * np.exp(-1j * theta)) == pytest.approx(np.zeros(120), abs=1e-3)


def test_the_trapezoids_error_falls_with_the_square_of_the_step() -> None:
    errors = []
    for count in (20, 40, 80):
        nodes = np.linspace(0.0, 1.4, count + 1)[1:]
        tested = pair(nodes)
        x = parameters("arc", tested.stations)
        errors.append(abs(tested.shape(x, 0.0).place[-1] - integrated(x, 0.0, nodes)[0][-1]))
    assert errors[0] / errors[1] == pytest.approx(4.0, rel=0.1)
    assert errors[1] / errors[2] == pytest.approx(4.0, rel=0.1)


def nodes_of_both(x: FloatArray, shape: PairShape) -> Complexes:
    half = 0.5j * (x[Parameter.WIDTH] + x[Parameter.TAPER] * NODES) * shape.along
    return np.concatenate((shape.place + half, shape.place - half))


@pytest.mark.parametrize("phase", PHASES)
@pytest.mark.parametrize("bend", BENDS)
def test_the_jacobian_is_that_of_finite_differences(bend: str, phase: float) -> None:
    tested, step = pair(), 1e-6
    x = parameters(bend, tested.stations)
    shape = tested.shape(x, phase)
    jacobian, normal = shape.jacobian.copy(), 1j * np.tile(shape.along, 2)
    assert jacobian.shape == (3 * len(NODES), len(x))
    for p in range(len(x)):
        up, down = x.copy(), x.copy()
        up[p] += step
        down[p] -= step
        one, other = tested.shape(up, phase), tested.shape(down, phase)
        moved = (nodes_of_both(up, one) - nodes_of_both(down, other)) / (2.0 * step)
        turned = np.angle(one.along / other.along) / (2.0 * step)
        left = (moved * normal.conj()).real
        assert jacobian[:, p] == pytest.approx(np.concatenate((left, turned)), abs=1e-7), p


def test_a_station_that_is_passed_changes_nothing_but_the_phase() -> None:
    tested = pair()
    x = parameters("s", tested.stations)
    before = tested.shape(x, SPACING * (1.0 - 1e-9)).place.copy()
    first = Parameter.CURVATURE
    rolled = np.concatenate((x[:first], x[first + 1 :], [0.7]))
    assert tested.shape(rolled, 0.0).place == pytest.approx(before, abs=1e-7)


def test_the_last_station_lies_ahead_of_the_last_node_at_any_phase() -> None:
    tested = pair()
    for phase in PHASES:
        jacobian = tested.shape(parameters("arc", tested.stations), phase).jacobian
        # One more of curvature everywhere turns each node by its arc length.
        assert jacobian[2 * len(NODES) :, Parameter.CURVATURE :].sum(axis=1) == pytest.approx(NODES)


@pytest.mark.parametrize("lateral", [0.0, 0.22, -0.22])
@pytest.mark.parametrize("bend", BENDS)
def test_the_table_is_the_curve_beside_the_centerline(bend: str, lateral: float) -> None:
    tested, phase = pair(), 0.1
    x = parameters(bend, tested.stations)
    s, points, theta, kappa = tested.table(x, phase, lateral)
    assert s[0] == 0.0
    reach = np.linspace(0.0, NODES[-1], len(s))
    place, heading, bent = integrated(x, phase, reach)
    curve = place + lateral * 1j * np.exp(1j * heading)
    assert points[:, 0] + 1j * points[:, 1] == pytest.approx(curve, abs=2e-5)
    assert theta == pytest.approx(heading, abs=5e-5)  # its quarters of a step run across stations
    assert kappa == pytest.approx(bent / (1.0 - lateral * bent), abs=1e-9)
    fine = np.linspace(0.0, NODES[-1], 20_001)
    path = integrated(x, phase, fine)
    steps = np.abs(np.diff(path[0] + lateral * 1j * np.exp(1j * path[1])))
    assert s[-1] == pytest.approx(steps.sum(), abs=2e-3)


def test_the_table_of_a_line_that_draws_away_goes_through_points_beside_the_centerline() -> None:
    tested, taper = pair(), 0.08
    x = parameters("s", tested.stations)
    s, points, theta, _ = tested.table(x, 0.1, 0.2, taper=taper)
    reach = np.linspace(0.0, NODES[-1], len(s))
    place, heading, _ = integrated(x, 0.1, reach)
    curve = place + (0.2 + taper * reach) * 1j * np.exp(1j * heading)
    assert points[:, 0] + 1j * points[:, 1] == pytest.approx(curve, abs=2e-5)
    steps = np.diff(points[:, 0] + 1j * points[:, 1])
    assert np.diff(s) == pytest.approx(np.abs(steps), rel=0.01)
    assert 0.5 * (theta[1:] + theta[:-1]) == pytest.approx(np.angle(steps), abs=0.01)


def test_the_table_behind_the_car_is_the_arc_run_backwards() -> None:
    tested = pair()
    x = parameters("arc", tested.stations)
    s, points, theta, _ = tested.table(x, 0.2, behind_m=0.2)
    ahead = tested.table(x, 0.2)
    before = len(s) - len(ahead[0])
    assert before > 0
    assert s[before] == pytest.approx(0.2)
    assert points[before:] == pytest.approx(ahead[1], abs=1e-12)
    start = points[before, 0] + 1j * points[before, 1]
    centre = start + 1j * np.exp(1j * x[1]) / 1.1
    back = centre + (start - centre) * np.exp(-1j * 1.1 * 0.2)
    assert complex(points[0, 0], points[0, 1]) == pytest.approx(back, abs=1e-6)
    assert theta[0] == pytest.approx(x[1] - 1.1 * 0.2)


def test_a_line_beyond_the_centre_of_curvature_stays_finite_and_runs_on() -> None:
    tested = pair()
    s, points, _, kappa = tested.table(parameters("arc", tested.stations), 0.0, lateral_m=1.5)
    assert np.isfinite(points).all()
    assert np.isfinite(kappa).all()
    assert (np.diff(s) > 0.0).all()


def test_single_precision_stays_close_to_double() -> None:
    narrow = ClothoidPair(NODES, SPACING, REFERENCE, np.float32)
    x = parameters("s", narrow.stations)
    shape, wide = narrow.shape(x.astype(np.float32), 0.1), pair().shape(x, 0.1)
    assert shape.place.dtype == np.complex64
    assert shape.jacobian.dtype == np.float32
    assert np.abs(shape.place - wide.place).max() < 1e-6
    assert shape.jacobian == pytest.approx(wide.jacobian, abs=1e-5)


@pytest.mark.parametrize(
    ("nodes", "spacing"), [([0.3], 0.25), ([0.0, 0.5], 0.25), ([0.5, 0.3], 0.25), ([0.3, 0.5], 0.0)]
)
def test_nodes_that_do_not_rise_are_refused(nodes: list[float], spacing: float) -> None:
    with pytest.raises(ValueError, match="nodes_m"):
        ClothoidPair(np.array(nodes), spacing, REFERENCE)

"""The clothoid tracker against drives on exact circles, and against lanes whose place is known."""

from __future__ import annotations

import cmath
import math

import numpy as np
import pytest

from automodel.estimation.clothoid.clothoid_pair import ClothoidPair, Parameter
from automodel.estimation.clothoid.clothoid_tracker import ClothoidTracker, TrackerConfig, _of_known_width
from automodel.types import FloatArray

REFERENCE, SPACING, WIDTH = 0.17, 0.25, 0.44
NODES = np.geomspace(0.3, 1.4, 15)
COUNT = len(NODES)
SIGMA = np.repeat((0.004, 0.03), (2 * COUNT, COUNT))
OFFSET, HEADING, LANE, TAPER, FIRST = (int(p) for p in Parameter)
EVERY = np.arange(2 * COUNT)


def tracker(
    solver: str = "gauss_newton", lane: tuple[float, float, float] = (0.03, -0.1, 0.6), noise: float = 1.0
) -> ClothoidTracker:
    """One that follows a lane of offset, heading and constant curvature, whose parameters are not correlated."""
    config = TrackerConfig(lane_width_m=WIDTH, radius_lanes=1.1, gate=3.5, solver=solver)
    made = ClothoidTracker(ClothoidPair(NODES, SPACING, REFERENCE), config, noise * SIGMA)
    offset, heading, curvature = lane
    made.start(np.array((offset, heading, curvature, WIDTH)), np.diag(np.full(4, 0.01)))
    x = np.full(FIRST + made.pair.stations, curvature)
    x[:FIRST] = offset, heading, WIDTH, 0.0
    made.parameters = x
    sigma = np.full(len(x), 0.3)
    sigma[:FIRST] = 0.02, 0.03, 0.01, 0.03
    made.covariance = np.diag(sigma**2)
    still(made)
    return made


def still(made: ClothoidTracker) -> None:
    """A frame in which the car stands."""
    made.move(0.0, 0.0, known=True)


def circle(offset: float, heading: float, curvature: float) -> complex:
    """The centre of the road's circle in the body frame."""
    normal = 1j * cmath.exp(1j * heading)
    return REFERENCE - offset * normal + normal / curvature


def residuals(made: ClothoidTracker, truth: FloatArray) -> FloatArray:
    """What a perfect search would say of a lane with the parameters `truth`: distances (2 n,), then angles (2 n,)."""
    pair, x, phase = made.pair, made.known(), made.phase_m
    ahead = np.linspace(0.005, 1.6, 800)
    fine = ClothoidPair(ahead, SPACING, REFERENCE)
    longer = np.concatenate((truth, np.full(fine.stations - pair.stations, truth[-1])))
    line, shape = fine.shape(longer, phase), pair.shape(x, phase)
    away, turned = [], []
    for side in (0.5, -0.5):
        nodes = shape.place + side * (x[LANE] + x[TAPER] * NODES) * 1j * shape.along
        curve = line.place + side * (truth[LANE] + truth[TAPER] * ahead) * 1j * line.along
        for node, along in zip(nodes, shape.along, strict=True):
            seen = (curve - node) * along.conjugate()
            away.append(np.interp(0.0, seen.real, seen.imag))
            turned.append(np.interp(0.0, seen.real, np.angle(line.along * along.conjugate())))
    return np.array(away + turned)


def see(made: ClothoidTracker, truth: FloatArray, times: int = 1) -> None:
    for _ in range(times):
        made.update(made.shape(), EVERY, residuals(made, truth), np.ones(4 * COUNT))


@pytest.mark.parametrize("curvature", [0.9, -0.9, 0.05])
@pytest.mark.parametrize(
    ("distance", "turn"), [(0.05, 0.0), (0.05, 0.06), (0.6, -0.5), (0.31, 0.4), (-0.1, 0.05), (0.0, 0.2)]
)
def test_the_prediction_on_a_circle_is_that_of_plane_geometry(curvature: float, distance: float, turn: float) -> None:
    offset, heading = 0.04, -0.15
    made = tracker(lane=(offset, heading, curvature))
    made.move(distance, turn, known=True)
    driven = distance if turn == 0.0 else (cmath.exp(1j * turn) - 1.0) / (1j * turn) * distance
    centre = (circle(offset, heading, curvature) - driven) * cmath.exp(-1j * turn)  # in the new body frame
    towards = centre - REFERENCE
    sign = math.copysign(1.0, curvature)
    wanted_heading = cmath.phase(-1j * sign * towards)
    x = made.known()
    assert x[OFFSET] == pytest.approx(1.0 / curvature - sign * abs(towards), abs=1e-9)
    assert x[HEADING] == pytest.approx(wanted_heading, abs=1e-9)
    distance = (wanted_heading + turn - heading) / curvature
    assert made.advance_m == pytest.approx(abs(distance), abs=1e-9)
    assert made.phase_m == pytest.approx(distance % SPACING, abs=1e-9)
    rolled = math.floor(distance / SPACING)
    old = x[FIRST : len(x) - max(rolled, 0)][max(-rolled, 0) :]
    assert old == pytest.approx(np.full(len(old), curvature))
    assert len(old) == made.pair.stations - abs(rolled)


def test_many_short_drives_are_one_long_drive() -> None:
    one, many = tracker(lane=(0.02, 0.1, 0.7)), tracker(lane=(0.02, 0.1, 0.7))
    one.move(0.4, 0.3, known=True)
    for _ in range(20):
        many.move(0.02, 0.015, known=True)
    assert many.known()[:FIRST] == pytest.approx(one.known()[:FIRST], abs=1e-9)
    assert many.phase_m == pytest.approx(one.phase_m)


def test_stations_stay_where_they_are_on_the_road() -> None:
    made = tracker()
    x = made.known()
    x[OFFSET] = x[HEADING] = 0.0
    x[FIRST:] = np.linspace(0.0, 1.0, made.pair.stations)
    before = made.pair.table(x, 0.0)
    s = 0.27  # past one station: the curvature of what lies ahead is unchanged, seen from further on
    ahead = np.interp(s + 0.5, before[0], before[3])
    made.move(s, 0.0, known=True)
    after = made.pair.table(made.known(), made.phase_m)
    assert np.interp(0.5, after[0], after[3]) == pytest.approx(ahead, abs=1e-3)
    assert made.curvature() == pytest.approx(np.interp(s, before[0], before[3]), abs=1e-3)


def test_the_covariance_is_carried_along_with_the_derivatives_of_the_drive() -> None:
    made = tracker(lane=(0.0, 0.0, 0.0))
    size, distance = len(made.known()), 0.1
    rng = np.random.default_rng(3)
    mixed = rng.normal(size=(size, size))
    made.covariance = before = 1e-4 * mixed @ mixed.T
    made.move(distance, 0.03, known=True)
    after = made.covariance

    def driven(change: FloatArray) -> FloatArray:
        moved = tracker(lane=(0.0, 0.0, 0.0))
        moved.parameters = moved.known() + change
        moved.move(distance, 0.03, known=True)
        return moved.known().astype(np.float64)

    onwards = np.stack([(driven(1e-6 * e) - driven(-1e-6 * e)) / 2e-6 for e in np.eye(size)], axis=1)
    wanted = onwards @ before @ onwards.T
    apart = after - wanted
    assert (apart.diagonal() > -2e-3 * before.diagonal()).all()  # less by no more than what is left out, see below
    shares = apart / np.sqrt(np.outer(wanted.diagonal(), wanted.diagonal()))
    np.fill_diagonal(shares, 0.0)
    # That curvature moves the offset too, by half the square of the distance, is left out.
    assert np.abs(shares).max() < 0.02
    unmoved = before / np.sqrt(np.outer(before.diagonal(), before.diagonal()))
    moved_much = wanted / np.sqrt(np.outer(wanted.diagonal(), wanted.diagonal())) - unmoved
    assert np.abs(moved_much).max() > 0.05  # so that the line above means something


def test_a_drive_makes_the_lane_less_sure() -> None:
    made = tracker()
    before = made.covariance.diagonal().copy()
    made.move(0.02, 0.0, known=True)
    assert (made.covariance.diagonal() > before).all()


def test_without_odometry_the_lane_in_sight_stays_and_all_is_less_sure() -> None:
    made = tracker(lane=(0.01, 0.02, 0.3))
    x = made.known()
    x[FIRST:] += np.linspace(0.0, 0.3, made.pair.stations)
    before = made.shape()
    place, along = before.place[0], before.along[0]
    sure = made.covariance[:FIRST, :FIRST].diagonal().copy()
    made.move(0.0, 0.0, known=False)
    after = made.shape()
    assert made.advance_m == 0.0
    assert abs(made.known()[FIRST] - x[FIRST]) > 1e-3  # below the car it is another curve
    back = along.conjugate()
    assert ((after.place[0] - place) * back).imag == pytest.approx(0.0, abs=1e-5)
    assert cmath.phase(after.along[0] * back) == pytest.approx(0.0, abs=1e-9)
    assert (made.covariance.diagonal()[[OFFSET, HEADING]] > sure[[OFFSET, HEADING]]).all()


@pytest.mark.parametrize("solver", ["gauss_newton", "gradient_descent"])
def test_perfect_sightings_lead_to_the_lane(solver: str) -> None:
    made = tracker(solver)
    truth = made.known().copy()
    truth[:FIRST] += 0.008, -0.012, 0.004, 0.0
    truth[FIRST:] += np.linspace(0.0, 0.15, made.pair.stations)
    at_first = np.abs(residuals(made, truth)[: 2 * COUNT]).max()
    see(made, truth, 3)
    left = np.abs(residuals(made, truth)[: 2 * COUNT])
    assert left.max() < 0.15 * at_first
    assert left.mean() < 0.0012
    wide = 0.5 * (truth[LANE] + truth[TAPER] * NODES)
    assert made.half_m() == pytest.approx(wide, abs=0.001)  # at the reference point it is not seen


def test_a_lane_that_narrows_keeps_both_lines_and_its_width_is_followed() -> None:
    made = tracker(lane=(0.0, 0.0, 0.0))
    truth = made.known().copy()
    truth[TAPER] = -0.1
    for _ in range(10):
        see(made, truth)
        made.move(0.02, 0.0, known=True)
        truth[LANE] += 0.02 * truth[TAPER]
    assert made.known()[TAPER] == pytest.approx(-0.1, abs=0.02)
    assert made.width_m == pytest.approx(WIDTH - 0.1 * 0.2, abs=0.003)
    assert made.half_m() == pytest.approx(0.5 * (truth[LANE] + truth[TAPER] * NODES), abs=0.01)


def test_a_line_out_of_sight_may_lie_anywhere_that_a_lane_widens_to() -> None:
    made = tracker(lane=(0.0, 0.0, 0.0))
    truth, left = made.known().copy(), np.arange(COUNT)
    at_first = 0.5 * math.sqrt(made.covariance[LANE, LANE])
    for _ in range(60):
        made.move(0.02, 0.0, known=True)
        found = np.zeros(4 * COUNT)
        found[left] = found[2 * COUNT + left] = 1.0
        made.update(made.shape(), EVERY, residuals(made, truth), found)
    near, far = made.sigma_m(made.shape())[[5, COUNT + 5]]
    assert far > 4.0 * near
    assert far > 2.0 * at_first


@pytest.mark.parametrize(("side", "wider"), [(0, 1.0), (1, -1.0)])
def test_a_lone_line_is_followed_and_says_nothing_of_the_width(side: int, wider: float) -> None:
    made = tracker(lane=(0.0, 0.0, 0.0))
    see(made, made.known().copy(), 3)
    width, taper = made.known()[[LANE, TAPER]]
    truth = made.known().copy()
    truth[OFFSET] -= 0.006  # the car has moved to the right, by which the line is off at every node
    lone = np.arange(COUNT) + side * COUNT
    found = np.zeros(4 * COUNT)
    found[lone] = found[2 * COUNT + lone] = 1.0
    for _ in range(40):
        made.move(0.02, 0.0, known=True)
        made.update(made.shape(), EVERY, residuals(made, truth), found)
    assert made.width_m == pytest.approx(width + 0.8 * taper, abs=0.003)
    assert made.known()[OFFSET] == pytest.approx(truth[OFFSET], abs=0.002)
    offset, lane = made.covariance[OFFSET, LANE], made.covariance[LANE, LANE]
    assert offset == pytest.approx(0.5 * wider * lane)  # a wider lane's middle lies farther from the line that is seen


def test_both_solvers_come_to_the_same_lane() -> None:
    ends = []
    for solver in ("gauss_newton", "gradient_descent"):
        made = tracker(solver, noise=5.0)
        truth = made.known().copy()
        truth[:LANE] += 0.008, -0.012
        see(made, truth)
        ends.append((made.shape().place.copy(), made.iterations))
    assert np.abs(ends[0][0] - ends[1][0]).max() < 1e-3
    assert ends[0][1] <= 2 < ends[1][1]


def test_a_second_look_does_not_count_the_prior_twice() -> None:
    made = tracker()
    still(made)
    truth = made.known().copy()
    truth[OFFSET] += 0.003
    see(made, truth)
    once, covariance = made.known().copy(), made.covariance.copy()
    see(made, truth)  # of the same frame: only the linearisation is newer
    assert made.known()[:FIRST] == pytest.approx(once[:FIRST], abs=1e-3)
    assert made.covariance.diagonal() == pytest.approx(covariance.diagonal(), rel=0.2)  # counted twice: half


def test_what_is_where_it_was_expected_changes_nothing_but_the_covariance() -> None:
    made = tracker()
    still(made)
    prior, expected = made.known().copy(), made.covariance.copy()
    shape = made.shape()
    rows = np.concatenate((shape.jacobian, shape.jacobian[2 * COUNT :]))
    for row, sigma in zip(rows, np.concatenate((SIGMA, SIGMA[2 * COUNT :])), strict=True):  # one after the other
        gain = expected @ row / (row @ expected @ row + sigma**2)
        expected -= np.outer(gain, row @ expected)
    carrying = made.update(shape, EVERY, np.zeros(4 * COUNT), np.ones(4 * COUNT))
    assert carrying.all()
    assert made.known() == pytest.approx(prior, abs=1e-12)
    assert made.covariance == pytest.approx(expected, rel=1e-5, abs=1e-9)
    assert made.moved_m == pytest.approx(0.0, abs=1e-12)


def test_nodes_that_were_not_found_have_no_say() -> None:
    ends = []
    for rubbish in (0.0, 3.0):
        made = tracker()
        truth = made.known().copy()
        truth[OFFSET] += 0.005
        away, found = residuals(made, truth), np.ones(4 * COUNT)
        dead = np.tile(np.isin(EVERY, (0, 4, 5, 20, 29)), 2)
        found[dead], away[dead] = 0.0, rubbish
        carrying = made.update(made.shape(), EVERY, away, found)
        assert carrying.tolist() == (~dead[: 2 * COUNT]).tolist()
        ends.append((made.known().copy(), made.covariance.copy()))
    assert ends[0][0] == pytest.approx(ends[1][0], abs=1e-12)
    assert ends[0][1] == pytest.approx(ends[1][1], abs=1e-12)


def test_only_the_nodes_that_were_looked_for_count() -> None:
    whole, part = tracker(), tracker()
    truth = whole.known().copy()
    truth[OFFSET] += 0.005
    away = residuals(whole, truth)
    nodes = np.array([2, 7, 11, 18, 25])
    found = np.tile(np.isin(EVERY, nodes).astype(float), 2)
    whole.update(whole.shape(), EVERY, away, found)
    part.update(part.shape(), nodes, np.concatenate((away[nodes], away[2 * COUNT + nodes])), np.ones(10))
    assert part.known() == pytest.approx(whole.known(), abs=1e-12)


def test_nothing_looked_for_and_nothing_found_leave_the_prediction() -> None:
    for nodes, found in ((EVERY[:0], np.ones(0)), (EVERY, np.zeros(4 * COUNT))):
        made = tracker()
        made.move(0.02, 0.01, known=True)
        before, covariance = made.known().copy(), made.covariance.copy()
        assert not made.update(made.shape(), nodes, np.full(len(found), 0.01), found).any()
        assert made.known() == pytest.approx(before)
        assert made.covariance == pytest.approx(covariance)


def test_a_ridge_that_is_far_off_is_not_believed() -> None:
    made, clean = tracker(), tracker()
    truth = made.known().copy()
    see(clean, truth, 1)
    still(made)
    see(made, truth)
    away = residuals(made, truth)
    away[[3, 9]] = 0.3
    still(made)
    carrying = made.update(made.shape(), EVERY, away, np.ones(4 * COUNT))
    assert np.flatnonzero(~carrying).tolist() == [3, 9]
    assert made.known()[:FIRST] == pytest.approx(truth[:FIRST], abs=1e-3)


def test_no_curvature_passes_that_of_the_tightest_bend() -> None:
    made = tracker()
    made.known()[FIRST:] = 50.0
    made.move(0.0, 0.0, known=True)
    made.update(made.shape(), EVERY[:0], np.ones(0), np.ones(0))
    tightest = 1.0 / (made.config.radius_lanes * WIDTH)
    assert made.known()[FIRST:] == pytest.approx(np.full(made.pair.stations, tightest))


def test_a_start_has_the_moments_of_what_is_believed_beside_the_car() -> None:
    made = tracker()
    mean = np.array((0.05, 0.1, 0.4, 0.46))
    root = np.array(((0.02, 0, 0, 0), (0.01, 0.02, 0, 0), (0.1, 0.2, 0.3, 0), (0, 0, 0, 0.01)))
    made.start(mean, root @ root.T)
    offset, heading, width, _ = made.pose()
    assert (offset, heading, made.curvature(), width) == pytest.approx(tuple(mean))
    of, believed = [OFFSET, HEADING, LANE], [0, 1, 3]
    assert made.covariance[np.ix_(of, of)] == pytest.approx((root @ root.T)[np.ix_(believed, believed)])
    assert np.linalg.eigvalsh(made.covariance).min() > 0.0


def test_the_pose_turns_the_sign_of_the_headings_covariance() -> None:
    made = tracker(lane=(0.03, -0.1, 0.6))
    offset, heading, width, covariance = made.pose()
    assert (offset, heading, width) == pytest.approx((0.03, -0.1, WIDTH))
    turn = np.diag((1.0, -1.0, 1.0))
    assert covariance == pytest.approx(turn @ made.covariance[:3, :3] @ turn)


def test_a_lane_that_was_forgotten_is_not_there() -> None:
    made = tracker()
    made.move(0.3, 0.0, known=True)
    made.forget()
    made.move(0.3, 0.0, known=True)
    assert (made.parameters, made.phase_m, made.iterations) == (None, 0.0, 0)
    with pytest.raises(ValueError, match="call start first"):
        made.shape()


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_a_lone_line_is_weighed_with_the_width_known(side: float) -> None:
    """The covariance given width and taper, by the formula of conditional normals, on a matrix that mixes all."""
    root = np.random.default_rng(2).normal(0.0, 1.0, (9, 9))
    p = root @ root.T
    known, rest = [int(Parameter.WIDTH), int(Parameter.TAPER)], [0, 1, 4, 5, 6, 7, 8]
    alone, moved = _of_known_width(p, side)
    explained = p[np.ix_(rest, known)] @ np.linalg.solve(p[np.ix_(known, known)], p[np.ix_(known, rest)])
    assert alone[np.ix_(rest, rest)] == pytest.approx(p[np.ix_(rest, rest)] - explained, rel=1e-9, abs=1e-12)
    assert alone[np.ix_(known, known)] == pytest.approx(np.diag(1e-6 * p.diagonal()[known]))
    assert not alone[np.ix_(known, rest)].any()
    # With a metre more of width the centre moves half a metre towards the other line, and the lone line stays.
    assert moved[Parameter.OFFSET].tolist() == [0.5 * side, 0.0]
    assert moved[Parameter.WIDTH].tolist() == [1.0, 0.0]
    assert moved[Parameter.HEADING].tolist() == [0.0, -0.5 * side]

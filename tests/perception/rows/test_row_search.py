"""The search about a pair's nodes, in images drawn pixel by pixel from the ground that each of them shows."""

from __future__ import annotations

import functools
import math

import numpy as np
import pytest
from numpy.typing import NDArray

from automodel.config import Extrinsics, Intrinsics
from automodel.estimation.clothoid.clothoid_pair import ClothoidPair, PairShape
from automodel.geometry import CameraModel, GroundCamera
from automodel.geometry.line_projection import LineProjection
from automodel.perception.rows.brightness import Brightness
from automodel.perception.rows.row_ridges import BLURRED
from automodel.perception.rows.row_search import NodeMeasurements, RowSearch
from automodel.types import FloatArray, Image

HEIGHT, WIDTH, MARKING, LANE, REFERENCE = 240, 400, 0.03, 0.42, 0.15
NODES = np.geomspace(0.45, 1.2, 10)
COUNT, FINE = len(NODES), 3
LENSES = {"none": (0.0, 0.0, 0.0, 0.0, 0.0), "barrel": (-0.2, 0.04, 0.002, -0.001, 0.0)}
ROADS = {"straight": 0.0, "left": 0.4, "right": -0.3}


@functools.cache
def camera(lens: str) -> GroundCamera:
    intrinsics = Intrinsics(fx_px=300.0, fy_px=300.0, cx_px=199.0, cy_px=118.0, distortion=LENSES[lens])
    return GroundCamera(CameraModel(intrinsics, WIDTH, HEIGHT), Extrinsics(z_m=0.2, pitch_rad=0.28))


@functools.cache
def ground(lens: str) -> FloatArray:
    """What each third of a pixel along its row sees: (height, 3 width, 2) [m], NaN above the horizon."""
    u, v = np.meshgrid((np.arange(FINE * WIDTH) + 0.5) / FINE - 0.5, np.arange(float(HEIGHT)))
    return camera(lens).px_to_ground(np.stack((u, v), axis=-1))


def from_the_centerline(points: FloatArray, offset: float, curvature: float) -> FloatArray:
    """How far points (..., 2) lie to the left of an arc that starts `offset` to the right of the reference point."""
    x, y = points[..., 0] - REFERENCE, points[..., 1] + offset
    if curvature == 0.0:
        return np.asarray(y)
    radius = 1.0 / curvature
    return np.asarray(radius - np.sign(curvature) * np.hypot(x, y - radius))


@functools.cache
def drawn(lens: str, road: str, lines: tuple[float, ...] = (0.5, -0.5), paint: int = 110) -> Image:
    """A grey image of markings at `lines` [lane widths] beside an arc through the reference point."""
    lateral = from_the_centerline(ground(lens), 0.0, ROADS[road])
    seen = np.zeros(lateral.shape)
    for line in lines:
        seen += np.abs(lateral - line * LANE) < 0.5 * MARKING
    shares = seen.reshape(HEIGHT, WIDTH, FINE).mean(axis=2)
    return np.rint(120.0 + paint * shares).astype(np.uint8)


HALF = np.full(COUNT, 0.5 * LANE)
SURE = np.zeros(2 * COUNT)  # the nodes' standard deviations where nothing is in doubt


def search(lens: str = "none", dark: bool = False) -> RowSearch:
    projection, brightness = LineProjection(camera(lens)), Brightness("grey", dark)
    return RowSearch(projection, brightness, 20.0, NODES, MARKING, LANE, (HEIGHT, WIDTH))


def shaped(road: str, offset: float = 0.0, heading: float = 0.0) -> PairShape:
    pair = ClothoidPair(NODES, 0.3, REFERENCE)
    return pair.shape(np.array([offset, heading, LANE, 0.0, *[ROADS[road]] * pair.stations]), 0.0)


def seen(measured: NodeMeasurements) -> NDArray[np.bool_]:
    """Which of the 2 n nodes were found."""
    all_of_them = np.zeros(2 * COUNT, bool)
    k = len(measured.nodes)
    assert measured.residual.shape == measured.found.shape == (2 * k,)
    assert np.array_equal(measured.found[:k], measured.found[k:] * measured.found[:k])
    all_of_them[measured.nodes[measured.found[:k] > 0.0]] = True
    return all_of_them


@pytest.mark.parametrize("lens", LENSES)
@pytest.mark.parametrize("road", ROADS)
@pytest.mark.parametrize("offset", [0.0, 0.02, -0.015])
def test_distances_to_the_left_are_those_on_the_ground(lens: str, road: str, offset: float) -> None:
    shape = shaped(road, offset)  # the car is said to be left of the centerline: so the lines lie left of the nodes
    measured = search(lens).look(drawn(lens, road), shape, HALF, SURE)
    k = len(measured.nodes)
    assert np.count_nonzero(seen(measured)) >= 14
    side = np.where(measured.nodes < COUNT, 0.5, -0.5) * LANE
    node = measured.nodes % COUNT
    place = shape.place[node] + 1j * side * shape.along[node]
    points = np.stack((place.real, place.imag), axis=-1)
    wanted = side - from_the_centerline(points, 0.0, ROADS[road])
    found = measured.found[:k] > 0.0
    assert measured.residual[:k][found] == pytest.approx(wanted[found], abs=0.1 * MARKING)
    assert abs(float(wanted.mean())) == pytest.approx(abs(offset), abs=0.1 * MARKING)  # the test's own geometry
    assert abs(float((measured.residual[:k] - wanted)[found].mean())) < 0.03 * MARKING


@pytest.mark.parametrize("turn", [0.12, -0.12])
def test_lines_turned_to_the_left_are_measured_so(turn: float) -> None:
    # The pair swings about its fifth node by -turn: the true lines are turned by +turn against it.
    middle = float(NODES[4])
    shape = shaped("straight", offset=middle * float(np.tan(-turn)), heading=-turn)
    measured = search().look(drawn("none", "straight"), shape, HALF, SURE)
    k = len(measured.nodes)
    found = measured.found[k:] > 0.0
    assert np.count_nonzero(found) >= 6
    assert float(np.median(measured.residual[k:][found])) == pytest.approx(turn, abs=0.05)


def test_dark_markings_are_found_where_they_are_looked_for() -> None:
    picture = drawn("none", "straight", paint=-80)
    assert np.count_nonzero(seen(search(dark=True).look(picture, shaped("straight"), HALF, SURE))) >= 14
    other = search()
    assert not seen(other.look(picture, shaped("straight"), HALF, SURE)).any()
    other.forget(dark=True)
    assert np.count_nonzero(seen(other.look(picture, shaped("straight"), HALF, SURE))) >= 14


def test_one_line_alone_is_found_and_the_other_is_not_made_up() -> None:
    for lines, left in (((0.5,), True), ((-0.5,), False)):
        found = seen(search().look(drawn("none", "straight", lines), shaped("straight"), HALF, SURE))
        assert np.count_nonzero(found[:COUNT]) >= 7 * left
        assert np.count_nonzero(found[COUNT:]) >= 7 * (not left)
        assert not (found[COUNT:] if left else found[:COUNT]).any()


def test_nothing_is_found_on_bare_ground_and_at_the_edge_of_a_shadow() -> None:
    bare = np.full((HEIGHT, WIDTH), 120, np.uint8)
    assert not seen(search().look(bare, shaped("straight"), HALF, SURE)).any()
    lateral = from_the_centerline(ground("none"), 0.0, 0.0)[:, 1::FINE]
    shadow = np.where(lateral > 0.5 * LANE, 60, 150).astype(np.uint8)  # along the left line
    assert not seen(search().look(shadow, shaped("straight"), HALF, SURE)).any()


def test_a_line_is_searched_as_far_from_its_node_as_the_node_may_be_wrong() -> None:
    away = 0.25 * LANE  # the lane is said to be wider: both lines lie further in, several markings from their nodes
    picture, shape, wider = drawn("none", "straight"), shaped("straight"), HALF + away
    assert not seen(search().look(picture, shape, wider, SURE)).any()
    measured = search().look(picture, shape, wider, SURE + 1.5 * away)
    found = np.flatnonzero(measured.found[: len(measured.nodes)])
    assert len(found) >= 10
    inwards = np.where(measured.nodes[found] < COUNT, -away, away)
    assert measured.residual[found] == pytest.approx(inwards, abs=0.1 * MARKING)


def test_no_doubt_makes_a_line_of_the_other_one() -> None:
    picture = drawn("none", "straight", (-0.5,))
    found = seen(search().look(picture, shaped("straight"), HALF, SURE + LANE)).reshape(2, COUNT)
    assert not found[0].any()
    assert found[1].any()


def test_a_gap_leaves_its_nodes_empty() -> None:
    picture = drawn("none", "straight").copy()
    x = ground("none")[:, FINE * WIDTH // 2, 0] - REFERENCE  # a straight road: a row has one arc length
    gap = (NODES[3] - 0.06, NODES[5] + 0.06)
    picture[(x > gap[0]) & (x < gap[1])] = 120
    found = seen(search().look(picture, shaped("straight"), HALF, SURE)).reshape(2, COUNT)
    assert not found[:, 3:6].any()
    assert found[:, :2].any(axis=1).all()
    assert found[:, 7:].all()


def test_a_piece_that_is_twice_as_broad_is_no_line_though_its_neighbours_are() -> None:
    points = ground("none")
    left = np.abs(from_the_centerline(points, 0.0, 0.0) - 0.5 * LANE)
    wide = np.abs(points[..., 0] - REFERENCE - NODES[5]) < 0.035
    shares = (left < np.where(wide, MARKING, 0.5 * MARKING)).reshape(HEIGHT, WIDTH, FINE).mean(axis=2)
    picture = np.rint(120.0 + 110.0 * shares).astype(np.uint8)
    found = seen(search().look(picture, shaped("straight"), HALF, SURE))
    assert found[[2, 3, 7, 8]].all()
    assert not found[5]


def test_what_crosses_the_line_is_not_the_line() -> None:
    points = ground("none")
    across = np.abs(points[..., 0] - REFERENCE - NODES[5] - 1.2 * (points[..., 1] - 0.5 * LANE)) < 0.02
    shares = across.reshape(HEIGHT, WIDTH, FINE).mean(axis=2)
    picture = np.rint(120.0 + 110.0 * shares).astype(np.uint8)
    assert not seen(search().look(picture, shaped("straight"), HALF, SURE)).any()


def test_nodes_outside_the_picture_are_not_looked_for() -> None:
    away = shaped("straight", offset=-1.2)  # the lane is far to the left of the car
    assert len(search().look(drawn("none", "straight"), away, HALF, SURE).nodes) < COUNT
    away = shaped("straight", heading=np.pi)  # behind the car
    measured = search().look(drawn("none", "straight"), away, HALF, SURE)
    assert len(measured.nodes) == 0
    assert len(measured.residual) == 0


def test_what_is_much_fainter_than_the_markings_were_is_none() -> None:
    usual, faint, shape = drawn("none", "straight"), drawn("none", "straight", paint=40), shaped("straight")
    looking = search()
    assert seen(looking.look(faint, shape, HALF, SURE)).any()  # before anything is known
    for known, other, believed in ((usual, faint, False), (faint, usual, True)):
        looking.forget()
        measured = looking.look(known, shape, HALF, SURE)
        looking.learn(measured, measured.found[: len(measured.nodes)] > 0.0)
        assert seen(looking.look(known, shape, HALF, SURE)).any()
        assert seen(looking.look(other, shape, HALF, SURE)).any() == believed
    looking.forget()
    assert seen(looking.look(usual, shape, HALF, SURE)).any()


def test_fainter_markings_are_believed_once_none_was_seen_for_a_while() -> None:
    looking, shape, faint = search(), shaped("straight"), drawn("none", "straight", paint=40)
    first = looking.look(drawn("none", "straight"), shape, HALF, SURE)
    looking.learn(first, first.found[: len(first.nodes)] > 0.0)
    empty = looking.look(faint, shaped("straight", heading=np.pi), HALF, SURE)
    assert not seen(looking.look(faint, shape, HALF, SURE)).any()
    frames = math.ceil(math.log(35.0 / (110.0 * BLURRED)) / math.log(1.0 - looking.LEARN))
    for _ in range(frames):
        looking.learn(empty, np.zeros(0, bool))
    assert seen(looking.look(faint, shape, HALF, SURE)).any()


def test_the_markings_themselves_are_believed_however_long_none_was_seen() -> None:
    looking, shape, usual = search(), shaped("straight"), drawn("none", "straight")
    first = looking.look(usual, shape, HALF, SURE)
    looking.learn(first, first.found[: len(first.nodes)] > 0.0)
    empty = looking.look(usual, shaped("straight", heading=np.pi), HALF, SURE)
    for _ in range(200):
        looking.learn(empty, np.zeros(0, bool))
    assert seen(looking.look(usual, shape, HALF, SURE)).any()


def test_no_pixel_but_those_of_two_rows_about_each_node_is_read() -> None:
    looking, shape, plain = search(), shaped("left"), drawn("none", "left")
    noise = np.random.default_rng(1).integers(0, 256, plain.shape).astype(np.uint8)
    near: NDArray[np.bool_] = np.zeros(HEIGHT, np.bool_)
    edges = [shape.place + side * LANE * 1j * shape.along for side in (0.5, -0.5)]
    along = np.concatenate([shape.along, shape.along])
    for point, tangent in zip(np.concatenate(edges), along, strict=True):
        # Every pixel belongs to a node: to rows that half a marking and two rows reach.
        ends = [point + k * MARKING * tangent for k in (0.5, -0.5)]
        high, low = camera("none").ground_to_px([(e.real, e.imag) for e in ends])[:, 1]
        near[math.floor(high - 2.0) : math.ceil(low + 2.0) + 1] = True
    assert near.sum() < 0.7 * HEIGHT
    expected = looking.look(plain, shape, HALF, SURE)
    got = looking.look(np.where(near[:, None], plain, noise), shape, HALF, SURE)
    for name in ("nodes", "residual", "found", "edge"):
        assert np.array_equal(getattr(got, name), getattr(expected, name))
    assert seen(expected).any()
    other = looking.look(np.where(near[:, None], noise, plain), shape, HALF, SURE)
    assert not np.array_equal(other.residual, expected.residual)

"""Random worlds: the same for the same seed, closed roads that touch themselves at crossings alone, ranges kept."""

from __future__ import annotations

import collections
import dataclasses
import math

import numpy as np
import pytest

from automodel.bench.centerline_paper import full_scale_car
from automodel.config import CarConfig
from automodel.sim.appearance import Appearance
from automodel.sim.random_draws import WorldRanges
from automodel.sim.random_roads import RoadRanges, random_road
from automodel.sim.random_worlds import KINDS, RandomWorld, kind_of, random_world
from automodel.sim.track_files import closing_error
from automodel.sim.truth import TruthFollower

CAR = CarConfig()
BLOCK = sum(KINDS.values())
KINDS_DRAWN = ["start", "unmarked", "plain", "circuit", "plain", "crossing"]
WORDS_DRAWN = "crossing 2 varied mirrored pitch-1.9 h1.07 w1.08 m1.76"
VALUES_DRAWN = (49.098929478338476, 2.833991160927759, 0.4870001789167942, 1.8205769965514298)


def world(seed: int, kind: str | None = None) -> RandomWorld:
    circuit = (kind or kind_of(seed)) == "circuit"
    return random_world(seed, kind, full_scale_car(CAR.pipeline) if circuit else CAR)


def flat(drawn: RandomWorld) -> list[object]:
    """Everything of a world that can be compared."""
    paint = [(p.colour, p.kind, p.polygon_m.tobytes()) for p in (*drawn.track.painted, *drawn.track.roadside)]
    boxes = [(o.polygon_m.tobytes(), o.height_m, o.grey) for o in drawn.track.obstacles]
    values = (drawn.look, drawn.car, drawn.believed, drawn.start_s_m, drawn.stop_s, drawn.nod, drawn.words)
    return [paint, boxes, *values, drawn.poses(np.arange(5) / 30.0)]


@pytest.mark.parametrize("kind", KINDS)
def test_a_seed_is_one_world(kind: str) -> None:
    assert flat(world(3, kind)) == flat(world(3, kind))
    assert flat(world(3, kind)) != flat(world(4, kind))


def test_worlds_are_the_same_on_every_machine() -> None:
    """Drawn once; a change of ranges or of what is drawn with them makes other worlds, and new figures here."""
    assert [kind_of(seed) for seed in range(6)] == KINDS_DRAWN
    drawn = world(0, "crossing")
    assert drawn.words == WORDS_DRAWN
    found = (drawn.track.road.length_m, drawn.start_s_m, drawn.speed_mps, drawn.look.read_noise)
    assert found == pytest.approx(VALUES_DRAWN, rel=1e-9)


def test_a_start_world_begins_at_rest_in_a_crossing() -> None:
    for seed in range(8):
        drawn = world(seed, "start")
        first, soon = drawn.poses([0.0, 0.5])
        assert (first.speed_mps, first.x_m) == (0.0, soon.x_m)
        places = [drawn.track.road.position(c.s_first_m) for c in drawn.track.crossings]
        near_m = min(math.hypot(first.x_m - x, first.y_m - y) for x, y in places)
        assert near_m < 1.5 * drawn.car.lane.width_m


def test_twenty_seeds_have_every_kind_in_its_share() -> None:
    assert collections.Counter(map(kind_of, range(40, 40 + BLOCK))) == KINDS
    assert [kind_of(seed) for seed in range(BLOCK)] != [kind_of(seed) for seed in range(BLOCK, 2 * BLOCK)]


@pytest.mark.parametrize("loops", [0, 1, 3])
def test_roads_are_closed_and_cross_themselves_as_often_as_asked(loops: int) -> None:
    for seed in range(6):
        road = random_road(np.random.default_rng(seed), 0.4, 2, loops, RoadRanges())
        gap_m, turn_rad = closing_error(road.line)
        assert gap_m < 1e-6
        assert turn_rad < 1e-9
        assert len(road.crossings) == loops
        s = np.linspace(0.0, road.line.length_m, 600, endpoint=False)
        assert 1.0 / np.abs(road.line.curvature(s)).max() >= 0.4 * RoadRanges().radius[0] - 1e-9
        near = np.ones(len(s), np.bool_)  # passes keep apart away from the crossings
        for crossing in road.crossings:
            for place in (crossing.s_first_m, crossing.s_second_m):
                near &= np.abs((s - place + 0.5 * road.line.length_m) % road.line.length_m
                               - 0.5 * road.line.length_m) > 4.0 * 0.4  # fmt: skip
        points = road.line.position(s)
        away = np.hypot(*(points[near][:, None] - points[None]).transpose(2, 0, 1))
        along = np.abs(s[near][:, None] - s[None])
        along = np.minimum(along, road.line.length_m - along)
        assert away[along > 7.0 * 0.4].min() > 2.0 * 0.4


def check(drawn: RandomWorld) -> None:
    ranges, lane_m = WorldRanges(), drawn.car.lane.width_m
    assert drawn.track.closed
    assert (len(drawn.track.crossings) > 0) == (drawn.kind in ("crossing", "start"))
    assert drawn.marked == bool(drawn.track.painted)
    assert 0.01 - 1e-9 <= drawn.car.lane.marking_width_m / lane_m <= 0.08 + 1e-9
    widths = drawn.lane.width_m(np.linspace(0.0, drawn.lane.centerline.length_m, 300))
    change = ranges.width_change[1] if drawn.kind in ("widths", "circuit") else 0.0
    assert np.abs(widths / lane_m - 1.0).max() <= change + 1e-9
    told, true = drawn.believed.camera.extrinsics, drawn.car.camera.extrinsics
    assert abs(told.pitch_rad - true.pitch_rad) <= math.radians(2.0) + 1e-12
    assert 0.9 - 1e-12 <= told.z_m / true.z_m <= 1.1 + 1e-12
    assert 0.85 - 1e-12 <= drawn.believed.lane.width_m / lane_m <= 1.15 + 1e-12
    assert 0.5 - 1e-12 <= drawn.believed.lane.marking_width_m / drawn.car.lane.marking_width_m <= 2.0 + 1e-12
    assert drawn.look.read_noise <= 20.0
    assert abs(drawn.look.marking_grey - drawn.look.floor_grey) * (1.0 - 0.5 * drawn.look.dirt) >= 18.0 - 1e-9


@pytest.mark.parametrize("kind", KINDS)
def test_every_kind_can_be_drawn(kind: str) -> None:
    for seed in range(8):
        check(world(seed, kind))


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_every_kind_can_be_drawn_again_and_again(kind: str) -> None:
    for seed in range(8, 28):
        check(world(seed, kind))


@pytest.mark.parametrize(("seed", "kind"), [(0, "plain"), (1, "crossing"), (2, "widths"), (3, "circuit")])
def test_the_car_drives_along_its_lane(seed: int, kind: str) -> None:
    drawn = world(seed, kind)
    follower = TruthFollower(drawn.lane, drawn.car.vehicle.reference_x_m)
    for pose in drawn.poses(np.arange(0.0, 8.0, 0.1)):
        truth = follower.step(pose.x_m, pose.y_m, pose.yaw_rad)
        assert abs(truth.offset_m) < 0.5 * truth.width_m
        assert abs(truth.heading_rad) < 0.9


def test_mirrored_worlds_are_left_hand_traffic() -> None:
    drawn = next(w for w in (world(seed, "crossing") for seed in range(20)) if w.mirrored and w.track.lanes())
    other = drawn.lane.centerline.position(1.0)
    s_m, _ = drawn.track.road.project(other)
    ahead, road = float(drawn.lane.centerline.heading(1.0)), float(drawn.track.road.heading(s_m))
    assert math.cos(ahead - road) < -0.9  # against the direction of the forward lane


def test_speeds_are_those_of_the_positions_also_around_a_stop() -> None:
    drawn = dataclasses.replace(world(0, "plain"), stop_s=(2.0, 3.5))
    t = np.arange(0.0, 6.0, 0.01)
    poses = drawn.poses(t)
    places = np.array([(p.x_m, p.y_m) for p in poses])
    speed = np.hypot(*np.diff(places, axis=0).T) / 0.01
    said = np.array([p.speed_mps for p in poses])
    assert speed == pytest.approx(0.5 * (said[1:] + said[:-1]), abs=0.02 * drawn.speed_mps)
    assert speed[(t[1:] > 2.02) & (t[1:] < 3.48)].max() < 1e-9
    from_rest = dataclasses.replace(drawn, stop_s=(0.0, 1.0)).poses([0.0, 0.9, 3.0])
    assert (from_rest[0].x_m, from_rest[0].speed_mps) == (from_rest[1].x_m, 0.0)
    assert from_rest[2].speed_mps == drawn.speed_mps


def test_an_unmarked_world_has_line_like_things() -> None:
    drawn = world(2, "unmarked")
    assert not drawn.track.painted
    colours = {paint.colour for paint in drawn.track.roadside}
    assert "asphalt" in colours
    assert colours & {"stone", "pale"}


def test_a_kind_that_does_not_exist() -> None:
    with pytest.raises(ValueError, match="expected one of plain, crossing"):
        random_world(0, "moon", CAR)


@pytest.mark.parametrize("style", ["hazy", "taped", "faint", "noisy", "reflections"])
def test_new_styles_can_be_drawn(style: str) -> None:
    drawn = [Appearance.random(seed, style=style) for seed in range(20)]
    assert len({look.floor_grey for look in drawn}) == 20
    assert all((look.marking_grey < look.floor_grey) == (style == "taped") for look in drawn)

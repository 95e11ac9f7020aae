"""What `contour` reads and holds: single pixels, no memory that grows with the image, one channel, single floats."""

from __future__ import annotations

import tracemalloc
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from automodel.config import CarConfig, LaneConfig, VehicleConfig
from automodel.perception.line_scan import SightedLine
from automodel.perception.markings.reflections import Reflections
from automodel.perception.rows import brightness, row_search
from automodel.perception.rows.brightness import read_pixels
from automodel.perception.rows.row_ridges import GATE, REACH
from automodel.perception.rows.row_search import measure_nodes
from automodel.pipelines.contour import Contour
from automodel.signals import Frame, LaneEstimate, LaneStatus, Motion
from automodel.sim.track_files import load_track
from automodel.types import Image
from tests.support.masked_drives import arc, gap, line, road
from tests.support.rendered_drives import CAR, RenderedDrive, Seen, camera, with_camera

WINDING = road(line(1.0), arc(1.0, 1.2), arc(1.0, -2.4), line(3.0))
BROKEN = road(line(12.0), gap(1.5, 5.0, "left", "right"))
HIGHWAY_CAR = replace(
    with_camera(camera(focal_px=500.0, x_m=1.5, z_m=1.2, pitch_rad=0.12)),
    lane=LaneConfig(width_m=3.7, marking_width_m=0.15),
    vehicle=VehicleConfig(wheelbase_m=2.7, reference_x_m=1.3, width_m=1.8),
)
TRACKING_SHARE = 0.04
LOOKS = 4  # at the whole view when a lane has begun: whether other lines may be its own
MEASURING_SHARE = 2.0 * TRACKING_SHARE  # where the markings' width is measured
EVERYTHING = 1.0  # the whole view is searched for lines: without a lane, and in doubt of it
GREY = np.array([0.114, 0.587, 0.299])  # of blue, green, red: ITU-R BT.601


class WatchedPixels:
    """Stands in for the two compiled functions that read an image: remembers which of its pixels they are told to read.

    All others are noise for `measure_nodes`, which is told places on the road: it reads no pixel that is not noted.
    """

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.read: set[int] = set()
        self._random = np.random.default_rng(5)
        monkeypatch.setattr(row_search, "measure_nodes", self._measure_nodes)
        monkeypatch.setattr(brightness, "read_pixels", self._read_pixels)
        search, streak = Contour._lines_in_view, Reflections._streak

        def search_everything(contour: Contour, image: Image) -> tuple[SightedLine, ...]:
            self.read.update(range(image.shape[0] * image.shape[1]))
            return search(contour, image)

        monkeypatch.setattr(Contour, "_lines_in_view", search_everything)

        def watched_streak(reflections: Reflections, image: Any, points: Any, paint: float) -> bool:
            image = Noting(image, self)
            return streak(reflections, image, points, paint)

        monkeypatch.setattr(Reflections, "_streak", watched_streak)

    def _measure_nodes(self, view: Any, pixels: Any, place: Any, along: Any, half_m: Any, runs: Any, *rest: Any) -> Any:
        image, channel, negated = pixels
        wider = runs.wider[np.searchsorted(runs.wider, rest[0].max())]
        reach, size = REACH + (wider - 1) * GATE, (runs.height_px, runs.width_px)
        lengths = runs.half_m, runs.sample_m
        at = np.clip(row_search.lay_nodes(view, place, along, half_m, lengths, int(reach), size)[1], 0, len(image) - 1)
        noise = self._random.integers(0, 256, image.shape).astype(np.uint8)
        noise[at] = image[at]
        noise.flags.writeable = False
        self.read.update(np.unique(at).tolist())
        return measure_nodes(view, (noise, channel, negated), place, along, half_m, runs, *rest)

    def _read_pixels(self, image: Any, channel: int, negated: bool, pixels: Any) -> Any:
        self.read.update(np.unique(np.clip(pixels, 0, len(image) - 1)).tolist())
        return read_pixels(image, channel, negated, pixels)


class Noting:
    """An image of which single pixels alone can be read; they are noted."""

    def __init__(self, image: Any, pixels: WatchedPixels) -> None:
        self._image, self._pixels, self.shape = image, pixels, image.shape

    def __getitem__(self, places: tuple[np.ndarray, np.ndarray]) -> Any:
        self._pixels.read.update(np.unique(places[0] * self.shape[1] + places[1]).tolist())
        return self._image[places]


class Watched:
    """`contour` on watched images: `shares` of their pixels that each step read, and whether it found a lane then."""

    name = "contour"

    def __init__(self, car: CarConfig, pixels: WatchedPixels) -> None:
        self.watched, self._pixels = Contour(car), pixels
        self.shares: list[float] = []

    def step(self, frame: Frame, motion: Motion) -> LaneEstimate:
        self._pixels.read.clear()
        estimate = self.watched.step(frame, motion)
        self.shares.append(len(self._pixels.read) / (frame.image.shape[0] * frame.image.shape[1]))
        return estimate

    def reset(self) -> None:
        self.watched.reset()


@pytest.fixture
def watched_pixels(monkeypatch: pytest.MonkeyPatch) -> WatchedPixels:
    return WatchedPixels(monkeypatch)


def watch(
    pixels: WatchedPixels, car: CarConfig = CAR, track=WINDING, to_m: float = 3.0, **options: Any
) -> tuple[list[Seen], list[float]]:
    pipeline = Watched(car, pixels)
    seen = RenderedDrive(track=track, car=car, pipeline=pipeline, **options).run(0.3, to_m)
    return seen, pipeline.shares


def check_shares(shares: Sequence[float], searching: float, most: float = TRACKING_SHARE) -> None:
    """Few pixels are read but where the whole view is searched, which is in at most this share of the frames."""
    assert shares[0] == EVERYTHING
    following = [share for share in shares if share < EVERYTHING]
    assert min(following) > 0.0
    assert max(following) < most
    assert len(following) >= (1.0 - searching) * len(shares)


def test_what_is_read_is_noted(watched_pixels: WatchedPixels) -> None:
    picture = np.arange(24, dtype=np.uint8).reshape(2, 4, 3)
    assert brightness.Brightness("green", False).read(picture, np.array([[7, 9], [2, -3]])).tolist() == [
        [22, 22],
        [7, 1],
    ]
    assert watched_pixels.read == {7, 2, 0}
    still = Motion(t_ns=0, speed_mps=0.0, yaw_rate_radps=0.0)
    watched = Watched(CAR, watched_pixels)
    watched.step(Frame(t_ns=0, index=0, image=np.zeros((360, 640), np.uint8)), still)
    assert watched.shares == [EVERYTHING]


@pytest.mark.parametrize("colour", [False, True])
def test_few_pixels_are_read(watched_pixels: WatchedPixels, monkeypatch: pytest.MonkeyPatch, colour: bool) -> None:
    car = with_camera(camera(colour=colour))
    seen, shares = watch(watched_pixels, car)
    assert seen[0].frame.image.shape[:2] == (360, 640)
    assert seen[0].frame.image.ndim == (3 if colour else 2)
    assert all(s.estimate.valid for s in seen)
    check_shares(shares, 0.5)  # the road bends to the other side at once: it is in doubt until one story is left
    monkeypatch.undo()
    plain = RenderedDrive(track=WINDING, car=car, pipeline=Contour(car)).run(0.3, 1.0)
    for one, other in zip(plain, seen, strict=False):  # nothing but the watching differs
        assert one.estimate.pose is not None
        assert other.estimate.pose is not None
        assert one.estimate.pose.offset_m == other.estimate.pose.offset_m


def test_few_pixels_are_read_in_the_dark_and_at_the_next_start(watched_pixels: WatchedPixels) -> None:
    """Coasting, lost, and found again: following reads as little as before."""
    seen, shares = watch(watched_pixels, track=BROKEN, to_m=6.0)
    statuses = [s.estimate.status for s in seen]
    assert {LaneStatus.TRACKING, LaneStatus.COASTING, LaneStatus.LOST} <= set(statuses)
    assert statuses[-1] is LaneStatus.TRACKING
    settled = [shares[k] for k in range(4, len(seen)) if all(s is LaneStatus.TRACKING for s in statuses[k - 4 : k + 1])]
    assert len(settled) > 60
    assert max(share for share in settled if share < EVERYTHING) < TRACKING_SHARE
    assert sum(share == EVERYTHING for share in settled) <= 2 * LOOKS


@pytest.mark.parametrize("radius_lanes", [1.4, 50.0])
def test_few_pixels_are_read_on_a_highway(watched_pixels: WatchedPixels, radius_lanes: float) -> None:
    contour = replace(HIGHWAY_CAR.pipeline.contour, radius_lanes=radius_lanes)
    car = replace(HIGHWAY_CAR, pipeline=replace(HIGHWAY_CAR.pipeline, contour=contour))
    seen, shares = watch(watched_pixels, car, road(line(90.0), width_m=3.7, marking_m=0.15), 40.0, speed_mps=25.0)
    assert all(s.estimate.status is LaneStatus.TRACKING for s in seen)
    check_shares(shares, (1.0 + LOOKS) / len(shares), MEASURING_SHARE)
    assert np.quantile(shares[1:], 0.8) < TRACKING_SHARE


def test_on_the_contest_floor_few_pixels_are_read(watched_pixels: WatchedPixels) -> None:
    seen, shares = watch(watched_pixels, track=load_track("tmr"), to_m=4.0)
    check_shares(shares, 0.35)  # where one line is in view, every quarter of a lane width of way
    valid = [s.estimate.valid for s in seen]
    followed = [shares[k] for k in range(4, len(seen)) if all(valid[k - 4 : k + 1])]
    assert len(followed) > 40
    assert np.median(followed) < TRACKING_SHARE


def peaks(car: CarConfig, seen: Sequence[Seen]) -> list[int]:
    """Most memory [bytes] that each step takes on top of what was held before it."""
    pipeline, most = Contour(car), []
    tracemalloc.start()
    try:
        for one in seen:
            tracemalloc.reset_peak()
            before = tracemalloc.get_traced_memory()[0]
            pipeline.step(one.frame, one.motion)
            most.append(tracemalloc.get_traced_memory()[1] - before)
    finally:
        tracemalloc.stop()
    return most


def test_no_memory_grows_with_the_picture() -> None:
    at = {}
    for width, height in ((640, 360), (1920, 1080)):
        car = with_camera(camera(width, height, 0.75 * width))
        seen = RenderedDrive(track=WINDING, car=car, pipeline=Contour(car)).run(0.3, 0.8)
        assert all(s.estimate.valid for s in seen)
        at[width] = peaks(car, seen)
    small, large = at[640], at[1920]
    assert max(large[2:]) < 300_000  # an image of 1920x1080 has 2 MB; the lane is found in the first
    assert max(large[2:]) < 1.1 * max(small[2:]) + 2_000
    assert large[0] < 1.2 * small[0] + 20_000


def test_the_tracker_holds_little() -> None:
    pipeline = Contour(CAR)
    RenderedDrive(track=WINDING, pipeline=pipeline).run(0.3, 1.0)
    held, fresh = vars(pipeline._tracker), vars(Contour(CAR)._tracker)
    bases: dict[int, int] = {}
    numbers = 0
    for name, value in held.items():
        for k, part in enumerate(value if isinstance(value, tuple) else (value,)):
            before = fresh[name][k] if isinstance(value, tuple) else fresh[name]
            if isinstance(part, np.ndarray) and not np.array_equal(part, before):
                memory = part.base if isinstance(part.base, np.ndarray) else part
                bases[id(memory)] = memory.nbytes
            elif isinstance(part, (float, int)):
                numbers += 1
    state = sum(bases.values()) + 8 * numbers
    parameters, covariance = held["parameters"], held["covariance"]
    assert parameters.nbytes + covariance.nbytes <= state < 4096


def poses(seen: Sequence[LaneEstimate]) -> np.ndarray:
    assert all(e.pose is not None for e in seen)
    return np.array([(e.pose.offset_m, e.pose.width_m, e.pose.heading_rad) for e in seen if e.pose])


def replay(car: CarConfig, seen: Sequence[Seen]) -> list[LaneEstimate]:
    pipeline = Contour(car)
    return [pipeline.step(s.frame, s.motion) for s in seen]


def optioned(car: CarConfig, **options: Any) -> CarConfig:
    return replace(car, pipeline=replace(car.pipeline, contour=replace(car.pipeline.contour, **options)))


@pytest.mark.slow  # compiles everything once more
@pytest.mark.parametrize("name", ["scale", "highway"])
def test_single_floats_give_the_same_lane(name: str) -> None:
    if name == "scale":
        car, bound_m = CAR, 0.002
        seen = RenderedDrive(track=WINDING, car=car, pipeline=Contour(car)).run(0.3, 3.5)
    else:
        car, bound_m = optioned(HIGHWAY_CAR, radius_lanes=50.0), 0.005
        track = road(line(60.0), arc(250.0, 0.8), width_m=3.7, marking_m=0.15)
        seen = RenderedDrive(track=track, car=car, pipeline=Contour(car), speed_mps=25.0).run(5.0, 90.0)
    double, single = replay(car, seen), replay(optioned(car, precision="single"), seen)
    differ = [one.status is not two.status for one, two in zip(double, single, strict=True)]
    assert sum(differ) <= 1  # a line that comes into view or leaves it does so a frame earlier in one of them
    apart = np.abs(poses(double) - poses(single))[8:]  # at the start one of them may look once more than the other
    places = apart[:, :2].max(axis=1)
    assert np.mean(places < bound_m) >= 0.9
    assert places.max() < 3.0 * bound_m  # a line that one of them lost earlier may be found by another look
    assert np.quantile(apart[:, 2], 0.9) < 0.005
    assert apart.max() > 0.0  # they are two ways of computing
    for one, other in zip(double[8::7], single[8::7], strict=True):
        assert one.centerline is not None
        assert other.centerline is not None
        length = min(one.centerline.length_m, other.centerline.length_m)
        s = np.linspace(0.0, 0.8 * length, 15)
        away = np.abs(one.centerline.position(s) - other.centerline.position(s))
        assert away.max() < 8.0 * bound_m  # at the far end, where one of them may take a node more


def test_colour_read_as_grey_is_grey() -> None:
    car = with_camera(camera(colour=True))
    seen = RenderedDrive(track=WINDING, car=car, pipeline=Contour(car)).run(0.3, 1.5)
    tint = np.array([0.6, 1.0, 0.8])
    coloured = [(s.frame.image * tint).astype(np.uint8) for s in seen]
    assert (coloured[0][..., 0] != coloured[0][..., 1]).any()
    grey = [np.rint(image @ GREY).astype(np.uint8) for image in coloured]
    reported = []
    for pictures in (coloured, grey):
        pipeline = Contour(optioned(CAR, colour="grey"))
        frames = [replace(s.frame, image=image) for s, image in zip(seen, pictures, strict=True)]
        reported.append([pipeline.step(frame, s.motion) for frame, s in zip(frames, seen, strict=True)])
    np.testing.assert_allclose(poses(reported[0]), poses(reported[1]), rtol=0.0, atol=1e-9)


@pytest.mark.parametrize(("colour", "channel"), [("blue", 0), ("green", 1), ("red", 2)])
def test_one_channel_is_read(colour: str, channel: int) -> None:
    seen = RenderedDrive(track=WINDING, pipeline=Contour(CAR)).run(0.3, 0.9)
    pipeline = Contour(optioned(CAR, colour=colour))
    for one in seen:
        image = np.full((*one.frame.image.shape, 3), 128, np.uint8)
        image[..., channel] = one.frame.image
        reported = pipeline.step(replace(one.frame, image=image), one.motion)
        assert one.estimate.pose is not None
        assert reported.pose is not None
        assert reported.pose.offset_m == one.estimate.pose.offset_m

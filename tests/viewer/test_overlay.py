from __future__ import annotations

import dataclasses
import math
from pathlib import Path

import cv2
import numpy as np
import pytest

from automodel.config import CameraConfig, ConfigError, Extrinsics, Intrinsics
from automodel.curves import arc, line
from automodel.geometry import GroundCamera
from automodel.signals import Command, Crossing, LaneEstimate, LaneLine, LanePose, LaneStatus
from automodel.viewer import overlay, video
from automodel.viewer.overlay import crossing_ends, draw, scale_of, status_lines
from automodel.viewer.video import VideoWriter, film_writer

CAMERA = CameraConfig()
GROUND = GroundCamera.from_config(CAMERA)
BLACK = np.zeros((360, 640), np.uint8)


def lane_line(y_m: float, seen: bool = True) -> LaneLine:
    points = [(0.6, y_m), (0.9, y_m)] if seen else np.empty((0, 2))
    return LaneLine(curve=line(0.4, y_m, 0.0, 1.5), points_m=np.array(points), seen=seen)


def estimate(**changes: object) -> LaneEstimate:
    pose = LanePose(offset_m=0.012, heading_rad=-0.1, width_m=0.4, curvature_per_m=0.7, covariance=np.eye(3))
    base = LaneEstimate(
        t_ns=0,
        status=LaneStatus.TRACKING,
        left=lane_line(0.2),
        right=lane_line(-0.2),
        centerline=line(0.0, 0.0, 0.0, 1.9),
        pose=pose,
    )
    return dataclasses.replace(base, **changes)  # type: ignore[arg-type]


def test_an_estimate_is_drawn_by_the_camera_that_it_was_measured_by() -> None:
    pitched = draw(BLACK, estimate(camera_pitch_rad=0.02), GROUND)
    assert np.array_equal(pitched, draw(BLACK, estimate(), GROUND.pitched(0.02)))
    assert not np.array_equal(pitched, draw(BLACK, estimate(), GROUND))


def pixel_of(x_m: float, y_m: float) -> tuple[int, int]:
    """Row and column by hand: a pinhole at height z, pitched down, on the x axis of the body."""
    e, k = CAMERA.extrinsics, CAMERA.intrinsics
    ahead, cos, sin = x_m - e.x_m, math.cos(e.pitch_rad), math.sin(e.pitch_rad)
    depth = ahead * cos + e.z_m * sin
    down = e.z_m * cos - ahead * sin
    return round(k.cy_px + k.fy_px * down / depth), round(k.cx_px - k.fx_px * y_m / depth)


def colour_at(picture: np.ndarray, x_m: float, y_m: float) -> tuple[int, ...]:
    row, column = pixel_of(x_m, y_m)
    return tuple(int(v) for v in picture[row, column])


def tinted(grey: int) -> tuple[int, ...]:
    """The colour of a grey ground in the lane."""
    return tuple(round(grey + 0.15 * (channel - grey)) for channel in overlay.BLUE)


def test_lines_are_blue_and_the_centerline_orange_where_they_lie() -> None:
    picture = draw(BLACK, estimate(), GROUND)
    for x_m in (0.5, 0.75, 1.2, 1.7):
        assert colour_at(picture, x_m, 0.2) == overlay.BLUE
        assert colour_at(picture, x_m, -0.2) == overlay.BLUE
        assert colour_at(picture, x_m, 0.0) == overlay.ORANGE
        assert colour_at(picture, x_m, 0.1) == tinted(0)  # the lane between its lines
    assert colour_at(picture, 1.2, 0.3) == (0, 0, 0)


def test_the_steered_path_is_the_circle_of_the_rear_axle() -> None:
    command = Command(t_ns=0, steering_rad=0.2, speed_mps=1.0, valid_until_ns=0)
    radius_m = 0.26 / math.tan(0.2)
    white = draw(BLACK, estimate(), GROUND, command, wheelbase_m=0.26)
    for s_m in (0.6, 0.8, 1.0):
        x_m, y_m = radius_m * math.sin(s_m / radius_m), radius_m * (1.0 - math.cos(s_m / radius_m))
        assert colour_at(white, x_m, y_m) == overlay.WHITE
    assert colour_at(draw(BLACK, estimate(), GROUND, command), x_m, y_m) != overlay.WHITE


def test_the_inset_shows_the_lane_from_above() -> None:
    inset = draw(BLACK, estimate(), GROUND)[8:130, 510:632]
    height, width = inset.shape[:2]
    lane_px = height / 3.0  # three lane widths ahead
    row = height - 1 - round(0.75 / 0.4 * lane_px)  # between two points
    for side in (-0.5, 0.5):
        column = round(0.5 * width + side * lane_px)
        assert (inset[row, column - 1 : column + 2] == overlay.BLUE).all(axis=1).any()
    assert tuple(inset[row, width // 2]) == overlay.ORANGE
    lost = draw(BLACK, LaneEstimate(t_ns=0, status=LaneStatus.LOST), GROUND)
    assert not lost[:360].any()


def test_measured_points_are_marked() -> None:
    picture = draw(BLACK, estimate(), GROUND)
    assert colour_at(picture, 0.6, 0.2) == overlay.YELLOW
    assert colour_at(picture, 0.9, -0.2) == overlay.YELLOW


def test_a_line_that_is_not_seen_is_dashed() -> None:
    def blue(picture: np.ndarray) -> int:
        return int((picture[:360, 330:] == overlay.BLUE).all(axis=2).sum())

    whole = blue(draw(BLACK, estimate(right=dataclasses.replace(lane_line(-0.2), points_m=np.empty((0, 2)))), GROUND))
    dashed = blue(draw(BLACK, estimate(right=lane_line(-0.2, seen=False)), GROUND))
    assert 0.25 * whole < dashed < 0.75 * whole


def test_the_crossing_lies_across_the_lane_at_its_distance() -> None:
    crossing = Crossing(distance_m=0.6, angle_rad=math.pi / 2)
    picture = draw(BLACK, estimate(crossing=crossing), GROUND, reference_x_m=0.13)
    for y_m in (-0.1, 0.1):
        assert colour_at(picture, 0.73, y_m) == overlay.PURPLE
    assert colour_at(picture, 0.73, 0.25) == (0, 0, 0)


def test_a_crossing_is_found_along_the_bend() -> None:
    curve = arc(0.0, 0.0, 0.0, 1.0, 1.5)  # a circle of 1 m around (0, 1)
    crossing = Crossing(distance_m=0.5, angle_rad=1.3)
    ends = crossing_ends(crossing, curve, 0.0, 0.4)
    middle = 0.5 * (ends[0] + ends[1])
    np.testing.assert_allclose(middle, (math.sin(0.5), 1.0 - math.cos(0.5)), atol=1e-9)
    along = ends[1] - ends[0]
    assert np.hypot(*along) == pytest.approx(0.4)
    assert math.atan2(along[1], along[0]) == pytest.approx(1.3)


def test_a_crossing_without_a_centerline_is_straight_ahead() -> None:
    ends = crossing_ends(Crossing(distance_m=0.5, angle_rad=math.pi / 2), None, 0.1, 0.4)
    np.testing.assert_allclose(ends, ((0.6, -0.2), (0.6, 0.2)), atol=1e-12)


def test_the_picture_itself_is_kept_and_not_written_to() -> None:
    noise = np.random.default_rng(0).integers(0, 256, (360, 640, 3), np.uint8)
    before = noise.copy()
    lost = draw(noise, LaneEstimate(t_ns=0, status=LaneStatus.LOST), GROUND)
    np.testing.assert_array_equal(lost[:360], before)
    draw(noise, estimate(), GROUND)
    np.testing.assert_array_equal(noise, before)


def test_the_status_is_legible_in_its_colour_below_the_picture() -> None:
    for status, colour in overlay.STATUS_COLOURS.items():
        lost = status is LaneStatus.LOST
        value = LaneEstimate(t_ns=0, status=status) if lost else estimate(status=status)
        strip = draw(BLACK, value, GROUND)[360:]
        assert 20 < len(strip) < 120
        assert (strip == colour).all(axis=2).any()
        assert not (strip[:, -4:].max() > 24)  # the text ends inside


def test_the_numbers_are_those_of_the_estimate() -> None:
    command = Command(t_ns=0, steering_rad=0.2, speed_mps=1.5, valid_until_ns=0)
    crossing = Crossing(distance_m=0.81, angle_rad=math.pi / 2)
    first, second = status_lines(estimate(crossing=crossing), command, "frame 12")
    assert first == "TRACKING  offset   +1.2 cm  heading  -5.7 deg  width  40.0 cm  curv +0.70 /m"
    assert second == "crossing 0.81 m at 90 deg  steer +11.5 deg 1.50 m/s  frame 12"
    assert status_lines(None, None, "") == ("no estimate", "crossing -  steer -")
    assert status_lines(LaneEstimate(t_ns=0, status=LaneStatus.LOST), None, "")[0] == "LOST"


def bounded(offset_bound_m: float, heading_bound_rad: float = math.inf) -> LaneEstimate:
    value = estimate()
    assert value.pose is not None
    pose = dataclasses.replace(value.pose, offset_bound_m=offset_bound_m, heading_bound_rad=heading_bound_rad)
    return dataclasses.replace(value, pose=pose)


def test_bounds_stand_behind_their_values_where_they_are_stated() -> None:
    assert status_lines(bounded(0.034, 0.02), None, "")[0].startswith(
        "TRACKING  offset   +1.2 +-3.4 cm  heading  -5.7 +-1.1 deg  width"
    )
    assert status_lines(bounded(0.034), None, "")[0].startswith("TRACKING  offset   +1.2 +-3.4 cm  heading  -5.7 deg")


def test_a_band_about_the_centerline_is_as_wide_as_the_offset_may_be_wrong() -> None:
    grey = np.full((360, 640), 100, np.uint8)
    picture = draw(grey, bounded(0.1), GROUND)
    for x_m in (0.5, 0.75, 1.2, 1.7):
        for y_m in (-0.09, -0.05, 0.05, 0.09):
            blue, green, red = colour_at(picture, x_m, y_m)
            assert blue < 100 < green < red < 200  # orange, and the picture is seen through it
        assert colour_at(picture, x_m, 0.11) == colour_at(picture, x_m, -0.11) == tinted(100)
    assert colour_at(picture, 0.75, 0.0) == overlay.ORANGE  # the centerline lies upon it


def test_there_is_no_band_without_a_bound_and_none_wider_than_the_lane_on_both_sides() -> None:
    grey = np.full((360, 640), 100, np.uint8)
    assert colour_at(draw(grey, estimate(), GROUND), 1.2, 0.02) == tinted(100)
    wide = draw(grey, bounded(50.0), GROUND)
    assert colour_at(wide, 1.2, 0.38) not in (tinted(100), (100, 100, 100))
    assert colour_at(wide, 1.2, 0.42) == (100, 100, 100)


@pytest.mark.parametrize(("width", "scale"), [(80, 8), (160, 4), (320, 2), (480, 1), (640, 1), (1920, 1)])
def test_small_pictures_are_enlarged(width: int, scale: int) -> None:
    assert scale_of(width) == scale


def test_a_small_picture_has_its_overlay_at_the_right_place() -> None:
    small = CameraConfig(
        width_px=160,
        height_px=120,
        intrinsics=Intrinsics(fx_px=120.0, fy_px=120.0, cx_px=79.5, cy_px=59.5),
        extrinsics=Extrinsics(pitch_rad=0.0),
    )
    picture = draw(np.zeros((120, 160), np.uint8), estimate(), GroundCamera.from_config(small))
    assert picture.shape[1] == 640
    assert picture.shape[0] > 480
    # a pixel centre u of the small picture is at 4 u + 1.5 of the large one
    v, u = 59.5 + 120.0 * 0.18 / 0.8, 79.5 - 120.0 * 0.2 / 0.8
    assert tuple(picture[round(4 * v + 1.5), round(4 * u + 1.5)]) == overlay.BLUE


def test_curves_behind_the_camera_and_far_outside_do_no_harm() -> None:
    behind = line(-3.0, 0.2, 0.0, 3.0)
    around = arc(0.0, 0.0, 0.0, 3.0, 30.0)
    points = np.array([(-1.0, 0.0), (0.2001, 5.0), (0.5, 0.0)])
    left = LaneLine(curve=behind, points_m=points, seen=True)
    right = LaneLine(curve=around, points_m=points, seen=True)
    picture = draw(BLACK, estimate(left=left, right=right, crossing=Crossing(distance_m=-2.0, angle_rad=0.0)), GROUND)
    assert picture.dtype == np.uint8


def test_sizes_are_even() -> None:
    odd = CameraConfig(width_px=641, height_px=361)
    picture = draw(np.zeros((361, 641), np.uint8), None, GroundCamera.from_config(odd))
    assert picture.shape[0] % 2 == picture.shape[1] % 2 == 0


# --- video ------------------------------------------------------------------------------------------------------------


@pytest.fixture(params=["ffmpeg", "opencv"])
def encoder(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> str:
    """What writes a video: the program ffmpeg, or OpenCV, which has to where there is none."""
    if request.param == "opencv":
        monkeypatch.setattr(video, "ffmpeg_with_h264", lambda: "")
    elif not video.ffmpeg_with_h264():
        pytest.skip("there is no ffmpeg that writes H.264")
    return str(request.param)


def test_a_video_is_written_at_its_rate(encoder: str, tmp_path: Path) -> None:
    path = tmp_path / "v.mp4"
    with VideoWriter(path, 20.0) as film:
        for level in range(0, 200, 20):
            film.write(np.full((48, 64, 3), level, np.uint8))
        film.write(np.full((48, 64), 200, np.uint8))
    capture = cv2.VideoCapture(str(path))
    assert capture.get(cv2.CAP_PROP_FPS) == pytest.approx(20.0)
    h264 = int(capture.get(cv2.CAP_PROP_FOURCC)) == cv2.VideoWriter.fourcc(*"h264")
    assert h264 == (encoder == "ffmpeg" or video.opencv_writes_h264())
    levels = []
    while True:
        there, image = capture.read()
        if not there:
            break
        levels.append(float(image.mean()))
    capture.release()
    np.testing.assert_allclose(levels, range(0, 201, 20), atol=4)


def test_an_animated_picture_is_a_webp_of_some_frames_a_second(tmp_path: Path) -> None:
    path = tmp_path / "v.webp"
    with film_writer(path, 25.0) as film:
        for level in range(0, 200, 10):
            film.write(np.full((96, 960), level, np.uint8))
    there, animation = cv2.imreadanimation(str(path))
    assert there
    assert len(animation.frames) == 10  # every second one
    assert set(animation.durations) == {80}
    assert animation.frames[0].shape[:2] == (48, 480)
    np.testing.assert_allclose([frame[..., :3].mean() for frame in animation.frames], range(0, 200, 20), atol=6)


def test_an_animated_picture_that_is_too_long_or_not_finished_is_not_written(tmp_path: Path) -> None:
    with film_writer(tmp_path / "v.webp", 12.5) as film:
        for _ in range(400):
            film.write(np.zeros((4, 4), np.uint8))
        with pytest.raises(ConfigError, match="32 s long at most; use --from and --to"):
            film.write(np.zeros((4, 4), np.uint8))
    (tmp_path / "v.webp").unlink()
    with pytest.raises(RuntimeError, match="stop"), film_writer(tmp_path / "v.webp", 20.0) as film:  # noqa: PT012
        film.write(np.zeros((48, 64), np.uint8))
        raise RuntimeError("stop")
    with pytest.raises(ConfigError, match="there is no folder"):
        film_writer(tmp_path / "no" / "v.webp", 20.0)
    assert not list(tmp_path.iterdir())


def write_frames(path: Path, count: int) -> None:
    with VideoWriter(path, 20.0) as film:
        for _ in range(count):
            film.write(np.zeros((480, 640), np.uint8))


def test_an_ffmpeg_that_fails_is_told_and_nothing_is_left(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    program, path = tmp_path / "ffmpeg", tmp_path / "v.mp4"
    monkeypatch.setattr(video, "ffmpeg_with_h264", lambda: str(program))
    for script in ("cat >/dev/null", "true"):  # it fails at the end, or takes no frame
        program.write_text(f"#!/bin/sh\n{script}\necho 'first' >&2\necho 'No space left on device' >&2\nexit 1\n")
        program.chmod(0o755)
        path.write_bytes(b"the old one")
        with pytest.raises(ConfigError, match="written as a video: No space left on device"):
            write_frames(path, 200)
        assert path.read_bytes() == b"the old one"
        assert {file.name for file in tmp_path.iterdir()} == {"ffmpeg", "v.mp4"}


def test_what_writes_h264_is_asked_of_the_program(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    program = tmp_path / "ffmpeg"
    monkeypatch.setenv("PATH", f"{tmp_path}:/usr/bin:/bin")
    for said, found in ((" V....D libx264  H.264 ", str(program)), (" V....D mpeg4 ", "")):
        program.write_text(f"#!/bin/sh\necho '{said}'\n")
        program.chmod(0o755)
        assert video.ffmpeg_with_h264.__wrapped__() == found
    monkeypatch.setenv("PATH", str(tmp_path / "nowhere"))
    assert video.ffmpeg_with_h264.__wrapped__() == ""


def test_videos_that_cannot_be_written_are_named(encoder: str, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"v\.avi: videos are written as MP4"):
        VideoWriter(tmp_path / "v.avi", 20.0)
    with pytest.raises(ConfigError, match="there is no folder"):
        VideoWriter(tmp_path / "no" / "v.mp4", 20.0)
    with pytest.raises(ValueError, match="rate_hz"):
        VideoWriter(tmp_path / "v.mp4", 0.0)
    (tmp_path / "folder.mp4").mkdir()
    with VideoWriter(tmp_path / "folder.mp4", 20.0) as film, pytest.raises(ConfigError, match="cannot be written"):
        film.write(np.zeros((48, 64), np.uint8))


def test_a_video_that_is_not_finished_leaves_the_old_one(encoder: str, tmp_path: Path) -> None:
    path = tmp_path / "v.mp4"
    path.write_bytes(b"the old one")
    with pytest.raises(RuntimeError, match="stop"), VideoWriter(path, 20.0) as film:  # noqa: PT012
        film.write(np.zeros((48, 64), np.uint8))
        raise RuntimeError("stop")
    with VideoWriter(path, 20.0):
        pass  # nothing written
    assert [file.name for file in tmp_path.iterdir()] == ["v.mp4"]
    assert path.read_bytes() == b"the old one"


def test_pictures_of_a_video_have_one_even_size(encoder: str, tmp_path: Path) -> None:
    with VideoWriter(tmp_path / "v.mp4", 20.0) as film:
        with pytest.raises(ValueError, match="even"):
            film.write(np.zeros((47, 64), np.uint8))
        film.write(np.zeros((48, 64), np.uint8))
        with pytest.raises(ValueError, match="first frame"):
            film.write(np.zeros((64, 64), np.uint8))

"""Two cameras from the command line: driven, recorded, replayed."""

from __future__ import annotations

import re
import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from automodel.assembly.simulated_car import Simulation, build_world
from automodel.cli.init import kit_path
from automodel.config import load_car
from automodel.config.camera import SecondCamera
from automodel.geometry.ground import cam_from_body_rotation
from automodel.recording.reader import Recording
from automodel.signals import StereoFrame
from automodel.sources.images import read_image


def test_a_drive_with_two_cameras_is_recorded_with_both_and_replays(cli, tmp_path: Path) -> None:
    run = tmp_path / "run.mcap"
    said = cli("run", "--car", kit_path("sim-stereo"), "--duration", "1", "--lossless", "--record", run, "--json")
    assert (said.code, said.rows[0]["left_lane"], said.rows[0]["stops"]) == (0, 0, 0)
    steps = list(Recording(run).steps())
    driven = [step.estimate.pose.offset_m for step in steps if step.estimate is not None and step.estimate.pose]
    assert len(steps) >= 58
    assert len(driven) >= 0.9 * len(steps)
    for step in steps:
        assert isinstance(step.frame, StereoFrame)
        assert np.abs(step.frame.left.astype(float) - step.frame.right).mean() > 1.0  # from two places

    said = cli("replay", run, "--csv", tmp_path / "poses.csv", "--json")
    assert said.code == 0
    row = said.rows[0]
    assert (row["pipeline"], row["frames"]) == ("stereo", len(steps))
    table = np.genfromtxt(tmp_path / "poses.csv", delimiter=",", names=True, dtype=None, encoding="utf-8")
    replayed = table["offset_m"][np.isfinite(table["offset_m"])]
    np.testing.assert_allclose(replayed, driven, atol=1e-6)
    assert cli("replay", run, "--pipeline", "windows", "--json").rows[0]["frames"] == len(steps)  # sees the left one


def test_each_eye_has_noise_of_its_own() -> None:
    car = load_car(kit_path("sim-stereo"))
    place = SecondCamera(intrinsics=car.camera.intrinsics, extrinsics=car.camera.extrinsics)
    car = replace(car, camera=replace(car.camera, right=place))
    left, right = build_world(car, Simulation(track="oval")).capture(0, 0)[0].astype(float)
    assert abs((left - right).mean()) < 0.1  # the same scene from the same place
    assert (left - right).std() > 1.0


@pytest.fixture(scope="module")
def folders(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """Ten pairs of the simulated car at rest, as two folders of images."""
    root = tmp_path_factory.mktemp("pairs")
    car = load_car(kit_path("sim-stereo"))
    world = build_world(car, Simulation(track="oval", style="clean"))
    for index in range(10):
        for side, image in zip(("left", "right"), world.capture(index * 16_666_667, index)[0], strict=True):
            (root / side).mkdir(exist_ok=True)
            assert cv2.imwrite(str(root / side / f"{index}.png"), image)
    return root / "left", root / "right"


def test_two_folders_are_a_pair(cli, folders: tuple[Path, Path], tmp_path: Path) -> None:
    csv, video = tmp_path / "poses.csv", tmp_path / "overlay.mp4"
    said = cli("replay", *folders, "--car", kit_path("sim-stereo"), "--csv", csv, "--video", video, "--json")
    assert (said.code, said.err) == (0, "")
    assert (said.rows[0]["frames"], said.rows[0]["lost"]) == (10, 0)
    table = np.genfromtxt(csv, delimiter=",", names=True, dtype=None, encoding="utf-8")
    assert abs(table["width_m"][-1] - 0.4) < 0.01  # by both cameras
    assert video.stat().st_size > 1000


def test_a_video_shows_what_each_stage_found(cli, folders: tuple[Path, Path], tmp_path: Path) -> None:
    video, kit = tmp_path / "stages.mp4", kit_path("sim-stereo")
    said = cli("replay", *folders, "--car", kit, "--video", video, "--stages", "--json")
    assert said.code == 0
    reader = cv2.VideoCapture(str(video))
    size = int(reader.get(cv2.CAP_PROP_FRAME_WIDTH)), int(reader.get(cv2.CAP_PROP_FRAME_COUNT))
    reader.release()
    assert size == (1920, said.rows[0]["frames"])
    said = cli("replay", *folders, "--car", kit, "--stages")
    assert (said.code, said.line()) == (
        2, "automodel replay: --stages is drawn into a video; give --video as well (see automodel replay --help)"
    )  # fmt: skip
    other = tmp_path / "other.mp4"
    said = cli("replay", *folders, "--car", kit, "--pipeline", "contour", "--video", other, "--stages")
    assert (said.code, said.out) == (2, "")
    assert said.line() == "automodel: --stages: the pipeline contour does not show its stages; stereo does"
    assert not other.exists()


def test_cameras_that_are_swapped_show_no_such_lane(cli, folders: tuple[Path, Path], tmp_path: Path) -> None:
    left, right = folders
    said = cli("replay", right, left, "--car", kit_path("sim-stereo"), "--json")
    assert (said.code, said.rows[0]["tracking"]) == (0, 0)


def shortened(folder: Path, to: Path, count: int) -> Path:
    to.mkdir()
    for path in sorted(folder.iterdir())[:count]:
        shutil.copy(path, to)
    return to


def test_pairs_that_cannot_be_are_refused_in_one_line(cli, folders: tuple[Path, Path], tmp_path: Path) -> None:
    (left, right), kit = folders, kit_path("sim-stereo")
    short, small = shortened(right, tmp_path / "short", 9), tmp_path / "small"
    small.mkdir()
    for path in right.iterdir():
        cv2.imwrite(str(small / path.name), np.zeros((180, 320), np.uint8))
    for other, expected in (
        (short, f"automodel: {short}: expected 10 images as in {left}, got 9: without times nothing tells which belong "
                "together; remove those without a partner"),
        (small, f"automodel: {left}: frame 0, right: expected 640x360 pixels (car.toml), got 320x180; set [camera] "
                "width_px, height_px and the intrinsics for this source, and give it with --car"),
        (left, f"automodel replay: LEFT and RIGHT are both {left}; give the right camera's pictures as well (see "
               "automodel replay --help)"),
        (tmp_path / "none", f"automodel: {tmp_path / 'none'}: no such file or folder"),
    ):  # fmt: skip
        said = cli("replay", left, other, "--car", kit)
        assert (said.code, said.out, said.line()) == (2, "", expected)


def test_frames_without_a_partner_are_reported(cli, folders: tuple[Path, Path], tmp_path: Path) -> None:
    videos = []
    for folder, count in zip(folders, (10, 7), strict=True):
        videos.append(tmp_path / f"{folder.name}.mp4")
        writer = cv2.VideoWriter(str(videos[-1]), cv2.VideoWriter.fourcc(*"mp4v"), 50.0, (640, 360))
        for index in range(count):
            writer.write(read_image(folder / f"{index}.png", colour=True))
        writer.release()
    said = cli("replay", *videos, "--car", kit_path("sim-stereo"), "--json")
    assert (said.code, said.rows[0]["frames"], said.rows[0]["unpaired"]) == (0, 7, 3)
    assert said.line() == f"{videos[0]}, {videos[1]}: 3 frames have no partner within 5 ms"


KITTI_CAR = Path(__file__).resolve().parents[1] / "cars" / "kitti_ramp.toml"


def replayed_street(cli, left: Path, right: Path, car: Path, motion: Path) -> tuple[dict, np.ndarray]:
    """What a replay of ten pairs a second says, and its table."""
    csv = car.parent / "poses.csv" if car != KITTI_CAR else motion.parent / "poses.csv"
    said = cli("replay", left, right, "--car", car, "--rate", "10", "--motion", motion, "--csv", csv, "--json")
    assert said.code == 0
    return said.rows[0], np.genfromtxt(csv, delimiter=",", names=True, dtype=None, encoding="utf-8")


@pytest.fixture(scope="module")
def street_motion(data_root: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Speed and yaw rate on a ramp of KITTI's."""
    poses = np.loadtxt(data_root / "kitti_ramp" / "poses.txt").reshape(-1, 3, 4)
    speed = np.linalg.norm(np.gradient(poses[:, :, 3], 0.1, axis=0), axis=1)
    yaw_rate = np.gradient(-np.unwrap(np.arctan2(poses[:, 0, 2], poses[:, 2, 2])), 0.1)
    rows = np.column_stack((np.arange(len(poses)) * 0.1, speed, yaw_rate))
    path = tmp_path_factory.mktemp("street") / "motion.csv"
    np.savetxt(path, rows, delimiter=",", header="t_s,speed_mps,yaw_rate_radps", comments="")
    return path


def turned_street(ramp: Path, to: Path) -> Path:
    """The pairs of a ramp as cameras would show them that are not rectified; returns their car.toml."""
    car = KITTI_CAR.read_text()
    level, lens = load_car(KITTI_CAR).camera, np.array([[718.856, 0.0, 607.193], [0.0, 718.856, 185.216], [0, 0, 1.0]])
    other = np.array([[640.0, 0.0, 590.0], [0.0, 650.0, 170.0], [0.0, 0.0, 1.0]])
    first, second = car.split("[camera.right.intrinsics]")
    for name, value in (("fx", 640.0), ("fy", 650.0), ("cx", 590.0), ("cy", 170.0)):
        second = re.sub(rf"{name}_px = \S+", f"{name}_px = {value}", second)
    texts = []
    for eye, text, its, turned_deg in (("l", first, lens, (-1.0, 0.5, -2.0)), ("r", second, other, (2.0, -1.5, 3.0))):
        yaw, pitch, roll = np.radians(turned_deg).tolist()
        turned = replace(level.extrinsics, yaw_rad=yaw, pitch_rad=pitch, roll_rad=roll)
        turn = cam_from_body_rotation(turned) @ cam_from_body_rotation(level.extrinsics).T
        onto = np.linalg.solve(lens.T, turn.T).T
        (to / eye).mkdir()
        for path in sorted((ramp / f"image_{eye}").iterdir()):
            image = read_image(path, colour=False)
            shown = cv2.warpPerspective(image, its @ onto, image.shape[::-1], flags=cv2.INTER_CUBIC)
            cv2.imwrite(str(to / eye / path.name), shown)
        angles = f"yaw_rad = {yaw}\npitch_rad = {pitch}\nroll_rad = {roll}"
        texts.append(text.replace("pitch_rad = 0.0", angles))
    (to / "car.toml").write_text("[camera.right.intrinsics]".join(texts))
    return to / "car.toml"


def assert_the_ramp(row: dict, table: np.ndarray) -> None:
    assert row["frames"] == 26
    assert row["tracking"] >= 24  # the first pair starts the lane
    widths_m = table["width_m"][np.isfinite(table["width_m"])]
    along = np.arange(len(widths_m))
    assert np.std(widths_m - np.polyval(np.polyfit(along, widths_m, 2), along)) < 0.1
    assert ((widths_m > 4.6) & (widths_m < 6.0)).all()
    assert widths_m[-1] < 4.9
    assert np.nanmax(np.abs(table["offset_m"])) < 0.4


@pytest.mark.realdata
@pytest.mark.parametrize("radius_lanes", [1.4, 5.0])
def test_how_tight_bends_may_be_does_not_decide_what_is_seen_of_a_real_one(
    cli, data_root: Path, street_motion: Path, tmp_path: Path, radius_lanes: float
) -> None:
    """The bend's radius is 4 lane widths. Not a line of the gore, nor where its chevrons meet, is the lane's."""
    ramp, car = data_root / "kitti_ramp", tmp_path / "car.toml"
    car.write_text(KITTI_CAR.read_text().replace("radius_lanes = 3.0 ", f"radius_lanes = {radius_lanes} "))
    assert load_car(car).pipeline.contour.radius_lanes == radius_lanes
    assert_the_ramp(*replayed_street(cli, ramp / "image_l", ramp / "image_r", car, street_motion))


@pytest.mark.realdata
def test_real_pairs_of_a_street_and_the_same_seen_by_cameras_that_are_not_rectified(
    cli, data_root: Path, street_motion: Path, tmp_path: Path
) -> None:
    """A ramp of KITTI's: a bend of 22 m radius that narrows, chevrons beside the lane, ten pairs a second."""
    ramp = data_root / "kitti_ramp"
    row, table = replayed_street(cli, ramp / "image_l", ramp / "image_r", KITTI_CAR, street_motion)
    other_row, other = replayed_street(
        cli, tmp_path / "l", tmp_path / "r", turned_street(ramp, tmp_path), street_motion
    )
    for each, its in ((row, table), (other_row, other)):
        assert_the_ramp(each, its)
    apart_m = np.abs(table["offset_m"] - other["offset_m"])[2:]
    assert apart_m.mean() < 0.06
    assert (apart_m < 0.5 * np.minimum(table["offset_bound_m"], other["offset_bound_m"])[2:]).all()


@pytest.mark.slow
def test_lamps_that_the_floor_mirrors_are_no_lines(cli) -> None:
    """Into a bend past two lamps' streaks: with these taken for lines the car left its lane after 4.2 s."""
    said = cli("run", "--car", kit_path("sim-stereo"), "--track", "oval", "--duration", "5", "--json")
    row = said.rows[0]
    assert (said.code, row["left_lane"], row["stops"], row["misled_pct"]) == (0, 0, 0, 0.0)
    assert row["max_abs_offset_m"] < 0.02

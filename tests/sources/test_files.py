from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from automodel.config import CameraConfig, ConfigError
from automodel.signals import Frame, MotionSource
from automodel.sources.errors import EndOfSource, SourceError
from automodel.sources.files import ImageSource, TubSource, VideoSource, is_tub, natural_key, read_motion_csv
from automodel.sources.images import check_size, read_image, with_channels


def picture(number: int, width: int = 64, height: int = 48) -> np.ndarray:
    """A flat picture whose grey level tells its number."""
    return np.full((height, width, 3), 8 * number, np.uint8)


def level(frame: Frame) -> int:
    return round(float(np.mean(frame.image)) / 8)


def write_video(path: Path, frames: int, fourcc: str = "mp4v", rate_hz: float = 25.0) -> Path:
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*fourcc), rate_hz, (64, 48))
    assert writer.isOpened()
    for number in range(frames):
        writer.write(picture(number))
    writer.release()
    return path


def drain(source: Any) -> list[Frame]:
    frames = []
    while True:
        try:
            frames.append(source.read(0.0))
        except EndOfSource:
            return frames


# --- pictures ---------------------------------------------------------------------------------------------------------


def test_numbers_in_names_sort_as_numbers() -> None:
    names = ["10.png", "a2b10.png", "2.png", "a2b9.png", "A10.png", "1.png", "b.png"]
    want = ["1.png", "2.png", "10.png", "a2b9.png", "a2b10.png", "A10.png", "b.png"]
    assert sorted(names, key=natural_key) == want


def test_a_folder_plays_at_its_rate_in_order(tmp_path: Path) -> None:
    for number in (0, 1, 2, 10):
        cv2.imwrite(str(tmp_path / f"frame{number}.png"), picture(number))
    (tmp_path / "notes.txt").write_text("not an image")
    frames = drain(ImageSource(tmp_path, rate_hz=30.0))
    assert [level(f) for f in frames] == [0, 1, 2, 10]
    assert [f.t_ns for f in frames] == [0, 33_333_333, 66_666_667, 100_000_000]
    assert [f.index for f in frames] == [0, 1, 2, 3]
    assert frames[0].image.shape == (48, 64)


def test_colour_is_bgr(tmp_path: Path) -> None:
    blue = np.zeros((4, 4, 3), np.uint8)
    blue[:, :, 0] = 200
    cv2.imwrite(str(tmp_path / "blue.png"), blue)
    (frame,) = drain(ImageSource(tmp_path, colour=True))
    np.testing.assert_array_equal(frame.image, blue)
    np.testing.assert_array_equal(with_channels(blue, False), np.full((4, 4), round(0.114 * 200), np.uint8))
    assert with_channels(with_channels(blue, False), True).shape == (4, 4, 3)


def test_folders_without_pictures(tmp_path: Path) -> None:
    with pytest.raises(SourceError, match="no images"):
        ImageSource(tmp_path)
    with pytest.raises(SourceError, match="no such folder"):
        ImageSource(tmp_path / "none")
    with pytest.raises(ValueError, match="rate_hz"):
        ImageSource(tmp_path, rate_hz=0.0)


def test_a_picture_of_another_size_is_named(tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "1.png"), picture(1))
    cv2.imwrite(str(tmp_path / "2.png"), picture(2, width=32))
    source = ImageSource(tmp_path)
    source.read(0.0)
    with pytest.raises(SourceError, match=r"2\.png: expected 64x48 pixels .* got 32x48"):
        source.read(0.0)


@pytest.mark.parametrize("suffix", ["jpg", "png"])
@pytest.mark.parametrize("keep", [0.0, 0.5, 0.9])
def test_a_cut_picture_is_named(tmp_path: Path, suffix: str, keep: float, capfd: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / f"cut.{suffix}"
    noise = np.random.default_rng(0).integers(0, 256, (48, 64), np.uint8)
    cv2.imwrite(str(path), noise)
    data = path.read_bytes()
    assert read_image(path, False).shape == (48, 64)
    path.write_bytes(data[: int(keep * len(data))])
    with pytest.raises(SourceError, match=rf"cut\.{suffix}"):
        ImageSource(tmp_path).read(0.0)
    assert capfd.readouterr() == ("", "")


def test_what_is_no_picture_is_named(tmp_path: Path) -> None:
    (tmp_path / "text.jpg").write_text("hello")
    with pytest.raises(SourceError, match=r"text\.jpg: not an image"):
        ImageSource(tmp_path).read(0.0)
    with pytest.raises(SourceError, match="cannot be read"):
        read_image(tmp_path / "none.jpg", False)


def test_sizes_are_checked_against_the_camera() -> None:
    camera = CameraConfig(width_px=64, height_px=48)
    check_size(Frame(t_ns=0, index=0, image=np.zeros((48, 64), np.uint8)), camera)
    with pytest.raises(SourceError, match=r"frame 3: expected 64x48 pixels \(car\.toml\), got 48x64; set \[camera\]"):
        check_size(Frame(t_ns=0, index=3, image=np.zeros((64, 48), np.uint8)), camera)


# --- video ------------------------------------------------------------------------------------------------------------


def test_a_video_plays_at_its_own_rate(tmp_path: Path) -> None:
    frames = drain(VideoSource(write_video(tmp_path / "v.mp4", 10)))
    assert [level(f) for f in frames] == list(range(10))
    assert [f.t_ns for f in frames] == [40_000_000 * i for i in range(10)]
    assert frames[0].image.shape == (48, 64)


def test_a_video_plays_at_a_given_rate_in_colour(tmp_path: Path) -> None:
    frames = drain(VideoSource(write_video(tmp_path / "v.mp4", 3), rate_hz=10.0, colour=True))
    assert [f.t_ns for f in frames] == [0, 100_000_000, 200_000_000]
    assert frames[0].image.shape == (48, 64, 3)


def test_a_closed_video_has_no_more_frames(tmp_path: Path) -> None:
    source = VideoSource(write_video(tmp_path / "v.mp4", 10))
    source.read(0.0)
    source.close()
    source.close()
    with pytest.raises(EndOfSource):
        source.read(0.0)


def test_cut_and_foreign_videos_are_named(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    path = write_video(tmp_path / "v.mp4", 10)
    path.write_bytes(path.read_bytes()[:-200])
    with pytest.raises(SourceError, match=r"v\.mp4: cannot be opened as a video"):
        VideoSource(path)
    (tmp_path / "text.mp4").write_text("hello")
    with pytest.raises(SourceError, match="cannot be opened as a video"):
        VideoSource(tmp_path / "text.mp4")
    with pytest.raises(SourceError, match="no such file"):
        VideoSource(tmp_path / "none.mp4")
    assert capfd.readouterr() == ("", "")


def test_a_video_that_ends_early_says_so_after_its_frames(tmp_path: Path) -> None:
    path = write_video(tmp_path / "v.avi", 30, "MJPG")
    data = path.read_bytes()
    path.write_bytes(data[: data.index(b"idx1") * 6 // 10])
    source = VideoSource(path)
    with pytest.raises(SourceError, match=r"ends after \d+ of 30 frames: the file is cut"):
        drain(source)
    source.close()
    source = VideoSource(path)
    assert [level(source.read(0.0)) for _ in range(5)] == list(range(5))
    source.close()


# --- tub --------------------------------------------------------------------------------------------------------------


def write_tub(folder: Path, count: int = 6, deleted: tuple[int, ...] = ()) -> Path:
    (folder / "images").mkdir(parents=True)
    names = ["catalog_0.catalog", "catalog_1.catalog"]
    manifest: list[Any] = [
        ["cam/image_array", "user/angle", "user/throttle"],
        ["image_array", "float", "float"],
        {},
        {},
    ]
    manifest.append({"paths": names, "current_index": count, "max_len": 3, "deleted_indexes": list(deleted)})
    (folder / "manifest.json").write_text("\n".join(json.dumps(line) for line in manifest) + "\n")
    for part, name in enumerate(names):
        lines = []
        for index in range(part * count // 2, (part + 1) * count // 2):
            image = f"{index}_cam_image_array_.jpg"
            cv2.imwrite(str(folder / "images" / image), picture(index))
            record = {"_index": index, "_timestamp_ms": 0, "cam/image_array": image}
            lines.append(json.dumps({**record, "user/angle": index / 10, "user/throttle": -0.5}))
        (folder / name).write_text("\n".join(lines) + "\n")
    return folder


def test_a_tub_plays_all_catalogs_at_20_hz(tmp_path: Path) -> None:
    source = TubSource(write_tub(tmp_path / "tub"))
    frames = drain(source)
    assert is_tub(tmp_path / "tub")
    assert not is_tub(tmp_path)
    assert [level(f) for f in frames] == list(range(6))
    assert [f.t_ns for f in frames] == [50_000_000 * i for i in range(6)]
    assert [source.record_of(f).angle for f in frames] == [0.0, 0.1, 0.2, 0.3, 0.4, 0.5]
    assert source.record_of(frames[2]).throttle == -0.5


def test_deleted_records_leave_a_gap_in_time(tmp_path: Path) -> None:
    source = TubSource(write_tub(tmp_path / "tub", deleted=(0, 2, 3)), rate_hz=10.0)
    frames = drain(source)
    assert [level(f) for f in frames] == [1, 4, 5]
    assert [f.t_ns for f in frames] == [0, 300_000_000, 400_000_000]
    assert [f.index for f in frames] == [0, 1, 2]
    assert source.record_of(frames[1]).angle == 0.4


def damage(path: Path, old: str, new: str) -> None:
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))


@pytest.mark.parametrize(
    ("file", "old", "new", "match"),
    [
        ("manifest.json", '"paths"', '"path"', r"manifest\.json: not a tub"),
        ("manifest.json", '"paths": [', '"paths": [[', r"manifest\.json:5: not JSON"),
        ("manifest.json", "catalog_1.catalog", "catalog_9.catalog", r"catalog_9\.catalog: no such file"),
        ("manifest.json", '"deleted_indexes": []', '"deleted_indexes": 3', r"manifest\.json:5: deleted_indexes"),
        ("manifest.json", '"deleted_indexes": []', '"deleted_indexes": [0, 1, 2, 3, 4, 5]', "holds no records"),
        ("catalog_0.catalog", '"_index": 1', '"_index": "1"', r"catalog_0\.catalog:2: a record without _index"),
        (
            "catalog_0.catalog",
            '"user/angle": 0.1',
            '"user/angle": NaN',
            r"catalog_0\.catalog:2: user/angle: expected a number, -1 .. 1, got nan",
        ),
        ("manifest.json", '"deleted_indexes": []', '"deleted_indexes": [[1]]', "is not a list of whole numbers"),
        (
            "catalog_0.catalog",
            '"_index": 1',
            f'"_index": 1{"0" * 400}',
            r"catalog_0\.catalog:2: _index: expected 0 \.\. ",
        ),
        (
            "catalog_0.catalog",
            '"user/angle": 0.1',
            f'"user/angle": 1{"0" * 400}',
            r"user/angle: expected a number, -1 \.\. 1",
        ),
        ("catalog_0.catalog", '"user/angle": 0.1', f'"user/angle": {"1" * 5000}', r"catalog_0\.catalog:2: not JSON"),
        ("catalog_0.catalog", '"user/angle": 0.1', f'"user/angle": {"[" * 100_000}', r"catalog_0\.catalog:2: not JSON"),
        ("catalog_0.catalog", '"cam/image_array": "', '"cam/image_array": "../../', "is outside the tub's images/"),
        ("catalog_0.catalog", '"cam/image_array": "', '"cam/image_array": "/', "is outside the tub's images/"),
        ("catalog_1.catalog", "0.5}", "0.5", r"catalog_1\.catalog:1: not JSON"),
        ("catalog_1.catalog", "cam/image_array", "cam", r"catalog_1\.catalog:1: a record without cam/image_array"),
    ],
)
def test_damaged_tubs_are_named_with_file_and_line(tmp_path: Path, file: str, old: str, new: str, match: str) -> None:
    folder = write_tub(tmp_path / "tub")
    damage(folder / file, old, new)
    with pytest.raises(SourceError, match=match):
        TubSource(folder)


def test_a_missing_picture_of_a_tub_is_named(tmp_path: Path) -> None:
    folder = write_tub(tmp_path / "tub")
    (folder / "images" / "0_cam_image_array_.jpg").unlink()
    with pytest.raises(SourceError, match="0_cam_image_array_"):
        TubSource(folder).read(0.0)
    with pytest.raises(SourceError, match="is this a donkeycar tub"):
        TubSource(tmp_path)


# --- real recordings --------------------------------------------------------------------------------------------------


@pytest.mark.realdata
def test_the_real_tub(data_root: Path) -> None:
    source = TubSource(data_root / "donkeycar_tub")
    assert len(source.records) == 1000
    frame = source.read(0.0)
    assert frame.image.shape == (120, 160)
    assert source.record_of(frame).angle == pytest.approx(0.2986, abs=1e-4)
    assert source.record_of(frame).throttle == pytest.approx(0.5391, abs=1e-4)
    for _ in range(99):
        frame = source.read(0.0)
    assert (frame.index, frame.t_ns) == (99, 4_950_000_000)


@pytest.mark.realdata
def test_the_real_video(data_root: Path) -> None:
    source = VideoSource(data_root / "udacity" / "solidWhiteRight.mp4")
    frames = drain(source)
    assert len(frames) == 221
    assert frames[-1].image.shape == (540, 960)
    assert frames[-1].t_ns == 220 * 40_000_000


def write_motion(folder: Path, text: str) -> Path:
    path = folder / "motion.csv"
    path.write_text(text)
    return path


def test_motion_is_linear_between_rows(tmp_path: Path) -> None:
    table = read_motion_csv(write_motion(tmp_path, "t_s,speed_mps,yaw_rate_radps\n0,1.0,0.0\n0.5,2.0,-0.4\n"))
    motion = table.at(125_000_000)
    assert (motion.t_ns, motion.source, motion.known) == (125_000_000, MotionSource.RECORDED, True)
    assert motion.speed_mps == pytest.approx(1.25)
    assert motion.yaw_rate_radps == pytest.approx(-0.1)
    assert table.at(0).speed_mps == 1.0
    assert table.at(500_000_000).speed_mps == 2.0


def test_outside_the_table_nothing_is_known(tmp_path: Path) -> None:
    table = read_motion_csv(write_motion(tmp_path, "t_s,speed_mps,yaw_rate_radps\n0.1,1.0,0.3\n0.5,2.0,0.3\n\n"))
    for t_ns in (0, 99_000_000, 501_000_000):
        assert (table.at(t_ns).known, table.at(t_ns).speed_mps) == (False, 0.0)


@pytest.mark.parametrize(
    ("text", "match"),
    [
        ("", r"motion\.csv:1: the first line must be t_s,speed_mps,yaw_rate_radps"),
        ("t,v,w\n0,1,2\n", r"motion\.csv:1: the first line"),
        ("t_s,speed_mps,yaw_rate_radps\n", r"motion\.csv: no rows"),
        ("t_s,speed_mps,yaw_rate_radps\n0,1,2\n1,2\n", r"motion\.csv:3: expected 3 values, got 2"),
        (
            "t_s,speed_mps,yaw_rate_radps\n0,1,2\n1,x,3\n",
            r"motion\.csv:3: speed_mps: expected a finite number, got 'x'",
        ),
        (
            "t_s,speed_mps,yaw_rate_radps\n0,1,nan\n",
            r"motion\.csv:2: yaw_rate_radps: expected a finite number, got 'nan'",
        ),
        ("t_s,speed_mps,yaw_rate_radps\n0,1,2\n0,1,2\n", r"motion\.csv:3: t_s must increase"),
    ],
)
def test_bad_motion_files_are_named_with_line(tmp_path: Path, text: str, match: str) -> None:
    with pytest.raises(ConfigError, match=match):
        read_motion_csv(write_motion(tmp_path, text))


def test_a_motion_file_that_is_not_there(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="no such file"):
        read_motion_csv(tmp_path / "motion.csv")
    (tmp_path / "binary.csv").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(ConfigError, match="cannot be read"):
        read_motion_csv(tmp_path / "binary.csv")

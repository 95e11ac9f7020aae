"""`automodel calibrate stereo` as a user runs it."""

from __future__ import annotations

import dataclasses
import datetime
import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from automodel.bench.stereo_calibration import RigDrive, pairs_of, random_rig
from automodel.config import load_car
from automodel.doctor.camera_pair import rig_findings
from automodel.doctor.examination import judge_records
from automodel.doctor.findings import Verdict
from automodel.pipelines.stereo import Stereo
from automodel.signals import StereoFrame
from automodel.viewer.video import VideoWriter
from calibration.boards import Board
from calibration.car_file import update_car_file
from calibration.ground import NAMES
from tests.support.board_pairs import RIGHT_LENS, cameras, drawn_pairs, mounts
from tests.support.drawn_boards import LENS, charuco

BOARD = Board(columns=9, rows=6, square_m=0.05)
GIVEN = ("--board", "9x6", "--square-mm", "50")
OURS = '# ours\n[camera]\nsource = "usb"  # both\nwidth_px = 640\nheight_px = 360\n'
TODAY = datetime.date(2026, 6, 1)


@pytest.fixture(scope="module")
def drawn() -> list[tuple[np.ndarray, np.ndarray]]:
    return list(drawn_pairs(0.25, BOARD, 7))


def write_car(path: Path, **right: object) -> None:
    """car.toml of a calibrated left camera, and what there is of [camera.right]."""
    path.write_text(OURS)
    parts = {"intrinsics": LENS, "extrinsics": mounts(0.25)[0]}
    parts |= {f"right.{name}": part for name, part in right.items()}
    for name, part in parts.items():
        values = {f"camera.{name}": dataclasses.asdict(part)}  # type: ignore[call-overload]
        update_car_file(path, values, residual="0.1 px", date=TODAY, method="chessboard")
    for backup in path.parent.glob(f"{path.name}.bak*"):
        backup.unlink()


def write_images(folder: Path, images: list[np.ndarray]) -> None:
    folder.mkdir(exist_ok=True)
    for number, image in enumerate(images):
        cv2.imwrite(str(folder / f"{number}.png"), image)


@pytest.fixture
def there(drawn: list[tuple[np.ndarray, np.ndarray]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The working folder: left, right and car.toml."""
    monkeypatch.chdir(tmp_path)
    for number, side in enumerate(("left", "right")):
        write_images(tmp_path / side, [pair[number] for pair in drawn])
    write_car(tmp_path / "car.toml")
    return tmp_path


def test_from_pictures_to_a_rig_that_the_doctor_accepts(there: Path, drawn, cli) -> None:
    before = Path("car.toml").read_text()
    said = cli("calibrate", "stereo", "left", "right", *GIVEN)
    assert said.code == 0, said.err
    assert "OK    residual: 0.0" in said.out
    text = Path("car.toml").read_text()
    added = text[text.index("[camera.right.intrinsics]") : text.index("[calibration.camera]")]
    assert text.replace(added, "").partition("\n\n[calibration.stereo]")[0] == before.rstrip("\n")
    assert Path("car.toml.bak").read_text() == before
    car = load_car("car.toml")
    right, record = car.camera.right, car.calibration.stereo
    assert right is not None
    assert right.intrinsics.fx_px == pytest.approx(RIGHT_LENS.fx_px, rel=0.01)
    for name in NAMES:
        assert getattr(right.extrinsics, name) == pytest.approx(getattr(mounts(0.25)[1], name), abs=0.005)
    assert Stereo.rig(car).baseline_m == pytest.approx(np.linalg.norm(np.subtract(*_centres())), abs=0.002)
    assert record is not None
    assert record.date == datetime.date.today()
    assert record.method.startswith("chessboard 9x6, ")
    assert "px off epipolar lines; beside the left camera +- 0." in record.residual
    picture = cv2.imread("calibration_pictures/stereo_epipolar.png")
    assert picture is not None
    assert picture.shape == (360, 1280, 3)
    pairs = [StereoFrame(t_ns=0, index=0, left=left, right=right) for left, right in drawn]
    assert {found.verdict for found in rig_findings(car, pairs)} <= {Verdict.OK, Verdict.SKIP}
    assert "stereo calibration" in [found.name for found in judge_records(car, datetime.date.today())]


def _centres() -> list[np.ndarray]:
    return [eye.centre_m for eye in cameras(0.25)]


def test_a_known_lens_stays_unless_it_is_asked_for(there: Path, cli) -> None:
    write_car(Path("car.toml"), intrinsics=RIGHT_LENS, extrinsics=mounts(0.25)[1])
    said = cli("calibrate", "stereo", "left", "right", *GIVEN, "--json")
    assert said.code == 0, said.err
    (row,) = said.rows
    assert json.loads(said.out)["command"] == "calibrate stereo"
    assert row["fx_px"] == RIGHT_LENS.fx_px
    assert {f"std_{name}" for name in NAMES} <= row.keys()
    assert said.err.splitlines()[-1].startswith("car.toml: [camera.right.extrinsics] written; ")
    assert load_car("car.toml").camera.right.intrinsics == RIGHT_LENS  # type: ignore[union-attr]
    said = cli("calibrate", "stereo", "left", "right", *GIVEN, "--json", "--fit-lens", "--dry-run", "--out", "drawn")
    (row,) = said.rows
    assert row["fx_px"] != RIGHT_LENS.fx_px
    assert said.err.splitlines()[-1] == "car.toml: unchanged (--dry-run)"
    assert [path.name for path in Path("drawn").iterdir()] == ["stereo_epipolar.png"]


@pytest.mark.slow
def test_two_videos_of_a_charuco_board(there: Path, cli) -> None:
    pairs = list(drawn_pairs(0.25, BOARD, 8, charuco(9, 6)))
    for number, side in enumerate(("left", "right")):
        with VideoWriter(Path(f"{side}.mp4"), 10.0) as writer:
            for pair in pairs:
                writer.write(np.stack((pair[number],) * 3, axis=-1))
    said = cli("calibrate", "stereo", "left.mp4", "right.mp4", *GIVEN, "--charuco", "--json")
    assert said.code == 0, said.err
    (row,) = said.rows
    assert row["baseline_m"] == pytest.approx(np.linalg.norm(np.subtract(*_centres())), abs=0.005)
    assert row["pairs"][0]["pair"] == "left.mp4:0"


REFUSED = {
    "left fewer": "fewer: expected 7 images as in left, got 6: without times nothing tells which belong together; "
    "remove those without a partner",
    "left nowhere": "nowhere: no such file or folder",
    "left run.mcap": "run.mcap: expected two folders of images or two videos, got a recording",
    "left film.mp4": "left and film.mp4: expected two folders of images or two videos, got one of each",
    "left large": "0.png: expected 640x360 pixels, for which [camera] was calibrated, got 800x450 of the right camera; "
    "take the images at the size in which the car drives",
    "left blank": "right camera: a chessboard of 9x6 inner corners is in none of the 7 images; is the size right?",
    "left late": "no pair of images shows the whole board to both cameras; hold it where both see it, farther away",
    "few few_right": "expected at least 4 pairs of images with the whole board in both, better 15, got 3: near and "
    "far, at all sides of what both cameras see, tilted to all sides",
    "left copy": "both cameras would be at the same place (",
    "right left": "LEFT and RIGHT seem to be swapped: RIGHT would be (",
    "left right --car lens.toml": "lens.toml: the left camera's [camera.extrinsics] were never calibrated, and the "
    "right camera is measured from it; run automodel calibrate ground with the left camera first",
    "left right --car bare.toml": "bare.toml: the left camera's [camera.intrinsics] were never calibrated, and the "
    "right camera is measured from it; run automodel calibrate camera with the left camera first",
    "left right --car none.toml": "none.toml: no such file",
    "left right --car text/none/car.toml": "text/none/car.toml: there is no folder {cwd}/text/none",
    "left right --out bare.toml": "--out bare.toml: bare.toml is not a folder",
}


@pytest.mark.parametrize("arguments", REFUSED)
def test_what_cannot_be_is_refused_in_one_line(arguments: str, there: Path, drawn, cli) -> None:
    left, right = ([pair[number] for pair in drawn] for number in (0, 1))
    blank = np.full((360, 640), 90, np.uint8)
    folders = {
        "fewer": right[1:],
        "large": [np.asarray(cv2.resize(image, (800, 450)), np.uint8) for image in right],
        "blank": [blank] * 7,
        "late": [blank] * 3 + right[:4],
        "few": left[:3],
        "few_right": right[:3],
        "copy": left,
    }
    if arguments == "left late":
        write_images(Path("left"), [*left[4:], *[blank] * 4])
    if arguments == "left copy":
        write_car(Path("car.toml"), intrinsics=LENS, extrinsics=mounts(0.25)[1])
    for name in set(arguments.split()) & folders.keys():
        write_images(Path(name), folders[name])
    Path("text").mkdir()
    Path("run.mcap").write_bytes(b"")
    Path("film.mp4").write_bytes(b"")
    Path("bare.toml").write_text(OURS)
    Path("lens.toml").write_text(Path("car.toml").read_text().replace("[calibration.ground]", "[calibration.servo]"))
    before = {path: path.read_bytes() for path in Path().rglob("*") if path.is_file()}
    said = cli("calibrate", "stereo", *arguments.split(), *GIVEN)
    assert (said.code, said.out) == (2, "")
    assert said.line().startswith("automodel: " + REFUSED[arguments].format(cwd=Path.cwd()))
    assert {path: path.read_bytes() for path in Path().rglob("*") if path.is_file()} == before


def test_the_same_folder_twice_is_a_wrong_argument(there: Path, cli) -> None:
    Path("other").symlink_to("left")
    said = cli("calibrate", "stereo", "left", "other", *GIVEN)
    assert (said.code, said.out) == (2, "")
    assert "LEFT and RIGHT are both left; give the right camera's images as well (see " in said.line()


def test_a_pair_that_does_not_go_together_is_drawn_but_not_written(there: Path, drawn, cli) -> None:
    write_car(Path("car.toml"), intrinsics=dataclasses.replace(RIGHT_LENS, fx_px=600.0), extrinsics=mounts(0.25)[1])
    before = Path("car.toml").read_text()
    said = cli("calibrate", "stereo", "left", "right", *GIVEN)
    assert said.code == 2
    assert "FAIL  residual: " in said.out
    last = said.err.splitlines()[-1]
    assert last.startswith("automodel: car.toml is unchanged, the right camera found is implausible: residual: ")
    assert Path("car.toml").read_text() == before


DRIVE_REFUSED = {
    "left right --from-lanes --board 9x6": "--from-lanes needs no board; leave --board and the like away",
    "left right --from-lanes --fit-lens": "--fit-lens needs a board: lanes do not show a lens",
    "left right --motion motion.csv --board 9x6 --square-mm 50": "--motion and --rate are for --from-lanes",
    "left --board 9x6 --square-mm 50": "Missing argument 'RIGHT'.",
    "left right": "Missing option '--board'.",
    "left --from-lanes": "left: expected a recording of both cameras, or two videos or folders, LEFT and RIGHT",
    "left right --from-lanes": "0: the car's motion is not known; give a recording with odometry, or a table with "
    "--motion",
    "left right --from-lanes --motion none.csv": "none.csv: no such file",
    "left right --from-lanes --motion still.csv": "the drive is 0.0 m long by its odometry; expected at least 8 m",
    "left right --from-lanes --motion still.csv --car lens.toml": "lens.toml: [camera.right.intrinsics] are missing, "
    "and lanes do not show a lens;",
    "left right --from-lanes --motion still.csv --car place.toml": "place.toml: [camera.right.extrinsics] are missing, "
    "and the search starts from them; measure them with a ruler",
}


@pytest.mark.parametrize("arguments", DRIVE_REFUSED)
def test_a_drive_that_cannot_be_used_is_refused_in_one_line(arguments: str, there: Path, cli) -> None:
    write_car(Path("lens.toml"))
    write_car(Path("place.toml"), intrinsics=RIGHT_LENS)
    write_car(Path("car.toml"), intrinsics=RIGHT_LENS, extrinsics=mounts(0.25)[1])
    Path("still.csv").write_text("t_s,speed_mps,yaw_rate_radps\n0,0,0\n1,0,0\n")
    said = cli("calibrate", "stereo", *arguments.split())
    assert (said.code, said.out) == (2, "")
    assert DRIVE_REFUSED[arguments] in said.err
    assert "Traceback" not in said.err


def test_folders_of_a_drive_and_its_motion_give_the_right_camera(tmp_path: Path, monkeypatch, cli) -> None:
    monkeypatch.chdir(tmp_path)
    car, start, lens = random_rig(2)
    rows = ["t_s,speed_mps,yaw_rate_radps"]
    for side in ("left", "right"):
        Path(side).mkdir()
    for index, (left, right, motion) in enumerate(pairs_of(RigDrive(seed=2, seconds=2.5), car)):
        for side, image in (("left", left), ("right", right)):
            cv2.imwrite(f"{side}/{index}.png", image)
        rows.append(f"{motion.t_ns * 1e-9},{motion.speed_mps},{motion.yaw_rate_radps}")
    Path("motion.csv").write_text("\n".join(rows))
    Path("car.toml").write_text(
        '[camera]\nsource = "usb"\nwidth_px = 640\nheight_px = 480\n[lane]\nwidth_m = 3.6\nmarking_width_m = 0.15\n'
    )
    parts = {"intrinsics": car.camera.intrinsics, "extrinsics": car.camera.extrinsics}
    for name, part in (parts | {"right.intrinsics": lens, "right.extrinsics": start}).items():
        values = {f"camera.{name}": dataclasses.asdict(part)}  # type: ignore[call-overload]
        update_car_file(Path("car.toml"), values, residual="0.1 px", date=TODAY, method="by a ruler")
    said = cli(
        "calibrate", "stereo", "left", "right", "--from-lanes", "--motion", "motion.csv", "--rate", "20", "--json"
    )
    assert said.code == 0, said.err
    (row,) = said.rows
    truth = car.camera.right.extrinsics  # type: ignore[union-attr]
    written = load_car("car.toml")
    for name in NAMES:
        assert row[name] == pytest.approx(getattr(truth, name), abs=0.03 if name.endswith("_m") else 0.003)
        assert getattr(written.camera.right.extrinsics, name) == row[name]  # type: ignore[union-attr]
    assert written.camera.right.intrinsics == lens  # type: ignore[union-attr]
    assert written.calibration.stereo is not None
    assert "lanes and odometry" in Path("car.toml").read_text()
    drawn = cv2.imread("calibration_pictures/stereo_lanes.png")
    assert drawn is not None
    assert drawn.shape == (480, 1280, 3)

"""`automodel calibrate camera` as a user runs it."""

from __future__ import annotations

import datetime
import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from automodel.config import load_car
from automodel.viewer.video import VideoWriter
from tests.support.drawn_boards import LENS, charuco, chessboard, held

BOARD = ("--board", "9x6", "--square-mm", "25")
PICTURES = {"camera_coverage.png", "camera_residuals.png", "camera_undistorted.png"}


@pytest.fixture(scope="module")
def drawn() -> list[np.ndarray]:
    return list(held(9, 6, 0.025, 6))


@pytest.fixture
def folder(drawn: list[np.ndarray], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    pictures = tmp_path / "pictures"
    pictures.mkdir()
    for number, image in enumerate(drawn):
        cv2.imwrite(str(pictures / f"{number}.png"), image)
    monkeypatch.chdir(tmp_path)
    return pictures


def test_from_pictures_to_car_toml(folder: Path, cli) -> None:
    Path("car.toml").write_text('# ours\n[camera]\nsource = "usb"  # front\nwidth_px = 640\nheight_px = 360\n')
    np.array([]).tofile(folder / "empty.jpg")
    said = cli("calibrate", "camera", folder, *BOARD)
    assert said.code == 0, said.err
    assert "6.png" not in said.out
    assert "empty.jpg: not an image" in " ".join(said.out.split())
    assert "OK    residual: 0." in said.out
    car = load_car("car.toml")
    assert car.camera.intrinsics.fx_px == pytest.approx(LENS.fx_px, rel=0.01)
    assert car.camera.source == "usb"
    assert car.calibration.camera is not None
    assert car.calibration.camera.date == datetime.date.today()
    assert car.calibration.camera.method == "chessboard 9x6, 6 views of 640x360"
    assert car.calibration.camera.residual.endswith("px in views left out")
    assert Path("car.toml").read_text().startswith('# ours\n[camera]\nsource = "usb"  # front\n')
    assert Path("car.toml.bak").read_text().endswith("height_px = 360\n")
    assert {path.name for path in Path("calibration_pictures").iterdir()} == PICTURES
    undistorted = cv2.imread("calibration_pictures/camera_undistorted.png")
    assert undistorted is not None
    assert undistorted.shape == (360, 1280, 3)


def test_a_dry_run_writes_pictures_and_no_car_and_json_is_one_object(folder: Path, cli) -> None:
    said = cli("calibrate", "camera", f"{folder}/*.png", *BOARD, "--dry-run", "--json", "--out", "drawn")
    assert said.code == 0
    (row,) = said.rows
    assert json.loads(said.out)["command"] == "calibrate camera"
    assert row["views"] == len(row["pictures"]) == 6
    assert (row["width_px"], row["height_px"], len(row["distortion"])) == (640, 360, 5)
    assert {"name", "status", "text"} == set(row["checks"][0])
    assert not Path("car.toml").exists()
    assert {path.name for path in Path("drawn").iterdir()} == PICTURES


@pytest.fixture
def video(drawn: list[np.ndarray], folder: Path) -> Path:
    path = folder.parent / "board.mp4"
    with VideoWriter(path, 10.0) as writer:
        for image in (*drawn[:2], *drawn):  # the first two come twice
            writer.write(np.stack((image, image, image), axis=-1))
    return path


@pytest.mark.slow
def test_a_video_and_its_repeated_views(video: Path, cli) -> None:
    said = cli("calibrate", "camera", video, *BOARD, "--car", "new.toml")
    assert said.code == 0, said.err
    assert " ".join(said.out.split()).count("nearly the same view as board.mp4:") == 2
    car = load_car("new.toml")  # which was not there
    assert (car.camera.width_px, car.camera.height_px) == (640, 360)


def test_live_tells_what_is_taken_and_missing(video: Path, cli) -> None:
    Path("car.toml").write_text(f'[camera]\nsource = "{video}"\nwidth_px = 640\nheight_px = 360\n')
    said = cli("calibrate", "camera", "live", *BOARD, "--views", "5")
    assert said.code == 0, said.err
    lines = said.err.splitlines()
    assert lines[0].startswith("show the board near and far and tilted")
    assert any(line.startswith("1 views, ") and "missing: the board at the " in line for line in lines)
    assert any(line.startswith("not taken: nearly the same view as frame ") for line in lines)
    assert Path("calibration_pictures/camera_coverage.png").exists()


def test_a_charuco_board_with_other_markers(folder: Path, cli) -> None:
    for path in folder.iterdir():
        path.unlink()
    for number, image in enumerate(held(9, 6, 0.025, 2, charuco(9, 6, cv2.aruco.DICT_5X5_50))):
        cv2.imwrite(str(folder / f"{number}.png"), image)
    said = cli("calibrate", "camera", folder, *BOARD, "--charuco")
    assert said.code == 2
    assert said.line().endswith("is the size right? The markers are those of --dictionary 5x5_50")


REFUSED = {
    "pictures --board 8x5 --square-mm 25": "no image shows a board of 8x5 inner corners, and 6 of 6 show one of 9x6; "
    "give --board 9x6 if that is yours",
    "blank --board 9x6 --square-mm 25": "a chessboard of 9x6 inner corners is in none of the 1 images; is the size "
    "right?",
    "mixed --board 9x6 --square-mm 25": "the images have mixed sizes (2 of 640x360, 2 of 800x450); give those of one "
    "camera at one size",
    "few --board 9x6 --square-mm 25": "expected at least 4 usable views of the board, better 15, got 2: near and far, "
    "in the corners of the image too, tilted to all sides",
    "nowhere --board 9x6 --square-mm 25": "nowhere: no such file or folder",
    "text --board 9x6 --square-mm 25": "text: no images in this folder (.jpg, .jpeg, .png, .bmp, .webp, .tif, "
    ".tiff, .pgm, .ppm)",
    "pictures --board 9x6 --square-mm 25 --car small.toml": "small.toml: [camera] is 320x180 and the images are "
    "640x360; a calibration holds for one size: take the images at the size in which the car drives",
    "pictures --board 9x6 --square-mm 25 --car wrong.toml": "wrong.toml:1: camer: unknown key; did you mean camera?",
    "pictures --board 9x6 --square-mm 25 --car text/none/car.toml": "text/none/car.toml: there is no folder "
    "{cwd}/text/none",
    "pictures --board 9x6 --square-mm 25 --car locked.toml": "locked.toml: cannot be written; look at the permissions "
    "of the file and its folder",
    "pictures --board 9x6 --square-mm 25 --out small.toml": "--out small.toml: small.toml is not a folder",
    "live --board 9x6 --square-mm 25": 'car.toml: [camera] source "sim" gives no images; live is for a camera',
}


@pytest.mark.parametrize("arguments", REFUSED)
def test_what_cannot_be_is_refused_in_one_line(arguments: str, folder: Path, drawn, cli) -> None:
    folders = {"blank": [np.zeros((360, 640), np.uint8)], "few": drawn[:2], "text": []}
    folders["mixed"] = [*drawn[:2], *(cv2.resize(image, (800, 450)) for image in drawn[2:4])]
    for name, images in folders.items():
        if name == arguments.split()[0] or name == "text":
            Path(name).mkdir()
            for number, image in enumerate(images):
                cv2.imwrite(f"{name}/{number}.png", image)
    Path("small.toml").write_text("[camera]\nwidth_px = 320\nheight_px = 180\n")
    Path("wrong.toml").write_text("[camer]\n")
    Path("locked.toml").write_text("")
    Path("locked.toml").chmod(0o444)
    before = {path: path.read_bytes() for path in Path().rglob("*") if path.is_file()}
    said = cli("calibrate", "camera", *arguments.split())
    assert (said.code, said.out) == (2, "")
    assert said.line() == "automodel: " + REFUSED[arguments].format(cwd=Path.cwd())
    assert {path: path.read_bytes() for path in Path().rglob("*") if path.is_file()} == before


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        ("x --square-mm 25", "--board"),
        ("x --board 9 --square-mm 25", "expected columns x rows of inner corners, as 9x6, got '9'"),
        ("x --board 9x2 --square-mm 25", "expected a board of 3 .. 50 inner corners each way, got 9x2"),
        ("x --board 9x6", "--square-mm"),
        ("x --board 9x6 --square-mm nan", "--square-mm"),
        ("x --board 9x6 --square-mm 25 --marker-mm 10", "--marker-mm is for --charuco"),
        (
            "x --board 9x6 --square-mm 25 --charuco --marker-mm 30",
            "expected markers smaller than squares of 0.025 m, got 0.03 m",
        ),
        ("--board 9x6 --square-mm 25", "SOURCE"),
    ],
)
def test_wrong_arguments(arguments: str, named: str, cli) -> None:
    said = cli("calibrate", "camera", *arguments.split())
    assert (said.code, said.out) == (2, "")
    assert named in said.line()
    assert said.line().endswith("(see automodel calibrate camera --help)")


@pytest.mark.slow
def test_an_implausible_camera_is_drawn_but_not_written(folder: Path, cli) -> None:
    from tests.support.drawn_boards import PAPER_PX, seen, turned

    for path in folder.iterdir():
        path.unlink()
    for number, (x, z) in enumerate(((-0.04, 0.3), (0.0, 0.3), (0.05, 0.3), (0.0, 0.4))):
        image = seen(chessboard(9, 6), 0.025 / PAPER_PX, turned(0.01 * number, 0.0), np.array([x, 0.0, z]))
        cv2.imwrite(str(folder / f"{number}.png"), image)
    said = cli("calibrate", "camera", folder, *BOARD)
    assert said.code == 2
    assert "FAIL  focal length: f = " in said.out
    assert said.err.splitlines()[-1].startswith("automodel: car.toml is unchanged, the camera found is implausible: ")
    assert not Path("car.toml").exists()


@pytest.mark.realdata
def test_the_real_boards(data_root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, cli) -> None:
    monkeypatch.chdir(tmp_path)
    said = cli("calibrate", "camera", data_root / "udacity" / "camera_cal", *BOARD, "--json")
    assert said.code == 0, said.err
    (row,) = said.rows
    assert row["rms_px"] <= 0.9
    assert row["fx_px"] == pytest.approx(1157.0, rel=0.01)
    notes = {picture["picture"]: picture["note"] for picture in row["pictures"] if picture["note"]}
    assert notes == {
        "calibration1.jpg": "used: 45 corners of a part of the board",
        "calibration5.jpg": "used: 45 corners of a part of the board",
        "calibration7.jpg": "expected 1280x720 pixels, as most images have, got 1281x721",
        "calibration15.jpg": "expected 1280x720 pixels, as most images have, got 1281x721",
    }
    assert load_car("car.toml").camera.width_px == 1280

"""`automodel calibrate ground` as a user runs it."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from automodel.config import Extrinsics, load_car
from automodel.geometry import CameraModel, GroundCamera
from tests.support.drawn_boards import LENS, PAPER_PX, SIZE, chessboard, marker, on_floor

MOUNT = Extrinsics(x_m=0.21, y_m=0.01, z_m=0.19, pitch_rad=0.35, yaw_rad=0.04, roll_rad=-0.05)
PLACES = ((0.55, 0.15), (0.55, -0.15), (0.95, 0.3), (0.95, -0.3), (1.4, 0.0))
CAR = f"""\
[camera]  # of team 7
width_px = 640
height_px = 360
[camera.intrinsics]
fx_px = {LENS.fx_px}
fy_px = {LENS.fy_px}
cx_px = {LENS.cx_px}
cy_px = {LENS.cy_px}
distortion = {list(LENS.distortion)}
[camera.extrinsics]
x_m = 0.2   # by tape
[calibration.camera]
date = 2026-01-02
method = "chessboard"
residual = "0.1 px"
"""


def pixels() -> np.ndarray:
    return GroundCamera(CameraModel(LENS, *SIZE), MOUNT).ground_to_px(np.array(PLACES))


@pytest.fixture
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with the pictures, the car and the points, and the working directory in it."""
    monkeypatch.chdir(tmp_path)
    Path("car.toml").write_text(CAR)
    cv2.imwrite("board.png", on_floor(chessboard(9, 6), 0.03 / PAPER_PX, (0.62, 0.02), 0.1, MOUNT))
    cv2.imwrite("marker.png", on_floor(marker(17), 0.2 / 192, (0.62, 0.02), 0.1, MOUNT))
    cv2.imwrite("floor.png", np.full((360, 640), 110, np.uint8))
    rows = [f"{x},{y},{u:.1f},{v:.1f}" for (x, y), (u, v) in zip(PLACES, pixels(), strict=True)]
    Path("points.csv").write_text("\n".join(["x_m,y_m,u_px,v_px", *rows]) + "\n")
    return tmp_path


def check_car(yaw_rad: float = 0.01) -> None:
    car = load_car("car.toml")
    found = car.camera.extrinsics
    assert (found.x_m, found.y_m, found.z_m) == pytest.approx((MOUNT.x_m, MOUNT.y_m, MOUNT.z_m), abs=0.004)
    assert (found.pitch_rad, found.roll_rad) == pytest.approx((MOUNT.pitch_rad, MOUNT.roll_rad), abs=0.006)
    assert found.yaw_rad == pytest.approx(MOUNT.yaw_rad, abs=yaw_rad)
    assert car.calibration.ground is not None
    assert "mm at 0.5 m" in car.calibration.ground.residual
    assert "x_m = 0.2" in Path("car.toml").read_text()
    assert "# by tape" in Path("car.toml").read_text()
    picture = cv2.imread("calibration_pictures/ground_grid.png")
    assert picture is not None
    assert picture.shape == (360, 640, 3)


@pytest.mark.parametrize(
    "sheet",
    ["board.png --board 9x6 --square-mm 30", "marker.png --aruco 1x1 --marker-mm 200"],
    ids=["board", "marker"],
)
def test_a_sheet_on_the_floor(sheet: str, place: Path, cli) -> None:
    said = cli("calibrate", "ground", *sheet.split(), "--at", 0.62, 0.02, "--turn-deg", 5.7296)
    assert said.code == 0, said.err
    assert said.err.splitlines()[-1].startswith("car.toml: [camera.extrinsics] written; the old file is ")
    check_car()
    ground = load_car("car.toml").calibration.ground
    assert ground is not None
    assert ground.method.endswith("on the floor at (0.62, 0.02) m")


def test_taped_points_from_a_file(place: Path, cli) -> None:
    said = cli("calibrate", "ground", "floor.png", "--points", "points.csv", "--json")
    assert said.code == 0, said.err
    (row,) = said.rows
    assert row["method"] == "5 taped points"
    assert row["residual_px"] < 0.2
    assert [error["distance_m"] for error in row["errors"]] == [0.5, 1.0, 2.0]
    assert all(0 < error["error_mm"] < error["within_mm"] for error in row["errors"])
    assert row["std_z_m"] > 0.0
    check_car()


def test_taped_points_on_the_command_line(place: Path, cli) -> None:
    points = [word for place_m, pixel in zip(PLACES, pixels(), strict=True) for word in ("--point", *place_m, *pixel)]
    said = cli("calibrate", "ground", "floor.png", *points, "--keep-position", "--tape-mm", 2, "--dry-run")
    assert said.code == 0, said.err
    assert "5 taped points" in said.out
    assert Path("car.toml").read_text() == CAR
    assert not Path("car.toml.bak").exists()


def test_a_straight_drive_between_lines(place: Path, cli) -> None:
    """Two lines 0.4 m apart; the car weaves a little, the pictures are all there is."""
    rng = np.random.default_rng(1)
    Path("drive").mkdir()
    for number in range(8):
        paper = np.full((1400, 500), 90, np.uint8)  # 4 mm a pixel
        for y in (-0.2, 0.2):
            column = round(250 + (y + 0.03 * np.sin(number)) / 0.004)
            paper[:, column - 3 : column + 4] = 240
        image = on_floor(paper, 0.004, (3.0, 0.0), 0.004 * rng.normal(), MOUNT)
        cv2.imwrite(f"drive/{number}.png", image)
    said = cli("calibrate", "ground", "drive", "--from-lanes", "--lane-width-m", 0.4, "--json", "--dry-run")
    assert said.code == 0, said.err
    (row,) = said.rows
    assert row["z_m"] == pytest.approx(MOUNT.z_m, rel=0.06)
    assert row["pitch_rad"] == pytest.approx(MOUNT.pitch_rad, abs=0.02)
    assert row["method"].startswith("a lane of 0.4 m, ")
    assert row["errors"][0]["within_mm"] is None
    assert 0.0 < row["std_pitch_rad"] < 0.02
    said = cli("calibrate", "ground", "drive", "--from-lanes", "--lane-width-m", 0.42)
    assert said.code == 0, said.err
    car = load_car(Path("car.toml"))
    assert car.lane.width_m == 0.42  # what the height rests on
    assert car.lane.markings == "light"
    assert car.camera.extrinsics.z_m == pytest.approx(1.05 * MOUNT.z_m, rel=0.06)


@pytest.mark.slow
def test_a_height_that_is_another_is_questioned(place: Path, cli) -> None:
    paper = np.full((1400, 500), 90, np.uint8)
    paper[:, 197:204] = paper[:, 297:304] = 240
    Path("drive").mkdir()
    for number in range(4):
        cv2.imwrite(f"drive/{number}.png", on_floor(paper, 0.004, (3.0, 0.0), 0.002 * number, MOUNT))
    said = cli("calibrate", "ground", "drive", "--from-lanes", "--lane-width-m", 0.8, "--dry-run")
    assert said.code == 0, said.err
    assert "and was 0.18: check it with a ruler" in said.err
    before = Path("car.toml").read_bytes()
    said = cli("calibrate", "ground", "drive", "--from-lanes", "--lane-width-m", 0.8)
    assert said.code == 2
    assert "the camera cannot be 0.38" in said.err
    assert Path("car.toml").read_bytes() == before


BOARD = "--board 9x6 --square-mm 30 --at 0.6 0"
POINTS = " ".join(f"--point {x} {y} {u:.1f} {v:.1f}" for (x, y), (u, v) in zip(PLACES, pixels(), strict=True))
REFUSED = {
    f"floor.png {BOARD}": "the whole board of 9x6 inner corners is in none of 1 images; is its size right, and is "
    "all of it visible and lit?",
    "floor.png --aruco 1x1 --marker-mm 200 --at 0.6 0": "the sheet of markers is in none of 1 images; is its size "
    "right, and is all of it visible and lit?",
    "small.png --points points.csv": "small.png: expected 640x360 pixels, for which [camera] was calibrated, got "
    "320x180; take the image at that size, or calibrate the camera at this one",
    "small.png --from-lanes": "small.png: expected 640x360 pixels, for which [camera] was calibrated, got 320x180; "
    "take the image at that size, or calibrate the camera at this one",
    "floor.png --points line.csv": "the points lie nearly on one line on the ground; spread them from near to far and "
    "from side to side",
    "floor.png --points cut.csv": "cut.csv:3: expected four finite numbers, got '0.5,-0.1,400'",
    "floor.png --points head.csv": "head.csv:1: the first line must be x_m,y_m,u_px,v_px",
    "floor.png --points none.csv": "none.csv: cannot be read: No such file or directory",
    "none.png --points points.csv": "none.png: no such file or folder",
    "bad.png --points points.csv": "bad.png: not an image, or a damaged one; replace or remove it",
    f"floor.png {' '.join(POINTS.split()[:15])}": "expected at least four ground points, better six, got 3",
    "live --points points.csv": 'car.toml: [camera] source "sim" gives no images; live is for a camera',
}


@pytest.mark.parametrize("arguments", REFUSED)
def test_what_cannot_be_is_refused_in_one_line(arguments: str, place: Path, cli) -> None:
    cv2.imwrite("small.png", np.full((180, 320), 110, np.uint8))
    Path("bad.png").write_text("hello")
    head, rows = "x_m,y_m,u_px,v_px\n", ["0.5,0.1,300,250", "0.7,0.1,310,200", "0.9,0.1,312,180", "1.1,0.1,314,160"]
    Path("line.csv").write_text(head + "\n".join(rows))
    Path("cut.csv").write_text(head + "0.5,0.1,300,250\n0.5,-0.1,400\n")
    Path("head.csv").write_text("x,y,u,v\n")
    before = {path: path.read_bytes() for path in Path().rglob("*") if path.is_file()}
    said = cli("calibrate", "ground", *arguments.split())
    assert (said.code, said.out) == (2, "")
    assert said.line() == "automodel: " + REFUSED[arguments]
    assert {path: path.read_bytes() for path in Path().rglob("*") if path.is_file()} == before


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        ("floor.png", "give one of --board, --aruco, --point or --points, --from-lanes"),
        (f"floor.png {BOARD} --from-lanes", "give one of --board, --aruco, --point or --points, --from-lanes"),
        ("floor.png --board 9x6 --square-mm 30", "--at X Y is missing"),
        ("floor.png --board 9x6 --at 0.6 0", "--square-mm is missing"),
        ("floor.png --aruco 2x2 --at 0.6 0", "--marker-mm is missing"),
        (
            "floor.png --aruco 0x2 --marker-mm 20 --at 0.6 0",
            "expected an ArUco sheet of 1 .. 30 markers each way, got 0x2",
        ),
    ],
)
def test_wrong_arguments(arguments: str, named: str, place: Path, cli) -> None:
    said = cli("calibrate", "ground", *arguments.split())
    assert (said.code, said.out) == (2, "")
    assert named in said.line()
    assert said.line().endswith("(see automodel calibrate ground --help)")


def test_without_a_calibrated_lens_it_says_so(place: Path, cli) -> None:
    Path("car.toml").write_text(CAR.split("[calibration.camera]")[0])
    said = cli("calibrate", "ground", "floor.png", "--points", "points.csv", "--dry-run")
    assert said.code == 0
    assert said.err.splitlines()[0].startswith("car.toml: [camera.intrinsics] were never calibrated")


@pytest.mark.realdata
@pytest.mark.slow
def test_the_highway_between_its_lines(data_root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, cli) -> None:
    """Against tests/cars: pitch and yaw from the vanishing point and height from the lane, found by other means."""
    car = Path(__file__).resolve().parents[1] / "cars" / "solid_white_right.toml"
    monkeypatch.chdir(tmp_path)
    source = data_root / "udacity" / "solidWhiteRight.mp4"
    said = cli("calibrate", "ground", source, "--from-lanes", "--car", car, "--dry-run", "--json", "--out", tmp_path)
    assert said.code == 0, said.err
    (row,) = said.rows
    known = load_car(car).camera.extrinsics
    assert row["z_m"] == pytest.approx(known.z_m, rel=0.03)
    assert row["pitch_rad"] == pytest.approx(known.pitch_rad, abs=0.004)
    assert row["yaw_rad"] == pytest.approx(known.yaw_rad, abs=0.004)
    assert [error["distance_m"] for error in row["errors"]] == [5.0, 10.0, 20.0]

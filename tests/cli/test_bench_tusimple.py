"""`bench tusimple` on drawn pictures whose labels are exact, and on the real ones."""

from __future__ import annotations

import json
import math
from pathlib import Path

import cv2
import numpy as np
import pytest

from tests.support.highway_pictures import DASHES, DOTS, LANE_M, SOLID, Line, camera_model, draw, mounted

KEYS = [
    "pipeline", "frames", "found", "both_ego", "ego_accuracy", "ego_fp", "ego_fn", "all_accuracy", "all_fp", "all_fn",
    "centre_median_pct", "p50_ms",
]  # fmt: skip
ROWS = list(range(112, 288, 8))
CAMERA = mounted(camera_model(f_px=443.4))
DRIVE = [(0.3, 0.01), (-0.4, -0.015), (0.1, 0.0), (-0.2, 0.005)]


def road(offset_m: float, pattern=DASHES) -> list[Line]:
    return [
        Line(1.5 * LANE_M - offset_m, SOLID),
        Line(0.5 * LANE_M - offset_m, pattern, 1.7),
        Line(-0.5 * LANE_M - offset_m, SOLID),
    ]


def label_of(lines: list[Line], heading_rad: float) -> list[list[float]]:
    """u on each row of ground that runs straight from beside the car."""
    lanes = []
    for line in lines:
        x = np.geomspace(2.0, 200.0, 500)
        u, v = CAMERA.ground_to_px(np.column_stack((x, line.offset_m + heading_rad * x))).T
        on_rows = np.interp(ROWS, v[::-1], u[::-1])
        lanes.append([round(float(a), 1) if 0 <= a <= 511 else -2 for a in on_rows])
    return lanes


def write(root: Path, name: str, picture: np.ndarray) -> None:
    file = root / name
    file.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(file), picture)


def folder(root: Path) -> Path:
    """Four labelled pictures; the first has three more before it."""
    labels = []
    for k, (offset, heading) in enumerate(DRIVE):
        lines = road(offset, DOTS if k == 3 else DASHES)
        name = f"clips/{k}/20.png"
        write(root, name, draw(CAMERA, lines, heading, seed=k))
        labels.append({"raw_file": name, "lanes": label_of(lines, heading), "h_samples": ROWS})
    (root / "label_data.json").write_text("\n".join(map(json.dumps, labels)) + "\n")
    return root


@pytest.fixture(scope="module")
def drawn(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return folder(tmp_path_factory.mktemp("tusimple"))


def test_drawn_lanes_are_found_and_scored(drawn: Path, tmp_path: Path, cli) -> None:
    predictions, figures = tmp_path / "found.json", tmp_path / "sheet.png"
    said = cli(
        "bench", "tusimple", "--root", drawn, "--pipeline", "contour", "--json", "--predictions", predictions,
        "--figures", figures,
    )  # fmt: skip
    assert said.code == 0
    assert said.line().startswith("camera: pitch 5.7")  # 0.1 rad
    assert "height 1.6" in said.line()
    assert "60 deg of view (f 443 px)" in said.line()
    (row,) = said.rows
    assert list(row) == KEYS
    assert (row["frames"], row["found"], row["both_ego"]) == (4, 4, 4)
    assert row["ego_accuracy"] > 0.9
    assert (row["ego_fp"], row["ego_fn"], row["all_fp"]) == (0.0, 0.0, 0.0)
    assert row["all_fn"] == pytest.approx(1.0 / 3.0)  # pipelines tell the own lane only
    assert row["centre_median_pct"] < 1.0
    assert figures.read_bytes().startswith(b"\x89PNG")
    labels = [json.loads(line) for line in (drawn / "label_data.json").read_text().splitlines()]
    told = [json.loads(line) for line in predictions.read_text().splitlines()]
    for one, label in zip(told, labels, strict=True):
        assert list(one) == ["raw_file", "lanes", "run_time"]
        assert one["raw_file"] == label["raw_file"]
        assert [len(lane) for lane in one["lanes"]] == [len(ROWS)] * 2
        assert all(u == -2 or 0 <= u <= 511 for lane in one["lanes"] for u in lane)
        assert one["run_time"] > 0


def test_every_pipeline_finds_the_drawn_lanes(drawn: Path, cli) -> None:
    said = cli("bench", "tusimple", "--root", drawn, "--json")
    assert said.code == 0
    assert [row["pipeline"] for row in said.rows] == ["centerline", "windows", "contour"]
    for row in said.rows:
        assert row["both_ego"] == 4
        assert row["centre_median_pct"] < 1.0


def test_several_pipelines_and_the_table(drawn: Path, tmp_path: Path, cli) -> None:
    predictions = tmp_path / "found.json"
    pipelines = ("--pipeline", "windows", "--pipeline", "contour")
    said = cli("bench", "tusimple", "--root", drawn, *pipelines, "--predictions", predictions)
    assert said.code == 0
    lines = said.out.splitlines()
    assert [line.split()[0] for line in lines if line[0] != " "][:3] == ["pipeline", "windows", "contour"]
    assert max(map(len, lines)) <= 80
    assert sorted(path.name for path in tmp_path.iterdir()) == ["found.contour.json", "found.windows.json"]


def test_a_clip_is_followed_up_to_its_label(tmp_path: Path, cli) -> None:
    """The lines of the last picture are hidden: only who has followed them knows where they are."""
    root = folder(tmp_path)
    hidden = draw(CAMERA, [], seed=9)
    labels = (root / "label_data.json").read_text().splitlines()
    for name in ("0/20.png", "1/20.png"):
        picture = cv2.imread(str(root / "clips" / name))
        assert picture is not None
        write(root, f"clips/{name}", hidden)
        for number in (18, 19):
            write(root, f"clips/{name[0]}/{number}.png", picture)
        write(root, f"clips/{name[0]}/21.png", hidden)  # after the label: not to be looked at
    alone = root / "clips" / "1"
    for number in (18, 19):
        (alone / f"{number}.png").unlink()
    (root / "label_data.json").write_text("\n".join(labels) + "\n")
    said = cli("bench", "tusimple", "--root", root, "--pipeline", "contour", "--json", "--car", car(tmp_path))
    assert said.code == 0, said.err
    assert (said.rows[0]["found"], said.rows[0]["both_ego"]) == (3, 3)


def car(folder: Path) -> Path:
    file = folder / "car.toml"
    file.write_text(
        "[camera]\nwidth_px = 512\nheight_px = 288\n[camera.intrinsics]\nfx_px = 443.4\nfy_px = 443.4\ncx_px = 255.5\n"
        "cy_px = 143.5\n[camera.extrinsics]\nx_m = 0.0\nz_m = 1.6\npitch_rad = 0.1\n[vehicle]\nreference_x_m = 1.4\n"
        "wheelbase_m = 2.8\n[lane]\nwidth_m = 3.7\nmarking_width_m = 0.12\n[pipeline.contour]\n"
        "look_ahead_lanes = 7.0\nradius_lanes = 50.0\n"
    )
    return file


def test_pictures_that_tell_nothing_get_a_usual_camera(tmp_path: Path, cli) -> None:
    write(tmp_path, "a.png", np.full((288, 512), 90, np.uint8))
    label = {"raw_file": "a.png", "lanes": [], "h_samples": ROWS}
    (tmp_path / "label_data.json").write_text(json.dumps(label))
    said = cli("bench", "tusimple", "--root", tmp_path, "--pipeline", "contour", "--json")
    assert said.code == 0
    assert "a usual one, as it was not found in the images" in said.line()
    assert said.rows[0]["found"] == 0
    assert said.rows[0]["centre_median_pct"] is None


def broken(folder: Path, what: str) -> None:
    """A folder with one thing wrong."""
    write(folder, "a.png", np.zeros((288, 512), np.uint8))
    label = {"raw_file": "a.png", "lanes": [[5] * len(ROWS)], "h_samples": ROWS}
    text = json.dumps(label)
    if what == "cut line":
        text = text + "\n" + text[:30]
    elif what == "missing picture":
        text = json.dumps({**label, "raw_file": "b.png"})
    elif what == "unequal rows":
        text = json.dumps({**label, "h_samples": ROWS[1:]})
    elif what == "no picture":
        (folder / "a.png").write_text("hello")
    elif what == "other size":
        write(folder, "b.png", np.zeros((100, 200), np.uint8))
        text = text + "\n" + json.dumps({**label, "raw_file": "b.png"})
    elif what == "outside":
        text = json.dumps({**label, "raw_file": "a.png/b.png"})
    if what != "no labels":
        (folder / "label_data.json").write_text(text)


@pytest.mark.parametrize(
    ("what", "wanted"),
    [
        ("no labels", "there is no label_data.json in it"),
        ("cut line", "label_data.json:2: not JSON"),
        ("missing picture", "b.png: there is no such image under"),
        ("outside", "a.png/b.png: there is no such image under"),
        ("unequal rows", f"lane 1 has {len(ROWS)} points for {len(ROWS) - 1} h_samples"),
        ("no picture", "a.png: not an image"),
        ("other size", "b.png: expected 512x288 pixels, as the camera has, got 200x100"),
    ],
)
def test_bad_folders_get_one_line(what: str, wanted: str, tmp_path: Path, cli) -> None:
    broken(tmp_path, what)
    predictions = tmp_path / "found.json"
    arguments = ["--root", tmp_path, "--pipeline", "contour", "--predictions", predictions]
    if what in ("no picture", "other size"):
        arguments += ["--car", car(tmp_path)]
    said = cli("bench", "tusimple", *arguments)
    assert (said.code, said.out) == (2, "")
    assert wanted in said.line()
    assert not predictions.exists()  # nothing half-written


def test_bad_arguments_get_one_line(drawn: Path, tmp_path: Path, cli) -> None:
    assert "no such folder" in cli("bench", "tusimple", "--root", tmp_path / "none").line()
    said = cli("bench", "tusimple", "--root", drawn, "--predictions", drawn / "label_data.json")
    assert said.code == 2
    assert "is the same file as the labels" in said.line()
    assert "there is no folder" in cli("bench", "tusimple", "--root", drawn, "--figures", tmp_path / "a/b.png").line()


@pytest.mark.realdata
def test_ten_real_frames(data_root: Path, cli) -> None:
    root = data_root / "tusimple"
    if not (root / "label_data.json").is_file():
        pytest.skip(f"no {root}/label_data.json")
    said = cli("bench", "tusimple", "--root", root, "--json")
    assert said.code == 0
    assert len(said.rows) == 3
    for row in said.rows:
        assert row["frames"] == 10
        assert row["both_ego"] == 10
        assert row["centre_median_pct"] <= 1.0
        assert math.isfinite(row["p50_ms"])

from __future__ import annotations

import csv
import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from automodel.config import ConfigError, RecordingConfig, parse_car
from automodel.curves import line
from automodel.recording.export import PosesCsv, export_csv, export_video, mean_rate_hz
from automodel.recording.reader import Recording
from automodel.recording.writer import McapRecorder
from automodel.signals import Command, Frame, LaneEstimate, LaneLine, LanePose, LaneStatus
from automodel.sources.errors import SourceError
from tests.support.recorded_values import CAR_TEXT, make_command, make_estimate, make_frame

HEADER = (
    "t_s,frame,status,offset_m,heading_rad,curvature_per_m,width_m,left_seen,right_seen,"
    "crossing_distance_m,crossing_angle_rad,steering_rad,latency_ms,offset_bound_m,heading_bound_rad,lane_change"
)


def rows(path: Path) -> list[dict[str, str]]:
    with open(path, newline="") as file:
        return list(csv.DictReader(file))


def test_rows_have_the_header_and_every_field(tmp_path: Path) -> None:
    path = tmp_path / "poses.csv"
    frame = Frame(t_ns=12_000_000_345, index=7, image=np.zeros((2, 2), np.uint8))
    with PosesCsv(path) as table:
        table.row(frame, make_estimate(1), make_command(1), 2.5)
    assert path.read_text().splitlines()[0] == HEADER
    (row,) = rows(path)
    estimate = make_estimate(1)
    assert estimate.pose is not None
    assert estimate.crossing is not None
    assert (row["t_s"], row["frame"], row["status"]) == ("12.000000345", "7", "ONE_LINE")
    assert float(row["offset_m"]) == pytest.approx(estimate.pose.offset_m, abs=5e-7)
    assert float(row["heading_rad"]) == pytest.approx(estimate.pose.heading_rad, abs=5e-7)
    assert float(row["curvature_per_m"]) == 0.0
    assert float(row["width_m"]) == pytest.approx(0.3)
    assert (row["left_seen"], row["right_seen"]) == ("1", "0")
    assert float(row["crossing_distance_m"]) == pytest.approx(estimate.crossing.distance_m, abs=5e-7)
    assert float(row["crossing_angle_rad"]) == 0.0
    assert float(row["steering_rad"]) == pytest.approx(make_command(1).steering_rad, abs=5e-7)
    assert row["latency_ms"] == "2.500"


def test_what_does_not_exist_is_empty_never_0(tmp_path: Path) -> None:
    path = tmp_path / "poses.csv"
    curve = line(0.0, 0.2, 0.0, 1.0)
    pose = LanePose(offset_m=0.0, heading_rad=0.0, width_m=0.4, curvature_per_m=0.0, covariance=np.eye(3))
    one = LaneLine(curve=curve, points_m=np.empty((0, 2)), seen=False)
    frame = make_frame(0)
    with PosesCsv(path) as table:
        table.row(frame, LaneEstimate(t_ns=0, status=LaneStatus.LOST))
        table.row(frame, None)
        coasting = LaneEstimate(t_ns=0, status=LaneStatus.COASTING, left=one, centerline=curve, pose=pose)
        table.row(frame, coasting, Command(t_ns=0, steering_rad=0.0, speed_mps=0.0, valid_until_ns=0), 0.0)
    lost, none, zero = path.read_text().splitlines()[1:]
    assert lost == "1.000000000,0,LOST" + "," * 13
    assert none == "1.000000000,0," + "," * 13
    assert zero == "1.000000000,0,COASTING,0.000000,0.000000,0.000000,0.400000,0,,,,0.000000,0.000,,,0"


@pytest.mark.parametrize(
    ("bounds", "lane_change", "end"),
    [
        ((0.034, 0.0), -1, ["0.034000", "0.000000", "-1"]),
        ((0.034, math.inf), 1, ["0.034000", "", "1"]),
        ((math.inf, 0.25), 0, ["", "0.250000", "0"]),
    ],
)
def test_bounds_are_in_the_last_columns_and_empty_where_they_are_not_stated(
    tmp_path: Path, bounds: tuple[float, float], lane_change: int, end: list[str]
) -> None:
    estimate = make_estimate(1)
    assert estimate.pose is not None
    pose = replace(estimate.pose, offset_bound_m=bounds[0], heading_bound_rad=bounds[1])
    bounded = replace(estimate, pose=pose, lane_change=lane_change)
    with PosesCsv(tmp_path / "poses.csv") as table:
        table.row(make_frame(0), bounded, None, 2.5)
    assert (tmp_path / "poses.csv").read_text().splitlines()[1].split(",")[-4:] == ["2.500", *end]


def test_a_csv_that_cannot_be_written_is_named(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="cannot be written"), PosesCsv(tmp_path / "no" / "poses.csv"):
        pass


def test_a_csv_that_is_not_finished_leaves_the_old_one(tmp_path: Path) -> None:
    path = tmp_path / "poses.csv"
    for earlier in (None, "the old one\n"):
        if earlier is not None:
            path.write_text(earlier)
        with pytest.raises(KeyboardInterrupt), PosesCsv(path) as table:  # noqa: PT012
            table.row(make_frame(0), None)
            raise KeyboardInterrupt
        assert [file.name for file in tmp_path.iterdir()] == ([] if earlier is None else ["poses.csv"])
    assert path.read_text() == "the old one\n"
    with PosesCsv(path) as table:
        table.row(make_frame(0), None)
        assert path.read_text() == "the old one\n"
    assert path.read_text().startswith("t_s,frame,")


def test_a_recording_exports_to_csv(recorded_run: Callable[[int], Path], tmp_path: Path) -> None:
    path = tmp_path / "poses.csv"
    seen: list[int] = []
    assert export_csv(Recording(recorded_run(5)), path, seen.append) == 5
    assert seen == [1, 2, 3, 4, 5]
    table = rows(path)
    assert [row["frame"] for row in table] == ["0", "1", "2", "3", "4"]
    assert all(row["latency_ms"] == "3.000" for row in table)
    assert table[1]["t_s"] == "1.016666667"


def test_a_part_of_a_recording_exports_its_own_frames(recorded_run: Callable[[int], Path], tmp_path: Path) -> None:
    run, path, video = Recording(recorded_run(5)), tmp_path / "poses.csv", tmp_path / "run.mp4"
    assert export_csv(run, path, span_s=(0.02, 0.06)) == 2  # frames are 1/60 s apart
    assert [row["frame"] for row in rows(path)] == ["2", "3"]
    assert export_video(run, video, parse_car(CAR_TEXT, "car.toml"), span_s=(0.0, 0.02)) == 2
    with pytest.raises(ConfigError, match=r"run.*\.mcap: no frames between --from 9 and --to inf s"):
        export_csv(run, path, span_s=(9.0, math.inf))
    assert len(rows(path)) == 2  # the older file is still there


def test_a_recording_exports_to_video(recorded_run: Callable[[int], Path], tmp_path: Path) -> None:
    path = tmp_path / "run.mp4"
    assert export_video(Recording(recorded_run(5)), path, parse_car(CAR_TEXT, "car.toml")) == 5
    capture = cv2.VideoCapture(str(path))
    assert capture.get(cv2.CAP_PROP_FPS) == pytest.approx(60.0, abs=0.1)
    frames = 0
    while capture.read()[0]:
        frames += 1
    capture.release()
    assert frames == 5


def test_a_car_with_another_camera_is_refused(recorded_run: Callable[[int], Path], tmp_path: Path) -> None:
    with pytest.raises(SourceError, match=r"expected 640x360 pixels \(car\.toml\), got 64x36"):
        export_video(Recording(recorded_run(1)), tmp_path / "run.mp4", parse_car("", "car.toml"))


def test_the_rate_of_one_frame_is_a_default(tmp_path: Path) -> None:
    recorder = McapRecorder(tmp_path / "run.mcap", "", RecordingConfig())
    recorder.frame(make_frame(0))
    recorder.close()
    assert mean_rate_hz(Recording(recorder.path)) == 20.0

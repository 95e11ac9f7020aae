from __future__ import annotations

import csv
import itertools
import json
import shutil
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

from automodel.assembly import replay
from automodel.assembly.parts import make_loop
from automodel.recording.codec import encode
from automodel.recording.reader import Recording
from automodel.runtime.loop import Tick
from automodel.signals import Frame

POSES = (
    "t_s,frame,status,offset_m,heading_rad,curvature_per_m,width_m,left_seen,right_seen,"
    "crossing_distance_m,crossing_angle_rad,steering_rad,latency_ms,offset_bound_m,heading_bound_rad,lane_change"
)
REPLAY_KEYS = [
    "pipeline", "source", "frames", "tracking", "one_line", "coasting", "lost", "availability_pct", "p50_ms", "p99_ms",
    "unpaired",
]  # fmt: skip


@pytest.fixture
def ticks(monkeypatch: pytest.MonkeyPatch) -> list[Tick]:
    """What the loop of a replay gives, with every bit: a CSV has six decimals only."""
    seen: list[Tick] = []

    def watched(car):
        loop = make_loop(car)
        tick = loop.tick

        def note(*arguments):
            seen.append(tick(*arguments))
            return seen[-1]

        monkeypatch.setattr(loop, "tick", note)
        return loop

    monkeypatch.setattr(replay, "make_loop", watched)
    return seen


def recorded_estimates(path: Path) -> list[bytes]:
    return [encode(step.estimate) for step in Recording(path).steps() if step.estimate is not None]


def rows_of(path: Path) -> list[dict[str, str]]:
    with open(path, newline="") as file:
        return list(csv.DictReader(file))


def pictures_of(path: Path) -> int:
    video = cv2.VideoCapture(str(path))
    try:
        return sum(1 for _ in itertools.takewhile(lambda there: there, (video.read()[0] for _ in itertools.count())))
    finally:
        video.release()


def test_a_replay_gives_the_same_estimates_to_the_bit(driven: Path, cli, ticks: list[Tick]) -> None:
    """Poses, covariances, curves, points, crossings: each number as it was."""
    said = cli("replay", driven / "run.mcap", "--json")
    assert said.code == 0
    recorded = recorded_estimates(driven / "run.mcap")
    assert len(recorded) == 120
    assert [encode(tick.estimate) for tick in ticks] == recorded
    first = json.loads(recorded[60])
    assert len(first["pose"]["covariance"]) == 9
    assert {"left", "right", "centerline"} <= set(first)
    (row,) = said.rows
    assert list(row) == REPLAY_KEYS
    assert row["frames"] == row["tracking"] + row["one_line"] + row["coasting"] + row["lost"] == 120


@pytest.mark.parametrize("pipeline", ["contour", "windows", "centerline"])
def test_a_replay_of_jpeg_is_within_2_mm_while_the_car_drives(
    pipeline: str, tmp_path: Path, cli, ticks: list[Tick]
) -> None:
    """The recording holds the estimates of the drive itself, made from the frames as they were."""
    path = tmp_path / "run.mcap"
    drive = ("--track", "oval", "--pipeline", pipeline, "--duration", "2.5", "--record", path)
    assert cli("run", *drive).code == 0
    assert cli("replay", path).code == 0
    steps = [step for step in Recording(path).steps() if step.estimate is not None]
    assert len(ticks) == len(steps) == 150
    pairs = [
        (tick.estimate.pose, step.estimate.pose)
        for tick, step in zip(ticks, steps, strict=True)
        if step.estimate is not None and step.motion.speed_mps > 0.1
    ]
    differ_m = [abs(a.offset_m - b.offset_m) for a, b in pairs if a is not None and b is not None]
    assert len(differ_m) == len(pairs) > 60
    assert 0.0 < max(differ_m) <= 0.002


@pytest.mark.slow
def test_another_pipeline_setting_gives_other_estimates(driven: Path, tmp_path: Path, cli, ticks: list[Tick]) -> None:
    """The comparison above can fail."""
    car = tmp_path / "car.toml"
    car.write_text("[camera.extrinsics]\nz_m = 0.19\n")
    assert cli("replay", driven / "run.mcap", "--car", car).code == 0
    assert [encode(tick.estimate) for tick in ticks] != recorded_estimates(driven / "run.mcap")


def test_a_cut_recording_is_recovered_and_replays(driven: Path, tmp_path: Path, cli, ticks: list[Tick]) -> None:
    whole = (driven / "run.mcap").read_bytes()
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(whole[: int(0.7 * len(whole))])
    said = cli("recover", cut)
    assert (said.code, said.out) == (0, "")
    saved = tmp_path / "cut.recovered.mcap"
    assert said.line().startswith(f"{saved}: ")
    assert cli("replay", saved).code == 0
    recorded = recorded_estimates(driven / "run.mcap")
    assert 60 < len(ticks) < 120
    # the last frame's motion may lie behind the cut; every other one is whole
    assert [encode(tick.estimate) for tick in ticks][:-1] == recorded[: len(ticks) - 1]
    again = cli("recover", cut)
    assert (again.code, again.line()) == (
        2,
        f"automodel: {saved}: already exists; choose another name, or overwrite it with --force",
    )
    assert cli("recover", cut, "--force").code == 0


def test_csv_and_video_of_a_replay_and_of_an_export(driven: Path, tmp_path: Path, cli, ticks: list[Tick]) -> None:
    poses, video = tmp_path / "poses.csv", tmp_path / "overlay.mp4"
    assert cli("replay", driven / "run.mcap", "--csv", poses, "--video", video).code == 0
    assert poses.read_text().splitlines()[0] == POSES
    rows = rows_of(poses)
    assert len(rows) == pictures_of(video) == 120
    for row, tick in zip(rows, ticks, strict=True):
        assert row["status"] == tick.estimate.status.value
        pose = tick.estimate.pose
        assert row["offset_m"] == (f"{pose.offset_m:.6f}" if pose else "")
        assert row["crossing_distance_m"] == (
            f"{tick.estimate.crossing.distance_m:.6f}" if tick.estimate.crossing else ""
        )
    exported, video = tmp_path / "exported.csv", tmp_path / "exported.mp4"
    said = cli("export", driven / "run.mcap", "--csv", exported, "--video", video)
    assert (said.code, said.out) == (0, "")
    assert said.err.splitlines() == [f"{exported}: 120 rows", f"{video}: 120 frames"]
    assert pictures_of(video) == 120
    own = ("steering_rad", "latency_ms")  # what was sent while disarmed, and when, only the run itself knows
    for a, b in zip(rows_of(exported), rows, strict=True):
        assert {k: v for k, v in a.items() if k not in own} == {k: v for k, v in b.items() if k not in own}


def test_a_part_of_a_run_is_exported_but_for_foxglove(driven: Path, tmp_path: Path, cli) -> None:
    part, foxglove = tmp_path / "part.csv", tmp_path / "foxglove.mcap"
    said = cli("export", driven / "run.mcap", "--csv", part, "--from", 0.5, "--to", 1.0)
    assert said.code == 0, said.err
    assert len(rows_of(part)) == pytest.approx(31, abs=1)
    refused = cli("export", driven / "run.mcap", "--foxglove", foxglove, "--to", 1.0)
    assert (refused.code, foxglove.exists()) == (2, False)
    assert "--from and --to are for --csv and --video" in refused.line()


def test_pictures_with_motion_replay_as_the_recording_did(driven: Path, tmp_path: Path, cli) -> None:
    """The way of a user's own data: a folder of pictures, motion.csv beside it, --rate."""
    folder = tmp_path / "pictures"
    folder.mkdir()
    steps = list(Recording(driven / "run.mcap").steps())
    with open(tmp_path / "motion.csv", "w") as file:
        file.write("t_s,speed_mps,yaw_rate_radps\n")
        for number, step in enumerate(steps):
            assert isinstance(step.frame, Frame)
            cv2.imwrite(str(folder / f"{number}.png"), step.frame.image)
            file.write(f"{number / 60:.9f},{step.motion.speed_mps!r},{step.motion.yaw_rate_radps!r}\n")
    poses = tmp_path / "poses.csv"
    said = cli("replay", folder, "--motion", tmp_path / "motion.csv", "--rate", "60", "--csv", poses, "--json")
    assert (said.code, said.err) == (0, "")
    recorded = [step.estimate.pose.offset_m for step in steps if step.estimate and step.estimate.pose]
    replayed = [float(row["offset_m"]) for row in rows_of(poses) if row["offset_m"]]
    assert len(recorded) == len(replayed)
    np.testing.assert_allclose(replayed, recorded, atol=2e-4)


def test_several_pipelines_write_a_file_each(driven: Path, tmp_path: Path, cli) -> None:
    arguments = ["--pipeline", "windows", "--pipeline", "windows", "--csv", tmp_path / "poses.csv", "--json"]
    said = cli("replay", driven / "run.mcap", *arguments)
    assert [row["pipeline"] for row in said.rows] == ["windows", "windows"]
    assert (tmp_path / "poses.windows.csv").exists()
    assert not (tmp_path / "poses.csv").exists()


def test_a_replay_knows_no_actuator(driven: Path, tmp_path: Path) -> None:
    """Neither the link nor the serial library is as much as imported, whatever the car.toml of the recording says."""
    shutil.copy(driven / "run.mcap", tmp_path / "run.mcap")
    program = (
        "import sys\n"
        "class Refuse:\n"
        "    def find_spec(self, name, path=None, target=None):\n"
        "        if name.split('.')[0] in ('firmware_link', 'serial', 'can'):\n"
        "            raise AssertionError(f'a replay imports {name}')\n"
        "sys.meta_path.insert(0, Refuse())\n"
        "from automodel.cli.main import run\n"
        "for words in {commands}:\n"
        "    assert run(words.split()) == 0\n"
    )
    replay = "replay run.mcap --pipeline windows --csv a.csv --video a.mp4"
    done, refused = (
        subprocess.run(
            [sys.executable, "-c", program.replace("{commands}", repr(commands))],
            cwd=tmp_path,
            capture_output=True,
            text=True,
        )
        for commands in ((replay, "export run.mcap --csv b.csv"), ("run --duration 1",))
    )
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "a.csv").exists()
    assert "a replay imports firmware_link" in refused.stderr  # the trap works


def test_a_part_of_a_recording(driven: Path, tmp_path: Path, cli) -> None:
    table, film = tmp_path / "poses.csv", tmp_path / "part.webp"
    said = cli("replay", driven / "run.mcap", "--from", 0.5, "--to", 1.0, "--csv", table, "--video", film, "--json")
    assert said.rows[0]["frames"] == pytest.approx(31, abs=1)
    whole = list(Recording(driven / "run.mcap").steps())
    first, *_, last = rows_of(table)
    assert float(first["t_s"]) - whole[0].frame.t_ns * 1e-9 == pytest.approx(0.5, abs=0.02)
    assert float(last["t_s"]) - whole[0].frame.t_ns * 1e-9 == pytest.approx(1.0, abs=0.02)
    assert film.stat().st_size > 1000


def timeless(rows: list[dict[str, object]]) -> list[dict[str, object]]:
    """Rows without what differs from run to run."""
    return [{name: value for name, value in row.items() if name not in ("p50_ms", "p99_ms")} for row in rows]


@pytest.mark.parametrize("jobs", [1, 2])
def test_a_folder_of_recordings_gives_what_each_gives_alone(jobs: int, driven: Path, tmp_path: Path, cli) -> None:
    folder = tmp_path / "runs"
    folder.mkdir()
    names = ["run2.mcap", "run10.mcap"]
    for name in names:
        shutil.copy(driven / "run.mcap", folder / name)
    (folder / "notes.txt").write_text("not a recording")
    options = ["--pipeline", "windows", "--pipeline", "contour", "--to", "0.5", "--json"]
    said = cli("replay", folder, *options, "--csv", tmp_path / "poses.csv", "--jobs", jobs, "--keep", tmp_path / "kept")
    assert (said.code, said.err) == (0, "")
    alone = [cli("replay", folder / name, *options).rows for name in names]
    assert timeless(said.rows) == timeless([*alone[0], *alone[1]])
    written = {f"poses.{stem}.{pipeline}.csv" for stem in ("run2", "run10") for pipeline in ("windows", "contour")}
    assert {path.name for path in tmp_path.glob("*.csv")} == written
    again = cli("replay", folder, *options, "--csv", tmp_path / "poses.csv", "--keep", tmp_path / "kept")
    assert again.rows == said.rows  # the times, too: nothing was replayed


def test_a_recording_that_cannot_be_read_costs_only_itself(driven: Path, tmp_path: Path, cli) -> None:
    cut = tmp_path / "cut.mcap"
    cut.write_bytes((driven / "run.mcap").read_bytes()[:5000])
    said = cli("replay", cut, driven / "run.mcap", "--pipeline", "contour", "--to", "0.2", "--jobs", "1", "--json")
    assert said.code == 2
    assert said.line() == f"{cut}: the file is cut; run: automodel recover {cut}"
    assert [row["source"] for row in said.rows] == [str(driven / "run.mcap")]


@pytest.mark.parametrize(
    ("arguments", "why"),
    [
        (("a.mcap", "b.mcap", "--guess"), "--guess, --can and --motion are for one SOURCE"),
        (("a.mcap", "b.mcap", "--motion", "m.csv"), "--guess, --can and --motion are for one SOURCE"),
        (("a/run.mcap", "b/run.mcap", "--csv", "p.csv"), "several sources are called 'run'"),
        (("a.mcap", "v.a.mp4", "--video", "v.mp4"), "v.a.mp4: is one of the sources"),
    ],
)
def test_what_several_sources_cannot_share_is_one_line(
    arguments: tuple[str, ...], why: str, tmp_path: Path, cli, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    said = cli("replay", *arguments)
    assert said.code == 2
    assert why in said.line()
    assert not list(tmp_path.iterdir())

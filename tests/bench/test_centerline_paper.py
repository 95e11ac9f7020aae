"""Table I of seed 001: figures that were put in come out beside the paper's; what is driven, seen and counted."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from automodel.bench import centerline_paper
from automodel.bench.accuracy import AccuracyMeter, TruePose
from automodel.bench.centerline_paper import (
    PAPER,
    RIDES,
    Ride,
    Wanted,
    believed,
    circuit,
    cost_rows,
    drive,
    full_scale_car,
    ride_row,
    rides,
    show_tables,
    times,
)
from automodel.cli.bench import command
from automodel.config import CarConfig, ConfigError, PipelineConfig
from automodel.curves import line
from automodel.geometry import GroundCamera
from automodel.signals import Frame, LaneEstimate, LaneLine, LanePose, LaneStatus, Motion, MotionSource
from automodel.sim.trajectory import CircuitDrive

CAR = full_scale_car(PipelineConfig())
TABLE = ["accuracy", "--table", "centerline-paper"]
ROAD = line(0.0, 0.0, 0.0, 1.0)


def estimate(t_ns: int, offset_m: float, heading_rad: float) -> LaneEstimate:
    edge = LaneLine(curve=ROAD, points_m=np.empty((0, 2)), seen=False)
    pose = LanePose(offset_m=offset_m, heading_rad=heading_rad, width_m=10.0, curvature_per_m=0.0, covariance=np.eye(3))
    return LaneEstimate(t_ns=t_ns, status=LaneStatus.TRACKING, left=edge, right=edge, centerline=ROAD, pose=pose)


class Believer:
    """A pipeline that goes by odometry alone, and remembers what it was given."""

    name = "believer"
    made: list[Believer] = []  # noqa: RUF012

    def __init__(self, name: str, car: CarConfig) -> None:
        self.heading_rad, self.resets, self.seen = 0.0, 0, list[tuple[Frame, Motion]]()
        Believer.made.append(self)

    def reset(self) -> None:
        self.heading_rad, self.resets = 0.0, self.resets + 1

    def step(self, frame: Frame, motion: Motion) -> LaneEstimate:
        self.seen.append((frame, motion))
        self.heading_rad += motion.yaw_rate_radps / CAR.camera.rate_hz
        return estimate(frame.t_ns, 0.0, self.heading_rad)


def ride(style: str = "oscillating", stretches: int | None = 2, light: str = "dry") -> Ride:
    return Ride(letter="A", file="circuit", style=style, light=light, seed=1, stretches=stretches)


@pytest.fixture
def short(monkeypatch: pytest.MonkeyPatch) -> None:
    """Stretches of 0.2 s after 0.1 s, and no pipeline but the believer."""
    monkeypatch.setattr(centerline_paper, "STRETCH_S", 0.2)
    monkeypatch.setattr(centerline_paper, "RUN_IN_S", 0.1)
    monkeypatch.setattr(centerline_paper, "make_pipeline", Believer)
    Believer.made.clear()


def test_the_camera_is_the_papers() -> None:
    camera = CAR.camera
    assert (camera.width_px, camera.height_px, camera.rate_hz) == (672, 376, 100.0)
    eye = GroundCamera.from_config(camera)
    across = math.degrees(2.0 * math.atan(0.5 * camera.width_px / camera.intrinsics.fx_px))
    assert 85.0 < across < 90.0
    assert 3.0 < eye.first_visible_x_m() < 5.0  # just over the bonnet
    assert full_scale_car(PipelineConfig(name="windows")).pipeline.name == "windows"


def test_rows_stand_beside_the_papers() -> None:
    meter = AccuracyMeter()
    for error in (0.1, -0.3):
        true = TruePose(offset_m=1.0, heading_rad=0.2, width_m=10.0)
        meter.add(0.0, estimate(0, 1.0 + error, 0.2 + math.radians(error)), true)
    meter.add(0.0, LaneEstimate(t_ns=0, status=LaneStatus.LOST), true)
    row = ride_row(("B", "racing", "wet"), ("windows", "encoder"), meter)
    assert (row["track"], row["style"], row["light"]) == ("B", "racing", "wet")
    assert (row["pipeline"], row["odometry"], row["frames"]) == ("windows", "encoder", 3)
    assert row["heading_mae_deg"] == pytest.approx(0.2)
    assert row["offset_mae_m"] == pytest.approx(0.2)
    assert row["offset_mae_pct"] == pytest.approx(2.0)
    assert row["availability_pct"] == pytest.approx(100.0 * 2 / 3)
    assert row["false_lane_pct"] == 0.0
    papers = [row[f"paper_{name}"] for name in ("heading_mae_deg", "offset_mae_m", "availability_pct")]
    assert papers == [3.120, 0.581, 95.92]
    ours_alone = ride_row(("A", "racing", "dry"), ("windows", "none"), AccuracyMeter())
    assert ours_alone["paper_offset_mae_m"] is None
    assert ours_alone["heading_mae_deg"] is None
    assert list(ours_alone) == list(row)


def test_the_papers_table_is_there_and_two_rides_more() -> None:
    assert len(PAPER) == 4
    assert list(PAPER) == list(RIDES[:4])
    assert {*RIDES} == {(track, style) for track in "AB" for style in ("centred", "oscillating", "racing")}


def test_costs_stand_side_by_side() -> None:
    rows = []
    for light, errors in (("dry", (0.1, 0.5)), ("wet", (0.2, 0.8))):
        for odometry, error in zip(("encoder", "command"), errors, strict=True):
            meter = AccuracyMeter()
            meter.add(0.0, estimate(0, error, 0.0), TruePose(offset_m=0.0, heading_rad=0.0, width_m=10.0))
            rows.append(ride_row(("A", "centred", light), ("windows", odometry), meter))
    dry, wet = cost_rows(rows)
    assert (dry["light"], wet["light"]) == ("dry", "wet")
    assert (dry["encoder_offset_mae_m"], dry["command_offset_mae_m"]) == pytest.approx((0.1, 0.5))
    assert (wet["encoder_offset_mae_m"], wet["command_offset_mae_m"]) == pytest.approx((0.2, 0.8))
    assert list(dry)[4:6] == ["encoder_heading_mae_deg", "command_heading_mae_deg"]


def test_a_stretch_is_short_in_way_and_time() -> None:
    lane = circuit("circuit", 0).lane()
    for style in ("centred", "oscillating"):
        way = CircuitDrive(lane, style, 1.8)
        spans = list(times(way, ride(style, 6)))
        assert len(spans) == 6
        for begin, end in spans:
            first, last = way.poses([begin, end])
            s = [lane.centerline.project((p.x_m, p.y_m))[0] for p in (first, last)]
            assert 5.0 < end - begin <= 10.0
            assert 40.0 < (s[1] - s[0]) % 1500.0 < 151.0
        assert max(end - begin for begin, end in spans) == pytest.approx(10.0, abs=0.2)
    assert list(times(way, ride("oscillating", None))) == [(0.0, way.lap_s)]


def test_what_the_car_believes_depends_on_its_odometry() -> None:
    way = CircuitDrive(circuit("circuit", 0).lane(), "racing", 1.8)
    t_s = way.time_at(1070.0) - 2.0 + np.arange(300) / 100.0  # braking for the tightest corner
    told = {name: list(believed(way, CAR, name, 5, t_s)) for name in ("encoder", "command", "none")}
    for motions in told.values():
        assert [m.t_ns for m in motions] == [10_000_000 * k for k in range(300)]
    sources = [motions[0].source for motions in told.values()]
    assert sources == [MotionSource.MEASURED, MotionSource.COMMAND, MotionSource.NONE]
    truly = np.array([p.speed_mps for p in way.poses(t_s - 0.005)])
    later = np.array([p.speed_mps for p in way.poses(t_s - 0.005 + 0.2)])
    measured, commanded = (np.array([m.speed_mps for m in told[name]]) for name in ("encoder", "command"))
    assert np.ptp(measured / truly) < 1e-9
    assert np.ptp(commanded / later) < 1e-9
    assert np.ptp(commanded / truly) > 0.01
    assert not any(m.known for m in told["none"])


@pytest.mark.usefixtures("short")
def test_every_seer_sees_the_same_frames_and_the_run_in_is_not_counted() -> None:
    seers = (("believer", "encoder"), ("believer", "command"), ("believer", "none"))
    meters = drive(CAR, seers, ride())
    assert [len(meter.t_s) for meter in meters] == [40, 40, 40]  # of 60
    first = Believer.made[0]
    assert first.resets == 2
    assert [frame.index for frame, _ in first.seen] == [*range(30), *range(30)]
    assert first.seen[7][0].t_ns == 70_000_000
    assert first.seen[0][0].image.shape == (376, 672)
    for other in Believer.made[1:]:
        assert all(a[0] is b[0] for a, b in zip(first.seen, other.seen, strict=True))
    assert meters[0].true == meters[1].true == meters[2].true
    assert meters[0].estimated != meters[1].estimated != meters[2].estimated
    assert np.diff(meters[0].t_s) == pytest.approx(np.full(39, 0.01))
    again = drive(CAR, seers, ride())
    assert [meter.estimated for meter in again] == [meter.estimated for meter in meters]


@pytest.mark.usefixtures("short")
def test_rain_is_driven_as_sun_is_and_looks_otherwise() -> None:
    dry, wet = (drive(CAR, (("believer", "encoder"),), ride("centred", 1, light))[0] for light in ("dry", "wet"))
    assert dry.true == wet.true
    pictures = [made.seen[0][0].image.astype(float) for made in Believer.made]
    assert pictures[0][188:].mean() > pictures[1][188:].mean() + 10.0


@pytest.mark.usefixtures("short")
def test_both_tables_as_json_and_the_plot(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    wanted = Wanted(tracks=("A",), styles=("racing",), lights=("wet",), stretches=1)
    seers = [("believer", "encoder"), ("believer", "command")]
    show_tables(CarConfig(), seers, wanted, 1, tmp_path / "plot.png", True)
    said = capsys.readouterr()
    rows = json.loads(said.out)["rows"]
    assert [row["table"] for row in rows] == ["rides", "rides", "odometry"]
    assert len({tuple(row) for row in rows}) == 1
    assert (rows[0]["track"], rows[0]["style"], rows[0]["light"], rows[0]["frames"]) == ("A", "racing", "wet", 20)
    assert rows[2]["command_heading_mae_deg"] == rows[1]["heading_mae_deg"] != rows[0]["heading_mae_deg"]
    assert "track A: circuit, 1500 m, 9.0 to 12.0 m wide" in said.err
    assert "1 stretch a ride" in said.err
    assert (tmp_path / "plot.png").read_bytes().startswith(b"\x89PNG")
    show_tables(CarConfig(), seers[:1], wanted, 1, None, False)
    assert "paper_offset_mae_m" in capsys.readouterr().out


def test_without_monza_its_rides_are_left_out_and_it_is_said(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("AUTOMODEL_DATA", str(tmp_path))
    assert {ride.letter for ride in rides(Wanted())} == {"A"}
    assert capsys.readouterr().err.startswith("track B is left out: there is no racetracks/Monza.csv")
    with pytest.raises(ConfigError, match="no drive is left"):
        rides(Wanted(tracks=("B",)))
    (tmp_path / "racetracks").mkdir()
    (tmp_path / "racetracks" / "Monza.csv").write_text("")
    capsys.readouterr()
    chosen = rides(Wanted(seed=4, stretches=None))
    assert capsys.readouterr().err == ""
    assert [(ride.letter, ride.style) for ride in chosen[::2]] == list(RIDES)
    assert [ride.light for ride in chosen] == ["dry", "wet"] * 6
    assert {(ride.seed, ride.stretches) for ride in chosen} == {(4, None)}
    one = rides(Wanted(tracks=("B",), styles=("racing",), lights=("wet",), monza=Path("my.csv")))
    assert [(ride.file, ride.style, ride.light) for ride in one] == [("my.csv", "racing", "wet")]


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ([*TABLE, "--speed", "3"], "--table has its own drives: leave out --speed"),
        ([*TABLE, "--look", "clean"], "--table has its own drives: leave out --look"),
        ([*TABLE, "--direction", "reverse"], "--table has its own drives: leave out --direction"),
        ([*TABLE, "--seeds", "2"], "--table has its own drives: leave out --seeds"),
        ([*TABLE, "--full", "--stretches", "3"], "--full drives whole laps: leave out --stretches"),
        ([*TABLE, "--track", "tmr"], "--track tmr: this table has circuit and Monza"),
        (["accuracy", "--full"], "--full is for --table centerline-paper alone"),
        (["accuracy", "--table", "windows-paper", "--light", "dry"], "--light is for --table centerline-paper alone"),
    ],
)
def test_options_that_do_not_go_together(arguments: list[str], words: str) -> None:
    said = CliRunner().invoke(command, arguments)
    assert said.exit_code == 2
    assert words in said.output


def test_a_track_for_toys_is_refused(tmp_path: Path) -> None:
    angle = np.arange(60) / 60 * math.tau
    path = tmp_path / "toy.csv"
    path.write_text("\n".join(f"{3 * math.cos(a):.6f},{3 * math.sin(a):.6f},0.2,0.2" for a in angle))
    with pytest.raises(ConfigError, match=r"toy\.csv: 19 m long and 0\.4 m wide at its narrowest; a circuit"):
        show_tables(CarConfig(), [("windows", "encoder")], Wanted(tracks=("B",), monza=path), 1, None, True)


@pytest.mark.slow
@pytest.mark.realdata
def test_a_real_pipeline_on_both_tracks(
    data_root: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(centerline_paper, "STRETCH_S", 1.5)
    monza = data_root / "racetracks" / "Monza.csv"
    wanted = Wanted(styles=("centred",), lights=("dry",), monza=monza, stretches=2)
    show_tables(CarConfig(), [("windows", "encoder")], wanted, 1, None, True)
    rows = json.loads(capsys.readouterr().out)["rows"]
    assert [(row["track"], row["paper_heading_mae_deg"]) for row in rows] == [("A", 2.892), ("B", 1.642)]
    assert all(row["frames"] == 300 for row in rows)
    assert all(row["availability_pct"] > 50.0 for row in rows)
    assert all(row["offset_mae_pct"] < 5.0 for row in rows)

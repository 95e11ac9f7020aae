"""Table I of Cudrano et al. 2020: metrics beside the paper's; what is driven, seen and counted."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from automodel.bench import centerline_paper
from automodel.bench.accuracy import AccuracyMeter, Choice
from automodel.bench.centerline_paper import (
    PAPER,
    RIDES,
    CircuitChoice,
    Ride,
    circuit,
    cost_rows,
    full_scale_car,
    measure,
    measure_ride,
    motions,
    ride_row,
    rides,
    spans_s,
)
from automodel.config import CarConfig, ConfigError, PipelineConfig
from automodel.console.workers import Sweep
from automodel.curves import line
from automodel.geometry import GroundCamera
from automodel.signals import Frame, LaneEstimate, LaneLine, LanePose, LaneStatus, Motion, MotionSource
from automodel.sim.trajectory import CircuitDrive
from automodel.sim.truth import Truth
from tests.support.command_line import Cli, cli

__all__ = ["cli"]

CAR = full_scale_car(PipelineConfig())
TABLE = ["bench", "accuracy", "--table", "centerline-paper"]
ROAD = line(0.0, 0.0, 0.0, 1.0)


def estimate(t_ns: int, offset_m: float, heading_rad: float) -> LaneEstimate:
    edge = LaneLine(curve=ROAD, points_m=np.empty((0, 2)), seen=False)
    pose = LanePose(offset_m=offset_m, heading_rad=heading_rad, width_m=10.0, curvature_per_m=0.0, covariance=np.eye(3))
    return LaneEstimate(t_ns=t_ns, status=LaneStatus.TRACKING, left=edge, right=edge, centerline=ROAD, pose=pose)


def truth(offset_m: float, heading_rad: float) -> Truth:
    return Truth(offset_m=offset_m, heading_rad=heading_rad, width_m=10.0, curvature_per_m=0.0, s_m=0.0, lap=0)


def no_tick(share: float) -> None:
    """Nobody watches the progress."""


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
        true = truth(1.0, 0.2)
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
            meter.add(0.0, estimate(0, error, 0.0), truth(0.0, 0.0))
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
        spans = list(spans_s(way, ride(style, 6)))
        assert len(spans) == 6
        for begin, end in spans:
            first, last = way.poses([begin, end])
            s = [lane.centerline.project((p.x_m, p.y_m))[0] for p in (first, last)]
            assert 5.0 < end - begin <= 10.0 + 1e-9  # rounding: times count from the lap's start
            assert 40.0 < (s[1] - s[0]) % 1500.0 < 151.0
        assert max(end - begin for begin, end in spans) == pytest.approx(10.0, abs=0.2)
    assert list(spans_s(way, ride("oscillating", None))) == [(0.0, way.lap_s)]


def test_what_the_car_believes_depends_on_its_odometry() -> None:
    way = CircuitDrive(circuit("circuit", 0).lane(), "racing", 1.8)
    t_s = way.time_at(1070.0) - 2.0 + np.arange(300) / 100.0  # braking for the tightest corner
    told = {name: list(motions(way, CAR, name, 5, t_s)) for name in ("encoder", "command", "none")}
    for moved in told.values():
        assert [m.t_ns for m in moved] == [10_000_000 * k for k in range(300)]
    sources = [moved[0].source for moved in told.values()]
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
    meters = measure_ride(CAR, seers, ride(), no_tick)
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
    again = measure_ride(CAR, seers, ride(), no_tick)
    assert [meter.estimated for meter in again] == [meter.estimated for meter in meters]


@pytest.mark.usefixtures("short")
def test_rain_is_driven_as_sun_is_and_looks_otherwise() -> None:
    seers = (("believer", "encoder"),)
    dry, wet = (measure_ride(CAR, seers, ride("centred", 1, light), no_tick)[0] for light in ("dry", "wet"))
    assert dry.true == wet.true
    pictures = [made.seen[0][0].image.astype(float) for made in Believer.made]
    assert pictures[0][188:].mean() > pictures[1][188:].mean() + 10.0


@pytest.mark.usefixtures("short")
def test_both_tables_and_the_plot(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    choice = Choice(pipelines=("believer",), tracks=("circuit",), styles=("racing",))
    circuits = CircuitChoice(lights=("wet",), odometries=("encoder", "command"), stretches=1)
    tables = measure(CarConfig(), choice, circuits, Sweep(jobs=1), tmp_path / "plot.png")
    encoder, command = tables["rides"]
    assert (encoder["track"], encoder["style"], encoder["light"], encoder["frames"]) == ("A", "racing", "wet", 20)
    (costs,) = tables["odometry"]
    assert costs["command_heading_mae_deg"] == command["heading_mae_deg"] != encoder["heading_mae_deg"]
    said = capsys.readouterr().err
    assert "track A: circuit, 1500 m, 9.0 to 12.0 m wide" in said
    assert "1 stretch a ride" in said
    assert (tmp_path / "plot.png").read_bytes().startswith(b"\x89PNG")
    alone = CircuitChoice(lights=("wet",), stretches=1)
    assert measure(CarConfig(), choice, alone, Sweep(jobs=1), None) == {"rides": [encoder], "odometry": []}


def test_without_monza_its_rides_are_left_out_and_it_is_said(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("AUTOMODEL_DATA", str(tmp_path))
    assert {ride.letter for ride in rides(Choice(), CircuitChoice())} == {"A"}
    assert capsys.readouterr().err.startswith("track B is left out: there is no racetracks/Monza.csv")
    with pytest.raises(ConfigError, match="no drive is left"):
        rides(Choice(tracks=("B",)), CircuitChoice())
    (tmp_path / "racetracks").mkdir()
    (tmp_path / "racetracks" / "Monza.csv").write_text("")
    capsys.readouterr()
    chosen = rides(Choice(seeds=range(4, 5)), CircuitChoice(stretches=None))
    assert capsys.readouterr().err == ""
    assert [(ride.letter, ride.style) for ride in chosen[::2]] == list(RIDES)
    assert [ride.light for ride in chosen] == ["dry", "wet"] * 6
    assert {(ride.seed, ride.stretches) for ride in chosen} == {(4, None)}
    circuits = CircuitChoice(lights=("wet",), monza=Path("my.csv"))
    one = rides(Choice(tracks=("monza",), styles=("racing",)), circuits)
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
        (["bench", "accuracy", "--full"], "--full is for --table centerline-paper alone"),
        (
            ["bench", "accuracy", "--table", "windows-paper", "--light", "dry"],
            "--light is for --table centerline-paper alone",
        ),
    ],
)
def test_options_that_do_not_go_together(cli: Cli, arguments: list[str], words: str) -> None:
    said = cli(*arguments)
    assert said.code == 2
    assert words in said.line()


def test_a_track_for_toys_is_refused(tmp_path: Path) -> None:
    angle = np.arange(60) / 60 * math.tau
    path = tmp_path / "toy.csv"
    path.write_text("\n".join(f"{3 * math.cos(a):.6f},{3 * math.sin(a):.6f},0.2,0.2" for a in angle))
    with pytest.raises(ConfigError, match=r"toy\.csv: expected a circuit of .*; got 19 m, 0\.4 m wide"):
        measure(CarConfig(), Choice(tracks=("B",)), CircuitChoice(monza=path), Sweep(jobs=1), None)


@pytest.mark.slow
@pytest.mark.realdata
def test_a_real_pipeline_on_both_tracks(data_root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(centerline_paper, "STRETCH_S", 1.5)
    circuits = CircuitChoice(lights=("dry",), monza=data_root / "racetracks" / "Monza.csv", stretches=2)
    rows = measure(CarConfig(), Choice(pipelines=("windows",), styles=("centred",)), circuits, Sweep(jobs=1), None)[
        "rides"
    ]
    assert [(row["track"], row["paper_heading_mae_deg"]) for row in rows] == [("A", 2.892), ("B", 1.642)]
    assert all(row["frames"] == 300 for row in rows)
    assert all(row["availability_pct"] > 50.0 for row in rows)
    assert all(row["offset_mae_pct"] < 5.0 for row in rows)

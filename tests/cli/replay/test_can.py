"""`automodel replay --can`: a recorded bus becomes motion.csv, and says what is wrong with it."""

from __future__ import annotations

import csv
import math
from pathlib import Path

import can
import numpy as np
import pytest

from automodel.assembly.can_parts import can_functions
from automodel.assembly.can_replay import read_log
from automodel.config import load_car
from firmware_link.can_receiver import CanReceiver, Verdict, load_dbc
from tests.support.can_logs import candump

CARS = Path(__file__).resolve().parents[2] / "cars"
TOYOTA = ("WHEEL_SPEEDS", "STEER_ANGLE_SENSOR", "KINEMATICS", "SPEED", "STEER_TORQUE_SENSOR", "BRAKE_MODULE")


@pytest.fixture
def mapping(tmp_path: Path) -> Path:
    path = tmp_path / "car.toml"
    path.write_text('[link]\nkind = "arduino"\n')  # the default mapping is that of automodel.dbc
    return path


def rows_of(path: Path) -> np.ndarray:
    with open(path, newline="") as file:
        header, *rows = csv.reader(file)
    assert header == ["t_s", "speed_mps", "yaw_rate_radps"]
    return np.array(rows, dtype=float)


def test_our_own_bus_becomes_a_motion(cli, tmp_path: Path, mapping: Path) -> None:
    log, out = candump(tmp_path / "bus.log", 2.0), tmp_path / "motion.csv"
    said = cli("replay", "--can", log, "--mapping", mapping, "--motion-csv", out, "--json")
    assert said.code == 0
    bus, *messages = said.rows
    assert (bus["frames"], bus["supervised"], bus["alarms"], bus["motion_rows"]) == (400, 400, 0, 200)
    assert [row["good"] for row in messages] == [200, 100, 100]
    motion = rows_of(out)
    assert motion[:, 0] == pytest.approx(np.arange(200) * 0.01)
    assert motion[:, 1] == pytest.approx(15.0, abs=0.003)
    assert motion[:, 2] == pytest.approx(0.1, abs=1e-4)


def test_what_is_wrong_is_counted_and_not_used(cli, tmp_path: Path, mapping: Path) -> None:
    def damage(name: str, index: int, data: bytes) -> bytes | None:
        if name != "AM_STATE" or not 50 <= index < 60:
            return data
        return bytes((data[0] ^ 0xFF, *data[1:]))

    log, out = candump(tmp_path / "bus.log", 2.0, damage), tmp_path / "motion.csv"
    said = cli("replay", "--can", log, "--mapping", mapping, "--motion-csv", out, "--json")
    bus, state, *_ = said.rows
    assert (bus["alarms"], state["checksum"], state["alarms"], state["timeouts"]) == (1, 10, 1, 1)
    times_s = rows_of(out)[:, 0]
    assert not np.any((times_s > 0.495) & (times_s < 0.65))


def test_beside_a_video_the_bus_tells_the_motion(cli, tmp_path: Path, mapping: Path) -> None:
    images = tmp_path / "images"
    images.mkdir()
    import cv2

    for index in range(3):
        cv2.imwrite(str(images / f"{index}.png"), np.full((360, 640), 90, np.uint8))
    log, out = candump(tmp_path / "bus.log", 1.0), tmp_path / "motion.csv"
    said = cli("replay", images, "--can", log, "--mapping", mapping, "--motion-csv", out, "--json")
    assert said.code == 0
    assert said.rows[0]["frames"] == 3
    assert len(rows_of(out)) == 100


@pytest.mark.parametrize(
    ("log", "text"),
    [
        (None, "no such file"),
        ("", "no motion in 0 frames"),
        ("(0.0) can0 123\n", "not a CAN log"),
        ("(nan) can0 123#00\n(nan) can0 123#00\n", "not a CAN log"),
        ("nonsense\n", "not a CAN log"),
        ("(0.0) can0 123#0011\n", "no motion in 1 frames, 0 of them of mapped messages"),
        (b"\xff\xfe\x00\x01", "not a CAN log"),
    ],
)
def test_a_log_that_is_none_is_one_line(cli, tmp_path: Path, mapping: Path, log: str | bytes | None, text: str) -> None:
    path, out = tmp_path / "bus.log", tmp_path / "motion.csv"
    if log is not None:
        path.write_bytes(log if isinstance(log, bytes) else log.encode())
    said = cli("replay", "--can", path, "--mapping", mapping, "--motion-csv", out)
    assert (said.code, said.out) == (2, "")
    assert len(said.err.splitlines()) == 1
    assert text in said.err
    assert not out.exists()


@pytest.mark.parametrize("kind", ["blf", "trc"])
def test_a_damaged_log_of_another_kind_is_one_line(cli, tmp_path: Path, mapping: Path, kind: str) -> None:
    """Their readers raise errors of their own, of the packing, or print each line that they cannot read."""
    import can

    path, out = tmp_path / f"bus.{kind}", tmp_path / "motion.csv"
    with can.LogReader(candump(tmp_path / "bus.log", 0.3)) as frames, can.Logger(path) as log:
        for frame in frames:
            log(frame)
    data = path.read_bytes()
    for at in range(150, len(data), len(data) // 6):
        path.write_bytes(data[:at] + b"\xff\xff" + data[at + 2 :])
        said = cli("replay", "--can", path, "--mapping", mapping, "--motion-csv", out)
        assert said.code in (0, 2)
        if said.code == 2:
            assert len(said.err.splitlines()) == 1


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (("--can", "{log}"), "--can needs --mapping"),
        (("--dbc", "x.dbc"), "SOURCE is missing"),
        (("{log}", "--dbc", "x.dbc"), "belong to --can"),
        (("--can", "{log}", "--mapping", "{mapping}", "--dbc", "{log}"), "not a DBC file"),
        (("--can", "{log}", "--mapping", "{mapping}", "--dbc", "{folder}"), "cannot be read: Is a directory"),
        (("--can", "{folder}", "--mapping", "{mapping}"), "is not a regular file"),
        (("--can", "{log}", "--mapping", "{mapping}", "--motion-csv", "{log}"), "is the same file as --can"),
        (("{log}", "--can", "{log}", "--mapping", "{mapping}", "--motion", "{log}"), "both tell the motion"),
    ],
)
def test_wrong_arguments_are_one_line(cli, tmp_path: Path, mapping: Path, arguments, text: str) -> None:
    names = {"log": candump(tmp_path / "bus.log", 0.1), "mapping": mapping, "folder": tmp_path}
    said = cli("replay", *(argument.format(**names) for argument in arguments))
    assert said.code == 2
    assert text in said.err
    assert len(said.err.splitlines()) == 1


def toyota_dbc(data_root: Path) -> tuple[Path, Path]:
    folder = data_root / "comma2k19"
    return folder / "toyota_new_mc_pt.dbc", folder / "_toyota_2017.dbc"


@pytest.mark.realdata
def test_a_real_bus_raises_no_false_alarm(cli, data_root: Path, tmp_path: Path) -> None:
    """40 s of a Toyota RAV4: every frame is read, every supervised one is good."""
    first, second = toyota_dbc(data_root)
    log, car, out = data_root / "comma2k19" / "rav4_40s.candump.log", CARS / "rav4_2017.toml", tmp_path / "motion.csv"
    said = cli("replay", "--can", log, "--dbc", first, "--dbc", second, "--mapping", car, "--motion-csv", out, "--json")
    assert said.code == 0
    bus, *messages = said.rows
    assert bus["frames"] == 35_874
    assert tuple(row["message"] for row in messages) == TOYOTA
    assert all(row["good"] == row["frames"] > 1600 for row in messages)
    assert bus["alarms"] == 0
    shipped = np.loadtxt(data_root / "comma2k19" / "speed.csv", delimiter=",", skiprows=1)
    motion = rows_of(out)
    assert np.interp(motion[:, 0], *shipped.T) == pytest.approx(motion[:, 1], abs=6e-5)  # shipped with 6 digits
    gyro = np.loadtxt(data_root / "comma2k19" / "gyro.csv", delimiter=",", skiprows=1)
    error = motion[:, 2] + np.interp(motion[:, 0], gyro[:, 0], gyro[:, 3])  # the recorder's z axis points down
    assert np.std(error) < 0.01


@pytest.mark.realdata
def test_a_real_steering_angle_equals_the_shipped_one(data_root: Path) -> None:
    config = load_car(CARS / "rav4_2017.toml").link.can
    receiver = CanReceiver(load_dbc(toyota_dbc(data_root)), config, can_functions(config))
    decoded = []
    for frame in read_log(data_root / "comma2k19" / "rav4_40s.candump.log"):
        if receiver.take(frame) is Verdict.GOOD and frame.frame_id == 0x25:
            angle = receiver.snapshot(frame.t_ns).values["steering_rad"] * config.steering_ratio
            decoded.append((frame.t_ns * 1e-9, math.degrees(angle)))
    shipped = np.loadtxt(data_root / "comma2k19" / "steering_angle.csv", delimiter=",", skiprows=1)
    table = np.array(decoded)
    near = np.searchsorted(table[:, 0], shipped[:, 0] - 5e-7)
    inside = near < len(table)
    assert np.mean(inside) > 0.99
    assert table[near[inside], 1] == pytest.approx(shipped[inside, 1], abs=1e-6)


def recorded_frames() -> list[can.Message]:
    """Standard and extended frames of every length, an error frame and a remote frame among them."""
    start_s = 1_700_000_000.0
    frames = [
        can.Message(
            timestamp=start_s + 0.01 * index,
            arbitration_id=0x18DAF110 + index if index % 3 == 0 else 0x100 + index,
            is_extended_id=index % 3 == 0,
            data=bytes((37 * index + byte) % 256 for byte in range(index % 9)),
            channel=0,
            is_rx=True,
        )
        for index in range(60)
    ]
    remote = can.Message(
        timestamp=start_s + 0.601, arbitration_id=0x123, is_extended_id=False, is_remote_frame=True, dlc=4
    )
    last = can.Message(
        timestamp=start_s + 0.61, arbitration_id=0x7FF, is_extended_id=False, data=b"\xff" * 8, channel=0
    )
    return [*frames, remote, last]


@pytest.mark.parametrize("kind", ["log", "blf", "asc", "trc", "csv", "db", "mf4"])
def test_a_log_of_every_kind_gives_the_frames_that_were_written(tmp_path: Path, kind: str) -> None:
    if kind == "mf4":
        pytest.importorskip("asammdf")
    path, sent = tmp_path / f"bus.{kind}", recorded_frames()
    with can.Logger(path) as logger:
        for message in sent:
            logger(message)
    frames = list(read_log(path))
    expected = [message for message in sent if not message.is_remote_frame]
    assert [(f.frame_id, f.extended, f.data) for f in frames] == [
        (m.arbitration_id, m.is_extended_id, bytes(m.data)) for m in expected
    ]
    times_s = np.array([message.timestamp for message in expected]) - sent[0].timestamp
    assert np.array([frame.t_ns for frame in frames]) * 1e-9 == pytest.approx(times_s, abs=1e-3)


@pytest.mark.parametrize("kind", ["blf", "asc", "trc"])
def test_our_own_bus_in_a_log_of_another_kind_is_the_same_motion(cli, tmp_path: Path, mapping: Path, kind: str) -> None:
    log = candump(tmp_path / "bus.log", 1.0)
    other = tmp_path / f"bus.{kind}"
    with can.LogReader(log) as reader, can.Logger(other) as logger:
        for message in reader:
            message.channel = 0
            logger(message)
    motions = []
    for path in (log, other):
        out = tmp_path / "motion.csv"
        said = cli("replay", "--can", path, "--mapping", mapping, "--motion-csv", out, "--json")
        assert (said.code, said.rows[0]["alarms"]) == (0, 0)
        motions.append(rows_of(out))
    assert motions[1] == pytest.approx(motions[0], abs=1e-3)

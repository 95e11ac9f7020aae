"""`run` with a real car's devices: the camera is a stand-in, the serial port and its bytes are real."""

from __future__ import annotations

import os
import signal
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from automodel.assembly import drive
from automodel.console.messages import EventPrinter
from automodel.recording.reader import Recording
from automodel.signals import Command, Event
from firmware_link import arduino
from firmware_link.emulator.board import EmulatedArduino
from firmware_link.emulator.logic import BoardOptions
from firmware_link.emulator.pty import BenchPeripherals, PtyBoard
from tests.support.fake_cars import StillCamera, car_toml, road

pytestmark = pytest.mark.realtime
PATIENCE_TURNS = 3000  # of the loop, at most 20 ms each: a test that hangs ends


@pytest.fixture
def port() -> Iterator[PtyBoard]:
    with PtyBoard(EmulatedArduino(BenchPeripherals(), 115200)) as board:
        yield board


@pytest.fixture
def camera(monkeypatch: pytest.MonkeyPatch) -> None:
    image = road()
    monkeypatch.setattr(drive, "make_camera", lambda car: StillCamera(image))


class Person:
    """Stands beside the car: `script` is called every turn with the kinds of the events so far, and may press Enter."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, script: Callable[[list[str]], bool]) -> None:
        self.events: list[Event] = []
        self._script, self._turns = script, 0
        person = self

        class Key:
            def __enter__(self) -> Key:
                return self

            def __exit__(self, *error: object) -> None:
                pass

            pressed = person.pressed

        tell = EventPrinter.__call__

        def note(teller: EventPrinter, event: Event) -> None:
            person.events.append(event)
            tell(teller, event)

        monkeypatch.setattr(drive, "ArmKey", Key)
        monkeypatch.setattr(EventPrinter, "__call__", note)

    def pressed(self, *_: object) -> bool:
        self._turns += 1
        if self._turns > PATIENCE_TURNS:
            stop()
        return self._script(self.kinds)

    @property
    def kinds(self) -> list[str]:
        return [event.kind for event in self.events]


def stop() -> None:
    """Ctrl-C."""
    signal.raise_signal(signal.SIGINT)


def every(turns: int) -> Callable[[], bool]:
    count = iter(range(10**9))
    return lambda: next(count) % turns == turns - 1


@pytest.mark.slow
def test_a_port_that_vanishes_stops_the_car_and_comes_back_disarmed(
    port: PtyBoard, camera: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, cli
) -> None:
    seen: dict[str, int] = {}
    again, wait = every(40), every(60)

    def script(kinds: list[str]) -> bool:
        if "driven" not in seen:
            if kinds[-1:] == ["driving"] and wait():
                seen["driven"] = len(kinds)
                port.unplug()
                return False
            return kinds[-1:] != ["driving"] and again()
        if "replugged" not in seen:
            if "link-lost" in kinds[seen["driven"] :] and wait():
                seen["replugged"] = len(kinds)
                port.replug()
            return False
        if "back" not in seen:  # nobody presses: it must stay as it is
            if "link-back" in kinds[seen["replugged"] :] and wait():
                seen["back"] = len(kinds)
            return False
        if kinds[-1] == "driving":
            stop()
        return again()

    person = Person(monkeypatch, script)
    said = cli("run", "--car", car_toml(tmp_path, port.path), "--record", tmp_path / "run.mcap", "--json")
    assert set(seen) == {"driven", "replugged", "back"}, said.err
    between = person.kinds[seen["driven"] : seen["back"]]
    assert sorted(between) == ["link-back", "link-lost", "stop"]
    assert between[-1] == "link-back"
    assert person.kinds[seen["back"] :][-2:] == ["driving", "end"]  # a person armed it
    assert said.code == 1  # it stopped for a fault
    (row,) = said.rows
    assert row["stops"] >= 1
    assert (row["laps"], row["max_abs_offset_m"]) == (None, None)
    for told in ("link-lost: ", "link-back: ", "stop: ", "stopped by SIGINT", f"{tmp_path}/run.mcap: "):
        assert told in said.err
    recording = Recording(tmp_path / "run.mcap")
    events = [message.value for message in recording if isinstance(message.value, Event)]
    assert [event.kind for event in events] == person.kinds
    lost, back = (next(e.t_ns for e in events if e.kind == kind) for kind in ("link-lost", "link-back"))
    sent = [message.value for message in recording if isinstance(message.value, Command)]
    assert not [command for command in sent if lost <= command.t_ns <= back]
    assert any(command.speed_mps > 0 for command in sent if command.t_ns < lost)


@pytest.mark.slow
def test_a_camera_that_is_lost_is_opened_again_and_the_car_stays_disarmed(
    port: PtyBoard, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, cli
) -> None:
    image = road()
    opened: list[StillCamera] = []

    def make_camera(car: object) -> StillCamera:
        if len(opened) == 1 and not tries():
            raise OSError("/dev/video0: cannot be opened")
        opened.append(StillCamera(image, dies_at=400 if not opened else None))
        return opened[-1]

    tries, again, wait = every(3), every(40), every(45)  # 0.75 s: a fault that lasts is told again after 1 s
    back: list[int] = []

    def script(kinds: list[str]) -> bool:
        if "source-back" in kinds:
            if wait():
                back.append(len(kinds))
                stop()
            return False
        return kinds[-1:] != ["driving"] and "source-failed" not in kinds and again()

    monkeypatch.setattr(drive, "make_camera", make_camera)
    person = Person(monkeypatch, script)
    said = cli("run", "--car", car_toml(tmp_path, port.path), "--json")
    assert back, said.err
    assert said.code == 1
    kinds = person.kinds[person.kinds.index("source-failed") :]
    assert [kind for kind in kinds if kind != "fault"][-2:] == ["source-back", "end"]
    assert "driving" not in kinds
    # the car may have rolled unseen: the lane that it finds may be the next one
    assert "fault" in kinds
    assert person.kinds.count("fault") == said.err.count("fault: offset uncertain")
    assert "source-failed: /dev/video0: no more frames" in said.err
    assert "source-back: " in said.err
    (recording,) = (tmp_path / "recordings").glob("*.mcap")  # a real car always records
    assert f"{recording}: " in said.err


def test_no_such_port_names_the_likely_ones(camera: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, cli) -> None:
    said = cli("run", "--car", car_toml(tmp_path, "/dev/ttyMISSING"), "--record", tmp_path / "run.mcap")
    assert (said.code, said.out) == (2, "")
    assert said.err.splitlines()[-1].startswith("automodel: /dev/ttyMISSING: no such port; ")
    assert said.err.splitlines()[-1].endswith("set [link] port in car.toml")
    assert not (tmp_path / "run.mcap").exists()  # nothing is in the way of the next try


def test_a_port_that_is_no_serial_port(camera: None, tmp_path: Path, cli) -> None:
    (tmp_path / "file").write_text("")
    said = cli("run", "--car", car_toml(tmp_path, str(tmp_path / "file")))
    assert (said.code, said.out) == (2, "")
    line = said.err.splitlines()[-1]
    assert line.startswith(f"automodel: {tmp_path}/file: cannot be opened as a serial port")
    assert line.endswith("set [link] port in car.toml")
    assert list((tmp_path / "recordings").iterdir()) == []


def test_a_board_that_says_nothing(camera: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, cli) -> None:
    monkeypatch.setattr(arduino, "_HELLO_TIMEOUT_NS", 300_000_000)
    master, slave = os.openpty()
    try:
        said = cli("run", "--car", car_toml(tmp_path, os.ttyname(slave)))
    finally:
        os.close(master)
        os.close(slave)
    assert (said.code, said.out) == (2, "")
    line = said.err.splitlines()[-1]
    assert "no Hello from the board; check port, baud rate and firmware; " in line
    assert line.endswith("set [link] port in car.toml")


def test_a_board_with_other_messages(camera: None, tmp_path: Path, cli) -> None:
    with PtyBoard(EmulatedArduino(BenchPeripherals(), 115200, BoardOptions(table_hash=0x1234))) as board:
        said = cli("run", "--car", car_toml(tmp_path, board.path))
    assert (said.code, said.out) == (2, "")
    assert "the board has message table 0x1234" in said.err.splitlines()[-1]

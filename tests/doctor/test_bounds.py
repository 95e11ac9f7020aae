"""The doctor's measurements: bounded in time, their errors told, the servo let go whatever comes."""

from __future__ import annotations

import threading
from pathlib import Path

import pytest

from automodel.config import CarConfig
from automodel.doctor import machine as doctor_machine
from automodel.doctor.board import Consent, can_finding, servo_finding
from automodel.doctor.findings import Finding, Verdict, bounded
from automodel.runtime.clocks import VirtualClock
from firmware_link.arduino import ArduinoLink
from firmware_link.emulator.board import EmulatedArduino
from firmware_link.emulator.logic import ROLL_OUT_MS
from firmware_link.emulator.pty import BenchPeripherals
from firmware_link.transport import MemoryTransport

CAR = CarConfig()


def test_a_measurement_ends_in_time_and_its_errors_are_findings() -> None:
    release = threading.Event()
    try:
        hung = bounded("x", release.wait, 0.05, "do")
    finally:
        release.set()
    assert isinstance(hung, Finding)
    assert (hung.verdict, hung.what) == (Verdict.FAIL, "no answer within 0.05 s")

    def raises(error: Exception) -> object:
        raise error

    own = bounded("x", lambda: raises(OSError("/dev/x: gone; plug it in")), 5.0, "look")
    assert isinstance(own, Finding)
    assert (own.what, own.do) == ("/dev/x: gone", "plug it in; look")
    assert bounded("x", lambda: 3, 5.0, "look") == 3


@pytest.mark.filterwarnings("ignore::pytest.PytestUnhandledThreadExceptionWarning")
def test_an_error_of_this_program_ends_one_check_only() -> None:
    broken = bounded("x", lambda: vars(Finding)["nothing"], 5.0, "look")
    assert isinstance(broken, Finding)
    assert (broken.verdict, broken.what) == (Verdict.FAIL, "the check itself failed")


def test_can_interfaces_are_named(tmp_path: Path) -> None:
    for name, kind, state in (("can0", "280", "up"), ("eth0", "1", "up")):
        (tmp_path / name).mkdir()
        (tmp_path / name / "type").write_text(f"{kind}\n")
        (tmp_path / name / "operstate").write_text(f"{state}\n")
    found = can_finding(tmp_path)
    assert (found.verdict, found.what.endswith("here are: can0 up")) == (Verdict.SKIP, True)
    assert "no CAN interface" in can_finding(tmp_path / "eth0").what


def test_providers_that_were_passed_over_are_told() -> None:
    def found(offered: tuple[str, ...], provider: str) -> Finding:
        tried = doctor_machine._Tried(offered=offered, provider=provider, notice="why", started_s=0.1, image_s=0.01)
        return doctor_machine._provider_finding(tried, ("tensorrt", "cuda", "cpu"))

    assert found(("cuda", "cpu"), "cuda").verdict is Verdict.OK
    assert found(("cuda", "cpu"), "cpu").verdict is Verdict.WARN


class Bench:
    """A board on the bench in virtual time, and a link that has heard from it."""

    def __init__(self, clock: type[VirtualClock] = VirtualClock) -> None:
        self.peripherals = BenchPeripherals()
        self.board = EmulatedArduino(self.peripherals, 115200)
        self.clock = clock(0, self.board.advance)
        self.link = ArduinoLink(MemoryTransport(self.board, self.clock), CAR.link, CAR.vehicle)
        self.link.open()
        while self.link.poll(self.clock.now_ns()) is None:
            self.clock.sleep(0.005)

    def move(self, consent: Consent) -> Finding:
        return servo_finding(CAR, self.link, self.clock, consent)


def test_a_person_may_take_time_to_answer() -> None:
    bench = Bench()
    questions: list[str] = []

    def ask(question: str) -> bool:
        questions.append(question)
        bench.clock.sleep(10.0)
        return True

    found = bench.move(Consent(given=False, ask=ask))
    assert (found.verdict, len(questions)) == (Verdict.OK, 2), found
    bench.clock.sleep(0.03)
    assert not bench.board.armed


class Impatient(VirtualClock):
    """Somebody presses Ctrl-C when the test says so."""

    press = False

    def sleep(self, seconds: float) -> None:
        super().sleep(seconds)
        if self.press and self.now_ns() > 1_500_000_000:
            self.press = False
            raise KeyboardInterrupt


def test_ctrl_c_while_the_servo_moves_disarms_the_board() -> None:
    bench = Bench(Impatient)
    assert isinstance(bench.clock, Impatient)
    bench.clock.press = True
    with pytest.raises(KeyboardInterrupt):
        bench.move(Consent(given=True))
    assert bench.board.armed  # the last bytes are on the line yet
    assert bench.peripherals.at_pins[0] != 1500.0
    bench.clock.sleep(0.03)  # far less than the board's own timer takes
    assert not bench.board.armed
    assert bench.peripherals.at_pins[1] == 1500.0
    bench.clock.sleep(ROLL_OUT_MS * 1e-3)
    assert bench.peripherals.at_pins == (1500.0, 1500.0)


def test_half_a_simulated_car_is_no_car(cli, tmp_path: Path) -> None:
    (tmp_path / "car.toml").write_text('[camera]\nsource = "usb"\n[pipeline]\nname = "windows"\n')
    said = cli("doctor", "--car", tmp_path / "car.toml", "--json")
    (row,) = (row for row in said.rows if row["check"] == "car.toml")
    assert (said.code, row["verdict"], row["do"]) == (1, "FAIL", 'set both to "sim", or neither')


def test_a_link_of_a_team_is_not_checked(cli, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    methods = "".join(
        f"    def {name}(self, *_): pass\n" for name in ("__init__", "open", "poll", "send", "arm", "disarm", "close")
    )
    (tmp_path / "team_link.py").write_text(f"class Link:\n{methods}")
    (tmp_path / "car.toml").write_text(
        '[camera]\nsource = "usb"\n[link]\nkind = "team_link:Link"\nport = "x"\n[pipeline]\nname = "windows"\n'
    )
    said = cli("doctor", "--car", "car.toml", "--move", "--yes", "--json")
    rows = {row["check"]: row for row in said.rows}
    assert (rows["board"]["verdict"], "servo" in rows) == ("SKIP", False)
    assert 'kind = "team_link:Link"' in str(rows["board"]["what"])


def test_a_network_that_is_none(cli, tmp_path: Path) -> None:
    (tmp_path / "my.onnx").write_text("hello")
    (tmp_path / "car.toml").write_text(f'[pipeline.centerline]\nmodel = "{tmp_path}/my.onnx"\n')
    said = cli("doctor", "--car", tmp_path / "car.toml", "--json")
    verdicts = {row["check"]: row["verdict"] for row in said.rows}
    assert [verdicts[name] for name in ("network", "exposure", "lane width")] == ["FAIL", "OK", "FAIL"]

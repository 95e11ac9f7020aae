"""The doctor at a CAN bus: what a bus is like, a message, and what the mapping misses; on buses of python-can."""

from __future__ import annotations

import dataclasses
from collections import Counter

import pytest

from automodel.config import CanConfig, CarConfig
from automodel.config.can import CanMessage
from automodel.doctor import can_bus
from automodel.doctor.can_bus import Heard, can_bus_findings, judge_bus, judge_message, judge_others, judge_senders
from automodel.doctor.findings import Finding, Verdict
from automodel.runtime.clocks import MonotonicClock
from firmware_link import can_receiver
from firmware_link.can_port import BusTrouble, PythonCanPort
from firmware_link.can_receiver import MessageCount, load_dbc
from tests.support.can_buses import BUSES, channel_of, served_vehicle

CONFIG = CanConfig()
MESSAGE = CanMessage(name="M", period_s=0.01)


def car_with(config: CanConfig) -> CarConfig:
    usual = CarConfig()
    return dataclasses.replace(usual, link=dataclasses.replace(usual.link, kind="can", port="x", can=config))


def examined(interface: str, channel: str, config: CanConfig = CONFIG) -> dict[str, Finding]:
    port = PythonCanPort(interface, channel, 500_000)
    return {finding.name: finding for finding in can_bus_findings(car_with(config), port, MonotonicClock())}


@pytest.fixture(autouse=True)
def _short(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(can_bus, "LISTENING_S", 0.5)


@pytest.mark.parametrize("interface", BUSES)
def test_a_vehicle_that_is_as_mapped_is_all_right(interface: str) -> None:
    with served_vehicle(interface, CONFIG) as served:
        found = examined(interface, served.path)
    names = ["CAN bus", "AM_STATE", "AM_DRIVER", "AM_HEARTBEAT", "CAN senders", "CAN mapping", "CAN override"]
    assert list(found) == names
    assert "frames/s of 3 messages" in found["CAN bus"].what
    assert found["CAN mapping"].what == "every message that came is mapped"
    assert Verdict.FAIL not in {found[name].verdict for name in ("CAN bus", "AM_DRIVER", "CAN senders")}
    assert "Hz" in found["AM_STATE"].what


def test_a_vehicle_that_is_not_as_mapped_is_told_message_by_message() -> None:
    with served_vehicle("virtual", CONFIG) as served:
        wrong = served.vehicle.wrong
        wrong.bad_checksum, wrong.missing, wrong.second_sender = {"AM_STATE"}, {"AM_HEARTBEAT"}, True
        found = examined("virtual", served.path)
    assert found["AM_STATE"].verdict is Verdict.FAIL
    assert "checksum" in found["AM_STATE"].what
    assert "see checksum" in found["AM_STATE"].do
    assert (found["AM_HEARTBEAT"].verdict, found["AM_HEARTBEAT"].what) == (Verdict.FAIL, "did not come")
    assert (found["CAN senders"].verdict, "AM_COMMAND" in found["CAN senders"].what) == (Verdict.FAIL, True)


def test_what_the_mapping_misses_is_told() -> None:
    state = tuple(value for value in CONFIG.state if value.message == "AM_STATE")
    config = dataclasses.replace(CONFIG, receive=CONFIG.receive[:1], state=state)
    with served_vehicle("virtual", CONFIG) as served:
        served.vehicle.wrong.load_frames = 1
        found = examined("virtual", served.path, config)
    told = found["CAN mapping"].what
    assert told.startswith("not mapped: AM_DRIVER, AM_HEARTBEAT; not in the DBC files: 0x7f8")
    assert found["CAN override"].verdict is Verdict.WARN
    assert "the brake" in found["CAN override"].what


@pytest.mark.parametrize("interface", BUSES)
def test_a_silent_bus_is_told(interface: str) -> None:
    if interface == "udp_multicast":
        with served_vehicle(interface, CONFIG):  # skips where there is no multicast
            pass
    found = examined(interface, channel_of(interface))
    assert list(found) == ["CAN bus", "CAN override"]
    assert found["CAN bus"].verdict is Verdict.FAIL
    assert "nothing came in 0.5 s" in found["CAN bus"].what


def test_a_bus_that_cannot_be_opened_is_told() -> None:
    found = examined("nonsense", "x")
    assert list(found) == ["CAN bus"]
    assert "cannot be opened" in found["CAN bus"].what
    assert "ip link set can0 up" in found["CAN bus"].do


def test_error_frames_are_a_wrong_bit_rate() -> None:
    heard = Heard(span_s=2.0, frames=Counter({(1, False): 10}), troubles=Counter({BusTrouble.ERROR: 7}))
    finding = judge_bus(heard, "can0")
    assert (finding.verdict, finding.what) == (Verdict.FAIL, "can0: 5 frames/s of 1 messages; 7 times error")
    assert "bitrate" in finding.do


def count(frames: int, every_ms: float, alarms: int = 0, **verdicts: int) -> MessageCount:
    span_ns = round((frames - 1) * every_ms * 1e6)
    told = Counter({can_receiver.Verdict(name): number for name, number in verdicts.items()})
    return MessageCount(frames=frames, verdicts=told, alarms=alarms, first_ns=0, last_ns=span_ns)


@pytest.mark.parametrize(
    ("counted", "verdict", "text"),
    [
        (count(200, 10.0, good=200), Verdict.OK, "100.0 Hz, 200 frames"),
        (count(200, 10.0, good=199, checksum=1), Verdict.OK, "100.0 Hz, 200 frames, wrong: 1 checksum"),
        (count(100, 20.0, good=100), Verdict.WARN, "50.0 Hz, 100 frames; expected 100.0 Hz"),
        (count(200, 10.0, 1, counter=200), Verdict.FAIL, "100.0 Hz, 200 frames, wrong: 200 counter"),
        (count(200, 10.0, 1, quality=200), Verdict.FAIL, "100.0 Hz, 200 frames, wrong: 200 quality"),
        (MessageCount(), Verdict.FAIL, "did not come"),
    ],
)
def test_a_message_is_judged(counted: MessageCount, verdict: Verdict, text: str) -> None:
    finding = judge_message(MESSAGE, counted)
    assert (finding.verdict, finding.what) == (verdict, text)


def test_many_foreign_messages_are_one_line() -> None:
    heard = Heard(span_s=2.0, frames=Counter({(0x500 + index, False): 1 for index in range(20)}))
    what = judge_others(CONFIG, load_dbc(()), heard).what
    assert what.endswith("0x507 and 12 more")
    assert judge_senders(CONFIG, load_dbc(()), heard).verdict is Verdict.OK

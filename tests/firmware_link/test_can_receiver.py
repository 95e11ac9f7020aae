"""The supervision of received CAN messages: every way of going wrong becomes a fault in time, and nothing else does."""

from __future__ import annotations

import dataclasses
import random
from typing import Any

import pytest

from automodel.assembly.can_parts import can_functions
from automodel.config import CanConfig, CanMessage, CanValue, ConfigError
from firmware_link.can_checks import autosar_e2e_2
from firmware_link.can_receiver import CanFrame, CanReceiver, Verdict, load_dbc

MS = 1_000_000
STATE_ID = 0x110
CONFIG = CanConfig()
MESSAGE = dataclasses.replace(CONFIG.receive[0])
ONLY_STATE = dataclasses.replace(
    CONFIG, receive=(MESSAGE,), state=tuple(value for value in CONFIG.state if value.message == "AM_STATE")
)


def receiver(config: CanConfig = ONLY_STATE) -> CanReceiver:
    return CanReceiver(load_dbc(config.dbc), config, can_functions(config))


def payload(counter: int, **signals: float) -> bytes:
    """A right AM_STATE."""
    definition: Any = load_dbc(()).get_message_by_name("AM_STATE")
    values = {"ENGAGED": 1, "STATE_VALID": 1, "SPEED": 15.0, "YAW_RATE": 0.1, "STEERING": -0.02} | signals
    data = definition.encode({**values, "STATE_CRC": 0, "STATE_COUNTER": counter % 16}, strict=False)
    return bytes((autosar_e2e_2(STATE_ID, STATE_ID, data), *data[1:]))


def at(t_ms: float, data: bytes, frame_id: int = STATE_ID, extended: bool = False) -> CanFrame:
    return CanFrame(t_ns=round(t_ms * MS), frame_id=frame_id, data=data, extended=extended)


def running(frames: int = 20) -> CanReceiver:
    """A receiver that had so many good frames, 10 ms apart."""
    made = receiver()
    for index in range(frames):
        assert made.take(at(10 * index, payload(index))) is Verdict.GOOD
    return made


def test_values_are_decoded_with_sign_and_unit() -> None:
    snapshot = running(1).snapshot(0)
    assert (snapshot.faults, snapshot.t_ns) == ((), 0)
    assert snapshot.values == pytest.approx(
        {"speed_mps": 15.0, "yaw_rate_radps": 0.1, "steering_rad": -0.02, "engaged": 1.0}, abs=1e-4
    )


def test_the_steering_ratio_divides_the_angle() -> None:
    made = receiver(dataclasses.replace(ONLY_STATE, steering_ratio=16.0))
    made.take(at(0, payload(0, STEERING=0.8)))
    assert made.snapshot(0).values["steering_rad"] == pytest.approx(0.05, abs=1e-4)


def test_nothing_is_known_before_the_first_frame() -> None:
    made = receiver()
    assert made.snapshot(0).faults == ("can_unseen:AM_STATE",)
    assert made.snapshot(31 * MS).faults == ("can_timeout:AM_STATE",)


@pytest.mark.parametrize(("period_s", "timeout_ms"), [(0.01, 30), (0.02, 60), (0.05, 100), (1.0, 100)])
def test_a_message_may_be_away_for_three_periods_and_no_longer(period_s: float, timeout_ms: int) -> None:
    config = dataclasses.replace(ONLY_STATE, receive=(dataclasses.replace(MESSAGE, period_s=period_s),))
    made = receiver(config)
    made.take(at(0, payload(0)))
    assert made.snapshot(timeout_ms * MS).faults == ()
    late = made.snapshot(timeout_ms * MS + 1)
    assert (late.faults, late.values) == (("can_timeout:AM_STATE",), {})
    made.take(at(timeout_ms + 1, payload(1)))
    assert made.snapshot((timeout_ms + 1) * MS).faults == ()
    (watch,) = made.watches.values()
    assert (watch.count.timeouts, watch.count.alarms) == (1, 1)


@pytest.mark.parametrize(
    ("signals", "verdict"),
    [
        ({"SPEED": 15.29}, Verdict.GOOD),
        ({"SPEED": 15.31}, Verdict.JUMP),
        ({"SPEED": 14.69}, Verdict.JUMP),
        ({"YAW_RATE": 0.29}, Verdict.GOOD),
        ({"YAW_RATE": -0.11}, Verdict.JUMP),
        ({"STEERING": 0.009}, Verdict.GOOD),
        ({"STEERING": -0.051}, Verdict.JUMP),
        ({"ENGAGED": 0}, Verdict.GOOD),
    ],
)
def test_a_value_that_is_too_far_from_the_one_before_is_rejected(signals: dict[str, float], verdict: Verdict) -> None:
    made = running()
    assert made.take(at(195, payload(20, **signals))) is verdict, "5 ms after, as two frames that come together"
    assert made.take(at(210, payload(21))) is Verdict.GOOD


def test_a_value_that_has_really_changed_is_good_as_soon_as_it_may_be_and_faulty_until_then() -> None:
    made = running()
    verdicts = [made.take(at(200 + 10 * index, payload(20 + index, SPEED=16.0))) for index in range(14)]
    assert verdicts == [Verdict.JUMP] * 3 + [Verdict.GOOD] * 11
    assert made.snapshot(331 * MS).faults == ()
    made = running()
    for index in range(3):
        made.take(at(200 + 10 * index, payload(20 + index, SPEED=16.0)))
    assert made.snapshot(220 * MS).faults == ("can_jump:AM_STATE",)


def test_frames_after_a_long_silence_may_say_anything() -> None:
    made = running()
    assert made.take(at(2_000, payload(20, SPEED=40.0))) is Verdict.GOOD


@pytest.mark.parametrize("after", [20, 21, 22])
def test_the_counter_after_damaged_frames_is_the_next_one_whether_they_counted_or_not(after: int) -> None:
    made = running()
    assert made.take(at(200, payload(20)[:-1])) is Verdict.LENGTH
    assert made.take(at(210, bytes(8))) is Verdict.CHECKSUM
    assert made.take(at(220, payload(after))) is Verdict.GOOD
    assert made.take(at(230, payload(after + 1))) is Verdict.GOOD


def test_the_counter_after_damaged_frames_is_no_other_one() -> None:
    made = running()
    assert made.take(at(200, payload(20)[:-1])) is Verdict.LENGTH
    assert made.take(at(210, payload(22))) is Verdict.COUNTER
    assert made.take(at(220, payload(24))) is Verdict.COUNTER


def test_frames_of_others_are_none_of_ours() -> None:
    made = running(1)
    assert made.take(at(1, payload(1), frame_id=0x7FF)) is None
    assert made.take(at(1, payload(1), extended=True)) is None


@pytest.mark.parametrize("length", [0, 7, 9])
def test_a_wrong_length_is_rejected(length: int) -> None:
    made = running()
    assert made.take(at(200, (payload(20) + b"\x00")[:length])) is Verdict.LENGTH


def bad_frame(kind: Verdict, index: int) -> bytes:
    if kind is Verdict.LENGTH:
        return payload(index)[:7]
    if kind is Verdict.CHECKSUM:
        return bytes((payload(index)[0] ^ 1, *payload(index)[1:]))
    if kind is Verdict.COUNTER:
        return payload(19)  # stuck
    return payload(index, SPEED=95.0)


@pytest.mark.parametrize("kind", [Verdict.LENGTH, Verdict.CHECKSUM, Verdict.COUNTER, Verdict.RANGE])
def test_three_bad_frames_are_a_fault_and_ten_good_ones_end_it(kind: Verdict) -> None:
    made = running()
    for index in range(20, 23):
        assert made.snapshot(round((10 * index - 1) * MS)).faults == ()
        assert made.take(at(10 * index, bad_frame(kind, index))) is kind
    assert made.snapshot(220 * MS).faults == (f"can_{kind.value}:AM_STATE",)
    assert made.snapshot(220 * MS).values == {}
    for index in range(23, 33):
        assert made.snapshot(10 * index * MS).faults != ()
        made.take(at(10 * index, payload(index)))
    extra = 33 if kind in (Verdict.COUNTER, Verdict.LENGTH, Verdict.CHECKSUM) else 32
    for index in range(33, extra + 1):  # the first after a lost counter was a jump
        made.take(at(10 * index, payload(index)))
    assert made.snapshot(10 * extra * MS).faults == ()


@pytest.mark.parametrize("kind", [Verdict.LENGTH, Verdict.CHECKSUM, Verdict.RANGE])
def test_one_bad_frame_is_dropped_and_no_fault(kind: Verdict) -> None:
    made = running()
    made.take(at(200, bad_frame(kind, 20)))
    snapshot = made.snapshot(200 * MS)
    assert snapshot.faults == ()
    assert snapshot.values["speed_mps"] == pytest.approx(15.0)
    assert snapshot.t_ns == 190 * MS  # what it says is as old as the last good one


def test_a_second_sender_of_the_same_identifier_is_a_fault() -> None:
    """It counts on its own: each frame after one of the other jumps."""
    made = running()
    verdicts = []
    for index in range(20, 24):
        verdicts.append(made.take(at(10 * index, payload(index))))
        verdicts.append(made.take(at(10 * index + 5, payload(index + 7, SPEED=3.0))))
    assert verdicts.count(Verdict.COUNTER) >= 3
    assert made.snapshot(235 * MS).faults == ("can_counter:AM_STATE",)


def test_doubtful_values_are_invalid_at_once() -> None:
    made = running()
    assert made.take(at(200, payload(20, STATE_VALID=0))) is Verdict.QUALITY
    assert made.snapshot(200 * MS).faults == ("can_quality:AM_STATE",)
    assert made.snapshot(200 * MS).values == {}


def test_no_mutated_frame_is_accepted() -> None:
    """Up to three wrong bits of a payload, which the checksum must find (test_can_checks proves it for all)."""
    draw = random.Random(7)
    made = running()
    good = int.from_bytes(payload(20), "big")
    for _ in range(20_000):
        mutated = good
        for bit in draw.sample(range(64), draw.randint(1, 3)):
            mutated ^= 1 << bit
        assert made.take(at(200, mutated.to_bytes(8, "big"))) is Verdict.CHECKSUM
    assert made.snapshot(200 * MS).values == {}


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({"name": "NOTHING"}, "there is no message NOTHING in the DBC files"),
        ({"counter_signal": "COUNT"}, "there is no signal COUNT in the DBC files"),
        ({"quality_signal": "Q"}, "there is no signal Q in the DBC files"),
    ],
)
def test_a_mapping_that_does_not_fit_says_so(change: dict[str, Any], text: str) -> None:
    message = dataclasses.replace(MESSAGE, **change)
    values = tuple(dataclasses.replace(value, message=message.name) for value in ONLY_STATE.state)
    with pytest.raises(ConfigError, match=text):
        receiver(CanConfig(receive=(message,), state=values))


@pytest.mark.parametrize(
    ("make", "text"),
    [
        (lambda: CanMessage(name="A", period_s=0.0), "period_s: expected a positive number"),
        (lambda: CanMessage(name="A", period_s=0.1, checksum="toyoda"), "did you mean 'toyota'"),
        (lambda: CanMessage(name="A", period_s=0.1, counter="rolling"), "counter: expected with counter_signal"),
        (lambda: CanMessage(name="A", period_s=0.1, data_id=70_000), "data_id: expected 0 .. 65535"),
        (lambda: CanValue(value="sped_mps", message="A", signal="B"), "did you mean 'speed_mps'"),
        (lambda: CanValue(value="speed_mps", message="A", signal="B", factor=0.0), "factor"),
        (lambda: CanConfig(receive=()), "is from AM_STATE, which is not in receive"),
        (lambda: CanConfig(receive=(MESSAGE, MESSAGE)), "AM_STATE is there twice"),
    ],
)
def test_a_mapping_that_makes_no_sense_says_so(make, text: str) -> None:
    with pytest.raises(ValueError, match=text):
        make()

"""The CAN link against the emulated vehicle, in virtual time: it drives, and lets go of the car whatever goes wrong."""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Callable, Iterable

import numpy as np
import pytest

from automodel.assembly.can_parts import can_functions
from automodel.config import CanConfig, ConfigError, VehicleConfig
from automodel.runtime.supervised_link import SupervisedLink
from automodel.signals import Command, Event, VehicleState
from firmware_link.can_limits import (
    ACCEL_JERK_MAX_MPS3,
    BANK_TOLERANCE_MPS2,
    LATERAL_ACCEL_MAX_MPS2,
    LATERAL_JERK_MAX_MPS3,
    lateral_accel_mps2,
)
from firmware_link.can_link import CanLink
from firmware_link.can_port import BusTrouble, WhitelistedPort
from firmware_link.can_receiver import Verdict, load_dbc
from firmware_link.emulator.can_vehicle import FULL_LOAD_FRAMES, EmulatedCanVehicle, MemoryCanPort
from firmware_link.errors import HandshakeError, LinkError, PortLost, PortNotFound

MS = 1_000_000
PERIOD_NS = 20 * MS
VEHICLE = VehicleConfig(wheelbase_m=2.7, reference_x_m=1.3, width_m=1.8)
CONFIG = CanConfig()


@dataclasses.dataclass(frozen=True)
class Measured:
    speed_mps: float
    yaw_rate_radps: float
    steering_rad: float


class Body:
    """Steers at once, and integrates the acceleration."""

    def __init__(self) -> None:
        self.t_ns = 0
        self.speed_mps, self.steering_rad, self.accel_mps2 = 15.0, 0.0, 0.0
        self.steered = True

    def drive(self, t_ns: int, steering_rad: float | None, accel_mps2: float) -> None:
        self.speed_mps = max(self.speed_mps + self.accel_mps2 * (t_ns - self.t_ns) * 1e-9, 0.0)
        self.t_ns, self.accel_mps2 = t_ns, accel_mps2
        self.steered = steering_rad is not None
        if steering_rad is not None:
            self.steering_rad = steering_rad

    def measure(self, t_ns: int) -> Measured:
        yaw = self.speed_mps * math.tan(self.steering_rad) / VEHICLE.wheelbase_m
        return Measured(speed_mps=self.speed_mps, yaw_rate_radps=yaw, steering_rad=self.steering_rad)


class Rig:
    """Link and vehicle on one virtual clock, and a loop of 50 Hz."""

    def __init__(self, config: CanConfig = CONFIG) -> None:
        self.t_ns = 0
        self.body = Body()
        database, functions = load_dbc(config.dbc), can_functions(config)
        self.vehicle = EmulatedCanVehicle(self.body, database, config, functions)
        self.link = CanLink(MemoryCanPort(self.vehicle, self), database, config, VEHICLE, functions)
        self.states: list[VehicleState | None] = []

    def now_ns(self) -> int:
        return self.t_ns

    def cycle(self, steering_rad: float | None = 0.0, speed_mps: float = 15.0) -> VehicleState | None:
        """A cycle of the loop; without an angle no command is given."""
        self.t_ns += PERIOD_NS
        state = self.link.poll(self.t_ns)
        if steering_rad is not None:
            until_ns = self.t_ns + 100 * MS
            command = Command(t_ns=self.t_ns, steering_rad=steering_rad, speed_mps=speed_mps, valid_until_ns=until_ns)
            self.link.send(command, self.t_ns)
        self.states.append(state)
        return state

    def driving(self, steering_rad: float = 0.0, speed_mps: float = 15.0) -> Rig:
        """Armed and followed."""
        self.link.open()
        for _ in range(5):
            self.cycle()
        self.link.arm(self.t_ns)
        for _ in range(10):
            state = self.cycle(steering_rad, speed_mps)
        assert state is not None
        assert state.armed, state
        assert self.vehicle.engaged
        return self

    def until_disarmed(self, **command: float) -> tuple[int, VehicleState]:
        """How long it took until the link let go [ns], and the state."""
        start_ns = self.t_ns
        for _ in range(50):
            state = self.cycle(**command)
            assert state is not None
            if not state.armed:
                return self.t_ns - start_ns, state
        raise AssertionError("still armed")


def test_nothing_is_known_before_every_message_has_come() -> None:
    rig = Rig()
    rig.vehicle.wrong.missing.add("AM_DRIVER")
    rig.link.open()
    assert [rig.cycle() for _ in range(10)] == [None] * 10
    assert rig.vehicle.verdicts.total() == 0, "nothing is sent to a vehicle that is not understood"
    rig.vehicle.wrong.missing.clear()
    rig.cycle()
    assert rig.cycle() is not None


def test_a_bus_without_the_vehicle_is_a_handshake_error() -> None:
    rig = Rig()
    rig.vehicle.wrong.missing.update(message.name for message in CONFIG.receive)
    rig.link.open()
    for _ in range(250):
        assert rig.cycle() is None
    rig.t_ns += 100 * MS
    with pytest.raises(HandshakeError, match="nothing valid of AM_STATE, AM_DRIVER, AM_HEARTBEAT"):
        rig.cycle()


def test_the_state_is_the_vehicle_s() -> None:
    rig = Rig()
    rig.body.steering_rad = 0.03
    rig.link.open()
    for _ in range(3):
        state = rig.cycle()
    assert state is not None
    assert state.speed_mps == pytest.approx(rig.body.speed_mps, abs=0.1)
    assert state.steering_rad == pytest.approx(0.03, abs=1e-4)
    assert (state.armed, state.engaged, state.driver_override, state.gear) == (False, False, False, "D")
    assert (state.boot_id, state.faults) == (1, ())


def test_disengaged_the_command_follows_the_measured_angle() -> None:
    rig = Rig()
    rig.link.open()
    for index in range(20):
        rig.body.steering_rad = 0.01 * math.sin(index)
        rig.cycle(0.3)
    assert not any(told["enable"] for _, told in rig.vehicle.accepted)
    assert abs(rig.vehicle.accepted[-1][1]["steering_rad"] - 0.01 * math.sin(19)) < 1e-3
    rig.body.steering_rad = 0.02
    rig.cycle()
    rig.link.arm(rig.t_ns)
    for _ in range(5):
        rig.cycle(0.02)
    angles = [told["steering_rad"] for _, told in rig.vehicle.accepted if told["enable"]]
    assert angles
    assert angles[0] == pytest.approx(0.02, abs=1e-4), "the first command is where the wheels are"


def test_it_drives_once_armed_and_sends_at_50_hz() -> None:
    rig = Rig().driving(0.005, 15.0)
    assert rig.body.steering_rad == pytest.approx(0.005, abs=1e-3)
    start = len(rig.vehicle.accepted)
    for _ in range(50):
        rig.cycle(0.005, 16.0)
    times = [t_ns for t_ns, _ in rig.vehicle.accepted[start:]]
    assert len(times) == 50
    assert {b - a for a, b in itertools.pairwise(times)} == {PERIOD_NS}
    assert set(rig.vehicle.verdicts) == {Verdict.GOOD}
    assert rig.vehicle.unknown == 0
    assert rig.body.speed_mps > 15.3


def drive_frames(rig: Rig, steps_ms: Iterable[float]) -> list[tuple[int, int]]:
    """A loop of 50 Hz that polls at its frames and when the link asks; the times of its frames and commands [ns]."""
    cycles, frame_ns = [], rig.t_ns
    for step_ms in steps_ms:
        frame_ns += PERIOD_NS
        while (wake_ns := rig.link.wake_ns) is not None and wake_ns < frame_ns:
            rig.t_ns = max(rig.t_ns + MS // 10, wake_ns)
            rig.link.poll(rig.t_ns)
        rig.t_ns = frame_ns
        rig.link.poll(rig.t_ns)
        rig.t_ns += round(step_ms * MS)
        command = Command(t_ns=rig.t_ns, steering_rad=0.0, speed_mps=15.0, valid_until_ns=frame_ns + 100 * MS)
        rig.link.send(command, rig.t_ns)
        cycles.append((frame_ns, rig.t_ns))
    return cycles


@pytest.mark.parametrize("after_ms", range(20))
def test_a_message_carries_the_command_of_its_own_cycle_whenever_the_frames_come(after_ms: int) -> None:
    """The loop commands 3 ms after a frame; messages were due at any time between two frames."""
    rig = Rig().driving()
    rig.t_ns += after_ms * MS
    cycles = drive_frames(rig, [3.0] * 200)[-50:]
    times = [t_ns for t_ns, _ in rig.vehicle.accepted if t_ns > cycles[0][0]]
    assert len(times) == 50
    for (_, commanded_ns), sent_ns in zip(cycles, times, strict=True):
        assert commanded_ns <= sent_ns <= commanded_ns + 1.5 * MS
    assert max(abs(b - a - PERIOD_NS) for a, b in itertools.pairwise(times)) <= 1.1 * MS


@pytest.mark.parametrize("seed", range(5))
def test_messages_leave_more_evenly_than_commands_come(seed: int) -> None:
    """Steps of a network take 7 to 13 ms, and a message that left with each command would be as uneven."""
    steps_ms = np.random.default_rng(seed).uniform(7.0, 13.0, 1000)
    rig = Rig().driving()
    cycles = drive_frames(rig, steps_ms)[500:]
    times = np.array([t_ns for t_ns, _ in rig.vehicle.accepted if t_ns > cycles[0][0]]) / MS
    jitter_ms = np.abs(np.diff(times) - PERIOD_NS / MS)
    assert np.percentile(np.abs(np.diff(steps_ms)), 99) > 5.0
    assert np.percentile(jitter_ms, 99) < 2.0
    waits_ms = times - np.array([commanded_ns for _, commanded_ns in cycles])[: len(times)] / MS
    assert (waits_ms > -0.1).all()
    assert waits_ms.mean() < 4.0, "a command waits for its message, but not for long"


def test_a_loop_that_falls_silent_is_asked_to_repeat_the_last_command_a_quarter_period_late() -> None:
    rig = Rig().driving()
    drive_frames(rig, [3.0] * 200)
    sent_ns = rig.vehicle.accepted[-1][0]
    assert rig.link.wake_ns is not None
    assert rig.link.wake_ns - sent_ns == pytest.approx(1.25 * PERIOD_NS, abs=1.5 * MS)


def test_before_the_vehicle_is_known_nothing_is_asked_for() -> None:
    rig = Rig()
    assert rig.link.wake_ns is None
    rig.link.open()
    assert rig.link.wake_ns is None


@pytest.mark.parametrize("speed_mps", [5.0, 15.0, 30.0])
def test_no_command_on_the_wire_exceeds_the_limits(speed_mps: float) -> None:
    rig = Rig()
    rig.body.speed_mps = speed_mps
    rig.driving(0.0, speed_mps)
    start = len(rig.vehicle.accepted)
    for index in range(200):
        rig.body.speed_mps, rig.body.accel_mps2 = speed_mps, 0.0
        rig.cycle(0.5 if index % 80 < 40 else -0.5, speed_mps)
    angles = [told["steering_rad"] for _, told in rig.vehicle.accepted[start + 1 :]]
    accels = [lateral_accel_mps2(angle, speed_mps, VEHICLE.wheelbase_m) for angle in angles]
    resolution = 2 * lateral_accel_mps2(0.00005, speed_mps, VEHICLE.wheelbase_m)  # of the signals, and of the speed
    assert max(map(abs, accels)) <= LATERAL_ACCEL_MAX_MPS2 - BANK_TOLERANCE_MPS2 + resolution
    steps = [abs(b - a) for a, b in itertools.pairwise(accels)]
    assert max(steps) <= LATERAL_JERK_MAX_MPS3 * 0.02 + 2 * resolution
    assert max(map(abs, accels)) > 1.0


def test_no_asked_acceleration_jumps() -> None:
    """Not at a step of the wanted speed, at the start of a ramp, nor where the wanted speed is noisy."""
    rig = Rig().driving()
    start = len(rig.vehicle.accepted)
    wanted = 15.0
    for index in range(300):
        wanted = max(wanted - 0.05, 5.0) if index % 100 > 50 else 15.0 + 0.2 * (-1) ** index
        rig.cycle(0.0, wanted)
    accels = [told["accel_mps2"] for _, told in rig.vehicle.accepted[start:]]
    assert max(abs(b - a) for a, b in itertools.pairwise(accels)) <= ACCEL_JERK_MAX_MPS3 * 0.02 + 0.001
    assert -CONFIG.decel_max_mps2 <= min(accels) < -2.0
    assert 1.0 < max(accels) <= CONFIG.accel_max_mps2


def test_a_new_arming_starts_without_acceleration() -> None:
    rig = Rig().driving(0.0, 0.0)
    for _ in range(50):
        rig.cycle(0.0, 0.0)
    assert rig.vehicle.accepted[-1][1]["accel_mps2"] < -2.0
    rig.link.disarm(rig.t_ns)
    assert rig.vehicle.accepted[-1][1]["accel_mps2"] == 0.0
    rig.cycle(0.0, 0.0)
    rig.link.arm(rig.t_ns)
    rig.cycle(0.0, 0.0)
    assert rig.vehicle.accepted[-1][1]["accel_mps2"] >= -ACCEL_JERK_MAX_MPS3 * 0.04


FAULTS: dict[str, tuple[Callable[[Rig], None], str]] = {
    "state missing": (lambda rig: rig.vehicle.wrong.missing.add("AM_STATE"), "can_timeout:AM_STATE"),
    "driver missing": (lambda rig: rig.vehicle.wrong.missing.add("AM_DRIVER"), "can_timeout:AM_DRIVER"),
    "heartbeat missing": (lambda rig: rig.vehicle.wrong.missing.add("AM_HEARTBEAT"), "can_timeout:AM_HEARTBEAT"),
    "stuck counter": (lambda rig: rig.vehicle.wrong.stuck_counter.add("AM_STATE"), "can_counter:AM_STATE"),
    "stuck counter of a slow one": (
        lambda rig: rig.vehicle.wrong.stuck_counter.add("AM_DRIVER"), "can_counter:AM_DRIVER",
    ),
    "bad checksum": (lambda rig: rig.vehicle.wrong.bad_checksum.add("AM_STATE"), "can_checksum:AM_STATE"),
    "short": (lambda rig: rig.vehicle.wrong.longer_by.update(AM_STATE=-1), "can_length:AM_STATE"),
    "long": (lambda rig: rig.vehicle.wrong.longer_by.update(AM_STATE=1), "can_length:AM_STATE"),
    "stale": (lambda rig: rig.vehicle.wrong.frozen.add("AM_STATE"), "can_counter:AM_STATE"),
    "out of range": (lambda rig: rig.vehicle.wrong.offset.update(speed_mps=80.0), "can_range:AM_STATE"),
    "quality": (lambda rig: rig.vehicle.wrong.invalid.add("AM_STATE"), "can_quality:AM_STATE"),
    "error frames": (lambda rig: setattr(rig.vehicle.wrong, "trouble", BusTrouble.ERROR), "can_bus_errors"),
    "error passive": (lambda rig: setattr(rig.vehicle.wrong, "trouble", BusTrouble.PASSIVE), "can_bus_errors"),
    "second sender": (lambda rig: setattr(rig.vehicle.wrong, "second_sender", True), "can_second_sender"),
    "torque": (lambda rig: setattr(rig.vehicle.driver, "torque_nm", -3.2), "driver_override"),
    "brake": (lambda rig: setattr(rig.vehicle.driver, "brake", True), "driver_override"),
    "accelerator": (lambda rig: setattr(rig.vehicle.driver, "accelerator", 0.1), "driver_override"),
    "gear": (lambda rig: setattr(rig.vehicle.driver, "gear", "N"), "driver_override"),
    "vehicle disengages": (lambda rig: rig.vehicle.refuse(), "disengaged"),
}  # fmt: skip


@pytest.mark.parametrize("name", FAULTS)
def test_every_fault_disarms_within_100_ms_for_good(name: str) -> None:
    cause, fault = FAULTS[name]
    rig = Rig().driving()
    cause(rig)
    took_ns, state = rig.until_disarmed()
    assert took_ns <= 100 * MS
    assert fault in state.faults
    rig.vehicle.wrong, rig.vehicle.driver = type(rig.vehicle.wrong)(), type(rig.vehicle.driver)()
    for _ in range(30):
        state_later = rig.cycle(0.1)
        assert state_later is not None
        assert not state_later.armed, "latched"
    assert not rig.vehicle.engaged
    rig.link.arm(rig.t_ns)
    for _ in range(10):
        state_later = rig.cycle()
    assert state_later is not None
    assert state_later.armed
    assert state_later.faults == ()


@pytest.mark.parametrize("name", ["torque", "brake", "accelerator", "gear"])
def test_a_driver_is_obeyed_within_one_cycle(name: str) -> None:
    rig = Rig().driving()
    FAULTS[name][0](rig)
    took_ns, state = rig.until_disarmed()
    assert took_ns == PERIOD_NS
    assert state.driver_override is True
    assert not rig.vehicle.accepted[-1][1]["enable"]


@pytest.mark.parametrize("name", ["torque", "brake", "accelerator", "gear"])
def test_it_does_not_arm_while_the_driver_drives(name: str) -> None:
    rig = Rig()
    rig.link.open()
    FAULTS[name][0](rig)
    for _ in range(5):
        rig.cycle()
    rig.link.arm(rig.t_ns)
    for _ in range(10):
        state = rig.cycle()
        assert state is not None
        assert not state.armed
        assert not rig.vehicle.accepted[-1][1]["enable"], "not even for a moment"


def test_a_driver_who_touched_the_brake_between_two_cycles_is_obeyed() -> None:
    rig = Rig().driving()
    rig.vehicle.driver.brake = True
    rig.vehicle._send(rig.t_ns + 1)  # no message may be due in this moment, so all are sent
    rig.vehicle._next_ns = dict.fromkeys(rig.vehicle._next_ns, rig.t_ns)
    rig.vehicle._send(rig.t_ns + 2)
    rig.vehicle.driver.brake = False
    _, state = rig.until_disarmed()
    assert "driver_override" in state.faults


@pytest.mark.parametrize("gone", ["torque", "missing"])
def test_it_does_not_arm_while_something_is_wrong(gone: str) -> None:
    rig = Rig()
    rig.link.open()
    for _ in range(5):
        rig.cycle()
    if gone == "torque":
        rig.vehicle.driver.torque_nm = 5.0
    else:
        rig.vehicle.wrong.missing.add("AM_STATE")
    for _ in range(5):
        rig.cycle()
    rig.link.arm(rig.t_ns)
    for _ in range(20):
        state = rig.cycle()
        assert state is not None
        assert not state.armed
    assert not any(told["enable"] for _, told in rig.vehicle.accepted)


def test_a_request_while_something_is_wrong_is_forgotten() -> None:
    rig = Rig()
    rig.link.open()
    for _ in range(5):
        rig.cycle()
    rig.vehicle.wrong.missing.add("AM_STATE")
    for _ in range(5):
        rig.cycle()
    rig.link.arm(rig.t_ns)
    rig.vehicle.wrong.missing.clear()
    for _ in range(20):
        state = rig.cycle()
        assert state is not None
        assert not state.armed


def test_a_vehicle_that_does_not_engage_is_given_up() -> None:
    rig = Rig()
    rig.link.open()
    for _ in range(5):
        rig.cycle()
    rig.vehicle.refuse()
    rig.vehicle.driver.accelerator = 0.01  # below our threshold, above the vehicle's
    rig.link.arm(rig.t_ns)
    for _ in range(20):
        state = rig.cycle()
    assert state is not None
    assert not state.armed
    assert "not_engaged" in state.faults
    assert not rig.vehicle.accepted[-1][1]["enable"]


def test_bus_off_loses_the_port_and_comes_back_disarmed() -> None:
    rig = Rig().driving()
    rig.vehicle.wrong.trouble = BusTrouble.OFF
    with pytest.raises(PortLost, match="bus-off"):
        rig.cycle()
    rig.link.close()
    with pytest.raises(PortNotFound):
        rig.link.open()
    rig.vehicle.wrong.trouble = None
    rig.t_ns += 200 * MS
    rig.link.open()
    for _ in range(5):
        state = rig.cycle(0.1)
    assert state is not None
    assert not state.armed
    assert not rig.vehicle.engaged


def test_the_bus_is_joined_again_within_200_ms_and_the_car_stays_disarmed() -> None:
    rig, events = Rig().driving(), list[Event]()
    link = SupervisedLink(rig.link, events.append)
    link._up = link._hello = link._met = True  # it was opened by the rig
    rig.vehicle.wrong.trouble = BusTrouble.OFF
    for _ in range(30):
        rig.t_ns += PERIOD_NS
        assert link.poll(rig.t_ns) is None
        rig.vehicle.advance(rig.t_ns)
    assert not rig.vehicle.engaged
    rig.vehicle.wrong.trouble = None
    back_ns = rig.t_ns
    state = None
    while state is None:
        rig.t_ns += PERIOD_NS
        state = link.poll(rig.t_ns)
    assert rig.t_ns - back_ns <= 200 * MS + 3 * PERIOD_NS, "joined, and every message heard once"
    for _ in range(30):
        rig.t_ns += PERIOD_NS
        until_ns = rig.t_ns + 100 * MS
        link.send(Command(t_ns=rig.t_ns, steering_rad=0.1, speed_mps=15.0, valid_until_ns=until_ns), rig.t_ns)
        state = link.poll(rig.t_ns)
        assert state is not None
        assert not state.armed
    assert not rig.vehicle.engaged
    assert [event.kind for event in events] == ["link-lost", "link-back"]


def test_error_passive_for_a_moment_disarms() -> None:
    rig = Rig().driving()
    rig.vehicle.wrong.trouble = BusTrouble.PASSIVE
    state = rig.cycle()
    rig.vehicle.wrong.trouble = None
    assert state is not None
    assert not state.armed
    assert "can_bus_errors" in state.faults


def test_one_error_frame_in_100_ms_is_none() -> None:
    rig = Rig().driving()
    for index in range(40):
        rig.vehicle.wrong.error_frames = int(index % 6 == 0)
        state = rig.cycle()
    assert state is not None
    assert state.armed


def test_the_link_itself_sends_only_what_is_on_the_list() -> None:
    rig = Rig().driving()
    rig.link._writers[0].frame_id = 0x7FF
    with pytest.raises(LinkError, match="0x7ff of 8 bytes is not one that may be sent"):
        rig.cycle()


def test_a_command_that_is_over_is_not_taken() -> None:
    rig = Rig().driving(0.0)
    for _ in range(4):
        rig.t_ns += PERIOD_NS
        rig.link.poll(rig.t_ns)
        stale = Command(t_ns=rig.t_ns - 1, steering_rad=0.3, speed_mps=1.0, valid_until_ns=rig.t_ns - 1)
        rig.link.send(stale, rig.t_ns)
    assert rig.vehicle.accepted[-1][1]["steering_rad"] == pytest.approx(0.0, abs=1e-3)


def test_a_full_queue_is_a_lost_port() -> None:
    rig = Rig().driving()
    rig.vehicle.wrong.queue_full = True
    with pytest.raises(PortLost, match="queue is full"):
        rig.cycle()


def test_a_full_bus_changes_nothing() -> None:
    rig = Rig().driving()
    rig.vehicle.wrong.load_frames = FULL_LOAD_FRAMES
    for _ in range(50):
        state = rig.cycle()
    assert state is not None
    assert state.armed


def test_stale_commands_that_a_flooded_bus_lets_through_at_last_engage_nothing() -> None:
    rig = Rig().driving()
    rig.vehicle.wrong.flooded = True
    took_ns, state = rig.until_disarmed()
    assert took_ns <= 100 * MS
    assert any(fault.startswith("can_timeout") for fault in state.faults)
    for _ in range(5):
        rig.cycle()
    assert not rig.vehicle.engaged
    changes, taken = len(rig.vehicle.engagements), len(rig.vehicle.accepted)
    rig.vehicle.wrong.flooded = False
    rig.cycle()
    assert any(told["enable"] for _, told in rig.vehicle.accepted[taken:]), "some of those that waited are not yet 0"
    assert len(rig.vehicle.engagements) == changes


def test_a_bus_that_stays_flooded_fills_the_queue() -> None:
    rig = Rig().driving()
    rig.vehicle.wrong.flooded = True
    for _ in range(10):
        rig.cycle()
    with pytest.raises(PortLost, match="queue is full"):
        rig.cycle()


def test_a_loop_that_gives_no_command_is_disarmed_and_one_that_hangs_sends_nothing() -> None:
    rig = Rig().driving()
    sent = len(rig.vehicle.accepted)
    states = [rig.cycle(None) for _ in range(8)]
    assert [state is not None and state.armed for state in states] == [True] * 5 + [False] * 3
    assert "command_timeout" in states[-1].faults  # type: ignore[union-attr]
    assert len(rig.vehicle.accepted) > sent
    rig = Rig().driving()
    sent = len(rig.vehicle.accepted)
    rig.vehicle.advance(rig.t_ns + 150 * MS)
    assert len(rig.vehicle.accepted) == sent
    assert not rig.vehicle.engaged, "the vehicle lets go by itself"


@pytest.mark.parametrize("angle", [math.nan, math.inf])
def test_what_is_no_number_is_never_sent(angle: float) -> None:
    rig = Rig().driving(0.01)
    for _ in range(5):
        rig.cycle(angle, angle)
    for _, told in rig.vehicle.accepted[-5:]:
        assert told["steering_rad"] == pytest.approx(0.01, abs=1e-4)
        assert told["speed_mps"] == 0.0
    accels = [told["accel_mps2"] for _, told in rig.vehicle.accepted[-6:]]
    steps = [b - a for a, b in itertools.pairwise(accels)]
    assert steps == pytest.approx([-ACCEL_JERK_MAX_MPS3 * 0.02] * 5, abs=0.002), "it brakes, more and more"


def test_closing_lets_the_vehicle_go() -> None:
    rig = Rig().driving()
    rig.link.close()
    rig.link.close()
    assert not rig.vehicle.accepted[-1][1]["enable"]
    with pytest.raises(PortLost):
        rig.link.poll(rig.t_ns)


def test_a_steering_wheel_s_angle_goes_both_ways_by_the_ratio() -> None:
    signals = tuple(
        dataclasses.replace(value, minimum=-1e9, maximum=1e9) if value.value == "steering_rad" else value
        for value in CONFIG.state
    )
    rig = Rig(dataclasses.replace(CONFIG, steering_ratio=16.0, state=signals)).driving(0.01)
    state = rig.cycle(0.01)
    assert state is not None
    assert state.steering_rad == pytest.approx(0.01, abs=1e-3)
    assert rig.vehicle.accepted[-1][1]["steering_rad"] == pytest.approx(0.16, abs=1e-2)


def test_only_frames_on_the_list_are_sent() -> None:
    rig = Rig()
    port = WhitelistedPort(MemoryCanPort(rig.vehicle, rig), frozenset({(0x100, False, 8)}))
    port.open()
    for frame_id, extended, length in ((0x101, False, 8), (0x100, True, 8), (0x100, False, 7)):
        with pytest.raises(LinkError, match="is not one that may be sent"):
            port.send(frame_id, bytes(length), extended)
    port.send(0x100, bytes(8), False)
    assert rig.vehicle.verdicts.total() == 1


def test_a_mapping_without_speed_or_with_our_own_identifier_is_refused() -> None:
    state = tuple(value for value in CONFIG.state if value.value != "speed_mps")
    with pytest.raises(ConfigError, match="speed_mps is missing"):
        Rig(dataclasses.replace(CONFIG, state=state))
    with pytest.raises(ConfigError, match="at least enable, and steering_rad or torque_nm"):
        Rig(dataclasses.replace(CONFIG, command=CONFIG.command[1:]))


def test_while_somebody_else_sends_our_messages_the_state_grows_old() -> None:
    """So that the loop does not take the input for well, and arms only half a second after the end."""
    rig = Rig().driving()
    rig.vehicle.wrong.second_sender = True
    rig.cycle()
    start_ns = rig.t_ns
    for _ in range(10):
        state = rig.cycle()
        assert state is not None
        assert state.t_ns <= start_ns
    rig.vehicle.wrong.second_sender = False
    for _ in range(7):
        state = rig.cycle()
    assert state is not None
    assert rig.t_ns - state.t_ns <= PERIOD_NS


def test_a_missing_heartbeat_is_no_restart() -> None:
    rig = Rig().driving()
    rig.vehicle.wrong.missing.add("AM_HEARTBEAT")
    _, state = rig.until_disarmed()
    assert (state.boot_id, state.faults) == (1, ("can_timeout:AM_HEARTBEAT",))


def test_a_falling_speed_is_followed_without_trailing_it() -> None:
    rig = Rig().driving()
    wanted = 15.0
    for _ in range(75):
        wanted -= 2.5 * PERIOD_NS * 1e-9
        rig.cycle(0.0, wanted)
    assert rig.body.speed_mps == pytest.approx(wanted, abs=0.3)  # by the gain alone 2.5 / 0.8 m/s more
    for _ in range(150):
        rig.cycle(0.0, wanted)
    assert rig.body.speed_mps == pytest.approx(wanted, abs=0.1)

"""Whether the car may drive: a pure state machine, time passed in.

*Unwell* (may pass by itself): no frame yet, the newest older than `frame_timeout_s`, its time not after the one
before or more than `FUTURE_S` ahead, an estimate that is LOST, anything not finite, an exception of the chain, an input
that cannot be true or a lane that is too uncertain (`runtime.input_checks`).
*Broken* (needs a person): link down or silent, the board restarted, or not armed when it should be (or armed when it
should not), a person who asks for a stop or who drove and lets go, a clock that went back, a loop that stood still for
longer than a command lives (or took that long from a frame to its command) while the car was fast. *Healthy*: neither.
`VehicleState.faults` stop nothing by themselves: a damaged byte is no reason to stop, and a board that no longer obeys
says so by being disarmed.

A loop that stood still is only *unwell* where it did so for less than `STALL_S` and the car cannot have come farther in
that time than the free space beside it (`blind_m`): whatever its direction was, it is still inside its lane. A board
disarms itself in such a pause, as it must: for `STALL_S` from then on it is asked to arm again while the car is held.

    mode              | on                                                       | next     | sent
    ------------------|----------------------------------------------------------|----------|---------------
    DISARMED, STOPPED | arm request, healthy for rearm_s                         | ARMING   | NEUTRAL, arm
    DISARMED, STOPPED | arm request, not healthy for so long: refused, forgotten | the same | NEUTRAL
    DISARMED          | auto-arm not yet used up, healthy for rearm_s            | ARMING   | NEUTRAL, arm
    ARMING            | unwell, broken or ARM_TIMEOUT_S over                     | DISARMED | NEUTRAL, disarm
    ARMING            | the vehicle says it is armed, healthy frame in this cycle | DRIVING  | PASS
    DRIVING           | broken                                                   | STOPPED  | roll out, disarm
    DRIVING           | unwell, and held holds_max times in holds_window_s       | STOPPED  | roll out, disarm
    DRIVING           | unwell                                                   | HOLD     | HOLD_STEERING
    HOLD              | broken, or hold_s over                                   | STOPPED  | roll out, disarm
    HOLD              | healthy frame in this cycle                               | DRIVING  | PASS

*Roll out* is HOLD_STEERING for `ROLL_OUT_S`, or until the car's odometry shows that it stands
(`runtime.standstill`), then NEUTRAL: a car that is stopped in a bend still rolls, and with
straight wheels it would roll out of its lane. The throttle is neutral from the first moment, whoever stops the car and
why; the steering is the one sent last, which no later frame changes and nothing prolongs: the next mode ends it. A
board that is disarmed holds it for the same time by itself (`firmware_link`).

The first row that fits counts, and nothing else changes the mode. TRACKING, ONE_LINE and COASTING all drive; driving
slower on less is the controller's task. A request is never remembered: a car that starts off seconds after the key
was pressed, because the camera came back just then, surprises whoever lifts it. Auto-arm (`--arm`) is the one
exception, a request made once at the start that is used up when the car first drives; no stop brings it back.

A person may take over at any time (`SafetyInputs.by_hand`), and needs no lane: what is wrong with it makes nothing
unwell meanwhile. The car that they let go of stops: the pipeline never gets it back by itself.

Event kinds: arming, driving, hold, stop, disarmed (arming given up), arm-refused, take-over.
"""

from __future__ import annotations

import enum
import math
from collections import deque
from dataclasses import dataclass

from automodel.config import SafetyConfig
from automodel.runtime.clocks import NS_PER_S
from automodel.runtime.standstill import Standstill
from automodel.signals import Event, LaneStatus, VehicleState

OVERLOADED = "overloaded"  # what the reason begins with where frames are too old once they have been looked at
CYCLE_S = 0.02  # the longest wait for a frame in one cycle: a signal goes unanswered no longer
STALL_S = 0.3  # after a longer pause of the loop a person must look, however slow the car was: as after a HOLD
FUTURE_S = 0.05  # a frame further ahead of the clock than this carries a wrong time
LINK_SILENCE_S = 0.1  # a vehicle that has said nothing for so long is gone: of 150 ms for a stop 45 are left then
ARM_TIMEOUT_S = 1.0  # the vehicle's time to say that it is armed
ROLL_OUT_S = 2.0  # a car that freewheels from 1.3 m/s stands by then (0.5 to 2 s by motor controller and speed)
REPEAT_S = 0.1  # arm and disarm are asked for again so often while the vehicle does not follow: a wire may lose bytes


class SafetyMode(enum.Enum):
    """The states of the machine."""

    DISARMED = "DISARMED"  # nothing has been asked for yet
    ARMING = "ARMING"  # the vehicle has been asked to take commands, and has not yet said that it does
    DRIVING = "DRIVING"
    HOLD = "HOLD"  # steering held, neutral throttle, for a bounded time
    STOPPED = "STOPPED"  # neutral, straight once it has rolled out; latched until a person arms again


class Action(enum.Enum):
    """What goes to the vehicle."""

    PASS = "PASS"  # the limited command of this cycle's frame; nothing in a cycle without one
    HOLD_STEERING = "HOLD_STEERING"  # the steering sent last, neutral throttle
    NEUTRAL = "NEUTRAL"  # straight, neutral throttle


@dataclass(frozen=True, slots=True, kw_only=True)
class Seen:
    """What this cycle's frame gave.

    `taken_ns` is when the loop took the frame up, `valid_until_ns` the life of the command made from it (None: the
    chain gave none).
    """

    frame_t_ns: int
    taken_ns: int
    status: LaneStatus
    valid_until_ns: int | None


@dataclass(frozen=True, slots=True, kw_only=True)
class SafetyInputs:
    """One cycle of the loop: `seen` is None when no frame came, `state` None while the vehicle has not said hello.

    `faults` are texts of what was found wrong in this cycle, `lane_faults` of what was wrong with the lane or with how
    the car turns; `arm` is a person's request made in this cycle, `stop` why
    a person, or the silence of one, wants the car to stop. `by_hand`: a person drives in this cycle.
    `speed_mps` is the greatest speed that the car may have had since the cycle before.
    """

    seen: Seen | None
    state: VehicleState | None
    link_up: bool = True
    faults: tuple[str, ...] = ()
    lane_faults: tuple[str, ...] = ()
    arm: bool = False
    stop: str | None = None
    by_hand: bool = False
    speed_mps: float = math.inf


@dataclass(frozen=True, slots=True, kw_only=True)
class SafetyDecision:
    """What to do now. `reason` tells why the input is not healthy, None where it is."""

    mode: SafetyMode
    action: Action
    arm: bool
    disarm: bool
    reason: str | None
    events: tuple[Event, ...]


class Safety:
    """The state machine; `auto_arm` counts as one request made by a person at the start.

    `blind_m` is the distance that the car may drive while the loop stands still without having to be stopped for it.
    """

    def __init__(self, config: SafetyConfig, auto_arm: bool = False, blind_m: float = 0.0) -> None:
        self._frame_timeout_ns = round(config.frame_timeout_s * NS_PER_S)
        self._validity_ns = round(config.command_validity_s * NS_PER_S)
        self._hold_ns = round(config.hold_s * NS_PER_S)
        self._rearm_ns = round(config.rearm_s * NS_PER_S)
        self._holds_max = config.holds_max
        self._holds_window_ns = round(config.holds_window_s * NS_PER_S)
        self._auto_arm = auto_arm
        self._blind_m = blind_m
        self._held_ns: deque[int] = deque()  # when the car was held in the last `holds_window_s`
        self._excused_ns: int | None = None  # until when a vehicle that has disarmed itself may be armed again
        self._standstill = Standstill()
        self._rolled_out = False  # the car stands after a stop
        self._mode = SafetyMode.DISARMED
        self._since_ns = 0  # when the mode was entered
        self._must_disarm = False
        self._asked_ns: int | None = None  # when the vehicle was last asked to arm or to disarm
        self._boot_id: int | None = None  # of the vehicle as it was armed
        self._by_hand = False
        self._healthy_since_ns: int | None = None
        self._drivable_since_ns: int | None = None  # by hand: healthy but for the lane
        self._last_ns: int | None = None
        self._frame_t_ns: int | None = None
        self._frame_fault: str | None = "no frame has come yet"  # holds until the next frame
        self._lane_fault: str | None = None  # this, too

    @property
    def mode(self) -> SafetyMode:
        """The mode now."""
        return self._mode

    def frame_time_fault(self, t_ns: int, now_ns: int) -> str | None:
        """Why a frame taken at `t_ns` must not be used, None where its time is right; changes nothing."""
        if self._frame_t_ns is not None and t_ns <= self._frame_t_ns:
            return f"the frame's time is not after the one before: {_s(t_ns - self._frame_t_ns)} s"
        if t_ns - now_ns > FUTURE_S * NS_PER_S:
            return f"the frame's time lies {_s(t_ns - now_ns)} s ahead"
        return None

    def frame_due_ns(self) -> int | None:
        """When the newest frame will be too old [ns], None before the first."""
        return None if self._frame_t_ns is None else self._frame_t_ns + self._frame_timeout_ns

    def step(self, inputs: SafetyInputs, now_ns: int) -> SafetyDecision:
        """One cycle at `now_ns`; call it at least every 20 ms, with or without a frame."""
        stall, broken = self._clock_fault(inputs, now_ns)
        disarmed, trouble = self._vehicle_fault(inputs, now_ns)
        broken = inputs.stop or broken or trouble or self._let_go(inputs)
        self._auto_arm = self._auto_arm and inputs.stop is None
        frame_fault, lane_fault = self._chain_fault(inputs, now_ns)  # always asked: it remembers the frame
        unwell = stall or disarmed or frame_fault
        self._last_ns = now_ns
        self._drivable_since_ns = _since(self._drivable_since_ns, (broken or unwell) is None, now_ns)
        whole = broken or unwell or lane_fault
        self._healthy_since_ns = _since(self._healthy_since_ns, whole is None, now_ns)
        unwell = unwell if inputs.by_hand else unwell or lane_fault
        heard = inputs.state if inputs.link_up else None
        self._rolled_out |= self._standstill.step(heard, self._mode is SafetyMode.DRIVING)
        reason = broken or unwell
        taken_over = inputs.by_hand and not self._by_hand
        self._by_hand = inputs.by_hand
        events: tuple[Event, ...] = ()
        if self._mode in (SafetyMode.DISARMED, SafetyMode.STOPPED):
            events = self._at_rest(inputs, reason, now_ns)
        elif self._mode is SafetyMode.ARMING:
            events = self._arming(inputs, reason, now_ns)
        elif broken is not None:
            events = self._enter(SafetyMode.STOPPED, "stop", broken, now_ns)
        elif self._mode is SafetyMode.DRIVING:
            if unwell is not None:
                events = self._hold(unwell, now_ns)
        else:
            events = self._held(inputs, unwell, now_ns)
        if taken_over and self._mode in (SafetyMode.DRIVING, SafetyMode.HOLD):
            events = (Event(t_ns=now_ns, kind="take-over", text="a person drives by hand"), *events)
        return self._decide(inputs, reason, events, now_ns)

    def _at_rest(self, inputs: SafetyInputs, reason: str | None, now_ns: int) -> tuple[Event, ...]:
        since_ns = self._drivable_since_ns if inputs.by_hand else self._healthy_since_ns
        healthy_ns = 0 if since_ns is None else now_ns - since_ns
        if reason is None and healthy_ns >= self._rearm_ns:
            if inputs.arm or self._auto_arm:
                self._boot_id = inputs.state.boot_id if inputs.state is not None else None
                by = "by request, to be driven by hand" if inputs.by_hand else "by request"
                text = by if inputs.arm else "by itself, as was asked for at the start"
                return self._enter(SafetyMode.ARMING, "arming", text, now_ns)
        elif inputs.arm:
            why = reason or f"the input is healthy for {_s(healthy_ns)} s only, expected {_s(self._rearm_ns)} s"
            return (Event(t_ns=now_ns, kind="arm-refused", text=why),)
        return ()

    def _arming(self, inputs: SafetyInputs, reason: str | None, now_ns: int) -> tuple[Event, ...]:
        if reason is None and now_ns - self._since_ns >= ARM_TIMEOUT_S * NS_PER_S:
            reason = f"the vehicle has not armed within {ARM_TIMEOUT_S} s"
        if reason is not None:
            self._healthy_since_ns = self._drivable_since_ns = None
            return self._enter(SafetyMode.DISARMED, "disarmed", reason, now_ns)
        if inputs.seen is not None and inputs.state is not None and inputs.state.armed:
            self._auto_arm = False
            return self._enter(SafetyMode.DRIVING, "driving", "the vehicle is armed", now_ns)
        return ()

    def _hold(self, unwell: str, now_ns: int) -> tuple[Event, ...]:
        """Hold the car; stop it where it has been held too often."""
        while self._held_ns and now_ns - self._held_ns[0] >= self._holds_window_ns:
            self._held_ns.popleft()
        if len(self._held_ns) >= self._holds_max:
            window_s = self._holds_window_ns / NS_PER_S
            often = f"held {self._holds_max} times within {window_s:g} s, and again: {unwell}"
            return self._enter(SafetyMode.STOPPED, "stop", often, now_ns)
        self._held_ns.append(now_ns)
        return self._enter(SafetyMode.HOLD, "hold", unwell, now_ns)

    def _held(self, inputs: SafetyInputs, unwell: str | None, now_ns: int) -> tuple[Event, ...]:
        held_ns = now_ns - self._since_ns
        if held_ns >= self._hold_ns:
            return self._enter(SafetyMode.STOPPED, "stop", f"held for {_s(held_ns)} s: {unwell or 'no frame'}", now_ns)
        if unwell is None and inputs.seen is not None:
            return self._enter(SafetyMode.DRIVING, "driving", f"healthy again after {_s(held_ns)} s", now_ns)
        return ()

    def _enter(self, mode: SafetyMode, kind: str, text: str, now_ns: int) -> tuple[Event, ...]:
        if mode in (SafetyMode.STOPPED, SafetyMode.DISARMED):
            self._boot_id = None
            self._must_disarm = True
            self._excused_ns = None
            self._held_ns.clear()
        if mode is not SafetyMode.HOLD:
            self._asked_ns = None  # so that the vehicle is asked at once
        self._mode = mode
        self._since_ns = now_ns
        self._rolled_out = False
        return (Event(t_ns=now_ns, kind=kind, text=text),)

    def _decide(
        self, inputs: SafetyInputs, reason: str | None, events: tuple[Event, ...], now_ns: int
    ) -> SafetyDecision:
        action, arm, disarm = Action.NEUTRAL, False, False
        if self._mode is SafetyMode.DRIVING:
            action = Action.PASS
        elif self._mode is SafetyMode.HOLD or self._rolls_out(now_ns):
            action = Action.HOLD_STEERING
        due = self._asked_ns is None or now_ns - self._asked_ns >= REPEAT_S * NS_PER_S
        armed = inputs.state is not None and inputs.state.armed
        if self._mode is SafetyMode.ARMING or (self._mode is SafetyMode.HOLD and not armed):
            arm = due
        elif self._mode in (SafetyMode.DISARMED, SafetyMode.STOPPED):
            disarm = due and (armed or self._must_disarm)
        if arm or disarm:
            self._asked_ns = now_ns
            self._must_disarm = False
        return SafetyDecision(mode=self._mode, action=action, arm=arm, disarm=disarm, reason=reason, events=events)

    def _rolls_out(self, now_ns: int) -> bool:
        rolled_ns = now_ns - self._since_ns
        if self._rolled_out:
            return False
        return self._mode is SafetyMode.STOPPED and 0 <= rolled_ns < ROLL_OUT_S * NS_PER_S

    def _clock_fault(self, inputs: SafetyInputs, now_ns: int) -> tuple[str | None, str | None]:
        """How the loop has stood still where the car can be held for it, and what is wrong with time where it cannot.

        Time itself went wrong (it stepped back), or the loop spent it so that a command went stale.
        """
        stood_ns = 0 if self._last_ns is None else now_ns - self._last_ns
        if stood_ns < 0:
            return None, f"the clock went back by {_s(-stood_ns)} s"
        text = self._stall(inputs, stood_ns, now_ns)
        if text is None:
            return None, None
        near = inputs.speed_mps * stood_ns <= self._blind_m * NS_PER_S
        if stood_ns >= STALL_S * NS_PER_S or not near:
            return None, text
        self._excused_ns = now_ns + round(STALL_S * NS_PER_S)
        return text, None

    def _stall(self, inputs: SafetyInputs, stood_ns: int, now_ns: int) -> str | None:
        """Why the vehicle may have got no command for longer than one lives, `stood_ns` after the cycle before."""
        if stood_ns > self._validity_ns:
            return f"the loop stood still for {_s(stood_ns)} s"
        seen = inputs.seen
        if seen is None or seen.valid_until_ns is None or now_ns < seen.valid_until_ns:
            return None
        if seen.taken_ns - seen.frame_t_ns >= self._frame_timeout_ns:
            return None  # it was late when it came: the camera's doing, which may pass
        return f"the command went stale in the loop, {_s(now_ns - seen.taken_ns)} s after the frame was taken up"

    def _vehicle_fault(self, inputs: SafetyInputs, now_ns: int) -> tuple[str | None, str | None]:
        """That the vehicle has disarmed itself while the loop stood still, which it may; and what it may not."""
        broken = self._vehicle_broken(inputs.state, inputs.link_up, now_ns)
        if broken is not None or inputs.state is None or inputs.state.armed:
            return None, broken
        if self._mode not in (SafetyMode.DRIVING, SafetyMode.HOLD):
            return None, None
        if self._excused_ns is None or now_ns >= self._excused_ns:
            return None, "the vehicle has disarmed itself"
        return "the vehicle has disarmed itself while the loop stood still", None

    def _vehicle_broken(self, state: VehicleState | None, link_up: bool, now_ns: int) -> str | None:
        if not link_up:
            return "the link to the vehicle is down"
        if state is None:
            return "the vehicle has not said hello"
        if abs(now_ns - state.t_ns) > LINK_SILENCE_S * NS_PER_S:
            return f"the vehicle has said nothing for {_s(now_ns - state.t_ns)} s"
        if self._boot_id is not None and state.boot_id != self._boot_id:
            return "the vehicle's controller has restarted"
        if state.driver_override:
            return "the driver has the car"
        if self._mode in (SafetyMode.DISARMED, SafetyMode.STOPPED) and state.armed:
            return "the vehicle is still armed"
        return None

    def _let_go(self, inputs: SafetyInputs) -> str | None:
        """That the person who drove by hand does so no more."""
        at_rest = self._mode in (SafetyMode.DISARMED, SafetyMode.STOPPED)
        return "the person who drove let go" if self._by_hand and not inputs.by_hand and not at_rest else None

    def _chain_fault(self, inputs: SafetyInputs, now_ns: int) -> tuple[str | None, str | None]:
        """What is wrong with the newest frame or with what was made of it, and what with the lane in it."""
        seen = inputs.seen
        if seen is not None:
            self._frame_fault = self.frame_time_fault(seen.frame_t_ns, now_ns)
            self._frame_t_ns = seen.frame_t_ns
            if self._frame_fault is None and inputs.faults:
                self._frame_fault = "; ".join(inputs.faults)
            self._lane_fault = "; ".join(inputs.lane_faults) or None
            if self._lane_fault is None and seen.status is LaneStatus.LOST:
                self._lane_fault = "the lane is lost"
        elif inputs.faults:
            return "; ".join(inputs.faults), self._lane_fault
        if self._frame_fault is None and self._frame_t_ns is not None:
            age_ns = now_ns - self._frame_t_ns
            if age_ns >= self._frame_timeout_ns:
                return self._too_old(seen, age_ns), self._lane_fault
        return self._frame_fault, self._lane_fault

    def _too_old(self, seen: Seen | None, age_ns: int) -> str:
        """Why the newest frame is too old: the machine took too long for it, or the camera gives none in time."""
        if seen is not None:
            in_time = seen.taken_ns - seen.frame_t_ns < self._frame_timeout_ns
            waited_ns = 0 if self._last_ns is None else seen.taken_ns - self._last_ns
            if in_time or waited_ns > 2 * CYCLE_S * NS_PER_S:  # nobody woke the loop when its wait was over
                limit_ms = self._frame_timeout_ns // 1_000_000
                return f"{OVERLOADED}: frames {age_ns // 1_000_000} ms late (limit {limit_ms})"
        return f"the newest frame is {_s(age_ns)} s old"


def _s(duration_ns: int) -> str:
    return f"{duration_ns / NS_PER_S:.3f}"


def _since(since_ns: int | None, holds: bool, now_ns: int) -> int | None:
    """Since when something holds, which it did since `since_ns` before."""
    if not holds:
        return None
    return now_ns if since_ns is None else since_ns

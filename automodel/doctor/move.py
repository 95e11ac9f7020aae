"""Moves the servo, with a person's consent and the whole safety chain between: limits, validity, the board's timer."""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from dataclasses import dataclass

from automodel.config import CarConfig
from automodel.control.limits import Limits
from automodel.doctor.board import POLL_S, Board, judge_followed
from automodel.doctor.findings import Finding, Verdict, fail, skip
from automodel.runtime.clocks import SleepingClock
from automodel.signals import Command, Motion, MotionSource
from firmware_link.errors import LinkError

NAME = "servo"
CONSENT = "Are the wheels off the ground, and is nobody's hand near? The front wheels turn left, right, straight"
LOOKED = "Did the front wheels turn left first, then right, then straight ahead?"

_SHARE = 0.5  # of the steering that the limits allow
_HOLDING_S = 0.6  # each angle
_ARMING_S = 1.0
_COMMAND_NS = 20_000_000  # between two commands


@dataclass(frozen=True, slots=True, kw_only=True)
class Consent:
    """`ask` puts a question to a person, None where nobody can be asked; `given` is consent from the start."""

    given: bool
    ask: Callable[[str], bool] | None = None


def servo_finding(car: CarConfig, link: Board, clock: SleepingClock, consent: Consent) -> Finding:
    """Left, right, straight, the motor in neutral throughout; the board is disarmed afterwards, come what may."""
    if not consent.given:
        if consent.ask is None:
            return skip(NAME, "not moved: there is nobody to ask", "give --yes, with the wheels off the ground")
        if not consent.ask(CONSENT):
            return skip(NAME, "not moved: no consent")
    reach = _SHARE * min(
        car.safety.steering_max_rad, max(car.link.servo.steering_rad), -min(car.link.servo.steering_rad)
    )
    asked = (reach, -reach, 0.0)
    try:
        applied = _steer(link, clock, car, asked)
    except LinkError as error:
        return fail(NAME, str(error), "close other programs, look at cable and supply, then run again")
    found = judge_followed(asked, applied)
    if found.verdict is Verdict.OK and not consent.given and consent.ask is not None and not consent.ask(LOOKED):
        do = "turned the other way: change the signs of [link.servo] steering_rad; not at all: wire to pin D9, supply"
        return fail(NAME, "the board set what was asked for, the wheels did otherwise", do)
    return found


def _steer(link: Board, clock: SleepingClock, car: CarConfig, asked: tuple[float, ...]) -> list[float | None]:
    """The angle [rad] that the board had set at the end of each of the `asked` ones; raises LinkError."""
    limits, applied = Limits(car.safety, car.vehicle), []
    try:
        _settle(link, clock, car.safety.rearm_s)
        link.arm(clock.now_ns())
        _await_armed(link, clock)
        for angle in asked:
            applied.append(_hold(link, clock, limits, angle))
    finally:
        with contextlib.suppress(LinkError):
            link.disarm(clock.now_ns())
    return applied


def _hold(link: Board, clock: SleepingClock, limits: Limits, angle_rad: float) -> float | None:
    """Ask for one angle, at no speed, for a while; the angle that the board set last."""
    end_ns = clock.now_ns() + round(_HOLDING_S * 1e9)
    state = None
    while (now_ns := clock.now_ns()) < end_ns:
        wanted = Command(t_ns=now_ns, steering_rad=angle_rad, speed_mps=0.0, valid_until_ns=now_ns + 5 * _COMMAND_NS)
        still = Motion(t_ns=now_ns, speed_mps=0.0, yaw_rate_radps=0.0, source=MotionSource.NONE)
        link.send(limits.step(wanted, still, now_ns).command, now_ns)
        clock.sleep(_COMMAND_NS * 1e-9)
        state = link.poll(clock.now_ns())
        if state is None or not state.armed:
            why = ", ".join(state.faults) if state is not None else "it restarted"
            raise LinkError(f"the board disarmed itself while the servo moved: {why or 'it does not say why'}")
    return None if state is None else state.steering_rad


def _settle(link: Board, clock: SleepingClock, seconds: float) -> None:
    """Listen for a while: the person took time to answer, and what came meanwhile is old."""
    end_ns = clock.now_ns() + round(seconds * 1e9)
    while clock.now_ns() < end_ns:
        link.poll(clock.now_ns())
        clock.sleep(POLL_S)


def _await_armed(link: Board, clock: SleepingClock) -> None:
    """Poll until the board is armed; raises LinkError where it does not become so in time."""
    end_ns = clock.now_ns() + round(_ARMING_S * 1e9)
    while clock.now_ns() < end_ns:
        state = link.poll(clock.now_ns())
        if state is not None and state.armed:
            return
        clock.sleep(POLL_S)
    raise LinkError("the board does not take the arming")

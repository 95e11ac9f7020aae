from __future__ import annotations

from dataclasses import replace

from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, rule

from automodel.runtime.safety import Action, SafetyDecision, SafetyMode
from automodel.signals import LaneStatus
from tests.support.safety_rig import Rig


class AnyHistory(RuleBasedStateMachine):
    """Any order of good and bad turns; the vehicle obeys or not, restarts or disarms as it likes."""

    def __init__(self) -> None:
        super().__init__()
        self.rig = Rig()
        self.asked = False  # whether a person asked since the machine last came to rest
        self.healthy_ms = 0.0
        self.last: SafetyDecision | None = None
        self.unwell_ms = 0.0
        self.stopped_ms = 0.0  # since the machine stopped
        self.good_turns = 0
        self.stood_ms = 1e9  # since the loop stood still while the car was slow
        self.before = SafetyMode.DISARMED

    def play(self, good: bool, step_ms: float, **how: object) -> None:
        arm = bool(how.get("arm"))
        self.before = self.rig.safety.mode
        decision = self.last = self.rig.turn(step_ms=step_ms, **how)  # type: ignore[arg-type]
        if self.before in (SafetyMode.DISARMED, SafetyMode.STOPPED):
            if decision.mode is SafetyMode.ARMING:
                assert arm
                assert decision.reason is None
                assert self.healthy_ms + step_ms >= 500.0
                self.asked = True
            else:
                assert decision.mode is self.before
        if decision.mode in (SafetyMode.DISARMED, SafetyMode.STOPPED):
            self.asked = False
        self.healthy_ms = self.healthy_ms + step_ms if decision.reason is None else 0.0
        self.good_turns = self.good_turns + 1 if good else 0
        if self.good_turns >= 2:  # the first may follow a frame from the future, and is then older than that
            assert decision.mode is not SafetyMode.HOLD
        if decision.mode is SafetyMode.DRIVING:
            assert self.rig.state.armed
        stood = how.get("age_ms") is None and step_ms > 100.0 and self.rig.speed_mps * step_ms <= 100.0
        self.stood_ms = 0.0 if stood or how.get("work_ms") else self.stood_ms + step_ms
        stays = decision.mode is SafetyMode.STOPPED and self.before is SafetyMode.STOPPED
        self.stopped_ms = self.stopped_ms + round(step_ms * 1e6) * 1e-6 if stays else 0.0
        self.unwell_ms = 0.0 if decision.reason is None else self.unwell_ms + step_ms

    @rule(step_ms=st.floats(5.0, 40.0), count=st.integers(1, 40))
    def good(self, step_ms: float, count: int) -> None:
        for _ in range(count):
            self.play(True, step_ms)

    @rule(step_ms=st.floats(5.0, 40.0), count=st.integers(14, 60))
    def good_and_arm(self, step_ms: float, count: int) -> None:
        for _ in range(count):
            self.play(True, step_ms)
        self.play(True, step_ms, arm=True)
        self.play(True, step_ms)

    @rule(
        step_ms=st.floats(1.0, 40.0),
        count=st.integers(1, 30),
        arm=st.booleans(),
        how=st.sampled_from(
            [
                {"status": LaneStatus.LOST},
                {"age_ms": 80.0},
                {"age_ms": -60.0},
                {"faults": ("not finite",)},
                {"link_up": False},
                {"hello": False},
                {"silent": True},
                {"work_ms": 60.0, "age_ms": 110.0},
            ]
        ),
    )
    def bad(self, step_ms: float, count: int, arm: bool, how: dict[str, object]) -> None:
        for _ in range(count):
            self.play(False, step_ms, arm=arm, **how)

    @rule(step_ms=st.floats(1.0, 200.0), count=st.integers(1, 30), arm=st.booleans())
    def no_frame(self, step_ms: float, count: int, arm: bool) -> None:
        for _ in range(count):
            self.play(False, step_ms, age_ms=None, arm=arm)

    @rule(speed_mps=st.sampled_from([0.0, 0.6, 3.0]))
    def car_has_a_speed(self, speed_mps: float) -> None:
        self.rig.speed_mps = speed_mps

    @rule(obeys=st.booleans())
    def vehicle_follows(self, obeys: bool) -> None:
        self.rig.obeys = obeys

    @rule(armed=st.booleans(), boot_id=st.integers(3, 4))
    def vehicle_does_as_it_likes(self, armed: bool, boot_id: int) -> None:
        self.rig.state = replace(self.rig.state, armed=armed, boot_id=boot_id)

    @invariant()
    def never_drives_without_a_person(self) -> None:
        if self.rig.safety.mode in (SafetyMode.ARMING, SafetyMode.DRIVING, SafetyMode.HOLD):
            assert self.asked

    @invariant()
    def what_is_sent_fits_the_mode(self) -> None:
        if self.last is None:
            return
        fits = {SafetyMode.DRIVING: Action.PASS, SafetyMode.HOLD: Action.HOLD_STEERING}
        if self.stopped_ms < 2000.0:
            fits[SafetyMode.STOPPED] = Action.HOLD_STEERING
        assert self.last.action is fits.get(self.last.mode, Action.NEUTRAL)
        if self.last.mode is SafetyMode.DRIVING:
            assert self.last.reason is None
        assert not (self.last.arm and self.last.disarm)
        if self.last.arm and self.last.mode is not SafetyMode.ARMING:
            assert self.last.mode is SafetyMode.HOLD
            assert self.stood_ms < 300.0  # the loop stood still a moment ago

    @invariant()
    def a_trouble_ends_in_neutral_in_bounded_time(self) -> None:
        # HOLD begins with the trouble's first turn and lasts 300 ms, or the one turn in which that time runs out.
        if self.unwell_ms > 300.0 + 200.0 + 40.0:
            assert self.rig.safety.mode in (SafetyMode.DISARMED, SafetyMode.STOPPED)


TestAnyHistory = AnyHistory.TestCase
TestAnyHistory.settings = settings(max_examples=150, stateful_step_count=25, deadline=None, derandomize=True)

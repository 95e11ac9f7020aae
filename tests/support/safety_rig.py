"""A safety machine and a vehicle that obeys it, for the tests."""

from __future__ import annotations

import math
from dataclasses import replace

from automodel.config import SafetyConfig
from automodel.runtime.safety import Safety, SafetyDecision, SafetyInputs, SafetyMode, Seen
from automodel.signals import LaneStatus, VehicleState

MS = 1_000_000
CONFIG = SafetyConfig(frame_timeout_s=0.06, command_validity_s=0.1, hold_s=0.3, rearm_s=0.5, holds_max=5)
T0 = 50_000 * MS


class Rig:
    """A safety machine and a vehicle that obeys it, in turns of `step_ms`; every turn brings a fresh good frame.

    The car is as fast as can be (`speed_mps`), and may drive 0.1 m while the loop stands still.
    """

    def __init__(self, auto_arm: bool = False) -> None:
        self.safety = Safety(CONFIG, auto_arm, blind_m=0.1)
        self.speed_mps = math.inf
        self.now_ns = T0
        self.state = VehicleState(t_ns=T0, armed=False, boot_id=3)
        self.obeys = True
        self.events: list[tuple[str, str]] = []

    def turn(
        self,
        step_ms: float = 10.0,
        age_ms: float | None = 2.0,
        status: LaneStatus = LaneStatus.TRACKING,
        arm: bool = False,
        stop: str | None = None,
        link_up: bool = True,
        hello: bool = True,
        faults: tuple[str, ...] = (),
        lane_faults: tuple[str, ...] = (),
        by_hand: bool = False,
        work_ms: float = 1.0,
        silent: bool = False,
    ) -> SafetyDecision:
        """A turn `step_ms` after the last; `age_ms` is the frame's when it is decided on (None: no frame)."""
        self.now_ns += round(step_ms * MS)
        if not silent:
            self.state = replace(self.state, t_ns=self.now_ns)
        seen = None
        if age_ms is not None:
            t_ns = self.now_ns - round(age_ms * MS)
            taken_ns = self.now_ns - round(work_ms * MS)
            seen = Seen(frame_t_ns=t_ns, taken_ns=taken_ns, status=status, valid_until_ns=t_ns + 100 * MS)
        decision = self.safety.step(
            SafetyInputs(
                seen=seen,
                state=self.state if hello else None,
                link_up=link_up,
                faults=faults,
                lane_faults=lane_faults,
                by_hand=by_hand,
                arm=arm,
                stop=stop,
                speed_mps=self.speed_mps,
            ),
            self.now_ns,
        )
        if self.obeys and (decision.arm or decision.disarm):
            self.state = replace(self.state, armed=decision.arm)
        self.events += [(event.kind, event.text) for event in decision.events]
        return decision

    def turns(self, count: int, **how: object) -> SafetyDecision:
        for _ in range(count):
            decision = self.turn(**how)  # type: ignore[arg-type]
        return decision

    def drive(self) -> Rig:
        """Arm by request, up to the first turn of DRIVING."""
        self.turns(52)
        self.turn(arm=True)
        assert self.turn().mode is SafetyMode.DRIVING
        return self

    def hold(self) -> Rig:
        self.drive()
        assert self.turn(status=LaneStatus.LOST).mode is SafetyMode.HOLD
        return self

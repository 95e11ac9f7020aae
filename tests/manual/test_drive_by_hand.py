"""The simulated car, in real time, driven by hand with a gamepad, and by the page's words."""

from __future__ import annotations

import math
from pathlib import Path

import pytest

from automodel.assembly.drive import RunOptions, drive_simulated
from automodel.config import CarConfig, parse_car
from automodel.manual.controls import ABS_RZ, ABS_X, BTN_TR, EV_ABS, EV_KEY
from automodel.manual.device import EvdevDevice
from automodel.manual.operator import DeviceOperator
from automodel.recording.reader import Recording, RecordingSource
from automodel.runtime.run_types import TickRecord
from automodel.runtime.safety import SafetyMode
from automodel.signals import Event
from tests.support.piped_pad import PipedPad

pytestmark = [pytest.mark.slow, pytest.mark.realtime]

EVERY = 40  # ticks between two presses: what is refused, or stopped on a loaded machine, is tried again
ENOUGH, AFTER = 60, 30  # ticks driven by hand, and after it has let go


class Person(DeviceOperator):
    """Presses the button until the car drives, goes left, and lets go."""

    def __init__(self, pad: PipedPad, vanish: bool) -> None:
        super().__init__(EvdevDevice(pad))
        self._pad, self._vanish, self._ticks, self._down = pad, vanish, 0, False
        self.driven = self.after = 0
        self.events: list[Event] = []

    def on_tick(self, record: TickRecord) -> None:
        if record.tick is None:
            return
        driving = record.tick.driver is not None and record.decision.mode is SafetyMode.DRIVING
        self._ticks += 1
        self.driven += driving
        if self.driven > ENOUGH:
            self.after += 1
            if self.after == 1 and self._vanish:
                self._pad.unplugged = True
            elif self.after == 1:
                self._pad.send((EV_KEY, BTN_TR, 0))
        elif self._ticks % EVERY == 0 and not driving:
            self._down = not self._down
            self._pad.send((EV_KEY, BTN_TR, int(self._down)), (EV_ABS, ABS_RZ, 1023), (EV_ABS, ABS_X, -9000), (0, 0, 0))

    def on_event(self, event: Event) -> None:
        self.events.append(event)


@pytest.mark.parametrize("vanish", [False, True], ids=["lets go", "is unplugged"])
def test_a_person_drives_and_the_car_stops_when_the_pad(vanish: bool, tmp_path: Path) -> None:
    car: CarConfig = parse_car('[pipeline]\nname = "windows"\n', "car.toml")
    options = RunOptions(
        track="oval", duration_s=120.0, realtime=True, by_hand=True, record=tmp_path / "run.mcap", style="clean"
    )
    pad = PipedPad()
    person = Person(pad, vanish)
    with person:
        drive_simulated(car, "", options, [person], over=lambda: person.after > AFTER)
    kinds = [event.kind for event in person.events]
    assert "driving" in kinds
    assert kinds[-1] == "end"
    stops = [event.text for event in person.events if event.kind == "stop"]
    assert "the gamepad is gone" in stops if vanish else "the gamepad's button was released" in stops
    steps = list(RecordingSource(tmp_path / "run.mcap").recording.steps())
    assert person.driven > ENOUGH
    driven = [step for step in steps if step.driver is not None and any(c.speed_mps > 0 for c in step.commands)]
    assert driven
    limit_rad = car.safety.steering_max_rad
    for step in driven:
        assert step.driver is not None
        assert step.driver.speed == pytest.approx(1.0)
        assert all(0.0 <= command.steering_rad <= limit_rad for command in step.commands)
    after = [step for step in steps if step.frame.t_ns > driven[-1].frame.t_ns + 100_000_000]
    assert all(command.speed_mps == 0.0 for step in after for command in step.commands)  # neutral, and it stays so
    moved = [step.state.speed_mps for step in steps if step.state is not None and step.state.speed_mps is not None]
    assert max(moved) > 0.2
    assert math.isfinite(max(moved))
    assert "/driver" in {message.topic for message in Recording(tmp_path / "run.mcap")}

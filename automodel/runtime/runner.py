"""The run: one cycle after the other until someone says stop, and the car in neutral however it ends.

A cycle waits for the newest frame, at most 20 ms and no longer than the link asks for, so that the vehicle is polled,
the safety machine stepped and a signal answered at that pace whatever the camera does. What goes to the wire goes
first; recording, telling and the collector come after it. The whole run lives on the clock it is given: with a
`VirtualClock` and a source that advances it inside `read` the same code runs in lock-step.

Event kinds besides those of `automodel.runtime.safety`: fault (something not finite, or an exception of the chain),
vehicle-fault, link-lost, link-back, source-failed, source-back, camera-missing and camera-back (of a pair, while the
other one goes on: its frames do not come, or are dark or stuck), recorder-failed, end.
"""

from __future__ import annotations

import contextlib
import traceback
from collections.abc import Callable
from pathlib import Path

from automodel.interfaces import Source
from automodel.runtime.clocks import NS_PER_S
from automodel.runtime.latencies import Latencies
from automodel.runtime.loop import Tick, motion_faults, state_faults
from automodel.runtime.os_signals import collect_all, collect_young, no_garbage_collection, stop_on_signals
from automodel.runtime.run_log import RunLog
from automodel.runtime.run_types import (
    MotionStage,
    RunConfig,
    RunEnd,
    RunObserver,
    RunParts,
    RunResult,
    TickRecord,
)
from automodel.runtime.safety import CYCLE_S, Action, SafetyDecision, SafetyInputs, SafetyMode, Seen
from automodel.runtime.supervised_link import SupervisedLink
from automodel.runtime.supervised_source import SupervisedSource
from automodel.signals import (
    NEUTRAL,
    Command,
    DriverInput,
    Event,
    Frame,
    LaneEstimate,
    LaneStatus,
    Motion,
    MotionSource,
    StereoFrame,
    VehicleState,
)
from automodel.sources.errors import EndOfSource

__all__ = ["MotionStage", "RunConfig", "RunEnd", "RunObserver", "RunParts", "RunResult", "Runner", "TickRecord"]

SLICE_NS = round(CYCLE_S * NS_PER_S)
WORK_SHARE = 0.125  # of the newest measurement in the mean time of work: a slow machine is known after 8 frames
SLICE_MIN_NS = 1_000_000  # the shortest: a wait of nothing would let no virtual time pass


class Runner:
    """Drives `parts` in cycles; one runner makes one run.

    `arm_requested` is called every cycle and says whether a person has asked to arm since, `stop_requested` before it
    why one wants the car to stop. `wanted_by_hand` is asked before a frame is looked at what a person who drives wants,
    None while none does. `reopen` makes a new source
    in place of one that failed, or raises OSError; it may block, and is only called while the car is disarmed. Without
    it a source that failed ends the run as soon as the car stands. `on_event` gets every event after the command of its
    cycle was sent; it must be quick.
    """

    def __init__(
        self,
        parts: RunParts,
        config: RunConfig,
        *,
        observer: RunObserver | None = None,
        arm_requested: Callable[[], bool] | None = None,
        stop_requested: Callable[[], str | None] | None = None,
        wanted_by_hand: Callable[[], DriverInput | None] | None = None,
        reopen: Callable[[], Source] | None = None,
        on_event: Callable[[Event], None] | None = None,
    ) -> None:
        self._motion = parts.motion
        self._loop = parts.loop
        self._safety = parts.safety
        self._clock = parts.clock
        self._config = config
        self._validity_ns = round(config.command_validity_s * NS_PER_S)
        self._observer = observer
        self._arm_requested = arm_requested
        self._stop_requested = stop_requested
        self._wanted_by_hand = wanted_by_hand
        self._run_log = RunLog(parts.recorder, on_event)
        self._source = SupervisedSource(parts.source, parts.clock, self._run_log, reopen)
        self._link = SupervisedLink(parts.link, self._run_log.note)
        self._on_wire = NEUTRAL
        self._said: VehicleState | None = None  # the vehicle's last word, right or wrong
        self._state: VehicleState | None = None  # the last one that made sense
        self._end = "an error"
        self._work_ns = 0.0  # mean time from taking a frame up to its command on the wire
        self._index: int | None = None
        self._frames = self._skipped = self._overruns = self._stops = 0
        self._camera_pitch_rad = 0.0  # beyond car.toml's, as the last estimate was measured
        self._latencies = Latencies()
        self._error: Exception | None = None
        self._traceback: str | None = None

    @property
    def warning(self) -> str:
        """The loop's."""
        return self._loop.warning

    def run(self, stop: Callable[[], bool] | None = None, max_frames: int | None = None) -> RunResult:
        """Drive until `stop` says so, after `max_frames`, at the source's end, or on a signal.

        Raises the link's OSError where the vehicle could not be reached in the first place, and whatever a part raised
        that is not to be expected of it; the car is in neutral and everything closed by then.
        """
        with contextlib.ExitStack() as leaving:
            signalled = leaving.enter_context(stop_on_signals())
            if self._config.collector_off:
                leaving.enter_context(no_garbage_collection())
            # The last one in is the first to be called, and each is called whatever the ones before it raise.
            leaving.callback(self._source.close)
            leaving.callback(self._run_log.flush_events)
            leaving.callback(lambda: self._run_log.close(self._clock.now_ns()))
            leaving.callback(self._link.close)
            leaving.callback(self._park)
            self._link.open(self._clock.now_ns())
            end = self._drive(signalled, stop, max_frames)
            self._end = signalled() or end.value
        return RunResult(
            end=end,
            frames=self._frames,
            skipped=self._skipped,
            overruns=self._overruns,
            stops=self._stops,
            latencies=self._latencies,
            events=self._run_log.events,
            traceback=self._traceback,
            interrupted=signalled() is not None,
            unpaired=self._source.unpaired,
        )

    def _drive(
        self, signalled: Callable[[], str | None], stop: Callable[[], bool] | None, max_frames: int | None
    ) -> RunEnd:
        while True:
            if signalled() is not None:
                return RunEnd.SIGNAL
            if stop is not None and stop():
                return RunEnd.STOP
            if max_frames is not None and self._frames >= max_frames:
                return RunEnd.FRAMES
            if self._source.dead and self._at_rest():
                return RunEnd.SOURCE_FAILED
            try:
                self._cycle()
            except EndOfSource:
                return RunEnd.SOURCE

    def _cycle(self) -> None:
        frame = self._await_frame()
        taken_ns = self._clock.now_ns()
        heard, faults = self._listen(taken_ns)
        by_hand = self._wanted_by_hand() if self._wanted_by_hand is not None else None
        seen, tick = None, None
        if frame is not None:
            tick = self._look(frame, by_hand, taken_ns)
            faults += tick.faults if tick is not None else ()
            seen = Seen(
                frame_t_ns=frame.t_ns,
                taken_ns=taken_ns,
                status=tick.estimate.status if tick is not None else LaneStatus.LOST,
                valid_until_ns=tick.command.valid_until_ns if tick is not None else None,
            )
        stop = self._stop_requested() if self._stop_requested is not None else None
        arm = self._arm_requested is not None and self._arm_requested()
        was_at_rest = self._at_rest()
        state = self._link.newest(self._state, self._clock.now_ns())  # the chain gets it with the next cycle
        inputs = SafetyInputs(
            seen=seen,
            state=state,
            link_up=self._link.up,
            faults=faults,
            lane_faults=tick.lane_faults if tick is not None else (),
            arm=arm,
            stop=stop,
            by_hand=by_hand is not None,
            speed_mps=self._fastest_mps(state),
        )
        decision = self._safety.step(inputs, self._clock.now_ns())
        sent, sent_ns = self._send(decision, tick)
        own = frame is not None and tick is not None and sent is tick.command
        record = TickRecord(
            t_ns=sent_ns,
            frame=frame,
            state=self._state,
            tick=tick,
            decision=decision,
            sent=sent,
            latency_ns=sent_ns - frame.t_ns if own and frame is not None else None,
            unpaired=self._source.unpaired,
        )
        self._settle(record, faults)
        self._count(record, taken_ns)
        self._run_log.write(record, heard)
        if self._observer is not None:
            self._observer.on_tick(record)
        self._run_log.flush_events()
        self._tidy(record, was_at_rest)

    def _fastest_mps(self, state: VehicleState | None) -> float:
        """The greater of the speed that the vehicle reports and the one that it was given."""
        reported_mps = 0.0 if state is None or state.speed_mps is None else abs(state.speed_mps)
        return max(reported_mps, abs(self._on_wire.speed_mps))

    def _await_frame(self) -> Frame | StereoFrame | None:
        now_ns = self._clock.now_ns()
        due_ns, wake_ns = self._safety.frame_due_ns(), self._link.wake_ns
        wait_ns = SLICE_NS
        if due_ns is not None and due_ns > now_ns:
            wait_ns = min(wait_ns, due_ns - now_ns)
        if wake_ns is not None:
            wait_ns = min(wait_ns, wake_ns - now_ns)
        wait_ns = max(wait_ns, SLICE_MIN_NS)
        return self._source.read(wait_ns / NS_PER_S, self._at_rest())

    def _listen(self, now_ns: int) -> tuple[VehicleState | None, tuple[str, ...]]:
        """The vehicle's state where a new one has come that makes sense, and what does not make sense in it."""
        said = self._link.poll(now_ns)
        if said is None:
            self._said = self._state = None
        if said is None or said == self._said:
            return None, ()
        self._said = said
        faults = state_faults(said)
        if faults:
            return None, faults
        before = self._state.faults if self._state is not None else ()
        if set(said.faults) - set(before):
            self._run_log.report("vehicle-fault", f"the vehicle reports {', '.join(said.faults)}", now_ns)
        self._state = said
        return said, ()

    def _look(self, frame: Frame | StereoFrame, by_hand: DriverInput | None, now_ns: int) -> Tick | None:
        """The chain's tick; LOST where the chain failed, None for a frame whose time is wrong."""
        if self._safety.frame_time_fault(frame.t_ns, now_ns) is not None:
            return None  # dead reckoning over a wrong time would spoil the estimate; the safety machine tells why
        motion = Motion(t_ns=frame.t_ns, speed_mps=0.0, yaw_rate_radps=0.0, source=MotionSource.NONE)
        try:
            measured = self._motion.step(self._state, self._on_wire, frame.t_ns)
            motion = motion if motion_faults(measured) else measured
            return self._loop.tick(frame, measured, self._state, now_ns + round(self._work_ns), by_hand)
        except Exception as error:  # noqa: BLE001 - the one place that catches everything: the car must be held first
            self._error = error
            nothing = self._standstill(0.0, now_ns)
            lost = LaneEstimate(t_ns=frame.t_ns, status=LaneStatus.LOST)
            return Tick(estimate=lost, motion=motion, wanted=nothing, command=nothing, faults=(_one_line(error),))

    def _send(self, decision: SafetyDecision, tick: Tick | None) -> tuple[Command | None, int]:
        """What went out, None where nothing did, and the time when it had."""
        now_ns = self._clock.now_ns()
        command: Command | None = None
        if decision.action is Action.HOLD_STEERING:
            command = self._standstill(self._on_wire.steering_rad, now_ns)
        elif decision.action is Action.NEUTRAL:
            command = self._standstill(0.0, now_ns)
        elif tick is not None:
            command = tick.command
        sent = command is not None and self._link.send(command, now_ns)
        sent_ns = self._clock.now_ns()
        if decision.arm:
            self._link.arm(now_ns)
        elif decision.disarm:
            self._link.disarm(now_ns)
        if command is not None:  # a vehicle that cannot be reached falls back to neutral by itself
            self._on_wire = command if sent else NEUTRAL
        return (command if sent else None), sent_ns

    def _settle(self, record: TickRecord, faults: tuple[str, ...]) -> None:
        """What could wait until the command was out: clean the chain up after a fault, and tell of it."""
        error, self._error = self._error, None
        if error is not None:
            self._loop.failed()
            if self._traceback is None:
                self._traceback = "".join(traceback.format_exception(type(error), error, error.__traceback__))
        if record.frame is not None and record.tick is not None:
            self._source.report_eyes(record.frame, self._loop.eye_trouble)
        if record.decision.action is not Action.PASS or (record.tick is not None and record.sent is None):
            self._loop.overruled(self._on_wire)
        if record.tick is not None and record.tick.driver is None:
            faults += record.tick.lane_faults
        if faults:
            self._run_log.report("fault", "; ".join(faults), record.t_ns)
        if record.tick is not None and record.tick.estimate.lane_change:
            side = "left" if record.tick.estimate.lane_change > 0 else "right"
            text = f"the lane on the {side} is the lane now"
            self._run_log.note(Event(t_ns=record.t_ns, kind="lane-change", text=text))
        if record.tick is not None and record.tick.estimate.camera_pitch_rad != self._camera_pitch_rad:
            self._camera_pitch_rad = record.tick.estimate.camera_pitch_rad
            text = f"by the lane's lines the camera's pitch_rad is {self._camera_pitch_rad:+.3f} off car.toml's"
            self._run_log.note(Event(t_ns=record.t_ns, kind="camera-pitch", text=text))
        for event in record.decision.events:
            self._run_log.note(event)
            self._stops += event.kind == "stop"

    def _count(self, record: TickRecord, taken_ns: int) -> None:
        if record.frame is None:
            return
        self._frames += 1
        if self._index is not None:
            self._skipped += max(record.frame.index - self._index - 1, 0)
        self._index = record.frame.index
        # a pause is no measure of the work: what is longer than a command lives counts as that long
        self._work_ns += WORK_SHARE * (min(record.t_ns - taken_ns, self._validity_ns) - self._work_ns)
        self._overruns += record.t_ns - taken_ns > self._config.period_s * NS_PER_S
        if record.latency_ns is not None:
            self._latencies.add(record.latency_ns)

    def _tidy(self, record: TickRecord, was_at_rest: bool) -> None:
        if not self._config.collector_off:
            return
        if self._at_rest() and not was_at_rest:
            collect_all()
        elif record.frame is not None:
            collect_young()

    def _at_rest(self) -> bool:
        return self._safety.mode in (SafetyMode.DISARMED, SafetyMode.STOPPED)

    def _standstill(self, steering_rad: float, now_ns: int) -> Command:
        return Command(t_ns=now_ns, steering_rad=steering_rad, speed_mps=0.0, valid_until_ns=now_ns + self._validity_ns)

    def _park(self) -> None:
        now_ns = self._clock.now_ns()
        # A car that is being driven rolls out as after every stop; what is on the wire is straight otherwise.
        self._link.send(self._standstill(self._on_wire.steering_rad, now_ns), now_ns)
        self._link.disarm(now_ns)
        self._run_log.note(Event(t_ns=now_ns, kind="end", text=self._end))


def _one_line(error: Exception) -> str:
    place = error.__traceback__
    while place is not None and place.tb_next is not None:
        place = place.tb_next
    where = f" at {Path(place.tb_frame.f_code.co_filename).name}:{place.tb_lineno}" if place is not None else ""
    return f"{type(error).__name__}: {' '.join(str(error).split())}{where}"

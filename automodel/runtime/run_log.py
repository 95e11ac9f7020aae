"""What a run leaves behind: its events, and everything that goes to the recorder."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable

from automodel.interfaces import Recorder
from automodel.runtime.clocks import NS_PER_S
from automodel.runtime.run_types import TickRecord
from automodel.signals import Event, VehicleState

QUIET_S = 1.0  # least time between two events of the same kind and cause
EVENTS_KEPT = 10_000  # in memory, the newest; the recording has them all


class RunLog:
    """Passes a run on to its recorder; a recorder that fails is reported once and not used again; the car drives on."""

    def __init__(self, recorder: Recorder | None, on_event: Callable[[Event], None] | None = None) -> None:
        self._recorder = recorder
        self._on_event = on_event
        self._works = recorder is not None
        self._pending: list[Event] = []
        self._news: list[Event] = []
        self._kept: deque[Event] = deque(maxlen=EVENTS_KEPT)
        self._reported_ns: dict[tuple[str, str], int] = {}

    @property
    def events(self) -> tuple[Event, ...]:
        """The run's events so far, oldest first."""
        return tuple(self._kept)

    def flush_events(self) -> None:
        """Pass the events since the last call to `on_event`; apart from `note`, so that the wire can go first."""
        news, self._news = self._news, []
        if self._on_event is not None:
            for event in news:
                self._on_event(event)

    def note(self, event: Event) -> None:
        """Take an event in; the recorder gets it with the next cycle."""
        self._kept.append(event)
        self._news.append(event)
        if self._works:
            self._pending.append(event)

    def report(self, kind: str, text: str, t_ns: int, cause: str = "") -> bool:
        """Take in what may go wrong again and again; whether it was taken in.

        The same kind with the same `cause` is taken in at most once a second.
        """
        last_ns = self._reported_ns.get((kind, cause))
        if last_ns is not None and t_ns - last_ns < QUIET_S * NS_PER_S:
            return False
        self._reported_ns[kind, cause] = t_ns
        self.note(Event(t_ns=t_ns, kind=kind, text=text))
        return True

    def write(self, record: TickRecord, heard: VehicleState | None) -> None:
        """Pass one cycle on; `heard` is the vehicle's state where a new one came in this cycle."""
        recorder = self._recorder
        if recorder is None or not self._works:
            return
        try:
            if heard is not None:
                recorder.state(heard)
            if record.tick is not None and record.frame is not None:
                recorder.frame(record.frame)
                recorder.motion(record.tick.motion)
                recorder.estimate(record.tick.estimate)
                if record.tick.driver is not None:
                    recorder.driver(record.tick.driver)
            if record.sent is not None:
                recorder.command(record.sent)
            self._write_events(recorder)
        except OSError as error:
            self._failed(error, record.t_ns)

    def close(self, t_ns: int) -> None:
        """Write the last events and close the recorder; a failure is an event, too."""
        if self._recorder is None:
            return
        try:
            if self._works:
                self._write_events(self._recorder)
            self._recorder.close()
        except OSError as error:
            self._failed(error, t_ns)

    def _write_events(self, recorder: Recorder) -> None:
        for event in self._pending:
            recorder.event(event)
        self._pending.clear()

    def _failed(self, error: OSError, t_ns: int) -> None:
        self._works = False
        self._pending.clear()
        self.note(Event(t_ns=t_ns, kind="recorder-failed", text=f"recording has ended: {error}"))

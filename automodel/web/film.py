"""A run that can be looked at frame by frame: what each pipeline said, and the images on disk."""

from __future__ import annotations

import contextlib
import math
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO

import cv2
import numpy as np

from automodel.assembly.parts import open_source
from automodel.assembly.replay import AnyFrame, check_frame_size, frames_between
from automodel.assembly.report import Eye, Seen, car_of_run, eyes_of
from automodel.config import CarConfig, ConfigError
from automodel.console.progress import progress
from automodel.recording.export import image_of
from automodel.recording.reader import RecordingSource, Step
from automodel.signals import Event, Frame, LaneStatus, Motion
from automodel.sources.files import read_motion_csv
from automodel.types import Image
from automodel.viewer.run_trace import DrivenPath, dead_reckoned

Shot = tuple[float, AnyFrame, Motion, Step | None]  # time since the first frame [s], and what was recorded with it
_JPEG_QUALITY = 92  # [%] of the frames kept for looking at
_BLIND = (LaneStatus.COASTING, LaneStatus.LOST)


class Film:
    """Images in a temporary file, by their number; the file is gone when the program ends."""

    def __init__(self) -> None:
        self._file: IO[bytes] = tempfile.TemporaryFile(prefix="automodel-view-")  # noqa: SIM115 - as long as the film
        self._places: list[tuple[int, int]] = []

    def __len__(self) -> int:
        return len(self._places)

    def add(self, image: Image) -> None:
        """Append an image, (h, w) or (h, w, 3)."""
        data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])[1].tobytes()
        self._places.append((self._file.seek(0, 2), len(data)))
        self._file.write(data)

    def image(self, number: int) -> Image:
        """The image of this number, grey or BGR as it was; raises IndexError."""
        start, length = self._places[number]
        self._file.seek(start)
        image = cv2.imdecode(np.frombuffer(self._file.read(length), np.uint8), cv2.IMREAD_UNCHANGED)
        return np.asarray(image, dtype=np.uint8)

    def close(self) -> None:
        """Give the disk's space back."""
        self._file.close()


@dataclass(frozen=True, slots=True, kw_only=True)
class Footage:
    """The frames of a source that are looked at; `from_s` and `to_s` count from its first one."""

    path: Path
    car_file: Path | None = None
    motion_file: Path | None = None
    rate_hz: float | None = None
    from_s: float = 0.0
    to_s: float = math.inf

    @contextlib.contextmanager
    def opened(self, car: CarConfig, bar_title: str = "") -> Iterator[Iterator[Shot]]:
        """The frames, under a progress bar where it has a title; raises ConfigError and SourceError."""
        motion = read_motion_csv(self.motion_file) if self.motion_file is not None else None
        with contextlib.closing(open_source(self.path, car, self.rate_hz)) as source, contextlib.ExitStack() as shown:
            tick = None
            if bar_title:
                tick = shown.enter_context(progress(bar_title, getattr(source, "frame_count", None)))

            def shots() -> Iterator[Shot]:
                for t_s, frame, moved, _ in frames_between(source, motion, self.from_s, self.to_s):
                    if tick is not None:
                        tick()
                    if isinstance(frame, Frame):
                        check_frame_size(self.path, frame, car, self.car_file)
                    yield t_s, frame, moved, source.step if isinstance(source, RecordingSource) else None

            yield shots()


@dataclass(slots=True, kw_only=True, eq=False)
class ViewedRun:
    """n frames of a run: `t_s` since the first, `frames` their numbers in the source, and for each eye n of `seen`.

    `events` have their time [s] on the same scale; `path` is where the car drove, None where no motion is known.
    `trials` has the eyes that see with a changed car: the eye that each is compared with, and what was changed.
    """

    name: str
    footage: Footage
    eyes: list[Eye]
    film: Film
    t_s: list[float] = field(default_factory=list)
    frames: list[int] = field(default_factory=list)
    motions: list[Motion] = field(default_factory=list)
    seen: dict[str, list[Seen]] = field(default_factory=dict)
    events: list[tuple[float, Event]] = field(default_factory=list)
    path: DrivenPath | None = None
    trials: dict[str, tuple[str, str]] = field(default_factory=dict)

    def eye(self, name: str) -> Eye:
        """The eye of this name; raises KeyError."""
        found = next((eye for eye in self.eyes if eye.name == name), None)
        if found is None:
            raise KeyError(name)
        return found

    def add_trial(self, base: str, change: str, car: CarConfig, seen: list[Seen]) -> str:
        """Keep what was seen with a changed car beside the eye `base`; the name of its eye."""
        name = f"change {len(self.trials) + 1}"
        before = self.trials[base][1] if base in self.trials else car.pipeline.name
        self.eyes.append(Eye(name, car, None))
        self.seen[name] = seen
        self.trials[name] = (base, f"{before}, {change}")
        return name

    def picture(self, number: int, eye_name: str) -> Image:
        """A frame with what an eye said of it; raises IndexError and KeyError."""
        eye = self.eye(eye_name)
        if not 0 <= number < len(self.frames):
            raise IndexError(number)
        note = f"{self.t_s[number]:.2f} s  frame {self.frames[number]}  {eye_name}"
        return eye.picture(self.film.image(number), self.seen[eye_name][number], note)

    def marks(self, eye_name: str) -> list[tuple[float, str]]:
        """What is worth jumping to, by time: events, and where an eye begins to see nothing or sees a line again."""
        marks = [(t_s, f"{event.kind}: {event.text}") for t_s, event in self.events]
        before: LaneStatus | None = None
        for t_s, word in zip(self.t_s, self.seen[eye_name], strict=True):
            status = LaneStatus.LOST if word.estimate is None else word.estimate.status
            if before is not None and status is not before and (status in _BLIND or before in _BLIND):
                marks.append((t_s, f"{before.value} to {status.value}"))
            before = status
        return sorted(marks)


def look_through(footage: Footage, pipelines: Sequence[str] = ()) -> ViewedRun:
    """Run the pipelines over a source and keep everything; raises ConfigError and SourceError for what is wrong."""
    path = footage.path
    car = car_of_run(footage.car_file, path)
    eyes = eyes_of(pipelines, car, path.suffix.lower() == ".mcap")
    run = ViewedRun(name=path.name, footage=footage, eyes=eyes, film=Film())
    run.seen = {eye.name: [] for eye in run.eyes}
    with contextlib.ExitStack() as on_error, footage.opened(car, f"view {path.name}") as shots:
        on_error.callback(run.film.close)
        for t_s, frame, moved, step in shots:
            for eye in run.eyes:
                run.seen[eye.name].append(eye.see(frame, moved, step))
            run.film.add(image_of(frame))
            run.t_s.append(t_s)
            run.frames.append(frame.index)
            run.motions.append(moved)
            happened = () if step is None else step.events
            run.events += [(t_s + (event.t_ns - frame.t_ns) * 1e-9, event) for event in happened]
        if not run.frames:
            raise ConfigError(f"{path}: no frames between --from {footage.from_s:g} and --to {footage.to_s:g} s")
        on_error.pop_all()
    if any(one.known for one in run.motions):
        run.path = dead_reckoned(np.array(run.t_s), run.motions)
    return run

"""A run that can be looked at frame by frame: what each pipeline said, and the images on disk."""

from __future__ import annotations

import contextlib
import math
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO

import cv2
import numpy as np

from automodel.assembly.parts import open_source
from automodel.assembly.replay import check_frame_size, frames_between
from automodel.assembly.report import Eye, Seen, car_of_run, eyes_of
from automodel.config import ConfigError
from automodel.console.progress import progress
from automodel.recording.export import image_of
from automodel.recording.reader import RecordingSource
from automodel.signals import Event, Frame, LaneStatus, Motion
from automodel.sources.files import read_motion_csv
from automodel.types import Image
from automodel.viewer.run_trace import DrivenPath, dead_reckoned

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


@dataclass(slots=True, kw_only=True, eq=False)
class ViewedRun:
    """n frames of a run: `t_s` since the first, `frames` their numbers in the source, and for each eye n of `seen`.

    `events` have their time [s] on the same scale; `path` is where the car drove, None where no motion is known.
    """

    name: str
    eyes: list[Eye]
    film: Film
    t_s: list[float] = field(default_factory=list)
    frames: list[int] = field(default_factory=list)
    motions: list[Motion] = field(default_factory=list)
    seen: dict[str, list[Seen]] = field(default_factory=dict)
    events: list[tuple[float, Event]] = field(default_factory=list)
    path: DrivenPath | None = None

    def picture(self, number: int, eye_name: str) -> Image:
        """A frame with what an eye said of it; raises IndexError and KeyError."""
        eye = next((eye for eye in self.eyes if eye.name == eye_name), None)
        if eye is None or not 0 <= number < len(self.frames):
            raise KeyError(eye_name) if eye is None else IndexError(number)
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


def look_through(
    path: Path,
    pipelines: Sequence[str] = (),
    car_file: Path | None = None,
    motion_file: Path | None = None,
    rate_hz: float | None = None,
    from_s: float = 0.0,
    to_s: float = math.inf,
) -> ViewedRun:
    """Run the pipelines over a source and keep everything; raises ConfigError and SourceError for what is wrong."""
    car = car_of_run(car_file, path)
    source = open_source(path, car, rate_hz)
    recorded = isinstance(source, RecordingSource)
    run = ViewedRun(name=path.name, eyes=eyes_of(pipelines, car, recorded), film=Film())
    run.seen = {eye.name: [] for eye in run.eyes}
    motion = read_motion_csv(motion_file) if motion_file is not None else None
    title, count = f"view {path.name}", getattr(source, "frame_count", None)
    with contextlib.ExitStack() as on_error, contextlib.closing(source), progress(title, count) as bar:
        on_error.callback(run.film.close)
        for t_s, frame, moved, _ in frames_between(source, motion, from_s, to_s):
            bar()
            if isinstance(frame, Frame):
                check_frame_size(path, frame, car, car_file)
            step = source.step if isinstance(source, RecordingSource) else None
            for eye in run.eyes:
                run.seen[eye.name].append(eye.see(frame, moved, step))
            run.film.add(image_of(frame))
            run.t_s.append(t_s)
            run.frames.append(frame.index)
            run.motions.append(moved)
            happened = () if step is None else step.events
            run.events += [(t_s + (event.t_ns - frame.t_ns) * 1e-9, event) for event in happened]
        if not run.frames:
            raise ConfigError(f"{path}: no frames between --from {from_s:g} and --to {to_s:g} s")
        on_error.pop_all()
    if any(one.known for one in run.motions):
        run.path = dead_reckoned(np.array(run.t_s), run.motions)
    return run

"""A folder of pictures as a source."""

from __future__ import annotations

import re
from pathlib import Path

from automodel.signals import Frame
from automodel.sources.errors import EndOfSource, SourceError
from automodel.sources.pictures import read_picture

SUFFIXES = (".jpg", ".jpeg", ".png", ".bmp", ".webp", ".tif", ".tiff", ".pgm", ".ppm")


def natural_key(name: str) -> tuple[tuple[int, int, str], ...]:
    """Sorts `2.png` before `10.png`."""
    parts = re.findall(r"[0-9]+|[^0-9]+", name.lower())
    return tuple((0, int(part), "") if part.isdecimal() else (1, 0, part) for part in parts)


class ImageSource:
    """The pictures of a folder in natural order at a fixed rate, the first at time 0.

    Raises SourceError for a folder that is not there or holds no picture, and (from `read`) for a damaged picture or
    one of another size than the first, by name.
    """

    def __init__(self, folder: str | Path, rate_hz: float = 20.0, colour: bool = False) -> None:
        self.folder, self.rate_hz, self.colour = Path(folder), rate_hz, colour
        if not rate_hz > 0:
            raise ValueError(f"rate_hz: {rate_hz} where a positive number is wanted")
        if not self.folder.is_dir():
            raise SourceError(f"{folder}: no such folder")
        found = (p for p in self.folder.iterdir() if p.suffix.lower() in SUFFIXES and p.is_file())
        self.files = sorted(found, key=lambda p: (natural_key(p.name), p.name))
        if not self.files:
            raise SourceError(f"{folder}: no pictures in this folder ({', '.join(SUFFIXES)})")
        self._next = 0
        self._shape: tuple[int, ...] | None = None

    def read(self, timeout_s: float) -> Frame:
        """The next picture; raises EndOfSource after the last."""
        if self._next >= len(self.files):
            raise EndOfSource
        path = self.files[self._next]
        image = read_picture(path, self.colour)
        shape = image.shape[:2]
        if self._shape is not None and shape != self._shape:
            raise SourceError(
                f"{path}: {shape[1]}x{shape[0]} pixels where the pictures before have "
                f"{self._shape[1]}x{self._shape[0]}; keep one size a folder"
            )
        self._shape = shape
        frame = Frame(t_ns=round(self._next * 1e9 / self.rate_hz), index=self._next, image=image)
        self._next += 1
        return frame

    def close(self) -> None:
        """No more frames."""
        self._next = len(self.files)

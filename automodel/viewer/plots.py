"""Plots and contact sheets as PNG files."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np

from automodel.config import ConfigError
from automodel.output_files import output_path
from automodel.types import FloatArray, Image

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Colour = tuple[int, int, int]  # BGR

# name, times [s], estimates (offset [m], heading [rad]) and truths (offset, heading, width), NaN without an estimate
Drive = tuple[str, Sequence[float], Sequence[tuple[float, float]], Sequence[tuple[float, float, float]]]

GREEN: Colour = (80, 220, 60)
RED: Colour = (40, 40, 255)
_WHITE: Colour = (255, 255, 255)
_COLUMNS, _WIDTH_PX, _STRIP_PX = 2, 640, 18


@contextlib.contextmanager
def plotted(path: Path, size_in: tuple[float, float]) -> Iterator[Figure]:
    """A figure of that size [inches] to draw on, written to `path` afterwards; raises ConfigError."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=size_in, layout="constrained")
    FigureCanvasAgg(figure)
    yield figure
    try:
        with output_path(path) as part:
            figure.savefig(part, dpi=90)
    except ValueError as error:
        raise ConfigError(f"{path}: cannot be written as an image: {error}") from None


def plot_accuracy(path: Path, drives: Sequence[Drive]) -> None:
    """Offset and heading over time, estimate and truth, a row a drive (as Cudrano et al. 2020, Fig. 8)."""
    with plotted(path, (14, 2.6 * len(drives))) as figure:
        axes = figure.subplots(len(drives), 2, squeeze=False)
        for (name, t_s, estimated, true), (left, right) in zip(drives, axes, strict=True):
            guess, truth = np.array(estimated).reshape(-1, 2), np.array(true).reshape(-1, 3)
            for axis, column, scale, label in ((left, 0, 100.0, "offset [cm]"), (right, 1, 57.29578, "heading [deg]")):
                axis.plot(t_s, scale * truth[:, column], color="tab:green", linewidth=2.0, label="truth")
                axis.plot(t_s, scale * guess[:, column], color="tab:blue", linewidth=0.8, label="estimate")
                axis.set_ylabel(label)
                axis.grid(alpha=0.3)
            left.set_title(name, fontsize=9, loc="left")
        for axis in axes[-1]:
            axis.set_xlabel("time [s]")
        axes[0][0].legend(loc="upper right", fontsize=8)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SheetImage:
    """One image (h, w, 3) BGR of a contact sheet, a line of text, and lines of points in one colour each.

    The lines (k, n) are u [px] on `rows` (n,) [px].
    """

    image: Image
    note: str
    rows: FloatArray
    lines: Sequence[tuple[FloatArray, Colour]]


def write_contact_sheet(path: Path, images: Sequence[SheetImage]) -> None:
    """Write the images as one PNG, two a row, in order; raises ConfigError."""
    drawn = [_drawn(image) for image in images]
    tallest = max(image.shape[0] for image in drawn)
    cells = [np.pad(image, ((0, tallest - image.shape[0]), (0, 0), (0, 0))) for image in drawn]
    cells += [np.zeros_like(cells[0])] * (-len(cells) % _COLUMNS)
    sheet = np.vstack([np.hstack(cells[at : at + _COLUMNS]) for at in range(0, len(cells), _COLUMNS)])
    coded, data = cv2.imencode(".png", sheet)
    if not coded:
        raise ConfigError(f"{path}: cannot be written as an image")
    with output_path(path) as part:
        part.write_bytes(data.tobytes())


def _drawn(sheet: SheetImage) -> Image:
    scale = _WIDTH_PX / sheet.image.shape[1]
    image = cv2.resize(sheet.image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    for lines, colour in sheet.lines:
        for line in lines:
            for u, v in zip(line, sheet.rows, strict=True):
                if np.isfinite(u):
                    cv2.circle(image, (round((u + 0.5) * scale), round((v + 0.5) * scale)), 2, colour, -1, cv2.LINE_AA)
    strip = np.zeros((_STRIP_PX, image.shape[1], 3), np.uint8)
    cv2.putText(strip, sheet.note, (4, _STRIP_PX - 5), cv2.FONT_HERSHEY_SIMPLEX, 0.42, _WHITE, 1, cv2.LINE_AA)
    return np.asarray(np.vstack((strip, image)), dtype=np.uint8)


# name of the pipeline, status of each estimate (n), bounds (n, 2) and errors (n, 2) of offset [lane widths] and heading
# [rad]
Claims = tuple[str, Sequence[str], FloatArray, FloatArray]
_BIN_FRAMES, _MOST_BINS = 100, 10  # frames a bin at least, and bins a curve at most
_QUANTILES = {0.5: ":", 0.99: "--", 0.999: "-"}  # of the error, and their lines
_STATUS_COLOURS = {"TRACKING": "tab:green", "ONE_LINE": "tab:olive", "COASTING": "tab:red"}


def plot_reliability(path: Path, claims: Sequence[Claims]) -> None:
    """Claimed bounds against observed errors, a row a pipeline: offset on the left, heading on the right.

    Frames of one status are binned by their bound. Drawn are the 50th, 99th and 99.9th percentile of the error (dotted,
    dashed, solid), taken of error over bound in each bin and multiplied by the bin's median bound: a curve lies below
    the diagonal where the bound holds in that share of frames.
    """
    with plotted(path, (12, 5.0 * len(claims))) as figure:
        axes = figure.subplots(len(claims), 2, squeeze=False)
        for (name, statuses, bounds, errors), row in zip(claims, axes, strict=True):
            for axis, k, scale, what in (
                (row[0], 0, 100.0, "offset [% of the lane]"),
                (row[1], 1, 57.29578, "heading [deg]"),
            ):
                stated = np.isfinite(bounds[:, k])
                for status, colour in _STATUS_COLOURS.items():
                    chosen = np.array([s == status for s in statuses], np.bool_) & stated
                    x, y = binned(scale * bounds[chosen, k], scale * errors[chosen, k])
                    for quantile, style, share in zip(y.T, _QUANTILES.values(), _QUANTILES, strict=True):
                        label = f"{status}, {int(chosen.sum())} frames" if share == max(_QUANTILES) else None
                        axis.plot(x, quantile, style, color=colour, marker=".", label=label)
                axis.axline((1.0, 1.0), slope=1.0, color="black", linewidth=0.8)
                axis.set(xscale="log", yscale="log", xlabel=f"claimed bound, {what}", ylabel=f"error, {what}")
                axis.set_title(f"{name}: {int((~stated).sum())} frames without a bound", fontsize=9, loc="left")
                axis.grid(alpha=0.3)
                axis.legend(fontsize=8)


def binned(bounds: FloatArray, errors: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Median bound (b,) and the error's quantiles (b, q) of bins with equally many frames."""
    count = min(len(bounds) // _BIN_FRAMES, _MOST_BINS)
    if not count:
        return np.empty(0), np.empty((0, len(_QUANTILES)))
    bins = np.array_split(np.argsort(bounds, kind="stable"), count)
    middles = np.array([np.median(bounds[chosen]) for chosen in bins])
    ratio = errors / np.maximum(bounds, 1e-12)
    quantiles = np.array([np.quantile(ratio[chosen], list(_QUANTILES)) for chosen in bins])
    return middles, middles[:, None] * quantiles

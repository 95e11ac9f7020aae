"""Figures as PNG files."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from automodel.config import ConfigError

# name, times [s], estimates (offset [m], heading [rad]) and truths (offset, heading, width), NaN without an estimate
Drive = tuple[str, Sequence[float], Sequence[tuple[float, float]], Sequence[tuple[float, float, float]]]


def plot_accuracy(path: Path, drives: Sequence[Drive]) -> None:
    """Offset and heading over time, estimate against truth, a row a drive (as Cudrano et al. 2020, Fig. 8)."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(14, 2.6 * len(drives)), layout="constrained")
    FigureCanvasAgg(figure)
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
    try:
        figure.savefig(path, dpi=90)
    except (OSError, ValueError) as error:
        raise ConfigError(f"{path}: cannot be written as a picture: {error}") from None

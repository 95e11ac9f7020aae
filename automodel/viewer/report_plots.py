"""The plots of a report, as SVG texts that scale with the page."""

from __future__ import annotations

import io
import itertools
import re
from collections.abc import Sequence
from html import escape
from typing import TYPE_CHECKING, Any

import numpy as np

from automodel.signals import LaneStatus
from automodel.types import FloatArray
from automodel.viewer.run_trace import ReportedRun, RunTrace, disagreement_m

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# Okabe and Ito 2008: colours that colour-blind people tell apart
BLUE, SKY, GREEN, ORANGE, VERMILION, PURPLE = "#0072B2", "#56B4E9", "#009E73", "#E69F00", "#D55E00", "#CC79A7"
STATUS_COLOURS = {
    LaneStatus.TRACKING: BLUE,
    LaneStatus.ONE_LINE: SKY,
    LaneStatus.COASTING: ORANGE,
    LaneStatus.LOST: VERMILION,
}
PIPELINE_COLOURS = (BLUE, VERMILION, GREEN, PURPLE, ORANGE, SKY)
TRUTH_COLOUR = "#000000"
MOST_POINTS = 600  # of a curve: a phone shows fewer
WIDTH_IN = 5.2  # at 72 points an inch about a phone's width, so that its text is as large as that of the page


def plots(run: ReportedRun) -> dict[str, str]:
    """Title -> SVG: the map, the offset with its bound, heading, speed, status and time of a run."""
    drawn = {} if run.path is None else {"Map": _map(run)}
    drawn["Status"] = _statuses(run.traces)
    drawn["Offset [m], its bound shaded"] = _offsets(run)
    if len(run.traces) > 1:
        drawn["Disagreement: offset minus the pipelines' median [m]"] = _disagreement(run.traces)
    drawn["Heading [deg], its bound shaded"] = _headings(run.traces)
    if run.path is not None:
        drawn["Speed [m/s]"] = _speed(run)
    drawn["Time a frame [ms]"] = _times(run.traces)
    return drawn


def svg_of(figure: Figure, title: str) -> str:
    """The figure as an SVG element without a fixed size, with text as text; `title` is for screen readers."""
    import matplotlib as mpl

    file = io.StringIO()
    with mpl.rc_context({"svg.fonttype": "none", "svg.hashsalt": title}):
        figure.savefig(file, format="svg", metadata={"Date": None, "Creator": None, "Type": None, "Format": None})
    text = file.getvalue()
    text = text[text.index("<svg") :]
    head, rest = text.split(">", 1)
    head = re.sub(r'\s(width|height)="[^"]*"', "", head)
    # matplotlib numbers its parts anew in each figure; in one page the names must differ
    key = re.sub(r"\W", "", title)
    rest = re.sub(r'(id="|xlink:href="#|url\(#)', rf"\g<1>{key}", rest)
    return f'{head} role="img" aria-label="{escape(title)}">{rest}'


def thinned(t_s: FloatArray, *columns: FloatArray) -> tuple[FloatArray, ...]:
    """Times and columns (n,) in at most `MOST_POINTS` bins: the value of largest size in each, gaps stay gaps."""
    bins = min(len(t_s), MOST_POINTS)
    edges = np.linspace(0, len(t_s), bins + 1).astype(int)
    if bins == len(t_s):
        return t_s, *columns
    picked = [np.array([_largest(column[a:b]) for a, b in itertools.pairwise(edges)]) for column in columns]
    return t_s[edges[:-1]], *picked


def _largest(values: FloatArray) -> float:
    if np.isnan(values).all():
        return float("nan")
    return float(values[np.nanargmax(np.abs(values))])


def _figure(height_in: float) -> tuple[Figure, Any]:
    from matplotlib.backends.backend_svg import FigureCanvasSVG
    from matplotlib.figure import Figure

    figure = Figure(figsize=(WIDTH_IN, height_in), layout="constrained")
    FigureCanvasSVG(figure)
    axis = figure.subplots()
    axis.grid(alpha=0.3)
    return figure, axis


def _legend(axis: Any) -> None:
    axis.legend(loc="upper center", bbox_to_anchor=(0.5, -0.16), ncols=4, frameon=False, fontsize=9)


def _over_time(axis: Any) -> None:
    axis.set_xlabel("time [s]", loc="right", labelpad=-2, fontsize=9)


def _map(run: ReportedRun) -> str:
    assert run.path is not None
    figure, axis = _figure(3.4)
    xy, statuses = run.path.xy_m, run.traces[0].statuses
    for status, colour in STATUS_COLOURS.items():
        there = np.array([own is status for own in statuses])
        there[1:] |= there[:-1]  # up to the point where the next status begins
        if there.any():
            line = np.where(there[:, None], xy, np.nan)
            axis.plot(*_thinned_path(line).T, color=colour, linewidth=2.5, label=status.value)
    axis.plot(*xy[0], marker="o", color=TRUTH_COLOUR, label="start", linestyle="none")
    for number, moment in enumerate(run.moments, 1):
        at = xy[int(np.argmin(np.abs(run.traces[0].t_s - moment.t_s)))]
        axis.annotate(str(number), at, xytext=(5, 5), textcoords="offset points", fontsize=10, weight="bold")
    axis.set_aspect("equal", adjustable="datalim")
    axis.set_xlabel("x [m]", loc="right", labelpad=-2, fontsize=9)
    axis.set_ylabel("y [m]")
    _legend(axis)
    return svg_of(figure, f"map {run.name}")


def _thinned_path(xy: FloatArray) -> FloatArray:
    return xy[:: max(1, len(xy) // (2 * MOST_POINTS))]


def _statuses(traces: Sequence[RunTrace]) -> str:
    figure, axis = _figure(0.9 + 0.3 * len(traces))
    axis.grid(visible=False)
    for row, trace in enumerate(traces):
        for start, end, status in _spans(trace):
            axis.broken_barh([(start, end - start)], (row - 0.4, 0.8), color=STATUS_COLOURS[status], linewidth=0)
    for status, colour in STATUS_COLOURS.items():
        axis.plot([], [], color=colour, linewidth=6, label=status.value)
    axis.set_yticks(range(len(traces)), [trace.name for trace in traces])
    axis.set_ylim(len(traces) - 0.5, -0.5)
    axis.legend(loc="upper center", bbox_to_anchor=(0.45, -0.3), ncols=4, frameon=False, fontsize=9)
    return svg_of(figure, "status " + " ".join(trace.name for trace in traces))


def _spans(trace: RunTrace) -> list[tuple[float, float, LaneStatus]]:
    """Start [s], end [s] and status of each stretch of one status."""
    if not trace.statuses:
        return []
    changes = [0, *(i for i in range(1, len(trace.statuses)) if trace.statuses[i] is not trace.statuses[i - 1])]
    ends = [*(float(trace.t_s[i]) for i in changes[1:]), float(trace.t_s[-1])]
    return [(float(trace.t_s[i]), end, trace.statuses[i]) for i, end in zip(changes, ends, strict=True)]


def _offsets(run: ReportedRun) -> str:
    figure, axis = _figure(2.6)
    if run.truth_m is not None:
        axis.plot(*thinned(run.traces[0].t_s, run.truth_m), color=TRUTH_COLOUR, linewidth=2.2, label="truth")
    for trace, colour in zip(run.traces, PIPELINE_COLOURS * len(run.traces), strict=False):
        t_s, value, bound = thinned(trace.t_s, trace.offset_m, trace.offset_bound_m)
        axis.fill_between(t_s, value - bound, value + bound, color=colour, alpha=0.15, linewidth=0)
        axis.plot(t_s, value, color=colour, linewidth=1.2, label=trace.name)
    widths_m = np.concatenate([trace.width_m for trace in run.traces])
    if np.isfinite(widths_m).any():
        half_m = 0.5 * float(np.nanmedian(widths_m))
        axis.set_ylim(-1.2 * half_m, 1.2 * half_m)
    _over_time(axis)
    _legend(axis)
    return svg_of(figure, f"offset {run.name}")


def _disagreement(traces: Sequence[RunTrace]) -> str:
    figure, axis = _figure(2.2)
    for trace, difference, colour in zip(traces, disagreement_m(traces), PIPELINE_COLOURS * len(traces), strict=False):
        axis.plot(*thinned(trace.t_s, difference), color=colour, linewidth=1.2, label=trace.name)
    _over_time(axis)
    _legend(axis)
    return svg_of(figure, "disagreement " + " ".join(trace.name for trace in traces))


def _headings(traces: Sequence[RunTrace]) -> str:
    figure, axis = _figure(2.4)
    for trace, colour in zip(traces, PIPELINE_COLOURS * len(traces), strict=False):
        t_s, value, bound = thinned(trace.t_s, np.degrees(trace.heading_rad), np.degrees(trace.heading_bound_rad))
        axis.fill_between(t_s, value - bound, value + bound, color=colour, alpha=0.15, linewidth=0)
        axis.plot(t_s, value, color=colour, linewidth=1.2, label=trace.name)
    _over_time(axis)
    _legend(axis)
    return svg_of(figure, "heading " + " ".join(trace.name for trace in traces))


def _speed(run: ReportedRun) -> str:
    assert run.path is not None
    figure, axis = _figure(1.8)
    axis.plot(*thinned(run.traces[0].t_s, run.path.speed_mps), color=BLUE, linewidth=1.2)
    axis.set_ylim(bottom=min(0.0, float(np.nanmin(run.path.speed_mps, initial=0.0))))
    _over_time(axis)
    return svg_of(figure, f"speed {run.name}")


def _times(traces: Sequence[RunTrace]) -> str:
    figure, axis = _figure(2.2)
    for trace, colour in zip(traces, PIPELINE_COLOURS * len(traces), strict=False):
        axis.plot(*thinned(trace.t_s, trace.time_ms), color=colour, linewidth=0.8, label=trace.name)
    known_ms = np.concatenate([trace.time_ms[np.isfinite(trace.time_ms)] for trace in traces])
    usual_ms = float(np.quantile(known_ms, 0.99)) if len(known_ms) else 0.0
    axis.set_ylim(0.0, 1.5 * usual_ms or 1.0)  # the first frame may take a hundred times as long: code is compiled
    _over_time(axis)
    _legend(axis)
    return svg_of(figure, "time " + " ".join(trace.name for trace in traces))

"""A report as one HTML file that needs nothing else: readable on a phone, in print and without scripts."""

from __future__ import annotations

import base64
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape

import cv2

from automodel.types import Image
from automodel.viewer.report_plots import plots
from automodel.viewer.run_trace import ReportedRun, metrics

PICTURE_PX, JPEG_QUALITY = 480, 75  # of a moment: some 30 kB
MOST_EVENTS = 40  # in the table of a run
HEADINGS = {
    "run": "run", "pipeline": "pipeline", "frames": "frames", "availability_pct": "available [%]",
    "tracking_pct": "two lines [%]", "one_line_pct": "one line [%]", "coasting_pct": "coasting [%]",
    "lost_pct": "lost [%]", "offset_bound_median_m": "bound of offset, median [m]",
    "disagreement_median_m": "disagreement, median [m]", "disagreement_p99_m": "disagreement, 99 % [m]",
    "offset_mae_m": "error of offset [m]", "misled_pct": "misled [%]", "p50_ms": "time, median [ms]",
    "p99_ms": "time, 99 % [ms]",
}  # fmt: skip
STYLE = """
:root { color-scheme: light dark; --page: #fff; --ink: #1a1a1a; --faint: #555; --rule: #ddd; --bar: #cfe3f3; }
body { font: 16px/1.45 system-ui, sans-serif; margin: 0 auto; padding: 0 12px 40px; max-width: 1200px; }
body { color: var(--ink); background: var(--page); }
h1 { font-size: 1.4rem; overflow-wrap: anywhere; }
h2 { font-size: 1.2rem; border-top: 2px solid var(--rule); padding-top: 1rem; margin-top: 2rem; }
h3 { font-size: 1rem; margin: 0.4rem 0; } h2, h3 { overflow-wrap: anywhere; }
.plots { display: grid; grid-template-columns: repeat(auto-fit, minmax(min(100%, 420px), 1fr)); gap: 12px 24px; }
.pictures { display: grid; grid-template-columns: repeat(auto-fit, minmax(min(100%, 340px), 1fr)); gap: 0 16px; }
.plots svg { width: 100%; height: auto; display: block; }
.wide { overflow-x: auto; } table { border-collapse: collapse; font-size: 0.9rem; font-variant-numeric: tabular-nums; }
th, td { text-align: right; padding: 4px 10px; border-bottom: 1px solid var(--rule); vertical-align: top; }
th:first-child, td:first-child { text-align: left; position: sticky; left: 0; background: var(--page); }
td.bar { background: linear-gradient(var(--bar), var(--bar)) no-repeat right bottom / var(--share) 4px; }
td.text { text-align: left; overflow-wrap: anywhere; min-width: 9rem; }
figure { margin: 0 0 1rem; } figure img { width: 100%; height: auto; display: block; }
figcaption, .note { color: var(--faint); font-size: 0.9rem; }
@media (max-width: 600px) { table { font-size: 0.8rem; } th, td { padding: 4px 6px; } }
@media screen and (prefers-color-scheme: dark) {
  :root { --page: #1a1a1a; --ink: #e8e8e8; --faint: #a8a8a8; --rule: #444; --bar: #2b5876; }
  .plots svg { filter: invert(0.9) hue-rotate(180deg); }
}
"""


@dataclass(frozen=True, slots=True, kw_only=True)
class ResultTable:
    """A table of measured results; a cell is its text and the share, 0 to 1, of the bar drawn below it."""

    title: str
    origin: str
    header: tuple[str, ...]
    rows: tuple[tuple[tuple[str, float], ...], ...]


def page(runs: Sequence[ReportedRun], version: str, results: Sequence[ResultTable] = ()) -> str:
    """The HTML of a report over runs and the results of benches.

    The first column of tables side by side names what the others compare.
    """
    title = ", ".join(dict.fromkeys([*(run.name for run in runs), *(one.title.split(":")[0] for one in results)]))
    parts = [
        "<!DOCTYPE html>",
        '<html lang="en"><head><meta charset="utf-8">',
        '<meta name="viewport" content="width=device-width, initial-scale=1">',
        f"<title>automodel: {escape(title)}</title><style>{STYLE}</style></head><body>",
        f"<h1>{escape(title)}</h1>",
        f'<p class="note">automodel {escape(version)}. Offsets are positive to the left of the lane\'s middle. '
        "A bound is an error that 1 of 1,000 frames is meant to exceed.</p>",
        _side_by_side([row for run in runs for row in metrics(run)]) if runs else "",
        _settings(runs),
        *(_run(run) for run in runs),
        *map(_results, results),
        "</body></html>",
    ]
    return "\n".join(parts)


def _side_by_side(rows: Sequence[Mapping[str, object]]) -> str:
    """The metrics, a column a pipeline; those that nobody has are left out."""
    names = [name for name in HEADINGS if name == "run" or any(row[name] is not None for row in rows)]
    if len({row["run"] for row in rows}) == 1:
        names.remove("run")
    lines = [[HEADINGS[name], *(_value(row[name]) for row in rows)] for name in names]
    return _table(lines[0], lines[1:])


def _settings(runs: Sequence[ReportedRun]) -> str:
    """The keys of car.toml in which the runs differ."""
    keys = sorted({key for run in runs for key in run.settings})
    differing = [key for key in keys if len({repr(run.settings.get(key)) for run in runs}) > 1]
    if not differing:
        return ""
    rows = [[key, *(_value(run.settings.get(key)) for run in runs)] for key in differing]
    return "<h2>car.toml: what differs</h2>" + _table(["key", *(run.name for run in runs)], rows)


def _run(run: ReportedRun) -> str:
    drawn = "".join(f"<div><h3>{escape(title)}</h3>{svg}</div>" for title, svg in plots(run).items())
    path = ""
    if run.path is None:
        path = '<p class="note">No map and no speed: the motion of the car is not known.</p>'
    elif not run.path.true:
        path = '<p class="note">The map is the car\'s own motion added up; it drifts.</p>'
    return (
        f'<h2>{escape(run.name)}</h2><p class="note">{escape(run.origin)}</p>'
        f'<div class="plots">{drawn}</div>{path}{_moments(run)}{_events(run)}'
    )


def _moments(run: ReportedRun) -> str:
    if not run.moments:
        return ""
    parts = []
    for number, moment in enumerate(run.moments, 1):
        pictures = "".join(
            f'<figure><img alt="{escape(name)} at {moment.t_s:.2f} s" src="{_data_url(picture)}">'
            f"<figcaption>{escape(name)}</figcaption></figure>"
            for name, picture in moment.pictures.items()
        )
        parts.append(
            f"<h3>{number}. {moment.t_s:.2f} s, frame {moment.frame}: {escape(moment.why)}</h3>"
            f'<div class="pictures">{pictures}</div>'
        )
    return "<h2>Worst moments</h2>" + "".join(parts)


def _events(run: ReportedRun) -> str:
    if not run.events:
        return ""
    rows = [[f"{t_s:.2f}", event.kind, event.text] for t_s, event in run.events[:MOST_EVENTS]]
    more = len(run.events) - MOST_EVENTS
    note = f'<p class="note">and {more} more</p>' if more > 0 else ""
    return "<h2>Events</h2>" + _table(["time [s]", "what", ""], rows) + note


def _results(table: ResultTable) -> str:
    body = [[text for text, _ in row] for row in table.rows]
    bars = [[share for _, share in row] for row in table.rows]
    return f'<h2>{escape(table.title)}</h2><p class="note">{escape(table.origin)}</p>{_table(table.header, body, bars)}'


def _table(header: Sequence[str], rows: Sequence[Sequence[str]], bars: Sequence[Sequence[float]] = ()) -> str:
    head = "".join(f"<th>{escape(cell)}</th>" for cell in header)
    shares = bars or [[0.0] * len(row) for row in rows]
    cells = ("".join(map(_cell, row, share)) for row, share in zip(rows, shares, strict=True))
    body = "".join(f"<tr>{row}</tr>" for row in cells)
    return f'<div class="wide"><table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table></div>'


def _cell(text: str, share: float) -> str:
    kind = ' class="text"' if len(text) > 16 else f' class="bar" style="--share:{100.0 * share:.0f}%"' * (share > 0.0)
    return f"<td{kind}>{escape(text)}</td>"


def _value(value: object) -> str:
    if value is None:
        return "-"
    if isinstance(value, float):
        if 0.0 < abs(value) < 0.001:
            return f"{value:.4f}"
        return f"{value:.3g}" if abs(value) < 100.0 else f"{value:.0f}"
    return str(value)


def _data_url(picture: Image) -> str:
    height = max(round(picture.shape[0] * PICTURE_PX / picture.shape[1]), 1)
    small = picture
    if picture.shape[1] > PICTURE_PX:
        small = cv2.resize(picture, (PICTURE_PX, height), interpolation=cv2.INTER_AREA)  # type: ignore[assignment]
    data = cv2.imencode(".jpg", small, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])[1].tobytes()
    return "data:image/jpeg;base64," + base64.b64encode(data).decode()

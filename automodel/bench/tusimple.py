"""The TuSimple lane benchmark: its labels, its metric, and what it hides: the error of the lane's middle.

The metric is that of the benchmark's own `evaluate/lane.py`: on the rows of a label a predicted point is right that
lies within 20 px / cos(angle of the lane) of the label's, at 1280 pixels of width; where a label has no point, no point
is right. A lane's accuracy is the share of right rows; a label is matched by a prediction of accuracy 0.85. Of more
than four lanes the worst is forgiven. Pictures of another width have the tolerance scaled with it.

`automodel bench tusimple`: any pipeline on labelled highway pictures, scored as TuSimple does.
"""

from __future__ import annotations

import dataclasses
import itertools
import json
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from automodel.assembly.parts import make_pipeline
from automodel.config import CameraConfig, CarConfig, ConfigError, Extrinsics, Intrinsics
from automodel.config.toml_reader import read_text
from automodel.console.messages import say
from automodel.console.progress import progress
from automodel.console.tables import show
from automodel.curves.base import Curve
from automodel.geometry import CameraModel, GroundCamera
from automodel.signals import Frame, LaneEstimate, Motion, MotionSource
from automodel.sources.files import natural_key
from automodel.sources.images import read_picture
from automodel.types import FloatArray, Image
from automodel.viewer.plots import GREEN, RED, Picture, write_sheet
from calibration.from_lanes import camera_from_lanes

NONE = -2  # stands in the files where a lane has no point
TOLERANCE_PX, MISSING_PX, OF_WIDTH_PX = 20.0, -100.0, 1280.0  # a missing point is taken for one at -100 px
MATCHED = 0.85
MOST_LANES = 4
FARTHEST_LANES = 20.0  # lane widths ahead: a few pixels under the horizon, where labels end
_STEPS = 400


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Label:
    """One labelled picture: `lanes` (k, n) of u [px] on the `rows` (n,) [px], NaN where a lane has no point."""

    raw_file: str
    lanes: FloatArray
    rows: FloatArray


@dataclass(frozen=True, slots=True, kw_only=True)
class Score:
    """Of one picture: `accuracy` 0..1, share of wrong predictions `fp`, share of missed labels `fn`.

    `accuracies` are those of the labels, one each, of the prediction that fits best.
    """

    accuracy: float
    fp: float
    fn: float
    accuracies: tuple[float, ...]


def parse_labels(text: str, file: str) -> list[Label]:
    """The labels in the lines of a label_data.json; raises ConfigError with file and line.

    Lanes without any point are left out. All labels must have the same number of rows as their lanes.
    """
    labels = []
    for number, line in enumerate(text.splitlines(), 1):
        if line.strip():
            labels.append(_label(line, f"{file}:{number}"))
    if not labels:
        raise ConfigError(f"{file}: no labels in it; a JSON object a line is wanted")
    names = [label.raw_file for label in labels]
    twice = next((name for name in names if names.count(name) > 1), None)
    if twice is not None:
        raise ConfigError(f"{file}: {twice} is labelled twice; keep one line of it")
    return labels


def _label(line: str, where: str) -> Label:
    try:
        entry: Any = json.loads(line)
    except json.JSONDecodeError as error:
        raise ConfigError(f"{where}: not JSON: {error.msg}; is the line cut?") from None
    if not isinstance(entry, dict):
        raise ConfigError(f"{where}: a JSON object is wanted")
    for key, kind in (("raw_file", str), ("lanes", list), ("h_samples", list)):
        if not isinstance(entry.get(key), kind):
            raise ConfigError(f"{where}: {key}: {'missing' if key not in entry else 'of the wrong kind'}")
    rows = entry["h_samples"]
    if len(rows) < 2 or not all(map(_is_number, rows)) or any(b <= a for a, b in itertools.pairwise(rows)):
        raise ConfigError(f"{where}: h_samples: rising numbers are wanted")
    for number, lane in enumerate(entry["lanes"], 1):
        if not isinstance(lane, list) or not all(map(_is_number, lane)):
            raise ConfigError(f"{where}: lanes: lane {number} is no list of numbers")
        if len(lane) != len(rows):
            raise ConfigError(f"{where}: lanes: lane {number} has {len(lane)} points for {len(rows)} h_samples")
    lanes = np.array([lane for lane in entry["lanes"] if any(u >= 0 for u in lane)], dtype=np.float64)
    lanes = np.where(lanes < 0.0, np.nan, lanes).reshape(-1, len(rows))
    return Label(raw_file=entry["raw_file"], lanes=lanes, rows=np.array(rows, dtype=np.float64))


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and bool(np.isfinite(value))


def score(predicted: FloatArray, label: FloatArray, rows: FloatArray, width_px: int) -> Score:
    """The metric of lanes (j, n) against labelled ones (k, n) on the same rows (n,), NaN where there is no point."""
    tolerance = TOLERANCE_PX * width_px / OF_WIDTH_PX
    accuracies = []
    for lane in label:
        limit = tolerance / np.cos(_angle(lane, rows))
        away = np.abs(_with_none(predicted, width_px) - _with_none(lane, width_px))
        accuracies.append(float(np.mean(away < limit, axis=1).max(initial=0.0)))
    matched = sum(accuracy >= MATCHED for accuracy in accuracies)
    total, missed = sum(accuracies), len(accuracies) - matched
    if len(accuracies) > MOST_LANES:
        total -= min(accuracies)
        missed = max(missed - 1, 0)
    count = max(min(len(accuracies), MOST_LANES), 1)
    fp = (len(predicted) - matched) / len(predicted) if len(predicted) else 0.0
    return Score(accuracy=total / count, fp=fp, fn=missed / count, accuracies=tuple(accuracies))


def _with_none(lanes: FloatArray, width_px: int) -> FloatArray:
    """Lanes whose missing points lie where the benchmark puts them."""
    return np.where(np.isnan(lanes), MISSING_PX * width_px / OF_WIDTH_PX, lanes)


def _angle(lane: FloatArray, rows: FloatArray) -> float:
    """The lane's angle to the vertical [rad], of a straight line through its points."""
    known = ~np.isnan(lane)
    if np.count_nonzero(known) < 2:
        return 0.0
    down, u = rows[known] - rows[known].mean(), lane[known]
    return float(np.arctan(down @ u / (down @ down)))


def ego_lines(lanes: FloatArray, rows: FloatArray, middle_px: float) -> tuple[FloatArray | None, FloatArray | None]:
    """The lanes (n,) next to the left and right of `middle_px` on the lowest row; None where there is none.

    Lanes that end before it are carried on straight, by the lower half of their points.
    """
    left: tuple[float, FloatArray | None] = (-np.inf, None)
    right: tuple[float, FloatArray | None] = (np.inf, None)
    for lane in lanes:
        known = np.flatnonzero(~np.isnan(lane))
        if len(known) < 2:
            continue
        lower = known[min(len(known) // 2, len(known) - 2) :]
        start = float(np.polyfit(rows[lower] - rows[-1], lane[lower], 1)[1])
        if left[0] < start < middle_px:
            left = start, lane
        if middle_px <= start < right[0]:
            right = start, lane
    return left[1], right[1]


def centre_error_pct(predicted: Sequence[FloatArray], label: Sequence[FloatArray]) -> float | None:
    """How far the middle of two predicted lines (n,) lies from that of two labelled ones, in % of the lane's width.

    Each row is measured in the width that the label has on it; the median over the rows that all four lines have.
    """
    if len(predicted) != 2 or len(label) != 2:
        return None
    width = label[1] - label[0]
    error = 50.0 * np.abs(predicted[0] + predicted[1] - label[0] - label[1]) / np.where(width > 0.0, width, np.nan)
    known = error[~np.isnan(error)]
    return float(np.median(known)) if len(known) else None


def lines_px(estimate: LaneEstimate, camera: GroundCamera, rows: FloatArray, unit_m: float) -> FloatArray:
    """The estimate's two lines (2, n) as u [px] on `rows` (n,), left first; (0, n) where it has none.

    NaN is outside the picture. Beyond its ends each line is carried on as its curve is, until `FARTHEST_LANES` lane
    widths `unit_m` ahead.
    """
    if estimate.left is None or estimate.right is None:
        return np.empty((0, len(rows)))
    return np.stack([_on_rows(line.curve, camera, rows, unit_m) for line in (estimate.left, estimate.right)])


def _on_rows(curve: Curve, camera: GroundCamera, rows: FloatArray, unit_m: float) -> FloatArray:
    far = FARTHEST_LANES * unit_m
    s = np.concatenate(
        (np.linspace(-2.0 * unit_m, 0.0, _STEPS // 4, endpoint=False), np.geomspace(0.1 * unit_m, far, _STEPS))
    )
    pixels = camera.ground_to_px(curve.position(s))
    known = np.isfinite(pixels).all(axis=1)
    u, v = pixels[known].T
    rising = np.concatenate(([True], v[1:] < np.minimum.accumulate(v)[:-1])) if len(v) else np.empty(0, np.bool_)
    u, v = u[rising][::-1], v[rising][::-1]
    if len(v) < 2:
        return np.full(len(rows), np.nan)
    on_rows = np.interp(rows, v, u, left=np.nan, right=np.nan)
    inside = (on_rows >= 0.0) & (on_rows <= camera.camera.width_px - 1.0)
    return np.where(inside, on_rows, np.nan)


LABELS = "label_data.json"
VIEW_DEG = 60.0  # horizontal angle of view of a camera about which nothing is known
LANE_M, MARKING_M = 3.7, 0.12  # a highway in the USA: lines of 4 to 6 inches
STANDARD = Extrinsics(x_m=1.8, z_m=1.5, pitch_rad=0.0)  # behind a windscreen, where pictures tell nothing
AHEAD_LANES, RADIUS_LANES = 7.0, 50.0  # how far lines are followed; the tightest bend
CLIP_RATE_HZ = 20.0
ENOUGH_FOR_CAMERA = 40  # pictures


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Result:
    """One labelled picture, as one pipeline sees it: predicted lanes (0 or 2, n) [px], and the time it took."""

    label: Label
    lanes: FloatArray
    run_time_ms: float
    status: str


def bench(
    root: Path, car: CarConfig | None, pipelines: Sequence[str], outputs: tuple[Path | None, Path | None], as_json: bool
) -> None:
    """Run `pipelines` on the pictures under `root`, show the scores, and write predictions and figures.

    `car` gives the camera; without it the camera is found in the pictures. `outputs`: predictions (JSON lines), figures
    (PNG); with several pipelines each gets its name into the files' names. Raises ConfigError, SourceError.
    """
    labels = read_labels(root)
    car = car or assumed_car(root, labels)
    rows = []
    for name in pipelines:
        results = list(_run(root, labels, car, name))
        predictions, figures = (_named(path, name, len(pipelines)) for path in outputs)
        if predictions is not None:
            write_predictions(predictions, results)
        if figures is not None:
            write_sheet(figures, [_figure(root, result) for result in results])
        rows.append(_row(name, results, car.camera))
    show("bench tusimple", rows, as_json)


def read_labels(root: Path) -> list[Label]:
    """The labels of a folder; raises ConfigError where a label or its picture is missing or wrong."""
    file = root / LABELS
    if not root.is_dir():
        raise ConfigError(f"--root {root}: no such folder")
    if not file.is_file():
        raise ConfigError(f"--root {root}: there is no {LABELS} in it; give the folder that holds it and clips/")
    labels = parse_labels(read_text(file), str(file))
    for label in labels:
        if not (root / label.raw_file).is_file():
            raise ConfigError(f"{file}: {label.raw_file}: there is no such picture under {root}")
    return labels


def assumed_car(root: Path, labels: Sequence[Label]) -> CarConfig:
    """A car on a highway whose camera is found in the labelled pictures, or where they tell nothing, a usual one.

    Says on stderr what was found and what was assumed.
    """
    step = -(-len(labels) // ENOUGH_FOR_CAMERA)
    pictures = [read_picture(root / label.raw_file, False) for label in labels[::step]]
    height, width = pictures[0].shape
    focal = round(0.5 * width / np.tan(np.radians(0.5 * VIEW_DEG)), 2)
    intrinsics = Intrinsics(fx_px=focal, fy_px=focal, cx_px=0.5 * (width - 1), cy_px=0.5 * (height - 1))
    least = min(3, len(pictures))
    same = [picture for picture in pictures if picture.shape == (height, width)]
    try:
        found = camera_from_lanes(same, CameraModel(intrinsics, width, height), LANE_M, STANDARD, least)
        extrinsics = found.extrinsics
        how = f"from the lines of {found.frames_used} of {found.frames_seen} pictures"
        how += f" (residual {found.residual_px:.1f} px, {_errors(found.ground_error_m)})"
    except ValueError as error:
        extrinsics, how = STANDARD, f"a usual one, as the pictures tell nothing ({error})"
    say(
        f"camera: pitch {np.degrees(extrinsics.pitch_rad):.2f}, yaw {np.degrees(extrinsics.yaw_rad):.2f}, roll"
        f" {np.degrees(extrinsics.roll_rad):.2f} deg, height {extrinsics.z_m:.2f} m, {how}; assumed: {VIEW_DEG:.0f} deg"
        f" of view (f {focal:.0f} px), no distortion, lanes {LANE_M} m wide"
    )
    return highway_car(CameraConfig(width_px=width, height_px=height, intrinsics=intrinsics, extrinsics=extrinsics))


def highway_car(camera: CameraConfig) -> CarConfig:
    """A full-size car on a highway behind that camera."""
    car = CarConfig()
    looks = car.pipeline
    return dataclasses.replace(
        car,
        camera=camera,
        vehicle=dataclasses.replace(car.vehicle, wheelbase_m=2.8, reference_x_m=1.4, width_m=1.8),
        lane=dataclasses.replace(car.lane, width_m=LANE_M, marking_width_m=MARKING_M),
        pipeline=dataclasses.replace(
            looks,
            centerline=dataclasses.replace(looks.centerline, view_ahead_lanes=AHEAD_LANES),
            contour=dataclasses.replace(looks.contour, look_ahead_lanes=AHEAD_LANES, radius_lanes=RADIUS_LANES),
            windows=dataclasses.replace(looks.windows, view_ahead_lanes=AHEAD_LANES, marking_px=4.0),
        ),
    )


def _errors(error_m: dict[float, float]) -> str:
    return "ground right to " + ", ".join(f"{error:.2f} m at {at:.0f} m" for at, error in error_m.items())


def _run(root: Path, labels: Sequence[Label], car: CarConfig, name: str) -> Iterator[Result]:
    pipeline = make_pipeline(name, car)
    camera = GroundCamera.from_config(car.camera)
    with progress(f"bench tusimple {name}", len(labels)) as bar:
        for label in labels:
            pipeline.reset()
            for index, path in enumerate(clip_of(root / label.raw_file)):
                image = read_picture(path, car.camera.colour)
                _check_size(path, image, car.camera)
                t_ns = round(index * 1e9 / CLIP_RATE_HZ)
                unknown = Motion(t_ns=t_ns, speed_mps=0.0, yaw_rate_radps=0.0, source=MotionSource.NONE)
                begin = time.perf_counter()
                estimate: LaneEstimate = pipeline.step(Frame(t_ns=t_ns, index=index, image=image), unknown)
                run_time_ms = 1e3 * (time.perf_counter() - begin)
            lanes = lines_px(estimate, camera, label.rows, car.lane.width_m)
            yield Result(label=label, lanes=lanes, run_time_ms=run_time_ms, status=estimate.status.value)
            bar()


def clip_of(labelled: Path) -> list[Path]:
    """The clip's pictures up to the labelled one, which is the last; it alone where it stands alone."""
    beside = [path for path in labelled.parent.iterdir() if path.suffix.lower() == labelled.suffix.lower()]
    last = natural_key(labelled.name)
    return sorted((p for p in beside if natural_key(p.name) <= last), key=lambda path: natural_key(path.name))


def _check_size(path: Path, image: Image, camera: CameraConfig) -> None:
    height, width = image.shape[:2]
    if (width, height) != (camera.width_px, camera.height_px):
        raise ConfigError(
            f"{path}: {width}x{height} pixels where the camera has {camera.width_px}x{camera.height_px}; one folder has"
            " pictures of one size, and --car the camera of that size"
        )


def _named(path: Path | None, name: str, several: int) -> Path | None:
    return path.with_name(f"{path.stem}.{name}{path.suffix}") if path is not None and several > 1 else path


def write_predictions(path: Path, results: Sequence[Result]) -> None:
    """A JSON object a line, in the benchmark's form; `h_samples` are the label's."""
    lines = [
        json.dumps(
            {
                "raw_file": result.label.raw_file,
                "lanes": [[NONE if np.isnan(u) else round(float(u), 2) for u in lane] for lane in result.lanes],
                "run_time": round(result.run_time_ms, 3),
            }
        )
        for result in results
    ]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


def _row(name: str, results: Sequence[Result], camera: CameraConfig) -> dict[str, object]:
    """Means over the pictures: of all lanes, of the two ego lines, and of the middle between these."""
    everything, ego, both, errors = [], [], 0, []
    for result in results:
        label = result.label
        lines = [line for line in ego_lines(label.lanes, label.rows, middle_px(label.rows, camera)) if line is not None]
        truth = np.array(lines).reshape(-1, len(label.rows))
        everything.append(score(result.lanes, label.lanes, label.rows, camera.width_px))
        ego.append(score(result.lanes, truth, label.rows, camera.width_px))
        both += len(lines) == 2 and ego[-1].fn == 0.0
        error = centre_error_pct(list(result.lanes), lines)
        if error is not None:
            errors.append(error)
    return {
        "pipeline": name,
        "frames": len(results),
        "found": sum(len(result.lanes) > 0 for result in results),
        "both_ego": both,
        **{f"ego_{key}": value for key, value in _means(ego).items()},
        **{f"all_{key}": value for key, value in _means(everything).items()},
        "centre_median_pct": float(np.median(errors)) if errors else None,
        "p50_ms": float(np.median([result.run_time_ms for result in results])),
    }


def middle_px(rows: FloatArray, camera: CameraConfig) -> float:
    """Where the car's own way lies on the lowest of the rows: straight ahead of the camera, on the ground."""
    ground = GroundCamera.from_config(camera)
    near = ground.centre_m[0] + np.linspace(0.5, 60.0, 400) * camera.extrinsics.z_m
    pixels = ground.ground_to_px(np.column_stack((near, np.full_like(near, ground.centre_m[1]))))
    pixels = pixels[np.isfinite(pixels).all(axis=1)]
    return float(np.interp(rows[-1], pixels[::-1, 1], pixels[::-1, 0]))


def _means(scores: Sequence[Score]) -> dict[str, float]:
    return {key: float(np.mean([getattr(each, key) for each in scores])) for key in ("accuracy", "fp", "fn")}


def _figure(root: Path, result: Result) -> Picture:
    """A picture with its labelled and its predicted points, for a contact sheet."""
    label = result.label
    lines = [(lanes, colour) for lanes, colour in ((label.lanes, GREEN), (result.lanes, RED))]
    image = read_picture(root / label.raw_file, True)
    return Picture(image=image, note=f"{label.raw_file} {result.status}", rows=label.rows, lines=lines)

"""`bench tusimple`: pipelines on labelled highway images, scored as the TuSimple lane benchmark does.

The metric is that of the benchmark's own `evaluate/lane.py`: on the rows of a label a predicted point is right if it
lies within 20 px / cos(angle of the lane) of the label's, at 1280 pixels of width; where a label has no point, no point
is right. A lane's accuracy is the share of right rows; a label is matched by a prediction of accuracy 0.85. Of more
than four lanes the worst does not count. Images of another width have the tolerance scaled with it. The benchmark does
not measure the error of the lane's middle; `centre_error_pct` does.
"""

from __future__ import annotations

import itertools
import json
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from operator import itemgetter
from pathlib import Path
from typing import Any

import numpy as np

from automodel.assembly.parts import make_pipeline
from automodel.bench.accuracy import Row
from automodel.config import PIPELINE_NAMES, CameraConfig, CarConfig, ConfigError, Extrinsics, Intrinsics
from automodel.config.toml_reader import read_text
from automodel.console.messages import say
from automodel.console.progress import progress
from automodel.curves.base import Curve
from automodel.geometry import CameraModel, GroundCamera
from automodel.output_files import output_text
from automodel.signals import Frame, LaneEstimate, Motion, MotionSource
from automodel.sources.files import natural_key
from automodel.sources.images import read_image
from automodel.types import FloatArray, Image
from automodel.viewer.plots import GREEN, RED, SheetImage, write_contact_sheet
from calibration.from_lanes import camera_from_lanes

NONE = -2  # in the files: a lane has no point on this row
TOLERANCE_PX, MISSING_PX, OF_WIDTH_PX = 20.0, -100.0, 1280.0  # a missing point counts as one at -100 px
MATCHED = 0.85
MOST_LANES = 4
FARTHEST_LANES = 20.0  # lane widths ahead: a few pixels under the horizon, where labels end
_STEPS = 400

LABELS = "label_data.json"
VIEW_DEG = 60.0  # horizontal angle of view where the camera is unknown
LANE_M, MARKING_M = 3.7, 0.12  # a highway in the USA: lines of 4 to 6 inches
STANDARD = Extrinsics(x_m=1.8, z_m=1.5, pitch_rad=0.0)  # behind a windscreen, where the images do not show the camera
AHEAD_LANES, RADIUS_LANES = 7.0, 50.0  # how far lines are followed; the tightest bend
CLIP_RATE_HZ = 20.0
ENOUGH_FOR_CAMERA = 40  # images
COLUMNS = (
    "pipeline", "frames", "found", "ego_accuracy", "ego_fp", "ego_fn", "centre_median_pct", "p50_ms", "both_ego",
    "all_accuracy", "all_fp", "all_fn",
)  # fmt: skip


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Label:
    """One labelled image: `lanes` (k, n) of u [px] on the `rows` (n,) [px], NaN where a lane has no point."""

    raw_file: str
    lanes: FloatArray
    rows: FloatArray


@dataclass(frozen=True, slots=True, kw_only=True)
class Score:
    """Of one image: `accuracy` 0..1, share of wrong predictions `fp`, share of missed labels `fn`.

    `accuracies` has one for each label, that of the prediction that fits best.
    """

    accuracy: float
    fp: float
    fn: float
    accuracies: tuple[float, ...]


def parse_labels(text: str, file: str) -> list[Label]:
    """The labels in the lines of a label_data.json; raises ConfigError with file and line.

    Lanes without any point are left out. All labels must have the same number of rows as their lanes.
    """
    lines = enumerate(text.splitlines(), 1)
    labels = [_label(line, f"{file}:{number}") for number, line in lines if line.strip()]
    if not labels:
        raise ConfigError(f"{file}: expected a JSON object on each line, got no labels")
    names = [label.raw_file for label in labels]
    twice = next((name for name in names if names.count(name) > 1), None)
    if twice is not None:
        raise ConfigError(f"{file}: {twice} is labelled twice; keep one of the lines")
    return labels


def _label(line: str, where: str) -> Label:
    try:
        entry: Any = json.loads(line)
    except json.JSONDecodeError as error:
        raise ConfigError(f"{where}: not JSON: {error.msg}; is the line cut?") from None
    if not isinstance(entry, dict):
        raise ConfigError(f"{where}: expected a JSON object, got {line.strip()[:20]!r}")
    for key, kind in (("raw_file", str), ("lanes", list), ("h_samples", list)):
        if not isinstance(entry.get(key), kind):
            raise ConfigError(f"{where}: {key}: {'missing' if key not in entry else 'of the wrong kind'}")
    rows = entry["h_samples"]
    if len(rows) < 2 or not all(map(_is_number, rows)) or any(b <= a for a, b in itertools.pairwise(rows)):
        raise ConfigError(f"{where}: h_samples: expected rising numbers")
    for number, lane in enumerate(entry["lanes"], 1):
        if not isinstance(lane, list) or not all(map(_is_number, lane)):
            raise ConfigError(f"{where}: lanes: lane {number} is not a list of numbers")
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
    """The lanes with their missing points where the benchmark puts them."""
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

    Lanes that end above it are extrapolated straight, by the lower half of their points.
    """
    starts = []
    for lane in lanes:
        known = np.flatnonzero(~np.isnan(lane))
        if len(known) >= 2:
            lower = known[min(len(known) // 2, len(known) - 2) :]
            starts.append((float(np.polyfit(rows[lower] - rows[-1], lane[lower], 1)[1]), lane))
    _, left = max((s for s in starts if s[0] < middle_px), key=itemgetter(0), default=(0.0, None))
    _, right = min((s for s in starts if s[0] >= middle_px), key=itemgetter(0), default=(0.0, None))
    return left, right


def centre_error_pct(predicted: Sequence[FloatArray], label: Sequence[FloatArray]) -> float | None:
    """Distance of the middle of two predicted lines (n,) from that of two labelled ones, in % of the lane's width.

    Each row is measured in the label's width on it; the median over the rows that all four lines have.
    """
    if len(predicted) != 2 or len(label) != 2:
        return None
    width = label[1] - label[0]
    error = 50.0 * np.abs(predicted[0] + predicted[1] - label[0] - label[1]) / np.where(width > 0.0, width, np.nan)
    known = error[~np.isnan(error)]
    return float(np.median(known)) if len(known) else None


def lines_px(estimate: LaneEstimate, camera: GroundCamera, rows: FloatArray, unit_m: float) -> FloatArray:
    """The estimate's two lines (2, n) as u [px] on `rows` (n,), left first; (0, n) where it has none.

    NaN is outside the image. Each line's curve is extrapolated beyond its ends, up to `FARTHEST_LANES` lane widths
    `unit_m` ahead.
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


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Result:
    """What one pipeline made of one labelled image: predicted lanes (0 or 2, n) [px], and the time it took."""

    label: Label
    lanes: FloatArray
    run_time_ms: float
    status: str


def measure(
    root: Path, car: CarConfig | None, pipelines: Sequence[str], predictions: Path | None, figures: Path | None
) -> list[Row]:
    """A row for each pipeline (default: all) on the images under `root`.

    Writes `predictions` (JSON lines) and `figures` (PNG) if they are given, with several pipelines each one's name in
    the files' names. `car` gives the camera; without it the camera is found in the images. Raises ConfigError,
    SourceError.
    """
    labels = read_labels(root)
    car = car or assumed_car(root, labels)
    names = tuple(dict.fromkeys(pipelines)) or PIPELINE_NAMES
    rows = []
    with progress("bench tusimple", len(names) * len(labels), threaded=False) as tick:
        for name in names:
            results = []
            for result in _run(root, labels, car, name):
                results.append(result)
                tick()
            if predictions is not None:
                write_predictions(_named(predictions, name, len(names)), results)
            if figures is not None:
                images = [_sheet_image(root, result) for result in results]
                write_contact_sheet(_named(figures, name, len(names)), images)
            rows.append(_row(name, results, car.camera))
    return rows


def read_labels(root: Path) -> list[Label]:
    """The labels of a folder; raises ConfigError where a label or its image is missing or wrong."""
    file = root / LABELS
    if not root.is_dir():
        raise ConfigError(f"--root {root}: no such folder")
    if not file.is_file():
        raise ConfigError(f"--root {root}: there is no {LABELS} in it; give the folder that holds it and clips/")
    labels = parse_labels(read_text(file), str(file))
    for label in labels:
        if not (root / label.raw_file).is_file():
            raise ConfigError(f"{file}: {label.raw_file}: there is no such image under {root}")
    return labels


def assumed_car(root: Path, labels: Sequence[Label]) -> CarConfig:
    """A car on a highway whose camera is found in the labelled images; where that fails, a usual one.

    Says on stderr what was found and what was assumed.
    """
    step = -(-len(labels) // ENOUGH_FOR_CAMERA)
    images = [read_image(root / label.raw_file, False) for label in labels[::step]]
    height, width = images[0].shape
    focal = round(0.5 * width / np.tan(np.radians(0.5 * VIEW_DEG)), 2)
    intrinsics = Intrinsics(fx_px=focal, fy_px=focal, cx_px=0.5 * (width - 1), cy_px=0.5 * (height - 1))
    least = min(3, len(images))
    same = [image for image in images if image.shape == (height, width)]
    try:
        found = camera_from_lanes(same, CameraModel(intrinsics, width, height), LANE_M, STANDARD, least)
        extrinsics = found.extrinsics
        errors = ", ".join(f"{error:.2f} m at {at:.0f} m" for at, error in found.ground_error_m.items())
        how = f"from the lines of {found.frames_used} of {found.frames_seen} images"
        how += f" (residual {found.residual_px:.1f} px, error on the ground {errors})"
    except ValueError as error:
        extrinsics, how = STANDARD, f"a usual one, as it was not found in the images ({error})"
    say(
        f"camera: pitch {np.degrees(extrinsics.pitch_rad):.2f}, yaw {np.degrees(extrinsics.yaw_rad):.2f}, roll"
        f" {np.degrees(extrinsics.roll_rad):.2f} deg, height {extrinsics.z_m:.2f} m, {how}; assumed: {VIEW_DEG:.0f} deg"
        f" of view (f {focal:.0f} px), no distortion, lanes {LANE_M} m wide"
    )
    return highway_car(CameraConfig(width_px=width, height_px=height, intrinsics=intrinsics, extrinsics=extrinsics))


def highway_car(camera: CameraConfig) -> CarConfig:
    """A full-size car on a highway with that camera."""
    car = CarConfig()
    pipeline = replace(
        car.pipeline,
        centerline=replace(car.pipeline.centerline, view_ahead_lanes=AHEAD_LANES),
        contour=replace(car.pipeline.contour, look_ahead_lanes=AHEAD_LANES, radius_lanes=RADIUS_LANES),
        windows=replace(car.pipeline.windows, view_ahead_lanes=AHEAD_LANES, marking_px=4.0),
    )
    vehicle = replace(car.vehicle, wheelbase_m=2.8, reference_x_m=1.4, width_m=1.8)
    lane = replace(car.lane, width_m=LANE_M, marking_width_m=MARKING_M)
    return replace(car, camera=camera, vehicle=vehicle, lane=lane, pipeline=pipeline)


def _run(root: Path, labels: Sequence[Label], car: CarConfig, name: str) -> Iterator[Result]:
    pipeline = make_pipeline(name, car)
    camera = GroundCamera.from_config(car.camera)
    for label in labels:
        pipeline.reset()
        for index, path in enumerate(clip_of(root / label.raw_file)):
            image = read_image(path, car.camera.colour)
            _check_size(path, image, car.camera)
            t_ns = round(index * 1e9 / CLIP_RATE_HZ)
            unknown = Motion(t_ns=t_ns, speed_mps=0.0, yaw_rate_radps=0.0, source=MotionSource.NONE)
            start = time.perf_counter()
            estimate: LaneEstimate = pipeline.step(Frame(t_ns=t_ns, index=index, image=image), unknown)
            run_time_ms = 1e3 * (time.perf_counter() - start)
        lanes = lines_px(estimate, camera, label.rows, car.lane.width_m)
        yield Result(label=label, lanes=lanes, run_time_ms=run_time_ms, status=estimate.status.value)


def clip_of(labelled: Path) -> list[Path]:
    """The images of the clip up to the labelled one, which comes last."""
    beside = [path for path in labelled.parent.iterdir() if path.suffix.lower() == labelled.suffix.lower()]
    last = natural_key(labelled.name)
    return sorted((p for p in beside if natural_key(p.name) <= last), key=lambda path: natural_key(path.name))


def _check_size(path: Path, image: Image, camera: CameraConfig) -> None:
    height, width = image.shape[:2]
    if (width, height) != (camera.width_px, camera.height_px):
        raise ConfigError(
            f"{path}: expected {camera.width_px}x{camera.height_px} pixels, as the camera has, got {width}x{height};"
            " all images of a folder have one size, and --car a camera of that size"
        )


def _named(path: Path, name: str, count: int) -> Path:
    return path.with_name(f"{path.stem}.{name}{path.suffix}") if count > 1 else path


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
    with output_text(path) as file:
        file.write("\n".join(lines) + "\n")


def _row(name: str, results: Sequence[Result], camera: CameraConfig) -> Row:
    """Means over the images: of all lanes, of the two ego lines, and of the middle between these."""
    whole, ego, both, errors = [], [], 0, []
    for result in results:
        label = result.label
        lines = [line for line in ego_lines(label.lanes, label.rows, middle_px(label.rows, camera)) if line is not None]
        truth = np.array(lines).reshape(-1, len(label.rows))
        whole.append(score(result.lanes, label.lanes, label.rows, camera.width_px))
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
        **{f"all_{key}": value for key, value in _means(whole).items()},
        "centre_median_pct": float(np.median(errors)) if errors else None,
        "p50_ms": float(np.median([result.run_time_ms for result in results])),
    }


def middle_px(rows: FloatArray, camera: CameraConfig) -> float:
    """Where the line straight ahead of the camera on the ground crosses the lowest of the rows."""
    ground = GroundCamera.from_config(camera)
    near = ground.centre_m[0] + np.linspace(0.5, 60.0, 400) * camera.extrinsics.z_m
    pixels = ground.ground_to_px(np.column_stack((near, np.full_like(near, ground.centre_m[1]))))
    pixels = pixels[np.isfinite(pixels).all(axis=1)]
    return float(np.interp(rows[-1], pixels[::-1, 1], pixels[::-1, 0]))


def _means(scores: Sequence[Score]) -> dict[str, float]:
    return {key: float(np.mean([getattr(each, key) for each in scores])) for key in ("accuracy", "fp", "fn")}


def _sheet_image(root: Path, result: Result) -> SheetImage:
    """An image with its labelled and its predicted points."""
    label = result.label
    lines = [(lanes, colour) for lanes, colour in ((label.lanes, GREEN), (result.lanes, RED))]
    image = read_image(root / label.raw_file, True)
    return SheetImage(image=image, note=f"{label.raw_file} {result.status}", rows=label.rows, lines=lines)

"""The values that cross stages <-> JSON objects, without losing a bit.

Python writes the shortest decimal that reads back as the same double, so that every float comes back as it was. What
is not finite is refused: it would not be JSON.

Frames <-> foxglove.CompressedImage messages.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from typing import Any, TypeAlias

import cv2
import numpy as np

from automodel.config import RecordingConfig
from automodel.curves import Curve, GraphCurve, JoinedCurve, TabulatedCurve, ThetaCurve
from automodel.signals import (
    Command,
    Crossing,
    DriverInput,
    Event,
    LaneEstimate,
    LaneLine,
    LanePose,
    LaneStatus,
    Motion,
    MotionSource,
    VehicleState,
)
from automodel.types import FloatArray, Image

CAMERA, LEFT, RIGHT = "/camera", "/camera/left", "/camera/right"
CAMERA_TOPICS = (CAMERA, LEFT, RIGHT)
SCHEMA = "foxglove.CompressedImage"
_BOUNDS = ("offset_bound_m", "heading_bound_rad")


class ImageCodec:
    """Compresses images as `[recording]` says: PNG (lossless) or JPEG.

    PNG with run-length matching only (Huffman coding of filtered rows) is several times faster than zlib's default
    strategy, and hardly larger for images with sensor noise.
    """

    def __init__(self, config: RecordingConfig) -> None:
        self.format = config.image
        if config.image == "png":
            strategy = (cv2.IMWRITE_PNG_STRATEGY, cv2.IMWRITE_PNG_STRATEGY_RLE)
            self._options = [cv2.IMWRITE_PNG_COMPRESSION, 1, *strategy]
        else:
            self._options = [cv2.IMWRITE_JPEG_QUALITY, config.jpeg_quality]

    def encode(self, t_ns: int, image: Image) -> bytes:
        """A serialised CompressedImage; raises ValueError for an image that cannot be compressed (an empty one)."""
        from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage

        try:
            data = cv2.imencode(f".{self.format}", image, self._options)[1].tobytes()
        except cv2.error as error:
            raise ValueError(f"image: shape {image.shape} cannot be compressed as {self.format}") from error
        message: Any = CompressedImage(frame_id="camera", data=data, format=self.format)
        message.timestamp.seconds, message.timestamp.nanos = divmod(t_ns, 1_000_000_000)
        return bytes(message.SerializeToString())


def decode_image(data: bytes) -> Image:
    """The image of a serialised CompressedImage, grey or BGR; raises ValueError if it is damaged."""
    from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
    from google.protobuf.message import DecodeError

    try:
        packed = bytes(CompressedImage.FromString(data).data)
    except DecodeError:
        raise ValueError("not a CompressedImage message") from None
    image = cv2.imdecode(np.frombuffer(packed, np.uint8), cv2.IMREAD_UNCHANGED) if packed else None
    if image is None or image.dtype != np.uint8 or (image.ndim == 3 and image.shape[2] != 3):
        raise ValueError("a damaged image")
    return np.asarray(image, dtype=np.uint8)


def descriptor_set() -> bytes:
    """The protobuf schema of CompressedImage for MCAP."""
    from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
    from mcap_protobuf.schema import build_file_descriptor_set

    return bytes(build_file_descriptor_set(CompressedImage).SerializeToString())


Value: TypeAlias = Motion | VehicleState | LaneEstimate | Command | DriverInput | Event
Json: TypeAlias = dict[str, Any]

TOPICS: dict[type[Value], str] = {
    Motion: "/motion",
    VehicleState: "/vehicle_state",
    LaneEstimate: "/estimate",
    Command: "/command",
    DriverInput: "/driver",
    Event: "/event",
}


def encode(value: Value) -> bytes:
    """The value as JSON; raises ValueError for a number that is not finite and for an unknown class of curve."""
    return json.dumps(_TO_JSON[type(value)](value), allow_nan=False, separators=(",", ":")).encode()


def decode(topic: str, data: bytes) -> Value:
    """The value in a message of one of `TOPICS`; raises ValueError for other data."""
    try:
        value: Value = _FROM_JSON[topic](json.loads(data))
    except (KeyError, TypeError, ValueError) as error:
        raise ValueError(f"{topic}: a message that automodel did not write ({error!r})") from None
    return value


def curve_to_json(curve: Curve) -> Json:
    """The parameters of the curve; `kind` names its class."""
    if isinstance(curve, ThetaCurve):
        parts: Json = {"x_m": curve.x_m, "y_m": curve.y_m, "length_m": curve.length_m}
        return {"kind": "theta", "coefficients": curve.coefficients.tolist(), **parts}
    if isinstance(curve, GraphCurve):
        parts = {"x0_m": curve.x0_m, "x1_m": curve.x1_m}
        return {"kind": "graph", "coefficients": curve.coefficients.tolist(), **parts}
    if isinstance(curve, TabulatedCurve):
        parts = {"s_m": curve.s_m.tolist(), "headings_rad": curve.headings_rad.tolist()}
        parts["curvatures_per_m"] = curve.curvatures_per_m.tolist()
        return {"kind": "table", **parts, **_points(curve.points_m)}
    if isinstance(curve, JoinedCurve):
        return {"kind": "joined", "closed": curve.closed, "pieces": [curve_to_json(p) for p in curve.pieces]}
    raise ValueError(f"curve: {type(curve).__name__} cannot be recorded")


def curve_from_json(data: Json) -> Curve:
    """The curve from its parameters."""
    kind = data["kind"]
    if kind == "theta":
        return ThetaCurve(data["x_m"], data["y_m"], data["coefficients"], data["length_m"])
    if kind == "graph":
        return GraphCurve(data["coefficients"], data["x0_m"], data["x1_m"])
    if kind == "table":
        return TabulatedCurve(data["s_m"], _points_from(data), data["headings_rad"], data["curvatures_per_m"])
    if kind == "joined":
        return JoinedCurve([curve_from_json(piece) for piece in data["pieces"]], closed=data["closed"])
    raise ValueError(f"curve: unknown kind {kind!r}; the file is from a newer version of automodel")


def _points(points_m: FloatArray) -> Json:
    return {"points_x_m": points_m[:, 0].tolist(), "points_y_m": points_m[:, 1].tolist()}


def _points_from(data: Json) -> FloatArray:
    return np.stack((np.array(data["points_x_m"], float), np.array(data["points_y_m"], float)), axis=-1)


def _fields(value: Any) -> Json:
    return {name: getattr(value, name) for name in value.__dataclass_fields__}


def _motion(value: Motion) -> Json:
    return {**_fields(value), "source": value.source.value}


def _motion_from(data: Json) -> Motion:
    return Motion(**{**data, "source": MotionSource(data["source"])})


def _state_from(data: Json) -> VehicleState:
    return VehicleState(**{**data, "ranges_m": tuple(data["ranges_m"]), "faults": tuple(data["faults"])})


def _estimate(value: LaneEstimate) -> Json:
    pose, crossing = value.pose, value.crossing
    return {
        "t_ns": value.t_ns,
        "status": value.status.value,
        "frame_age_ns": value.frame_age_ns,
        "lane_change": value.lane_change,
        "camera_pitch_rad": value.camera_pitch_rad,
        "pose": None if pose is None else _pose(pose),
        "crossing": None if crossing is None else _fields(crossing),
        "left": None if value.left is None else _line(value.left),
        "right": None if value.right is None else _line(value.right),
        "centerline": None if value.centerline is None else curve_to_json(value.centerline),
    }


def _estimate_from(data: Json) -> LaneEstimate:
    pose, crossing, centerline = data["pose"], data["crossing"], data["centerline"]
    return LaneEstimate(
        t_ns=data["t_ns"],
        status=LaneStatus(data["status"]),
        frame_age_ns=data["frame_age_ns"],
        lane_change=data.get("lane_change", 0),  # older recordings have none
        camera_pitch_rad=data.get("camera_pitch_rad", 0.0),
        pose=None if pose is None else _pose_from(pose),
        crossing=None if crossing is None else Crossing(**crossing),
        left=None if data["left"] is None else _line_from(data["left"]),
        right=None if data["right"] is None else _line_from(data["right"]),
        centerline=None if centerline is None else curve_from_json(centerline),
    )


def _pose(pose: LanePose) -> Json:
    """An unknown bound is null: JSON has no infinity."""
    bounds = {key: getattr(pose, key) if math.isfinite(getattr(pose, key)) else None for key in _BOUNDS}
    return {**_fields(pose), "covariance": pose.covariance.ravel().tolist(), **bounds}


def _pose_from(data: Json) -> LanePose:
    bounds = {key: math.inf if data.get(key) is None else data[key] for key in _BOUNDS}
    return LanePose(**{**data, "covariance": np.array(data["covariance"]).reshape(3, 3), **bounds})


def _line(line: LaneLine) -> Json:
    return {"seen": line.seen, **_points(line.points_m), "curve": curve_to_json(line.curve)}


def _line_from(data: Json) -> LaneLine:
    return LaneLine(curve=curve_from_json(data["curve"]), points_m=_points_from(data), seen=data["seen"])


_TO_JSON: dict[type[Value], Callable[[Any], Json]] = {
    Motion: _motion,
    VehicleState: _fields,
    LaneEstimate: _estimate,
    Command: _fields,
    DriverInput: _fields,
    Event: _fields,
}

_FROM_JSON: dict[str, Callable[[Json], Any]] = {
    "/motion": _motion_from,
    "/vehicle_state": _state_from,
    "/estimate": _estimate_from,
    "/command": lambda data: Command(**data),
    "/driver": lambda data: DriverInput(**data),
    "/event": lambda data: Event(**data),
}

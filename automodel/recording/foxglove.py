"""What a pipeline saw, as messages of Foxglove's schemas: annotations on the image, the scene from above, the log.

Frames of reference: `world` (dead reckoning from the start) > `body` > `camera`, and `body` > `lane`, in which the
car's pose is (0, offset, heading). Topics lie below /foxglove, besides the calibrations, which belong to the images.
What holds for the whole run has topics of its own: after a jump in time a viewer asks for the last message of each.

This takes a millisecond of the interpreter a frame, three times what the recorder needs for the values themselves, so
that it is done after the drive (`automodel export --foxglove`), not by the recorder.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from importlib import resources
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from foxglove_schemas_protobuf.CameraCalibration_pb2 import CameraCalibration
from foxglove_schemas_protobuf.Color_pb2 import Color
from foxglove_schemas_protobuf.FrameTransform_pb2 import FrameTransform
from foxglove_schemas_protobuf.FrameTransforms_pb2 import FrameTransforms
from foxglove_schemas_protobuf.ImageAnnotations_pb2 import ImageAnnotations
from foxglove_schemas_protobuf.Log_pb2 import Log
from foxglove_schemas_protobuf.PointsAnnotation_pb2 import PointsAnnotation
from foxglove_schemas_protobuf.PoseInFrame_pb2 import PoseInFrame
from foxglove_schemas_protobuf.SceneEntityDeletion_pb2 import SceneEntityDeletion
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate
from google.protobuf.message import Message
from google.protobuf.timestamp_pb2 import Timestamp
from mcap_protobuf.schema import build_file_descriptor_set
from scipy.spatial.transform import Rotation

from automodel.config import CameraConfig, CarConfig, VehicleConfig
from automodel.geometry import SE2, GroundCamera
from automodel.recording.codec import CAMERA, LEFT, RIGHT
from automodel.signals import Event, LaneEstimate, LaneStatus, Motion
from automodel.types import FloatArray
from automodel.viewer.overlay import BLUE, GREY, ORANGE, STATUS_COLOURS, YELLOW, Colour, status_lines

Topical: TypeAlias = tuple[str, Message]

POSE, LANE, CAR, LOG = "/foxglove/pose", "/foxglove/lane", "/foxglove/car", "/foxglove/log"
ANNOTATIONS = "/foxglove/annotations"
WORLD_BODY, BODY_LANE, BODY_CAMERA = "/foxglove/tf/world_body", "/foxglove/tf/body_lane", "/foxglove/tf/body_camera"
CALIBRATIONS = {topic: f"{topic}/calibration" for topic in (CAMERA, LEFT, RIGHT)}
TOPICS: dict[str, type[Message]] = {
    **dict.fromkeys((WORLD_BODY, BODY_LANE), FrameTransform),
    BODY_CAMERA: FrameTransforms,
    POSE: PoseInFrame,
    **dict.fromkeys((LANE, CAR), SceneUpdate),
    LOG: Log,
    ANNOTATIONS: ImageAnnotations,
    **dict.fromkeys(CALIBRATIONS.values(), CameraCalibration),
}
_SAMPLES = 24  # points of a curve: of 2 m in a bend of 0.5 m, chord and curve are within 2 mm
_LINE_PX = 2.0  # thickness on the image, and from above
_POINT_PX = 3.0
_CAR_HEIGHT = 0.5  # of the car's width: no key of car.toml says how high the car is
_ERRORS = frozenset({"stop", "link-lost", "source-lost", "recorder-failed"})
_WARNINGS = frozenset({"hold", "arm-refused"})


def layout_file() -> Path:
    """The layout, JSON, that shows these topics."""
    return Path(str(resources.files("automodel.recording") / "foxglove_layout.json"))


def schema_of(kind: type[Message]) -> tuple[str, bytes]:
    """Full name and file descriptor set of a message class, as MCAP wants them."""
    return kind.DESCRIPTOR.full_name, bytes(build_file_descriptor_set(kind).SerializeToString())


class FoxgloveScene:
    """Makes the messages of a run, value by value; keeps the dead reckoning between frames.

    Every method yields (topic, message), with times [ns] as in the values.
    """

    def __init__(self, car: CarConfig) -> None:
        self._car = car.vehicle
        self._cameras = _cameras(car.camera)
        self._ground = GroundCamera.from_config(car.camera)
        self._place = SE2()
        self._moved_ns: int | None = None

    def start(self, t_ns: int) -> Iterator[Topical]:
        """What holds for the whole run: calibrations, where the cameras sit, the car's body."""
        for topic, frame_id, camera in self._cameras:
            yield CALIBRATIONS[topic], _calibration(camera, frame_id, t_ns)
        transforms = [_camera_transform(*camera[1:], t_ns) for camera in self._cameras]
        yield BODY_CAMERA, FrameTransforms(transforms=transforms)
        yield CAR, _body(self._car, t_ns)

    def motion(self, motion: Motion) -> Iterator[Topical]:
        """The car's place in the world after a motion; where none is known it stays."""
        if self._moved_ns is not None and motion.known:
            dt_s = (motion.t_ns - self._moved_ns) * 1e-9
            self._place = self._place @ SE2.arc(motion.speed_mps * dt_s, motion.yaw_rate_radps * dt_s)
        self._moved_ns = motion.t_ns
        yield self.placed(self._place, motion.t_ns)

    def placed(self, place: SE2, t_ns: int) -> Topical:
        """The car at a place in the world."""
        return WORLD_BODY, _transform("world", "body", place, t_ns)

    def estimate(self, estimate: LaneEstimate) -> Iterator[Topical]:
        """Lines, centerline and its bound on the image and from above, and the pose in the lane."""
        yield ANNOTATIONS, self._annotations(estimate)
        yield LANE, _lane(estimate)
        pose = estimate.pose
        if pose is not None:
            lane_from_body = SE2(0.0, pose.offset_m, pose.heading_rad) @ SE2(-self._car.reference_x_m)
            yield BODY_LANE, _transform("body", "lane", lane_from_body.inverse(), estimate.t_ns)
            message = PoseInFrame(timestamp=_time(estimate.t_ns), frame_id="lane")
            message.pose.position.y = pose.offset_m
            message.pose.orientation.z, message.pose.orientation.w = _turn(pose.heading_rad)
            yield POSE, message

    def event(self, event: Event) -> Iterator[Topical]:
        """A line of the log: stops and losses are errors, holds warnings."""
        level = Log.ERROR if event.kind in _ERRORS else Log.WARNING if event.kind in _WARNINGS else Log.INFO
        yield LOG, Log(timestamp=_time(event.t_ns), level=level, name=event.kind, message=event.text)

    def _annotations(self, estimate: LaneEstimate) -> ImageAnnotations:
        stamp = _time(estimate.t_ns)
        message, ground = ImageAnnotations(timestamp=stamp), self._ground.pitched(estimate.camera_pitch_rad)
        for points_m, colour in _lines(estimate):
            for pixels in _visible(ground.ground_to_px(points_m), ground):
                kind = PointsAnnotation.LINE_STRIP
                points = message.points.add(timestamp=stamp, type=kind, thickness=_LINE_PX, outline_color=_ink(colour))
                _fill(points.points, pixels)
        for line in (estimate.left, estimate.right):
            if line is not None and len(line.points_m):
                ink, kind = _ink(YELLOW), PointsAnnotation.POINTS
                for pixels in _visible(ground.ground_to_px(line.points_m), ground):
                    points = message.points.add(timestamp=stamp, type=kind, thickness=_POINT_PX, outline_color=ink)
                    _fill(points.points, pixels)
        size = max(10.0, self._ground.camera.width_px / 40)
        text = message.texts.add(timestamp=stamp, text=status_lines(estimate, None, "")[0], font_size=size)
        text.position.x, text.position.y = size / 2, 1.5 * size
        text.text_color.CopyFrom(_ink(STATUS_COLOURS[estimate.status]))
        text.background_color.CopyFrom(Color(a=0.6))
        return message


def _lines(estimate: LaneEstimate) -> Iterator[tuple[FloatArray, Colour]]:
    """Points (n, 2) [m] of what is drawn, and its colour: both lines (grey where not seen) and the middle."""
    for line in (estimate.left, estimate.right):
        if line is not None:
            s = np.linspace(0.0, line.curve.length_m, _SAMPLES)
            yield line.curve.position(s), BLUE if line.seen else GREY
    if estimate.centerline is not None:
        s = np.linspace(0.0, estimate.centerline.length_m, _SAMPLES)
        yield estimate.centerline.position(s), ORANGE


def _lane(estimate: LaneEstimate) -> SceneUpdate:
    """The lane from above in the body frame; it disappears where it is lost."""
    stamp = _time(estimate.t_ns)
    update = SceneUpdate()
    if estimate.status is LaneStatus.LOST:
        update.deletions.add(timestamp=stamp, type=SceneEntityDeletion.MATCHING_ID, id="lane")
        return update
    entity = update.entities.add(timestamp=stamp, frame_id="body", id="lane", frame_locked=True)
    for points_m, colour in _lines(estimate):
        strip = entity.lines.add(thickness=_LINE_PX, scale_invariant=True, color=_ink(colour))
        strip.pose.orientation.w = 1.0
        _fill(strip.points, points_m)
    pose, middle = estimate.pose, estimate.centerline
    if pose is not None and middle is not None and math.isfinite(pose.offset_bound_m):
        s, half_m = np.linspace(0.0, middle.length_m, _SAMPLES), min(pose.offset_bound_m, pose.width_m)
        band = entity.triangles.add(color=_ink(ORANGE, 0.3))
        band.pose.orientation.w = 1.0
        edges = np.stack((middle.offset_position(s, half_m), middle.offset_position(s, -half_m)), axis=1)
        _fill(band.points, edges.reshape(-1, 2))
        first = np.arange(0, 2 * _SAMPLES - 2, 2)[:, None]
        band.indices.extend(np.add(first, [0, 1, 2, 2, 1, 3]).ravel().tolist())
    return update


def _body(car: VehicleConfig, t_ns: int) -> SceneUpdate:
    update = SceneUpdate()
    entity = update.entities.add(timestamp=_time(t_ns), frame_id="body", id="car", frame_locked=True)
    cube = entity.cubes.add(color=_ink(BLUE, 0.6))
    length_m, height_m = car.rear_overhang_m + car.wheelbase_m + car.front_overhang_m, _CAR_HEIGHT * car.width_m
    cube.size.x, cube.size.y, cube.size.z = length_m, car.width_m, height_m
    cube.pose.position.x, cube.pose.position.z = 0.5 * length_m - car.rear_overhang_m, 0.5 * height_m
    cube.pose.orientation.w = 1.0
    return update


def _cameras(config: CameraConfig) -> list[tuple[str, str, CameraConfig]]:
    """Topic of the images, frame of reference and configuration of each camera."""
    if config.right is None:
        return [(CAMERA, "camera", config)]
    left, right = config.eyes
    return [(LEFT, "camera", left), (RIGHT, "camera/right", right)]


def _calibration(config: CameraConfig, frame_id: str, t_ns: int) -> CameraCalibration:
    """The pinhole with Brown's distortion, which Foxglove calls plumb_bob; the image is not rectified."""
    lens = config.intrinsics
    k = [lens.fx_px, 0.0, lens.cx_px, 0.0, lens.fy_px, lens.cy_px, 0.0, 0.0, 1.0]
    return CameraCalibration(
        timestamp=_time(t_ns),
        frame_id=frame_id,
        width=config.width_px,
        height=config.height_px,
        distortion_model="plumb_bob",
        D=lens.distortion,
        K=k,
        R=np.eye(3).ravel(),
        P=np.insert(np.reshape(k, (3, 3)), 3, 0.0, axis=1).ravel(),
    )


def _camera_transform(frame_id: str, config: CameraConfig, t_ns: int) -> FrameTransform:
    camera = GroundCamera.from_config(config)
    transform = _transform("body", frame_id, SE2(), t_ns)
    x, y, z, w = Rotation.from_matrix(camera.cam_from_body.T).as_quat()
    transform.translation.x, transform.translation.y, transform.translation.z = camera.centre_m
    turn = transform.rotation
    turn.x, turn.y, turn.z, turn.w = x, y, z, w
    return transform


def _transform(parent: str, child: str, parent_from_child: SE2, t_ns: int) -> FrameTransform:
    transform = FrameTransform(timestamp=_time(t_ns), parent_frame_id=parent, child_frame_id=child)
    transform.translation.x, transform.translation.y = parent_from_child.x_m, parent_from_child.y_m
    transform.rotation.z, transform.rotation.w = _turn(parent_from_child.yaw_rad)
    return transform


def _turn(yaw_rad: float) -> tuple[float, float]:
    """z and w of the quaternion of a turn about z."""
    return math.sin(0.5 * yaw_rad), math.cos(0.5 * yaw_rad)


def _time(t_ns: int) -> Timestamp:
    return Timestamp(seconds=t_ns // 10**9, nanos=t_ns % 10**9)


def _ink(colour: Colour, alpha: float = 1.0) -> Color:
    blue, green, red = (part / 255.0 for part in colour)
    return Color(r=red, g=green, b=blue, a=alpha)


def _visible(pixels: FloatArray, ground: GroundCamera) -> Iterator[FloatArray]:
    """The stretches of a row of pixels (n, 2) that lie on the image or close to it."""
    camera = ground.camera
    with np.errstate(invalid="ignore"):
        there = camera.inside(pixels, -float(camera.width_px))
    for part in np.split(np.arange(len(pixels)), np.flatnonzero(np.diff(there)) + 1):
        if len(part) and there[part[0]]:
            yield pixels[part]


def _fill(field: Any, points: Iterable[Iterable[float]]) -> None:
    """Append points (n, 2) to a repeated field of Point2 or Point3."""
    for x, y in np.asarray(points).tolist():
        field.add(x=x, y=y)

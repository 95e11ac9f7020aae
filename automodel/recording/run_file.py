"""Writing the MCAP file of a run, with JSON schemas of its topics for Foxglove.

Foxglove expects one plain type per property: no unions (although values may be null), no arrays of arrays.
"""

from __future__ import annotations

import contextlib
import dataclasses
import datetime
import importlib.metadata
import json
import os
import platform
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from mcap.writer import CompressionType, Writer

from automodel.config import ConfigError, RecordingConfig, parse_car
from automodel.recording.codec import CAMERA, LEFT, RIGHT, SCHEMA, TOPICS, ImageCodec, Value, descriptor_set, encode
from automodel.signals import Frame, StereoFrame

# Not compressed, so that only the end of a cut chunk is lost. More than JPEGs take between two syncs, where chunks end:
# of every chunk 0.6 kB stay in memory to the end, for the index.
CHUNK_BYTES = 4 * 1024 * 1024
CAR_TOML, CALIBRATION, METADATA, END_METADATA = "car.toml", "calibration.json", "automodel", "automodel end"

_Schema = dict[str, Any]

_TYPES: dict[str, _Schema] = {
    **{name: {"type": name} for name in ("number", "integer", "boolean", "string")},
    **{f"{name}s": {"type": "array", "items": {"type": name}} for name in ("number", "string")},
}


def _object(fields: str, **objects: _Schema) -> _Schema:
    """The schema of an object with fields "name:type ..." and further objects."""
    simple = {name: _TYPES[kind] for name, _, kind in (field.partition(":") for field in fields.split())}
    return {"type": "object", "properties": {**simple, **objects}}


_CURVE = _object("kind:string coefficients:numbers points_x_m:numbers points_y_m:numbers")
_LINE = _object("seen:boolean points_x_m:numbers points_y_m:numbers", curve=_CURVE)
_POSE = _object(
    "offset_m:number heading_rad:number width_m:number curvature_per_m:number covariance:numbers"
    " offset_bound_m:number heading_bound_rad:number"
)
_CROSSING = _object("distance_m:number angle_rad:number")
_ESTIMATE_PARTS = {"pose": _POSE, "crossing": _CROSSING, "left": _LINE, "right": _LINE, "centerline": _CURVE}
_STATE = (
    "t_ns:integer speed_mps:number yaw_rate_radps:number steering_rad:number ranges_m:numbers battery_v:number"
    " armed:boolean faults:strings boot_id:integer engaged:boolean driver_override:boolean gear:string"
)

SCHEMAS: dict[str, tuple[str, _Schema]] = {
    "/motion": (
        "automodel.Motion",
        _object("t_ns:integer speed_mps:number yaw_rate_radps:number source:string"),
    ),
    "/vehicle_state": ("automodel.VehicleState", _object(_STATE)),
    "/estimate": (
        "automodel.LaneEstimate",
        _object(
            "t_ns:integer status:string frame_age_ns:integer lane_change:integer camera_pitch_rad:number",
            **_ESTIMATE_PARTS,
        ),
    ),
    "/command": (
        "automodel.Command",
        _object("t_ns:integer steering_rad:number speed_mps:number valid_until_ns:integer"),
    ),
    "/driver": ("automodel.DriverInput", _object("t_ns:integer steering:number speed:number")),
    "/event": ("automodel.Event", _object("t_ns:integer kind:string text:string")),
}


def schema_text(topic: str) -> tuple[str, bytes]:
    """Name and JSON schema of a topic's messages."""
    name, schema = SCHEMAS[topic]
    return name, json.dumps({"title": name, **schema}).encode()


class RunFile:
    """Writes values into a new MCAP file; after `sync` they are on the disk.

    The log time of a message is the value's `t_ns`, that of a pair's right image its own; its sequence number is the
    index of its frame. A right image without a left one is of a pair whose left camera was missing. Chunks are not
    compressed: images already are, and the records of a half-written chunk can still be read. Raises ConfigError for a
    file that exists or cannot be created, OSError when writing fails, and ValueError for a value that cannot be written
    (then the file is unchanged).
    """

    def __init__(self, path: str | Path, car_text: str, config: RecordingConfig) -> None:
        self.path = Path(path)
        calibration = _calibration(car_text)
        if self.path.exists():
            raise ConfigError(f"{path}: already exists; choose another name or delete it")
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            self._stream = open(self.path, "xb")  # noqa: SIM115 - open as long as the run lasts
        except OSError as error:
            raise ConfigError(f"{path}: cannot be written: {error.strerror}") from None
        self._images = ImageCodec(config)
        self._writer: Any = Writer(self._stream, chunk_size=CHUNK_BYTES, compression=CompressionType.NONE)
        self._writer.start(library=f"automodel {_version()}")
        self._writer.add_attachment(0, 0, CAR_TOML, "application/toml", car_text.encode())
        self._writer.add_attachment(0, 0, CALIBRATION, "application/json", calibration.encode())
        self._writer.add_metadata(METADATA, _origin(config))
        self._channels = self._register()
        self.sync()
        _sync_folder(self.path.parent)

    def frame(self, frame: Frame | StereoFrame) -> None:
        """Write a frame."""
        if isinstance(frame, StereoFrame):
            images = {LEFT: (frame.t_ns, frame.left), RIGHT: (frame.t_ns + frame.right_late_ns, frame.right)}
        else:
            images = {RIGHT if frame.eye else CAMERA: (frame.t_ns, frame.image)}
        encoded = {topic: (t_ns, self._images.encode(t_ns, image)) for topic, (t_ns, image) in images.items()}
        for topic, (t_ns, data) in encoded.items():
            self._add(topic, t_ns, frame.index, data)

    def value(self, value: Value, frame_index: int) -> None:
        """Write any other value with the index of its frame."""
        self._add(TOPICS[type(value)], value.t_ns, frame_index, encode(value))

    def sync(self) -> None:
        """Flush everything to the disk."""
        self._writer.flush()
        os.fsync(self._stream.fileno())

    def finish(self, counts: dict[str, int]) -> None:
        """Write the counts and the index, and close."""
        self._writer.add_metadata(END_METADATA, {name: str(count) for name, count in counts.items()})
        self._writer.finish()
        self._stream.flush()
        os.fsync(self._stream.fileno())
        self._stream.close()

    def abandon(self) -> None:
        """Close without an index, after an error."""
        with contextlib.suppress(OSError):
            self._stream.close()

    def _add(self, topic: str, t_ns: int, frame_index: int, data: bytes) -> None:
        if not (0 <= t_ns < 2**63 and 0 <= frame_index < 2**32):
            raise ValueError(f"{topic}: t_ns {t_ns}, frame {frame_index}: out of range")
        self._writer.add_message(self._channels[topic], t_ns, data, t_ns, frame_index)

    def _register(self) -> dict[str, int]:
        camera = self._writer.register_schema(SCHEMA, "protobuf", descriptor_set())
        channels = {topic: self._writer.register_channel(topic, "protobuf", camera) for topic in (CAMERA, LEFT, RIGHT)}
        for topic in TOPICS.values():
            name, text = schema_text(topic)
            schema = self._writer.register_schema(name, "jsonschema", text)
            channels[topic] = self._writer.register_channel(topic, "json", schema)
        return channels


def _calibration(car_text: str) -> str:
    """The car's calibration with defaults, as JSON."""
    car = parse_car(car_text, CAR_TOML)
    link = {"servo": dataclasses.asdict(car.link.servo), "motor": dataclasses.asdict(car.link.motor)}
    return json.dumps({"camera": dataclasses.asdict(car.camera), **link}, indent=1)


def _origin(config: RecordingConfig) -> dict[str, str]:
    return {
        "started": datetime.datetime.now(datetime.timezone.utc).isoformat(timespec="milliseconds"),
        "automodel": _version(),
        "numpy": np.__version__,
        "opencv": cv2.__version__,
        "python": platform.python_version(),
        "machine": platform.machine(),
        "image": config.image,
    }


def _version() -> str:
    return importlib.metadata.version("automodel")


def _sync_folder(folder: Path) -> None:
    """Flush the folder entry of the new file to the disk."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)

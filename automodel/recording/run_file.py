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

CHUNK_BYTES = 512 * 1024  # not compressed, so that only the end of a cut chunk is lost
CAR_TOML, CALIBRATION, METADATA, END_METADATA = "car.toml", "calibration.json", "automodel", "automodel end"

_Schema = dict[str, Any]

_NUMBER: _Schema = {"type": "number"}
_INTEGER: _Schema = {"type": "integer"}
_BOOLEAN: _Schema = {"type": "boolean"}
_STRING: _Schema = {"type": "string"}
_NUMBERS: _Schema = {"type": "array", "items": _NUMBER}


def _object(**properties: _Schema) -> _Schema:
    return {"type": "object", "properties": properties}


_CURVE = _object(kind=_STRING, coefficients=_NUMBERS, points_x_m=_NUMBERS, points_y_m=_NUMBERS)
_LINE = _object(seen=_BOOLEAN, points_x_m=_NUMBERS, points_y_m=_NUMBERS, curve=_CURVE)
_POSE = _object(offset_m=_NUMBER, heading_rad=_NUMBER, width_m=_NUMBER, curvature_per_m=_NUMBER, covariance=_NUMBERS)

SCHEMAS: dict[str, tuple[str, _Schema]] = {
    "/motion": (
        "automodel.Motion",
        _object(t_ns=_INTEGER, speed_mps=_NUMBER, yaw_rate_radps=_NUMBER, source=_STRING),
    ),
    "/vehicle_state": (
        "automodel.VehicleState",
        _object(
            t_ns=_INTEGER,
            speed_mps=_NUMBER,
            yaw_rate_radps=_NUMBER,
            steering_rad=_NUMBER,
            ranges_m=_NUMBERS,
            battery_v=_NUMBER,
            armed=_BOOLEAN,
            faults={"type": "array", "items": _STRING},
            boot_id=_INTEGER,
        ),
    ),
    "/estimate": (
        "automodel.LaneEstimate",
        _object(
            t_ns=_INTEGER,
            status=_STRING,
            frame_age_ns=_INTEGER,
            pose=_POSE,
            crossing=_object(distance_m=_NUMBER, angle_rad=_NUMBER),
            left=_LINE,
            right=_LINE,
            centerline=_CURVE,
        ),
    ),
    "/command": (
        "automodel.Command",
        _object(t_ns=_INTEGER, steering_rad=_NUMBER, speed_mps=_NUMBER, valid_until_ns=_INTEGER),
    ),
    "/event": ("automodel.Event", _object(t_ns=_INTEGER, kind=_STRING, text=_STRING)),
}


def schema_text(topic: str) -> tuple[str, bytes]:
    """Name and JSON schema of a topic's messages."""
    name, schema = SCHEMAS[topic]
    return name, json.dumps({"title": name, **schema}).encode()


class RunFile:
    """Writes values into a new MCAP file; after `sync` they are on the disk.

    The log time of a message is the value's `t_ns`; its sequence number is the index of its frame. Chunks are not
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
            images = {LEFT: frame.left, RIGHT: frame.right}
        else:
            images = {CAMERA: frame.image}
        for topic, image in images.items():
            self._add(topic, frame.t_ns, frame.index, self._images.encode(frame.t_ns, image))

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

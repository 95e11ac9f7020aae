from __future__ import annotations

import dataclasses
import math
import struct
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from automodel.config import RecordingConfig
from automodel.curves import Curve, ReversedCurve, ThetaCurve
from automodel.recording.codec import TOPICS, ImageCodec, Value, decode, decode_image, encode
from automodel.recording.run_file import SCHEMAS
from automodel.signals import Command, LaneEstimate, LaneStatus, Motion, MotionSource, VehicleState
from tests.support.recorded_values import (
    make_command,
    make_driver,
    make_estimate,
    make_event,
    make_frame,
    make_motion,
    make_state,
)


def bits(value: Any) -> Any:
    """Everything that a value is made of, floats as their eight bytes."""
    if isinstance(value, float):
        return struct.pack("<d", value)
    if isinstance(value, np.ndarray):
        return value.shape, value.dtype.str, value.tobytes()
    if dataclasses.is_dataclass(value):
        return type(value), {f.name: bits(getattr(value, f.name)) for f in dataclasses.fields(value)}
    if isinstance(value, Curve):
        return type(value), {name: bits(part) for name, part in vars(value).items()}
    if isinstance(value, tuple | list):
        return [bits(part) for part in value]
    return value


def round_trip(value: Value) -> Value:
    return decode(TOPICS[type(value)], encode(value))


VALUES = [make(7) for make in (make_motion, make_state, make_estimate, make_command, make_driver, make_event)]
BARE = [
    LaneEstimate(t_ns=0, status=LaneStatus.LOST),
    VehicleState(t_ns=5),
    Motion(t_ns=1, speed_mps=0.0, yaw_rate_radps=-0.0, source=MotionSource.NONE),
]


@pytest.mark.parametrize("value", VALUES + BARE, ids=lambda v: type(v).__name__)
def test_every_value_comes_back_bit_by_bit(value: Value) -> None:
    assert bits(round_trip(value)) == bits(value)


def test_the_comparison_sees_one_bit() -> None:
    command = make_command(0)
    other = dataclasses.replace(command, steering_rad=math.nextafter(command.steering_rad, 9.0))
    assert bits(command) != bits(other)
    assert bits(-0.0) != bits(0.0)


@given(st.floats(allow_nan=False, allow_infinity=False), st.integers(0, 2**63 - 1))
def test_any_double_and_any_time_come_back(number: float, t_ns: int) -> None:
    command = Command(t_ns=t_ns, steering_rad=number, speed_mps=-number, valid_until_ns=t_ns)
    assert bits(round_trip(command)) == bits(command)


def test_numpy_floats_are_written_as_numbers() -> None:
    command = Command(t_ns=1, steering_rad=np.float64(0.1), speed_mps=0.0, valid_until_ns=2)
    assert round_trip(command) == command


@pytest.mark.parametrize("number", [math.nan, math.inf, -math.inf])
def test_what_is_not_finite_is_refused(number: float) -> None:
    with pytest.raises(ValueError):
        encode(Motion(t_ns=0, speed_mps=number, yaw_rate_radps=0.0))


def test_a_curve_that_is_not_known_is_refused_by_name() -> None:
    curve = ReversedCurve(ThetaCurve(0.0, 0.0, (0.1,), 1.0))
    with pytest.raises(ValueError, match="ReversedCurve"):
        encode(LaneEstimate(t_ns=0, status=LaneStatus.TRACKING, centerline=curve))


@pytest.mark.parametrize("data", [b"", b"{", b"[]", b"{}", b'{"t_ns":1}', b"\xff", b'{"t_ns":1,"kind":2,"more":3}'])
@pytest.mark.parametrize("topic", sorted(SCHEMAS))
def test_foreign_messages_are_refused_by_topic(topic: str, data: bytes) -> None:
    with pytest.raises(ValueError, match=topic):
        decode(topic, data)


def plain(schema: dict[str, Any]) -> bool:
    """What Foxglove's reader takes: one plain type each, arrays of numbers, strings or objects."""
    kind = schema.get("type")
    if kind == "object":
        return all(plain(part) for part in schema["properties"].values())
    if kind == "array":
        return schema["items"]["type"] != "array" and plain(schema["items"])
    return kind in ("number", "integer", "boolean", "string")


@pytest.mark.parametrize("topic", TOPICS.values())
def test_schemas_are_of_the_kind_that_foxglove_reads(topic: str) -> None:
    assert SCHEMAS[topic][1]["type"] == "object"
    assert plain(SCHEMAS[topic][1])


@pytest.mark.parametrize("value", VALUES, ids=lambda v: type(v).__name__)
def test_schemas_name_every_field(value: Value) -> None:
    import json

    schema = SCHEMAS[TOPICS[type(value)]][1]
    assert set(schema["properties"]) == set(json.loads(encode(value)))


@pytest.mark.parametrize("colour", [False, True])
def test_png_keeps_every_bit(colour: bool) -> None:
    frame = make_frame(3, colour)
    image = decode_image(ImageCodec(RecordingConfig(image="png")).encode(frame.t_ns, frame.image))
    np.testing.assert_array_equal(image, frame.image)


def test_jpeg_is_near_and_keeps_grey_grey() -> None:
    ramp = np.tile(np.arange(0, 128, 2, dtype=np.uint8), (36, 1))
    image = decode_image(ImageCodec(RecordingConfig()).encode(0, ramp))
    assert image.shape == ramp.shape
    assert np.abs(image.astype(int) - ramp).max() <= 6


def test_image_messages_carry_time_and_format() -> None:
    from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage

    for image, start in (("png", b"\x89PNG"), ("jpeg", b"\xff\xd8")):
        codec = ImageCodec(RecordingConfig(image=image))
        message = CompressedImage.FromString(codec.encode(12_000_000_345, make_frame(0).image))
        assert (message.timestamp.seconds, message.timestamp.nanos) == (12, 345)
        assert message.format == image
        assert message.data.startswith(start)


@pytest.mark.parametrize("data", [b"", b"\xff\xff\xff", b"hello"])
def test_what_is_no_image_is_refused(data: bytes) -> None:
    with pytest.raises(ValueError, match=r"CompressedImage|damaged image"):
        decode_image(data)

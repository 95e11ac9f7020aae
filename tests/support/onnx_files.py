"""ONNX files written byte by byte, good ones and hostile ones, without the onnx package."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

WIDTH, HEIGHT = 256, 128  # the small size, for speed
OPEN = (1, 1, "rows", WIDTH)  # a shape whose height is open
UINT8, FLOAT, INT64 = 2, 1, 7


def varint(value: int) -> bytes:
    out = b""
    while value > 0x7F:
        out += bytes([value & 0x7F | 0x80])
        value >>= 7
    return out + bytes([value])


def field(number: int, value: int | str | bytes) -> bytes:
    if isinstance(value, int):
        return varint(number << 3) + varint(value)
    data = value.encode() if isinstance(value, str) else value
    return varint(number << 3 | 2) + varint(len(data)) + data


def attribute(name: str, value: int | Sequence[int]) -> bytes:
    if isinstance(value, int):
        return field(1, name) + field(3, value) + field(20, 2)
    return field(1, name) + b"".join(field(8, item) for item in value) + field(20, 7)


def node(operator: str, inputs: str, output: str, domain: str = "", **attributes: int | Sequence[int]) -> bytes:
    body = b"".join(field(1, name) for name in inputs.split()) + field(2, output) + field(4, operator)
    body += b"".join(field(5, attribute(name, value)) for name, value in attributes.items())
    return body + (field(7, domain) if domain else b"")


def weights(name: str, values: NDArray[np.float32]) -> bytes:
    dims = b"".join(field(1, size) for size in values.shape)
    return dims + field(2, FLOAT) + field(8, name) + field(9, values.astype("<f4").tobytes())


def integers(name: str, values: Sequence[int]) -> bytes:
    packed = np.array(values, "<i8").tobytes()
    return field(1, len(values)) + field(2, INT64) + field(8, name) + field(9, packed)


def scalar(name: str, value: float) -> bytes:
    return weights(name, np.float32(value).reshape(()))


def value(name: str, kind: int = UINT8, shape: Sequence[int | str] = (1, 1, HEIGHT, WIDTH)) -> bytes:
    dims = b"".join(field(1, field(1 if isinstance(size, int) else 2, size)) for size in shape)
    return field(1, name) + field(2, field(1, field(1, kind) + field(2, dims)))


# A mask of what is brighter than its surroundings: 255 where it is by 72 grey values, 0 where by 40 or less.
NODES = (
    node("Cast", "image", "grey", to=FLOAT),
    node("AveragePool", "grey", "mean", kernel_shape=(31, 31), pads=(15, 15, 15, 15)),
    node("Sub", "grey mean", "above"),
    node("Sub", "above least", "over"),
    node("Mul", "over gain", "scaled"),
    node("Clip", "scaled low high", "clipped"),
    node("Cast", "clipped", "marking", to=UINT8),
)
WEIGHTS = (scalar("least", 40.0), scalar("gain", 8.0), scalar("low", 0.0), scalar("high", 255.0))
INPUTS = (value("image"),)
OUTPUTS = (value("marking"),)


def graph(
    nodes: Sequence[bytes] = NODES,
    tensors: Sequence[bytes] = WEIGHTS,
    inputs: Sequence[bytes] = INPUTS,
    outputs: Sequence[bytes] = OUTPUTS,
    more: bytes = b"",
) -> bytes:
    parts = [field(1, item) for item in nodes] + [field(2, "ridge")] + [field(5, item) for item in tensors]
    parts += [field(11, item) for item in inputs] + [field(12, item) for item in outputs]
    return b"".join(parts) + more


def model(body: bytes | None = None, opset: int = 17, domain: str = "", more: bytes = b"") -> bytes:
    versions = field(8, (field(1, domain) if domain else b"") + field(2, opset))
    return field(1, 8) + field(7, graph() if body is None else body) + versions + more


def open_model() -> bytes:
    """The network of `NODES` for images of any height."""
    return model(graph(inputs=(value("image", shape=OPEN),), outputs=(value("marking", shape=OPEN),)))

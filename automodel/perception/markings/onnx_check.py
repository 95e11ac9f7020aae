"""What an ONNX file must be for the marking network to be loaded from it: checked before onnxruntime sees the bytes.

One graph of standard operators with all weights inside, a grey image in and a mask of the same size out. Refused: other
operators and domains, control flow and functions (a graph within the graph), data in other files, weights that are not
finite, other names, types or shapes. The field numbers are those of onnx.proto.

`Message` reads the protobuf encoding, without the onnx package, from files that nobody vouches for: every length is
checked against the bytes that are left, nothing is copied, nothing recurses by itself, and the number of parts is
bounded, so that no file can hang or crash the reader. It reads one level of a message; the caller opens the parts that
it needs. It is stricter than protobuf where readers may differ: no groups, and no message or string given twice where
one is expected (protobuf would merge or replace).
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

INPUT, OUTPUT = "image", "marking"
ROWS = "rows"  # a height of this name is open: the network takes any multiple of STRIDE
STRIDE = 8  # rows: the coarsest level of a network has one row for so many of the image
DIGEST = "graph_sha256"  # name in the metadata
OPSET = 17
OPSETS = range(11, 24)
UINT8, FLOAT = 2, 1

# Operators of networks from images to masks: none of these reads a file, loops or calls another graph.
# fmt: off
OPERATORS = frozenset([
    "Add", "And", "AveragePool", "BatchNormalization", "Cast", "Ceil", "Clip", "Concat", "Constant", "Conv",
    "ConvTranspose", "DepthToSpace", "DequantizeLinear", "Div", "Elu", "Equal", "Erf", "Exp", "Flatten", "Floor",
    "Gather", "Gelu", "Gemm", "GlobalAveragePool", "GlobalMaxPool", "Greater", "GroupNormalization", "HardSigmoid",
    "HardSwish", "Identity", "InstanceNormalization", "LayerNormalization", "LeakyRelu", "Less", "Log", "MatMul",
    "Max", "MaxPool", "Mean", "Min", "Mish", "Mul", "Neg", "PRelu", "Pow", "QLinearConv", "QuantizeLinear",
    "Reciprocal", "ReduceMax", "ReduceMean", "ReduceMin", "ReduceSum", "Relu", "Reshape", "Resize", "Round", "Selu",
    "Shape", "Sigmoid", "Slice", "Softmax", "Softplus", "SpaceToDepth", "Split", "Sqrt", "Squeeze", "Sub", "Sum",
    "Tanh", "Transpose", "Unsqueeze", "Where",
])
# fmt: on

MAX_PARTS = 200_000  # of one file at all levels; a network of 100 layers has a few thousand

VARINT, FIXED64, BYTES, FIXED32 = 0, 1, 2, 5

_MODEL = {"ir_version": 1, "graph": 7, "opset_import": 8}
_METADATA = 14
_MODEL_KNOWN = frozenset((*range(1, 9), _METADATA))  # 20 training_info, 25 functions, 26 configuration: never needed
_GRAPH_KNOWN = frozenset((1, 2, 5, 10, 11, 12, 13, 14, 16))  # 15 sparse_initializer
_NODE_KNOWN = frozenset((*range(1, 8), 9))  # 8 overload, 10 device_configurations
_ATTRIBUTE_KNOWN = frozenset((1, 2, 3, 4, 5, 7, 8, 9, 10, 13, 20))  # 6, 11: graphs; 21: of a function
_TENSOR_KNOWN = frozenset((1, 2, 4, 5, 7, 8, 9, 10, 11, 12, 14, 16))  # 3 segment, 6 strings, 13 external data


def check_onnx(data: bytes, width_px: int, height_px: int) -> bool:
    """Whether the network's height is open; it is for images of that width and that height, or of `ROWS` rows.

    Raises ValueError with one line that says what is wrong where `data` is no such network, or has another digest than
    it states (`graph_digest`, which `automodel train` writes).
    """
    if data[4:8] == b"ORTM":
        raise MalformedError("is in onnxruntime's own format; give an ONNX file")
    model = Message(memoryview(data), "the file", PartBudget())
    if not model.fields >= set(_MODEL.values()):
        raise MalformedError("is not an ONNX file")
    _only(model, _MODEL_KNOWN)
    _check_opsets(model)
    graph = model.message(_MODEL["graph"], "the graph")
    stated = {entry.text(1): entry.text(2) for entry in model.messages(_METADATA, "its metadata")}.get(DIGEST)
    if stated is not None and stated != graph_digest(data):
        raise MalformedError(
            "is damaged, or a tool has changed it: its layers have another SHA-256 than it states; give the file as "
            f"it was trained, or take {DIGEST} out of its metadata"
        )
    _only(graph, _GRAPH_KNOWN)
    for node in graph.messages(1, "a node"):
        _check_node(node)
    for tensor in graph.messages(5, "a weight"):
        _check_tensor(tensor)
    inputs, outputs = graph.messages(11, "an input"), graph.messages(12, "an output")
    is_open = any(ROWS in _shape(value) for value in inputs)
    shape = (1, 1, ROWS if is_open else height_px, width_px)
    _check_value(inputs, "input", INPUT, shape)
    _check_value(outputs, "output", OUTPUT, shape)
    return is_open


def graph_digest(data: bytes) -> str:
    """The SHA-256 of a network's layers and weights, to be kept in its metadata under `DIGEST`."""
    model = Message(memoryview(data), "the file", PartBudget())
    return hashlib.sha256(model.blob(_MODEL["graph"], "the graph")).hexdigest()


def _only(message: Message, known: frozenset[int]) -> None:
    unknown = sorted(message.fields - known)
    if unknown:
        raise MalformedError(f"{message.what} has a field {unknown[0]}, which no mask network needs")


def _check_opsets(model: Message) -> None:
    for opset in model.messages(_MODEL["opset_import"], "an operator set"):
        domain, version = opset.text(1), opset.number(2)
        if domain not in ("", "ai.onnx"):
            raise MalformedError(f"uses operators of {domain!r}; only standard ONNX operators are allowed")
        if version not in OPSETS:
            raise MalformedError(f"uses operator set {version}; supported are {OPSETS.start} to {OPSETS.stop - 1}")


def _check_node(node: Message) -> None:
    _only(node, _NODE_KNOWN)
    operator, domain = node.text(4), node.text(7)
    if domain not in ("", "ai.onnx"):
        raise MalformedError(f"uses operator {operator!r} of {domain!r}; only standard ONNX operators are allowed")
    if operator not in OPERATORS:
        raise MalformedError(f"uses operator {operator!r}, which no mask network needs")
    for attribute in node.messages(5, f"an attribute of {operator}"):
        _only(attribute, _ATTRIBUTE_KNOWN)
        for number in (5, 10):  # t, tensors
            for tensor in attribute.messages(number, f"a tensor of {operator}"):
                _check_tensor(tensor)


def _check_tensor(tensor: Message) -> None:
    if 13 in tensor.fields or tensor.number(14) != 0:
        raise MalformedError(f"keeps {tensor.text(8)!r} in another file; export it with all weights inside")
    _only(tensor, _TENSOR_KNOWN)
    if tensor.number(2) != FLOAT:
        return
    for number in (4, 9):  # float_data, raw_data
        for blob in tensor.blobs(number):
            if len(blob) % 4 or not np.isfinite(np.frombuffer(blob, dtype="<f4")).all():
                raise MalformedError(f"has weights in {tensor.text(8)!r} that are not finite numbers")


def _shape(value: Message) -> tuple[int | str, ...]:
    """A value's size along each dimension: a number, or the name of one that is open; 0 where there is neither."""
    tensor = value.message(2, "the type").message(1, "a tensor type")
    return tuple(dim.text(2) or dim.number(1) for dim in tensor.message(2, "the shape").messages(1, "a dimension"))


def _check_value(values: list[Message], kind: str, name: str, shape: tuple[int | str, ...]) -> None:
    """Raise MalformedError unless there is one `kind`, called `name`, of type uint8 and this shape."""
    names = [value.text(1) for value in values]
    if names != [name]:
        raise MalformedError(f"expected one {kind}, {name!r}, got {', '.join(map(repr, names)) or 'none'}")
    tensor = values[0].message(2, "the type").message(1, "a tensor type")
    found = _shape(values[0])
    if tensor.number(1) != UINT8 or found != shape:
        kinds = {UINT8: "uint8", FLOAT: "float32"}
        got = f"{kinds.get(tensor.number(1), 'another type')} {found}"
        raise MalformedError(f"expected {kind} {name!r} as uint8 {shape}, got {got}")


class MalformedError(ValueError):
    """The bytes are no protobuf message, or not the expected one."""


@dataclass(slots=True)
class PartBudget:
    """The number of parts of one file that may still be read."""

    parts: int = MAX_PARTS

    def take(self) -> None:
        """Count one part; raises MalformedError when there are too many."""
        self.parts -= 1
        if self.parts < 0:
            raise MalformedError(f"more than {MAX_PARTS} parts")


class Message:
    """The parts of one message by field number; `what` names it in errors. Raises MalformedError.

    A varint, fixed32 or fixed64 is an unsigned int; a string, bytes or inner message is a memoryview.
    """

    def __init__(self, data: memoryview, what: str, budget: PartBudget) -> None:
        self.what, self._budget = what, budget
        self._parts: dict[int, list[tuple[int, int | memoryview]]] = {}
        for number, kind, value in self._read(data):
            self._parts.setdefault(number, []).append((kind, value))

    @property
    def fields(self) -> frozenset[int]:
        """The numbers of the fields present."""
        return frozenset(self._parts)

    def messages(self, number: int, what: str) -> list[Message]:
        """All messages of a repeated field."""
        return [Message(data, what, self._budget) for data in self.blobs(number)]

    def message(self, number: int, what: str) -> Message:
        """The message of a field that must occur once."""
        return Message(self.blob(number, what), what, self._budget)

    def blobs(self, number: int) -> list[memoryview]:
        """The bytes of each part of a repeated field."""
        return [value for value in self._of_kind(number, BYTES) if isinstance(value, memoryview)]

    def blob(self, number: int, what: str) -> memoryview:
        """The bytes of a field that must occur once."""
        found = self.blobs(number)
        if len(found) != 1:
            raise MalformedError(f"{self.what}: expected {what} once, got {len(found)}")
        return found[0]

    def texts(self, number: int) -> list[str]:
        """A repeated field of strings."""
        return [_text(data, self.what) for data in self.blobs(number)]

    def text(self, number: int) -> str:
        """A string that may occur once; empty when it is absent."""
        found = self.texts(number)
        if len(found) > 1:
            raise MalformedError(f"{self.what}: expected one string in field {number}, got {len(found)}")
        return found[0] if found else ""

    def number(self, number: int) -> int:
        """An integer that may occur once; 0 when it is absent."""
        found = self._of_kind(number, VARINT)
        if len(found) > 1:
            raise MalformedError(f"{self.what}: expected one number in field {number}, got {len(found)}")
        value = found[0] if found else 0
        assert isinstance(value, int)
        return value

    def numbers(self, number: int) -> list[int]:
        """A repeated field of integers, given one by one or packed."""
        found: list[int] = []
        for _, value in self._parts.get(number, []):
            if isinstance(value, int):
                found.append(value)
                continue
            at = 0
            while at < len(value):
                self._budget.take()
                one, at = _varint(value, at, self.what)
                found.append(one)
        return found

    def _of_kind(self, number: int, wanted: int) -> list[int | memoryview]:
        parts = self._parts.get(number, [])
        if any(kind != wanted for kind, _ in parts):
            raise MalformedError(f"field {number} of {self.what} has another type than in ONNX")
        return [value for _, value in parts]

    def _read(self, data: memoryview) -> Iterator[tuple[int, int, int | memoryview]]:
        at = 0
        while at < len(data):
            self._budget.take()
            key, at = _varint(data, at, self.what)
            number, kind = key >> 3, key & 7
            if not 0 < number < 1 << 29:
                raise MalformedError(f"{self.what} has a field {number}")
            if kind == VARINT:
                value, at = _varint(data, at, self.what)
                yield number, kind, value
                continue
            if kind == BYTES:
                size, at = _varint(data, at, self.what)
            elif kind in (FIXED32, FIXED64):
                size = 4 if kind == FIXED32 else 8
            else:
                raise MalformedError(f"{self.what} has a part of unknown kind {kind}")
            if size > len(data) - at:
                raise MalformedError(f"{self.what} is cut off: a part has {size} bytes, {len(data) - at} are left")
            part = data[at : at + size]
            at += size
            yield number, kind, part if kind == BYTES else int.from_bytes(part, "little")


def _varint(data: memoryview, at: int, what: str) -> tuple[int, int]:
    """The number (unsigned, 64 bits) that starts at byte `at`, and the byte after it."""
    value = 0
    for index in range(10):
        if at + index >= len(data):
            raise MalformedError(f"{what} ends within a number")
        byte = data[at + index]
        value |= (byte & 0x7F) << (7 * index)
        if byte < 0x80:
            if value >= 1 << 64:
                break
            return value, at + index + 1
    raise MalformedError(f"{what} has a number longer than 64 bits")


def _text(data: memoryview, what: str) -> str:
    try:
        return bytes(data).decode("utf-8")
    except UnicodeDecodeError:
        raise MalformedError(f"{what} has a text that is not UTF-8") from None

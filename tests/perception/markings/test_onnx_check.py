"""Files that nobody vouches for: each is refused in one line, and never hangs or surprises the reader."""

from __future__ import annotations

import contextlib

import hypothesis.strategies as st
import numpy as np
import pytest
from hypothesis import given

from automodel.perception.markings import onnx_check
from automodel.perception.markings.onnx_check import MalformedError, Message, PartBudget, check_onnx
from tests.support import onnx_files as files

GOOD = files.model()
field, node, value = files.field, files.node, files.value


def with_nodes(*nodes: bytes) -> bytes:
    return files.model(files.graph(nodes))


def with_tensor(tensor: bytes) -> bytes:
    return files.model(files.graph(tensors=(*files.WEIGHTS, tensor)))


def with_attribute(more: bytes) -> bytes:
    return with_nodes(node("Cast", "image", "grey", to=1) + field(5, more), *files.NODES[1:])


OUTSIDE = field(2, 1) + field(8, "far") + field(13, field(1, "location") + field(2, "/etc/passwd")) + field(14, 1)
NAN = files.weights("w", np.array([1.0, np.nan], np.float32))

HOSTILE = {
    "nothing": (b"", "is not an ONNX file"),
    "text": (b"hello, this is a text\n", "the file"),
    "zeros": (bytes(100), "has a field 0"),
    "only a graph": (field(7, files.graph()), "is not an ONNX file"),
    "onnxruntime's own format": (GOOD[:4] + b"ORTM" + GOOD[8:], "own format"),
    "a part of 2 GB": (GOOD + b"\x32\xff\xff\xff\xff\x07", "is cut off: a part has 2147483647 bytes"),
    "a part of 2^63": (GOOD + b"\x32" + files.varint(1 << 63), "is cut off"),
    "a number of 80 bits": (GOOD + b"\x08" + b"\xff" * 11, "longer than 64 bits"),
    "a number of 70 bits": (GOOD + b"\x08" + b"\xff" * 9 + b"\x7f", "longer than 64 bits"),
    "a number cut off": (GOOD + b"\x08\xff", "ends within a number"),
    "a group": (GOOD + b"\x33", "unknown kind 3"),
    "two graphs": (GOOD + field(7, files.graph()), "expected the graph once, got 2"),
    "a graph that is a number": (field(1, 8) + field(7, 5) + field(8, field(2, 17)), "has another type"),
    "training information": (GOOD + field(20, b""), "has a field 20"),
    "functions": (GOOD + field(25, field(1, "f")), "has a field 25"),
    "an own domain": (with_nodes(*files.NODES, node("Evil", "grey", "x", domain="com.evil")), "'Evil' of 'com.evil'"),
    "a set of an own domain": (files.model(domain="com.microsoft"), "operators of 'com.microsoft'"),
    "an old operator set": (files.model(opset=7), "operator set 7; supported are 11 to 23"),
    "a future operator set": (files.model(opset=99), "operator set 99"),
    "an unknown operator": (with_nodes(*files.NODES, node("Evil", "grey", "x")), "operator 'Evil'"),
    "If": (with_nodes(*files.NODES, node("If", "grey", "x")), "operator 'If'"),
    "Loop": (with_nodes(*files.NODES, node("Loop", "grey", "x")), "operator 'Loop'"),
    "Scan": (with_nodes(*files.NODES, node("Scan", "grey", "x")), "operator 'Scan'"),
    "a graph in an attribute": (with_attribute(field(1, "body") + field(6, files.graph())), "field 6"),
    "graphs in an attribute": (with_attribute(field(1, "body") + field(11, files.graph())), "field 11"),
    "two operators of one node": (
        with_nodes(files.NODES[0] + field(4, "If"), *files.NODES[1:]),
        "one string in field 4, got 2",
    ),
    "an operator in Latin-1": (with_nodes(field(4, b"\xe9")), "not UTF-8"),
    "a weight in another file": (with_tensor(OUTSIDE), "keeps 'far' in another file"),
    "a constant in another file": (
        with_attribute(field(1, "value") + field(5, OUTSIDE)),
        "keeps 'far' in another file",
    ),
    "constants in another file": (with_attribute(field(1, "v") + field(10, OUTSIDE)), "keeps 'far' in another file"),
    "a sparse weight": (files.model(files.graph(more=field(15, b""))), "has a field 15"),
    "a weight of texts": (with_tensor(field(2, 8) + field(6, "text")), "has a field 6"),
    "a weight that is NaN": (with_tensor(NAN), "weights in 'w' that are not finite"),
    "a constant that is NaN": (with_attribute(field(1, "value") + field(5, NAN)), "weights in 'w'"),
    "weights that are infinite": (with_tensor(field(2, 1) + field(4, np.float32(np.inf).tobytes())), "not finite"),
    "half a weight": (with_tensor(field(2, 1) + field(9, b"\0\0")), "not finite"),
    "no input": (files.model(files.graph(inputs=())), "expected one input, 'image', got none"),
    "another input": (files.model(files.graph(inputs=(value("x"),))), "expected one input, 'image', got 'x'"),
    "two inputs": (files.model(files.graph(inputs=(value("image"), value("more")))), "got 'image', 'more'"),
    "another output": (files.model(files.graph(outputs=(value("y"),))), "expected one output, 'marking', got 'y'"),
    "a float input": (
        files.model(files.graph(inputs=(value("image", 1),))),
        "'image' as uint8 (1, 1, 128, 256), got float32 (1, 1, 128, 256)",
    ),
    "a float output": (files.model(files.graph(outputs=(value("marking", 1),))), "got float32"),
    "another size": (
        files.model(files.graph(inputs=(value("image", shape=(1, 1, 64, 64)),))),
        "as uint8 (1, 1, 128, 256), got uint8 (1, 1, 64, 64)",
    ),
    "an open size": (
        files.model(files.graph(inputs=(value("image", shape=("n", 1, 128, 256)),))),
        "uint8 ('n', 1, 128",
    ),
    "an open width": (
        files.model(files.graph(inputs=(value("image", shape=(1, 1, 128, "rows")),))),
        "as uint8 (1, 1, 'rows', 256), got uint8 (1, 1, 128, 'rows')",
    ),
    "an open height of the input alone": (
        files.model(files.graph(inputs=(value("image", shape=files.OPEN),))),
        "expected output 'marking' as uint8 (1, 1, 'rows', 256), got uint8 (1, 1, 128, 256)",
    ),
    "no shape": (files.model(files.graph(inputs=(field(1, "image") + field(2, field(1, field(1, 2))),))), "the shape"),
    "a sequence": (files.model(files.graph(inputs=(field(1, "image") + field(2, field(4, b"")),))), "a tensor type"),
}


def test_a_good_file_passes() -> None:
    assert not check_onnx(GOOD, files.WIDTH, files.HEIGHT)


def test_a_height_may_be_open() -> None:
    assert check_onnx(files.open_model(), files.WIDTH, files.HEIGHT)


@pytest.mark.parametrize("name", HOSTILE)
def test_a_hostile_file_is_refused(name: str) -> None:
    data, said = HOSTILE[name]
    with pytest.raises(MalformedError) as error:
        check_onnx(data, files.WIDTH, files.HEIGHT)
    assert said in str(error.value)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("share", [0.01, 0.2, 0.5, 0.9, 0.999])
def test_a_truncated_file_is_refused(share: float) -> None:
    with pytest.raises(MalformedError):
        check_onnx(GOOD[: int(share * len(GOOD))], files.WIDTH, files.HEIGHT)


def test_a_file_of_very_many_parts_is_given_up(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(onnx_check, "MAX_PARTS", 1000)
    with pytest.raises(MalformedError, match="more than 1000 parts"):
        Message(memoryview(b"\x08\x00" * 1001), "the file", PartBudget(1000))
    Message(memoryview(b"\x08\x00" * 1000), "the file", PartBudget(1000))


def test_the_parts_of_all_levels_are_counted_together() -> None:
    nodes = b"".join(field(1, b"\x08\x01" * 10) for _ in range(10))
    with pytest.raises(MalformedError, match="parts"):
        Message(memoryview(nodes), "a graph", PartBudget(100)).messages(1, "a node")


@pytest.mark.parametrize("number", [0, 1, 127, 128, 300, (1 << 64) - 1])
def test_numbers_are_read_back(number: int) -> None:
    message = Message(memoryview(field(3, number) + field(536870911, b"abc")), "a message", PartBudget())
    assert message.number(3) == number
    assert message.fields == {3, 536870911}
    assert bytes(message.blob(536870911, "bytes")) == b"abc"


def test_fixed_numbers_are_little_endian() -> None:
    message = Message(
        memoryview(b"\x0d\x01\x02\x00\x00\x11\x03\x00\x00\x00\x00\x00\x00\x00"), "a message", PartBudget()
    )
    assert message.fields == {1, 2}
    with pytest.raises(MalformedError, match="another type"):
        message.number(1)


@given(st.binary(max_size=400))
def test_any_bytes_are_read_or_refused(data: bytes) -> None:
    with pytest.raises(MalformedError):  # nothing so short is a network
        check_onnx(data, files.WIDTH, files.HEIGHT)


@given(st.data())
def test_a_damaged_file_is_read_or_refused(data: st.DataObject) -> None:
    damaged = bytearray(GOOD)
    for _ in range(data.draw(st.integers(1, 4))):
        damaged[data.draw(st.integers(0, len(damaged) - 1))] = data.draw(st.integers(0, 255))
    cut = data.draw(st.integers(0, len(damaged)))
    with contextlib.suppress(MalformedError):  # and nothing else is ever raised
        check_onnx(bytes(damaged[:cut]), files.WIDTH, files.HEIGHT)

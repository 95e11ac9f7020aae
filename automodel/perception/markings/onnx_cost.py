"""What one image costs a network, in memory and in multiplications, by the shapes that onnxruntime infers.

A file of 300 bytes can ask for gigabytes: nothing of it is run here. The bytes must have passed `check_onnx`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any

from automodel.perception.markings.onnx_check import BYTES, Message, PartBudget

# Of one image. The networks that `automodel train` makes at 512x256 take 100 MB and 0.3e9 multiplications.
MAX_MB = 1000  # of all layers' outputs together, of which a runtime keeps a part at a time; a Nano has 4 GB for all
MAX_WORK = 20e9  # multiplications: 0.1 s of the old Nano's GPU at its best (472 GFLOP/s, in half precision)

_GRAPH, _NODE, _WEIGHT, _OUTPUT = 7, 1, 5, 12  # field numbers of onnx.proto
_LONG = ("tensor(double)", "tensor(int64)", "tensor(uint64)")  # 8 bytes an element; others have 4 or less

Shape = tuple[int, ...]


def check_cost(data: bytes, outputs_of: Callable[[bytes], Any]) -> None:
    """Raise ValueError, with one line that says what is wrong, where an image costs more than `MAX_MB` or `MAX_WORK`.

    `outputs_of` gives a session's outputs (with a name, a shape and a type) for the bytes of a network, not optimised.
    A network whose shapes depend on the image is refused.
    """
    graph = Message(memoryview(data), "the file", PartBudget()).message(_GRAPH, "the graph")
    nodes = graph.messages(_NODE, "a node")
    told = {value.text(1) for value in graph.messages(_OUTPUT, "an output")}
    values = {name for node in nodes for name in node.texts(2) if name} - told
    more = b"".join(_field(_OUTPUT, _field(1, name.encode())) for name in sorted(values))
    shapes: dict[str, Shape] = {}
    memory = 0
    for output in outputs_of(data + _field(_GRAPH, more)):  # protobuf joins the parts of a message given twice
        if not isinstance(output.shape, list) or not all(isinstance(size, int) and size >= 0 for size in output.shape):
            raise ValueError(f"{output.name!r} has no size that is known before it runs; export it for one size")
        shapes[output.name] = tuple(output.shape)
        memory += math.prod(output.shape) * (8 if output.type in _LONG else 4)
    if memory > MAX_MB * 1e6:
        raise ValueError(f"takes {memory / 1e6:.0f} MB for one image; {MAX_MB} MB are allowed")
    for tensor in graph.messages(_WEIGHT, "a weight"):
        shapes[tensor.text(8)] = tuple(tensor.numbers(1))
    work = sum(_work(node, shapes) for node in nodes)
    if work > MAX_WORK:
        raise ValueError(f"takes {work / 1e9:.0f}e9 multiplications for one image; {MAX_WORK / 1e9:.0f}e9 are allowed")


def _work(node: Message, shapes: Mapping[str, Shape]) -> int:
    """The multiplications, or other steps, that an operator takes."""
    operator = node.text(4)
    inputs = [shapes.get(name, ()) for name in node.texts(1)]
    out = max((math.prod(shapes.get(name, ())) for name in node.texts(2)), default=0)
    largest = max((math.prod(shape) for shape in inputs), default=0)
    if operator in ("Conv", "QLinearConv"):
        kernel = inputs[1 if operator == "Conv" else 3]
        return out * math.prod(kernel[1:])
    if operator == "ConvTranspose":
        return math.prod(inputs[0]) * math.prod(inputs[1][1:])
    if operator in ("MatMul", "Gemm"):
        return out * max(inputs[0], default=1)
    if operator in ("AveragePool", "MaxPool"):
        kernels = (each for each in node.messages(5, "an attribute") if each.text(1) == "kernel_shape")
        return out * math.prod(size for each in kernels for size in each.numbers(8))
    return max(out, largest)


def _varint(value: int) -> bytes:
    out = bytearray()
    while value > 0x7F:
        out.append(value & 0x7F | 0x80)
        value >>= 7
    return bytes((*out, value))


def _field(number: int, data: bytes) -> bytes:
    return _varint(number << 3 | BYTES) + _varint(len(data)) + data

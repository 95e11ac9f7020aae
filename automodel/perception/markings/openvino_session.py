"""The marking network on OpenVINO, which knows the vector instructions of Intel's CPUs; called as onnxruntime is."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from automodel.config.extras import need_extra
from automodel.types import Image


class OpenvinoSession:
    """Runs the bytes of an ONNX network in single precision, on so many threads.

    `rows` is the height of the images, for a network whose height is open; 0: it may change. Raises RuntimeError where
    OpenVINO cannot run it, and ConfigError where it is not installed.
    """

    def __init__(self, data: bytes, threads: int, rows: int) -> None:
        need_extra("provider openvino", "openvino")
        import openvino

        core = openvino.Core()
        model = core.read_model(data)
        if rows:
            shape = model.input(0).get_partial_shape()
            shape[2] = rows
            model.reshape(shape)
        options = {
            "INFERENCE_NUM_THREADS": threads,
            "NUM_STREAMS": 1,
            "INFERENCE_PRECISION_HINT": "f32",  # its own choice may be half precision, and other masks
            "ENABLE_CPU_PINNING": False,  # a thread that may not leave a core waits for whatever runs there
        }
        self._request: Any = core.compile_model(model, "CPU", options).create_infer_request()

    def run(self, outputs: Sequence[str], images: dict[str, Image]) -> list[Any]:
        """The named outputs for the named inputs; raises RuntimeError where it fails."""
        found = self._request.infer(images, share_inputs=True)
        return [found[name] for name in outputs]

"""A trained network as one ONNX file that `automodel.perception.markings.unet` takes.

Needs torch and onnx (the extra `train`).
"""

from __future__ import annotations

import copy
import io
import os
import warnings
from collections.abc import Mapping
from pathlib import Path

import torch
from torch import Tensor, nn

from automodel.perception.markings.onnx_check import INPUT, OPSET, OUTPUT
from automodel.training.unet import MarkingNet


class ProbabilityNet(nn.Module):
    """What is exported: grey values (1, 1, h, w) uint8 in, probability of marking times 255 as uint8 out."""

    def __init__(self, net: MarkingNet) -> None:
        super().__init__()
        self.net = net

    def forward(self, image: Tensor) -> Tensor:
        """The mask (1, 1, h, w)."""
        return (torch.sigmoid(self.net(image)) * 255.0 + 0.5).to(torch.uint8)


def onnx_bytes(net: MarkingNet, width_px: int, height_px: int, metadata: Mapping[str, object]) -> bytes:
    """The network as ONNX: fixed shapes, batch normalisation folded into the weights, `metadata` inside."""
    import onnx

    whole = ProbabilityNet(copy.deepcopy(net).to("cpu").eval())
    buffer = io.BytesIO()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # this exporter is the older of two; the newer one folds less
        torch.onnx.export(
            whole,
            (torch.zeros((1, 1, height_px, width_px), dtype=torch.uint8),),
            buffer,
            dynamo=False,
            opset_version=OPSET,
            input_names=[INPUT],
            output_names=[OUTPUT],
        )
    model = onnx.load_from_string(buffer.getvalue())
    onnx.checker.check_model(model, full_check=True)
    return with_metadata(model.SerializeToString(), metadata)


def with_metadata(data: bytes, metadata: Mapping[str, object]) -> bytes:
    """The same network with other metadata inside."""
    import onnx

    model = onnx.load_from_string(data)
    onnx.helper.set_model_props(model, {key: str(value) for key, value in metadata.items()})
    return model.SerializeToString()


def write_whole(path: Path, data: bytes) -> None:
    """Write a file so that it is there whole or, after a crash, as it was before."""
    part = path.with_name(path.name + ".part")
    part.write_bytes(data)
    os.replace(part, path)

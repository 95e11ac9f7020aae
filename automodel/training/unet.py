"""The marking network: a U-Net of two levels on an image packed to half size (after Cudrano et al. 2020).

The paper reduces U-Net to two poolings for a small computer. Three changes improve the accuracy at the same run time: a
strided first layer and a pixel-shuffle last layer run the whole U-Net at half the image size; the levels are depth-wise
separable residual blocks; dilated blocks at the bottom have a receptive field of some 400 pixels, enough to tell a lane
marking from the edge of a table. Needs torch (the extra `train`).

A trained network as one ONNX file that `automodel.perception.markings.unet` takes.

Needs torch and onnx (the extra `train`).
"""

from __future__ import annotations

import copy
import io
import warnings
from collections.abc import Mapping

import torch
from torch import Tensor, nn
from torch.nn import functional

from automodel.perception.markings.onnx_check import DIGEST, INPUT, OPSET, OUTPUT, ROWS, graph_digest

CHANNELS = (16, 48, 96)  # at 1/2, 1/4 and 1/8 of the image size; multiples of 16 fill the vector registers
DILATIONS = (1, 2, 4, 8, 4, 2)  # of the blocks at the bottom
DARKEST_STD = 0.03  # of grey values in 0..1: flatter images are not stretched further


def _layer(inside: int, out: int, kernel: int, **options: int) -> list[nn.Module]:
    return [nn.Conv2d(inside, out, kernel, bias=False, **options), nn.BatchNorm2d(out)]


class FullPrecision(nn.Conv2d):
    """A convolution in 32 bits under autocast on a CPU.

    For dilated depth-wise kernels: on a CPU, torch's bfloat16 gradient of them is sometimes wrong by any amount (oneDNN
    reads uninitialised memory; seen with torch 2.13) and takes twice as long.
    """

    def forward(self, x: Tensor) -> Tensor:
        """The convolution of x, in 32 bits on a CPU."""
        if x.device.type != "cpu":
            return super().forward(x)
        with torch.autocast(x.device.type, enabled=False):
            return super().forward(x if x.dtype == torch.float32 else x.float())


class Block(nn.Module):
    """A residual block: 3x3 depth-wise, then 1x1; keeps the shape (n, channels, h, w)."""

    def __init__(self, channels: int, dilation: int = 1) -> None:
        super().__init__()
        kind = nn.Conv2d if dilation == 1 else FullPrecision
        self.layers = nn.Sequential(
            kind(channels, channels, 3, padding=dilation, dilation=dilation, groups=channels, bias=False),
            nn.BatchNorm2d(channels),
            nn.ReLU(),
            *_layer(channels, channels, 1),
        )

    def forward(self, x: Tensor) -> Tensor:
        """The block's features (n, channels, h, w)."""
        return functional.relu(x + self.layers(x))


class Down(nn.Sequential):
    """A level down: 2x2 maximum pooling, which keeps thin bright lines, then 1x1 to more channels."""

    def __init__(self, inside: int, out: int) -> None:
        super().__init__(nn.MaxPool2d(2), *_layer(inside, out, 1), nn.ReLU())


class Up(nn.Module):
    """A level up: 1x1 to fewer channels, upsampling by 2, plus the encoder's features of that level."""

    def __init__(self, inside: int, out: int) -> None:
        super().__init__()
        self.narrow = nn.Sequential(*_layer(inside, out, 1))
        self.block = Block(out)

    def forward(self, deep: Tensor, skip: Tensor) -> Tensor:
        """(n, inside, h, w) and (n, out, 2h, 2w) -> (n, out, 2h, 2w)."""
        doubled = functional.interpolate(self.narrow(deep), scale_factor=2.0, mode="nearest")
        return self.block(functional.relu(doubled + skip))


class MarkingNet(nn.Module):
    """Grey images (n, 1, h, w) to logits of "lane marking" (same shape); h and w are multiples of 8.

    Image values are 0..255, uint8 or floating point. Each image is normalised to mean 0 and standard deviation 1, to
    reduce the effect of exposure.
    """

    def __init__(self, channels: tuple[int, int, int] = CHANNELS, dilations: tuple[int, ...] = DILATIONS) -> None:
        super().__init__()
        fine, middle, coarse = channels
        self.stem = nn.Sequential(*_layer(1, fine, 6, stride=2, padding=2), nn.ReLU(), Block(fine))
        self.down1 = nn.Sequential(Down(fine, middle), Block(middle), Block(middle))
        self.down2 = nn.Sequential(Down(middle, coarse), *(Block(coarse, dilation) for dilation in dilations))
        self.up1 = Up(coarse, middle)
        self.up2 = Up(middle, fine)
        self.head = nn.Sequential(*_layer(fine, fine, 3, padding=1, groups=fine), nn.ReLU(), nn.Conv2d(fine, 4, 1))
        last = self.head[-1]
        assert isinstance(last, nn.Conv2d)
        assert last.bias is not None
        nn.init.constant_(last.bias, -3.5)  # some 3 % of all pixels are marking

    def forward(self, image: Tensor) -> Tensor:
        """The logits."""
        half = self.stem(standardised(image))
        quarter = self.down1(half)
        eighth = self.down2(quarter)
        up = self.up2(self.up1(eighth, quarter), half)
        return functional.pixel_shuffle(self.head(up), 2)


def standardised(image: Tensor) -> Tensor:
    """Images (n, 1, h, w) of grey values 0..255, each normalised to mean 0 and deviation 1 (less if it is flat)."""
    grey = image.float() * (1.0 / 255.0)
    centred = grey - grey.mean((2, 3), keepdim=True)
    variance = (centred * centred).mean((2, 3), keepdim=True)
    return centred / torch.sqrt(variance + DARKEST_STD**2)


class ProbabilityNet(nn.Module):
    """The exported network: grey image (1, 1, h, w) uint8 to probability of marking times 255, uint8."""

    def __init__(self, net: MarkingNet) -> None:
        super().__init__()
        self.net = net

    def forward(self, image: Tensor) -> Tensor:
        """The mask (1, 1, h, w)."""
        return (torch.sigmoid(self.net(image)) * 255.0 + 0.5).to(torch.uint8)


def onnx_bytes(net: MarkingNet, width_px: int, height_px: int, metadata: Mapping[str, object]) -> bytes:
    """The network as ONNX: batch normalisation folded into the weights, the height open, `metadata` inside."""
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
    for value in (*model.graph.input, *model.graph.output):  # no layer knows the height
        value.type.tensor_type.shape.dim[2].dim_param = ROWS
    onnx.checker.check_model(model, full_check=True)
    return with_metadata(model.SerializeToString(), metadata)


def with_metadata(data: bytes, metadata: Mapping[str, object]) -> bytes:
    """The same network with other metadata, and with the digest by which the car knows that it is undamaged."""
    import onnx

    model = onnx.load_from_string(data)
    whole = {**metadata, DIGEST: graph_digest(model.SerializeToString())}
    onnx.helper.set_model_props(model, {key: str(value) for key, value in whole.items()})
    return model.SerializeToString()

# ruff: noqa: E402 - torch is not installed everywhere
"""The layers of the marking network."""

from __future__ import annotations

import math

import pytest

torch = pytest.importorskip("torch")

from automodel.training.unet import DILATIONS, Block, FullPrecision, MarkingNet


@pytest.mark.parametrize("size", [(256, 512), (128, 256), (64, 96)])
def test_the_mask_has_the_images_size(size: tuple[int, int]) -> None:
    with torch.no_grad():
        assert MarkingNet().eval()(torch.zeros((2, 1, *size), dtype=torch.uint8)).shape == (2, 1, *size)


def test_the_network_is_small() -> None:
    assert 50_000 < sum(weights.numel() for weights in MarkingNet().parameters()) < 150_000


def test_each_pixel_is_judged_by_its_surroundings() -> None:
    torch.manual_seed(0)
    net = MarkingNet().eval()
    features = torch.randn((1, 96, 48, 64)).requires_grad_()  # at an eighth of the image's size
    net.down2[1:](features)[0, :, 24, 32].sum().backward()
    seen = features.grad.abs().sum((0, 1))
    assert int((seen.sum(0) > 0).sum()) == 2 * sum(DILATIONS) + 1
    assert 8 * sum(DILATIONS) > 150  # pixels to each side, before what the levels above see


@pytest.mark.parametrize("dilation", sorted(set(DILATIONS)))
def test_gradients_in_16_bits_are_those_in_32(dilation: int) -> None:
    torch.manual_seed(dilation)
    block = Block(32, dilation).to(memory_format=torch.channels_last)
    x = torch.randn((4, 32, 32, 64)).to(memory_format=torch.channels_last)
    kernel = block.layers[0].weight

    def gradient(sixteen: bool):
        block.zero_grad()
        with torch.autocast("cpu", dtype=torch.bfloat16, enabled=sixteen):
            out = block(x)
        for value in (math.nan, 1e4):  # memory that is used again holds anything
            spoilt = [torch.full((1 << power,), value) for power in range(8, 21)]
            del spoilt
        out.float().square().mean().backward()
        return kernel.grad.clone()

    true = gradient(False)
    for _ in range(6):
        assert float((gradient(True) - true).abs().max()) < 0.05 * float(true.abs().max())


def test_dilated_kernels_work_in_32_bits_within_16() -> None:
    layer = FullPrecision(8, 8, 3, padding=2, dilation=2, groups=8)
    x = torch.randn((1, 8, 16, 16))
    plain = layer(x)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        assert torch.equal(layer(x), plain)
        assert layer(x.bfloat16()).dtype == torch.float32

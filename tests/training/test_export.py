# ruff: noqa: E402 - torch is not installed everywhere
"""A network's ONNX file does what the network does, and is one that the car loads."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

torch = pytest.importorskip("torch")
onnx = pytest.importorskip("onnx")

from automodel.perception.markings.onnx_check import DIGEST, OPSET, check_onnx, graph_digest
from automodel.perception.markings.unet import SIZES, open_session, run_network
from automodel.training.metrics import Metrics
from automodel.training.session import Origin, write_card, write_metrics
from automodel.training.unet import MarkingNet, onnx_bytes, standardised, with_metadata


@pytest.fixture(scope="module")
def net() -> MarkingNet:
    """A network with random weights, and with statistics that folding must not lose."""
    torch.manual_seed(4)
    net = MarkingNet()
    for module in net.modules():
        if isinstance(module, torch.nn.BatchNorm2d):
            module.running_mean.normal_(0.0, 0.3)
            module.running_var.uniform_(0.5, 2.0)
            with torch.no_grad():
                module.weight.uniform_(0.5, 1.5)
                module.bias.normal_(0.0, 0.3)
    with torch.no_grad():  # masks that use the whole range
        net.head[-1].weight.mul_(12.0)
        net.head[-1].bias.zero_()
    return net.eval()


@pytest.fixture(scope="module", params=SIZES.values(), ids=list(SIZES))
def exported(net: MarkingNet, request: pytest.FixtureRequest) -> tuple[bytes, int, int]:
    width, height = request.param
    return onnx_bytes(net, width, height, {"seed": 7}), width, height


def test_the_file_gives_what_the_network_gives(net: MarkingNet, exported: tuple[bytes, int, int]) -> None:
    data, width, height = exported
    session = open_session(data, "cpu", 1)
    rng = np.random.default_rng(0)
    for picture in (rng.integers(0, 256, (height, width)), np.tile(np.arange(width) // 2, (height, 1))):
        grey = picture.astype(np.uint8)
        with torch.no_grad():
            wanted = torch.sigmoid(net(torch.from_numpy(grey)[None, None]))[0, 0].numpy()
        found = run_network(session, grey)
        assert np.abs(found / 255.0 - wanted).max() < 0.6 / 255.0 + 1e-3
        assert np.ptp(found.astype(int)) > 60  # and it is no constant


def test_the_file_is_one_that_the_car_loads(exported: tuple[bytes, int, int]) -> None:
    data, width, height = exported
    check_onnx(data, width, height)
    assert len(data) < 2_000_000
    with pytest.raises(ValueError, match="expected input"):
        check_onnx(data, 2 * width, height)


def test_the_file_is_one_plain_graph(exported: tuple[bytes, int, int]) -> None:
    model = onnx.load_from_string(exported[0])
    assert [(each.domain, each.version) for each in model.opset_import] == [("", OPSET)]
    kinds = {node.op_type for node in model.graph.node}
    assert "Conv" in kinds
    assert "BatchNormalization" not in kinds
    assert {each.key: each.value for each in model.metadata_props} == {"seed": "7", DIGEST: graph_digest(exported[0])}


def test_other_metadata_leaves_the_network_as_it_is(exported: tuple[bytes, int, int]) -> None:
    again = onnx.load_from_string(with_metadata(exported[0], {"steps": 3}))
    before = onnx.load_from_string(exported[0])
    assert again.graph == before.graph
    assert {each.key: each.value for each in again.metadata_props} == {"steps": "3", DIGEST: graph_digest(exported[0])}


def test_a_network_with_one_flipped_bit_is_refused(exported: tuple[bytes, int, int]) -> None:
    data, width, height = exported
    weight = max(onnx.load_from_string(data).graph.initializer, key=lambda each: len(each.raw_data)).raw_data
    flipped = bytearray(data)
    flipped[data.index(weight) + 1] ^= 1  # of a mantissa: no mask would tell
    with pytest.raises(ValueError, match="is damaged, or a tool has changed it: its layers have another SHA-256"):
        check_onnx(bytes(flipped), width, height)


def test_exporting_leaves_the_network_as_it_was() -> None:
    net = MarkingNet().train()
    before = {name: weights.clone() for name, weights in net.state_dict().items()}
    onnx_bytes(net, 256, 128, {})
    assert net.training
    assert all(torch.equal(before[name], weights) for name, weights in net.state_dict().items())


def test_images_are_brought_to_mean_0_and_deviation_1() -> None:
    picture = torch.from_numpy(np.random.default_rng(1).integers(0, 256, (2, 1, 16, 24)).astype(np.uint8))
    picture[1] = 100  # flat
    found = standardised(picture)
    assert float(found[0].mean()) == pytest.approx(0.0, abs=1e-5)
    assert float(found[0].std()) == pytest.approx(1.0, abs=0.02)
    assert float(found[1].abs().max()) < 1e-4
    darker = standardised((picture * 0.5).float() + 20.0)
    assert torch.allclose(found[0], darker[0], atol=0.03)


def test_the_card_tells_of_all_networks_in_a_folder(tmp_path: Path) -> None:
    metrics = Metrics(precision=0.5, recall=0.25, iou=0.2, near_precision=0.75, near_recall=0.5)
    for size in SIZES:
        origin = Origin(
            size=size,
            seed=3,
            steps=1234,
            batch=8,
            samples=12000,
            validation=256,
            data_version="0123456789ab",
            parameters=84516,
            rate=0.003,
            resumed=False,
            device="CPU",
            command=f"automodel train --size {size}",
        )
        write_metrics(tmp_path / f"marking_{size}.json", origin, metrics)
    write_card(tmp_path)
    card = (tmp_path / "MODEL_CARD.md").read_text(encoding="utf-8")
    for said in ("## marking_512x256.onnx", "## marking_256x128.onnx", "`automodel train --size 256x128`"):
        assert said in card
    for row in ("| steps | 1234 |", "| data version | 0123456789ab |", "| near precision | 0.750 |"):
        assert card.count(row) == len(SIZES)
    assert metrics.score == pytest.approx(0.6)

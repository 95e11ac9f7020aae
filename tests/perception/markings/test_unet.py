"""The marking network as the car loads and runs it."""

from __future__ import annotations

import importlib.resources
import importlib.util
import os
import subprocess
import sys
import types
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import onnxruntime
import pytest

from automodel.config import CenterlineConfig
from automodel.config.toml_reader import ConfigError
from automodel.perception.markings import onnx_check, onnx_cost, unet
from automodel.perception.markings.openvino_session import OpenvinoSession
from automodel.perception.markings.unet import (
    BIRDSEYE,
    SIZES,
    MarkingNetwork,
    UnetConfig,
    drawn_lines,
    drawn_view,
    self_test,
)
from tests.support import onnx_files as files

SMALL = (files.HEIGHT, files.WIDTH)


@pytest.fixture
def path(tmp_path: Path) -> Path:
    """A network of a few lines, which marks what is brighter than its surroundings."""
    path = tmp_path / "ridge.onnx"
    path.write_bytes(files.model())
    return path


def config(path: Path | str, **keys: Any) -> UnetConfig:
    return UnetConfig(model=str(path), size="256x128", threads=1, **keys)


def refusal(path: Path, data: bytes | None = None, **keys: Any) -> str:
    if data is not None:
        path.write_bytes(data)
    with pytest.raises(ConfigError) as error:
        MarkingNetwork(config(path, **keys))
    said = str(error.value)
    assert said.startswith(f"{path}: ")
    assert "\n" not in said
    return said.removeprefix(f"{path}: ")


def with_nodes(*nodes: bytes) -> bytes:
    return files.model(files.graph(nodes))


def test_the_mask_is_where_the_line_is(path: Path) -> None:
    network = MarkingNetwork(config(path))
    grey = np.full(SMALL, 80, np.uint8)
    grey[:, 100:104] = 230
    mask = network.step(grey)
    assert mask.dtype == np.uint8
    assert mask.shape == SMALL
    assert (mask[:, 100:104] == 255).all()
    assert not mask[:, :100].any()
    assert not mask[:, 104:].any()
    assert network.faults == 0


@pytest.mark.parametrize(("markings", "light", "dark"), [("light", 1, 0), ("dark", 0, 1), ("both", 1, 1)])
def test_dark_markings_are_light_ones_of_the_negative(path: Path, markings: str, light: int, dark: int) -> None:
    grey = np.full(SMALL, 120, np.uint8)
    grey[:, 60:64], grey[:, 180:184] = 250, 10
    mask = MarkingNetwork(config(path), markings).step(grey)
    assert [bool((mask[:, at : at + 4] >= 128).all()) for at in (60, 180)] == [bool(light), bool(dark)]
    assert not (mask[:, 100:140] >= 128).any()


@pytest.mark.parametrize("factor", [0.5, 1.0, 2.5, 5.0])
def test_pictures_of_any_size_are_stretched_to_the_networks(path: Path, factor: float) -> None:
    h, w = round(96 * factor), round(320 * factor)
    grey = np.full((h, w), 80, np.uint8)
    grey[:, round(0.4 * w) : round(0.43 * w)] = 230
    mask = MarkingNetwork(config(path)).step(grey)
    assert mask.shape == SMALL
    assert np.median(np.flatnonzero(mask[64])) == pytest.approx(0.415 * files.WIDTH - 0.5, abs=1.0)


def test_only_rows_that_show_the_road_are_looked_at(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path.write_bytes(files.open_model())
    seen: list[tuple[int, ...]] = []
    real = unet.run_network

    def run_network(session: Any, grey: Any) -> Any:
        seen.append(grey.shape)
        return real(session, grey)

    monkeypatch.setattr(unet, "run_network", run_network)
    grey = np.full(SMALL, 80, np.uint8)
    grey[:, 100:104] = 230
    for above, first_row in ((0.0, 0), (0.05, 0), (0.4, 48), (0.999, 120)):
        network = MarkingNetwork(config(path, above=above))
        seen.clear()
        mask = network.step(grey)
        assert seen == [(files.HEIGHT - first_row, files.WIDTH)]
        assert mask.shape == SMALL
        assert not mask[:first_row].any()
        assert (mask[first_row:, 100:104] == 255).all()
        assert not mask[first_row:, :100].any()
        assert network.step(grey) is not mask  # a caller may keep it


def test_a_network_of_a_fixed_height_sees_all_rows(path: Path) -> None:
    grey = np.full(SMALL, 80, np.uint8)
    grey[:, 100:104] = 230
    mask = MarkingNetwork(config(path, above=0.4)).step(grey)
    assert (mask[:, 100:104] == 255).all()


@pytest.mark.parametrize("scale", [1.5, 2.0, 2.5, 4.0])
def test_no_thin_line_is_left_out_by_resizing(path: Path, scale: float) -> None:
    """A line two pixels wide of a large image keeps its contrast, wherever it lies."""
    height, width = round(files.HEIGHT * scale), round(files.WIDTH * scale)
    network = MarkingNetwork(config(path))
    for column in range(width // 2, width // 2 + 6):
        grey = np.full((height, width), 60, np.uint8)
        grey[:, column : column + 2] = 255
        least = 195.0 * min(1.0, 0.9 / scale)  # its share of a pixel of the network's
        assert int(network._resized(grey)[64].max()) - 60 >= least


@pytest.mark.parametrize(
    "picture",
    [np.zeros(SMALL, np.uint8), np.full(SMALL, 255, np.uint8), np.zeros((1, 1), np.uint8)],
    ids=["black", "white", "one pixel"],
)
def test_a_picture_of_nothing_gives_an_empty_mask(path: Path, picture: Any) -> None:
    network = MarkingNetwork(config(path))
    assert not network.step(picture).any()
    assert network.faults == 0


@pytest.mark.parametrize(
    "picture",
    [np.zeros((0, 5), np.uint8), np.full(SMALL, np.nan), np.zeros((4, 4, 3), np.uint8), np.zeros(9, np.uint8)],
    ids=["empty", "nan", "colour", "flat"],
)
def test_what_is_no_grey_picture_is_a_fault(path: Path, picture: Any) -> None:
    network = MarkingNetwork(config(path))
    mask = network.step(picture)
    assert mask.shape == SMALL
    assert not mask.any()
    assert network.faults == 1


def _raise(*_: object) -> None:
    raise onnxruntime.capi.onnxruntime_pybind11_state.RuntimeException("the device is gone")


@pytest.mark.parametrize(
    "run",
    [
        _raise,
        lambda *_: [np.full((1, 1, *SMALL), np.nan, np.float32)],
        lambda *_: [np.zeros((1, 1, 5, 5), np.uint8)],
        lambda *_: [np.zeros((), np.uint8)],
        lambda *_: [None],
    ],
    ids=["an error", "nan", "another shape", "a scalar", "nothing"],
)
def test_an_output_that_cannot_be_used_is_an_empty_mask_and_counted(
    path: Path, monkeypatch: pytest.MonkeyPatch, run: Any
) -> None:
    network = MarkingNetwork(config(path))
    monkeypatch.setattr(network, "_session", types.SimpleNamespace(run=run))
    for count in (1, 2):
        mask = network.step(np.full(SMALL, 90, np.uint8))
        assert mask.shape == SMALL
        assert mask.dtype == np.uint8
        assert not mask.any()
        assert network.faults == count


def test_files_that_cannot_be_read_are_refused(tmp_path: Path) -> None:
    assert refusal(tmp_path / "missing.onnx") == "no such file"
    assert refusal(tmp_path) == "cannot be read: Is a directory"
    assert refusal(tmp_path / "large.onnx", bytes(unet.MAX_BYTES + 1)).startswith("larger than 8 MB")
    assert refusal(tmp_path / "text.onnx", b"hello\n")


@pytest.mark.parametrize("seed", range(5))
def test_random_bytes_are_refused(tmp_path: Path, seed: int) -> None:
    assert refusal(tmp_path / "noise.onnx", np.random.default_rng(seed).bytes(20_000))


def test_a_hostile_file_never_reaches_onnxruntime(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(unet, "_runtime", lambda: pytest.fail("was given to onnxruntime"))
    assert "'Evil'" in refusal(path, with_nodes(*files.NODES, files.node("Evil", "grey", "x")))


def test_the_bytes_that_were_checked_are_those_that_are_loaded(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    checked = onnx_check.check_onnx

    def check_and_swap(data: bytes, *size: int) -> None:
        checked(data, *size)
        path.write_bytes(b"something else by now")

    monkeypatch.setattr(unet, "check_onnx", check_and_swap)
    assert MarkingNetwork(config(path)).provider == "cpu"


@pytest.mark.parametrize(
    "data",
    [
        with_nodes(files.node("Cast", "nowhere", "marking", to=2)),
        with_nodes(files.node("Cast", "image", "grey", to=1), files.node("Conv", "grey", "marking")),
        with_nodes(files.node("Identity", "image", "image")),
        with_nodes(files.node("Flatten", "image", "marking")),
        with_nodes(files.node("Cast", "image", "marking", to=1)),
        with_nodes(),
    ],
    ids=["no such value", "no kernel", "a loop", "another shape", "another type", "no layers"],
)
def test_a_graph_that_makes_no_sense_is_refused(path: Path, data: bytes) -> None:
    said = refusal(path, data, providers=("cpu",))
    assert said.startswith(("onnxruntime cannot read it: ", "runs on none of the configured providers: cpu: "))


def resized(sizes: str, source: str, result: str) -> bytes:
    """A node that makes a picture as large as the weight `sizes` says."""
    return b"".join(files.field(1, name) for name in (source, "", "", sizes)) + files.field(2, result) + RESIZE


RESIZE = files.field(4, "Resize")
HUGE = files.integers("huge", (1, 1, 40_000, 40_000))
USUAL = files.integers("usual", (1, 1, *SMALL))
GREY, MARKING = files.node("Cast", "image", "grey", to=files.FLOAT), files.node("Cast", "back", "marking", to=2)
LARGE = (GREY, resized("huge", "grey", "large"), resized("usual", "large", "back"), MARKING)
SLOW = [
    files.node("AveragePool", f"p{i}", f"p{i + 1}", kernel_shape=(127, 255), pads=(63, 127, 63, 127)) for i in range(20)
]
BY_IMAGE = (
    GREY,
    files.node("ReduceMax", "grey", "brightest", keepdims=0),
    files.node("Cast", "brightest", "size", to=files.INT64),
    files.node("Unsqueeze", "size zero", "some"),
    files.node("Concat", "ones some some", "sizes", axis=0),
    resized("sizes", "grey", "large"),
    resized("usual", "large", "back"),
    MARKING,
)
ZERO, ONES = files.integers("zero", (0,)), files.integers("ones", (1, 1))


@pytest.mark.parametrize(
    ("graph", "said"),
    [
        (files.graph(LARGE, (HUGE, USUAL)), "takes 6400 MB for one image; 1000 MB are allowed"),
        (
            files.graph(LARGE, (HUGE, USUAL), more=files.field(13, files.value("large", files.FLOAT))),
            "'large' has no size that is known before it runs",
        ),
        (files.graph(BY_IMAGE, (USUAL, ZERO, ONES)), "'large' has no size that is known before it runs"),
        (
            files.graph(
                (files.node("Cast", "image", "p0", to=files.FLOAT), *SLOW, files.node("Cast", "p20", "marking", to=2))
            ),
            "takes 21e9 multiplications for one image; 20e9 are allowed",
        ),
    ],
    ids=["memory", "a size that is a lie", "a size by the image", "work"],
)
def test_a_small_file_that_asks_for_much_is_refused_before_it_runs(
    path: Path, monkeypatch: pytest.MonkeyPatch, graph: bytes, said: str
) -> None:
    monkeypatch.setattr(unet, "open_session", lambda *_: pytest.fail("was to be run"))
    assert said in refusal(path, files.model(graph))


@pytest.mark.parametrize("size", SIZES)
def test_the_networks_that_ship_cost_far_less_than_is_allowed(size: str, monkeypatch: pytest.MonkeyPatch) -> None:
    _, data = unet.read_network(UnetConfig(size=size))
    monkeypatch.setattr(onnx_cost, "MAX_MB", 0.2 * onnx_cost.MAX_MB)
    monkeypatch.setattr(onnx_cost, "MAX_WORK", 0.02 * onnx_cost.MAX_WORK)
    onnx_cost.check_cost(data, lambda given: unet.inferred_outputs(given, SIZES[size][1]))
    monkeypatch.setattr(onnx_cost, "MAX_WORK", 0.002 * onnx_cost.MAX_WORK)
    with pytest.raises(ValueError, match="multiplications for one image"):
        onnx_cost.check_cost(data, lambda given: unet.inferred_outputs(given, SIZES[size][1]))


@pytest.mark.parametrize(
    ("nodes", "said"),
    [
        ((files.node("Identity", "image", "marking"),), "of all other pixels"),
        ((files.node("Sub", "image image", "marking"),), "marks 0% of two drawn lines"),
    ],
    ids=["the picture itself", "nothing"],
)
def test_a_network_that_does_not_find_two_lines_is_refused(path: Path, nodes: tuple[bytes, ...], said: str) -> None:
    assert said in refusal(path, with_nodes(*nodes), providers=("cpu",))


def test_the_self_test_refuses_marks_on_black() -> None:
    def network(grey: Any) -> Any:
        return drawn_lines(256, 128)[1] if grey.any() else np.full(SMALL, 255, np.uint8)

    with pytest.raises(ValueError, match="marks a black image"):
        self_test(network, *drawn_lines(256, 128))


def test_the_lane_of_the_drawn_view_is_as_wide_as_the_pipelines() -> None:
    width, height = SIZES[BIRDSEYE]
    view, lines = drawn_view(width, height)
    assert view.shape == lines.shape == (height, width)
    left, right = (int(np.flatnonzero(half[0]).mean()) for half in (lines[:, : width // 2], lines[:, width // 2 :]))
    lane_px = right + width // 2 - left
    assert lane_px == pytest.approx(width / (2.0 * CenterlineConfig().view_half_lanes), abs=2)
    assert (lines == lines[0]).all()
    assert view[lines > 0].mean() > view[lines == 0].mean() + 80


@pytest.mark.parametrize("size", [size for name, size in SIZES.items() if name != BIRDSEYE])
def test_the_drawn_lines_run_together_ahead(size: tuple[int, int]) -> None:
    picture, lines = drawn_lines(*size)
    assert picture.shape == lines.shape == size[::-1]
    gaps = []
    for row in range(int(0.5 * size[1]), size[1]):
        count, _, stats, _ = cv2.connectedComponentsWithStats(lines[row][None], connectivity=8)
        assert count == 3
        gaps.append(abs(int(stats[2, 0]) - int(stats[1, 0])))
    assert (np.diff(gaps) >= 0).all()
    assert gaps[-1] > 2 * gaps[0]
    assert picture[lines > 0].mean() > picture[lines == 0].mean() + 80


def test_providers_that_are_not_there_are_passed_over(path: Path) -> None:
    network = MarkingNetwork(config(path, providers=("cpu", "tensorrt")))
    if "TensorrtExecutionProvider" not in onnxruntime.get_available_providers():
        assert network.provider == "cpu"
        assert network.notice == f"{path} runs on cpu (tensorrt: not in this onnxruntime)"


def test_no_provider_at_all_is_an_error(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(onnxruntime, "get_available_providers", lambda: ["CPUExecutionProvider"])
    assert (
        refusal(path, providers=("cuda",)) == "runs on none of the configured providers: cuda: not in this onnxruntime"
    )


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("above", [0.0, 0.25])
def test_openvino_gives_the_masks_of_onnxruntime(size: str, above: float) -> None:
    pytest.importorskip("openvino")
    random = np.random.default_rng(7)
    ours, theirs = (
        MarkingNetwork(UnetConfig(size=size, providers=(provider,), threads=1, above=above))
        for provider in ("cpu", "openvino")
    )
    assert theirs.provider == "openvino"
    assert theirs.first_row == ours.first_row
    picture, lines = (drawn_view if size == BIRDSEYE else drawn_lines)(*SIZES[size])
    for image in (picture, picture[:, ::-1].copy(), random.integers(0, 256, picture.shape).astype(np.uint8)):
        expected, got = ours.step(image).astype(int), theirs.step(image).astype(int)
        assert np.abs(got - expected).max() <= 2  # of 255: the order of sums is another one
        assert np.count_nonzero((got >= 128) != (expected >= 128)) <= 0.001 * lines.size
    assert theirs.faults == 0


def test_openvino_that_is_not_installed_is_passed_over(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    find = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name, *rest: None if name == "openvino" else find(name))
    network = MarkingNetwork(config(path, providers=("openvino", "cpu")))
    assert network.provider == "cpu"
    assert network.notice.endswith("which is not installed: pip install 'automodel[openvino]')")
    with pytest.raises(ConfigError, match="provider openvino needs openvino"):
        OpenvinoSession(path.read_bytes(), 1, 0)


ALL = list(unet.PROVIDERS.values())


def test_a_provider_that_fails_gives_way_to_the_next(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    opened: list[str] = []

    def open_session(data: bytes, provider: str, *options: Any, **more: Any) -> Any:
        opened.append(provider)
        if provider == "tensorrt":
            raise RuntimeError("no engine\nfor this board")
        session = real(data, "cpu", *options, **more)
        if provider == "cuda":  # it starts, and gives wrong masks
            return types.SimpleNamespace(run=lambda *_: [np.zeros((1, 1, *SMALL), np.uint8)])
        return session

    real = unet.open_session
    monkeypatch.setattr(onnxruntime, "get_available_providers", lambda: ALL)
    monkeypatch.setattr(unet, "open_session", open_session)
    network = MarkingNetwork(config(path, providers=("cpu", "cuda", "tensorrt")))
    assert opened == ["tensorrt", "cuda", "cpu"]
    assert network.provider == "cpu"
    assert "tensorrt: no engine for this board; cuda: it fails the self-test: marks 0%" in network.notice


def test_a_provider_that_onnxruntime_drops_is_not_taken_for_it(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    given: list[Any] = []

    def session(data: bytes, options: Any, providers: Any, **_: Any) -> Any:
        given.append(providers)
        return real(data, options, ["CPUExecutionProvider"])

    real = onnxruntime.InferenceSession
    monkeypatch.setattr(onnxruntime, "get_available_providers", lambda: ALL)
    monkeypatch.setattr(onnxruntime, "InferenceSession", session)
    network = MarkingNetwork(config(path, engine_cache="engines"))
    assert network.notice.count("its libraries cannot be loaded") == 2
    assert network.provider == "cpu"
    given = given[1:]  # the first only tells the shapes
    assert given[0][0] == (ALL[0], {"trt_engine_cache_enable": True, "trt_engine_cache_path": "engines"})
    assert given[1:] == [ALL[1:], ALL[2:]]


@pytest.mark.parametrize(
    ("keys", "said"),
    [
        ({"size": "100x100"}, "size: '100x100' is none of 512x256, 256x128, birdseye"),
        ({"providers": ()}, "providers: "),
        ({"providers": ("cpu", "tpu")}, "providers: "),
        ({"threads": -1}, "threads: expected a number >= 0, got -1"),
        ({"above": -0.1}, "above: expected a number >= 0, got -0.1"),
        ({"above": 1.0}, "above: expected a share below 1, got 1.0"),
    ],
)
def test_a_wrong_configuration_is_refused(keys: dict[str, Any], said: str) -> None:
    with pytest.raises(ValueError, match=said):
        UnetConfig(**keys)


def test_onnxruntime_is_imported_only_when_a_network_is_loaded() -> None:
    code = "import sys, automodel.perception.markings.unet; sys.exit('onnxruntime' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


@pytest.mark.parametrize("size", SIZES)
def test_the_networks_that_ship_find_lines(size: str) -> None:
    network = MarkingNetwork(UnetConfig(size=size, providers=("cpu",), threads=1))
    assert network.notice == f"marking_{size}.onnx runs on cpu"
    picture, lines = drawn_lines(672, 376)
    found = cv2.resize(network.step(picture), (672, 376)) > 127
    assert found[lines > 0].mean() > 0.7
    assert found[lines == 0].mean() < 0.02
    _, data = unet.read_network(UnetConfig(size=size))
    assert len(data) < 2_000_000


@pytest.mark.parametrize("size", SIZES)
def test_a_network_that_ships_and_was_damaged_is_refused(
    size: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    _, data = unet.read_network(UnetConfig(size=size))
    (tmp_path / "weights").mkdir()
    damaged = tmp_path / "weights" / f"marking_{size}.onnx"
    monkeypatch.setattr(importlib.resources, "files", lambda package: tmp_path)
    damaged.write_bytes(data)
    assert MarkingNetwork(UnetConfig(size=size, providers=("cpu",), threads=1)).faults == 0
    at = len(data) // 2
    damaged.write_bytes(data[:at] + bytes((data[at] ^ 1,)) + data[at + 1 :])
    with pytest.raises(ConfigError, match="is not the network that ships") as error:
        MarkingNetwork(UnetConfig(size=size, providers=("cpu",), threads=1))
    assert "\n" not in str(error.value)


def test_the_networks_that_ship_are_described() -> None:
    card = (Path(unet.__file__).parents[1] / "weights" / "MODEL_CARD.md").read_text(encoding="utf-8")
    for size in SIZES:
        assert f"## marking_{size}.onnx" in card


def test_a_network_in_use_reports_to_nobody(tmp_path) -> None:
    """onnxruntime by itself sends reports to its makers, and keeps the machine's number in the temporary folder."""
    code = (
        "from automodel.perception.markings.unet import MarkingNetwork, UnetConfig\n"
        "MarkingNetwork(UnetConfig(providers=('cpu',)))"
    )
    environment = {name: value for name, value in os.environ.items() if name not in ("CI", "ORT_DISABLE_TELEMETRY")}
    environment |= {"TMPDIR": str(tmp_path), "HOME": str(tmp_path), "XDG_CACHE_HOME": str(tmp_path)}
    assert subprocess.run([sys.executable, "-c", code], check=False, env=environment).returncode == 0
    assert list(tmp_path.iterdir()) == []

"""The marking network in the car: a grey image in, each pixel's probability of being a lane marking out.

A U-Net, as in Cudrano et al. 2020, section IV. The network's file is not trusted: it is read once and checked
(`onnx_check`, `onnx_cost`), and only the checked bytes go to onnxruntime. Then it must find two lines in a drawn image.
"""

from __future__ import annotations

import functools
import hashlib
import importlib.resources
import importlib.util
import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from automodel.config.extras import missing_extra, need_extra
from automodel.config.pipelines import NETWORK_PROVIDERS
from automodel.config.toml_reader import ConfigError, not_negative
from automodel.perception.markings.onnx_check import INPUT, OUTPUT, ROWS, STRIDE, check_onnx
from automodel.perception.markings.onnx_cost import check_cost
from automodel.perception.markings.openvino_session import OpenvinoSession
from automodel.types import Image

BIRDSEYE = "birdseye"  # the network that sees the bird's-eye view of the road, not the picture
SIZES = {"512x256": (512, 256), "256x128": (256, 128), BIRDSEYE: (192, 160)}  # width, height [px]
SHIPPED = {  # SHA-256 of the networks that ship
    "512x256": "0bc37d088444c2b40d553906539656c0a5c1b43db28e7f62f6ab483a34ee91d5",
    "256x128": "1443e7d4497b43b92d505889593093e559da25f9b5ef5076f8687dc50638d5e9",
    BIRDSEYE: "df67ca60a030f73055b9ab80b434ddac797f0509e8889d0d40d485506d56ef4d",
}
PROVIDERS = {"tensorrt": "TensorrtExecutionProvider", "cuda": "CUDAExecutionProvider", "cpu": "CPUExecutionProvider"}
OPENVINO = "openvino"  # which is no part of onnxruntime
MAX_BYTES = 8_000_000
_ERRORS = 3  # onnxruntime's log level; a missing provider is reported by `MarkingNetwork.notice`

SELF_TEST_FOUND = 0.6  # minimum share of the drawn lines' pixels that the self-test requires
SELF_TEST_ELSEWHERE = 0.03  # maximum share of all other pixels
_MARKING = 128  # of 255: a pixel is a marking


@dataclass(frozen=True, slots=True, kw_only=True)
class UnetConfig:
    """Which network runs, and where."""

    model: str = ""  # an ONNX file; empty: the one that ships for this size
    size: str = BIRDSEYE  # the network's input, of `SIZES`
    providers: tuple[str, ...] = ("tensorrt", "cuda", "cpu")  # tried in the order of `NETWORK_PROVIDERS`
    threads: int = 0  # on the CPU; 0: half of the cores
    above: float = 0.0  # share of the image's height, from its top, in which no marking is looked for
    engine_cache: str = ""  # folder for TensorRT's compiled engines; empty: compiled at each start, which takes minutes

    def __post_init__(self) -> None:
        not_negative(self, "threads", "above")
        if self.size not in SIZES:
            raise ValueError(f"size: {self.size!r} is none of {', '.join(SIZES)}")
        if not self.providers or not set(self.providers) <= set(NETWORK_PROVIDERS):
            raise ValueError(f"providers: expected some of {', '.join(NETWORK_PROVIDERS)}, got {list(self.providers)}")
        if self.above >= 1.0:
            raise ValueError(f"above: expected a share below 1, got {self.above}")

    @property
    def first_row(self) -> int:
        """The first of the network's rows that is looked at, a multiple of its stride."""
        return min(int(self.above * SIZES[self.size][1]), SIZES[self.size][1] - 1) // STRIDE * STRIDE


class MarkingNetwork:
    """A network, loaded and tested at construction; `step` computes the mask of an image of any size.

    `provider` runs the network, `notice` says in one line which one and why; `faults` counts unusable outputs, for each
    of which `step` returned an empty mask. A network `from_above` takes bird's-eye views (`network_view`). Raises
    ConfigError when the file is not a network that may be loaded, or fails the test on all providers.

    The network knows light `markings`; for "dark" ones it gets the negative, for "both" it runs on both, and the larger
    probability counts. It sees the rows from `first_row` on, above which the mask is empty: those that `config.above`
    leaves, if its height is open, else all.
    """

    def __init__(self, config: UnetConfig | None = None, markings: str = "light") -> None:
        config = config or UnetConfig()
        self._markings = markings
        self.width_px, self.height_px = SIZES[config.size]
        self.size, self.from_above = config.size, config.size == BIRDSEYE
        self.faults = 0
        name, data = read_network(config)
        try:
            is_open = check_onnx(data, self.width_px, self.height_px)
            check_cost(data, functools.partial(inferred_outputs, rows=self.height_px))
        except ConfigError:  # onnxruntime is not installed
            raise
        except ValueError as error:
            raise ConfigError(f"{name}: {error}") from None
        self.first_row = config.first_row if is_open else 0
        self.provider, self._session, self.notice = _first_session(config, name, data, self.first_row)

    def step(self, grey: Image) -> Image:
        """The probability of a marking times 255, uint8 (height_px, width_px), of a grey image (h, w) of any size.

        The image is stretched to the network's size: pixel u of w lies at (u + 0.5) width_px / w - 0.5 of the mask.
        """
        if grey.dtype != np.uint8 or grey.ndim != 2 or not grey.size:
            return self._no_mask()
        try:
            rows = self._run(self._resized(grey)[self.first_row :])
        except session_errors():
            return self._no_mask()
        if not self.first_row:
            return rows
        mask = np.empty((self.height_px, self.width_px), np.uint8)
        mask[: self.first_row], mask[self.first_row :] = 0, rows
        return mask

    def _run(self, grey: Image) -> Image:
        """The mask of the rows that the network sees."""
        if self._markings == "light":
            return run_network(self._session, grey)
        mask = run_network(self._session, np.asarray(cv2.bitwise_not(grey), dtype=np.uint8))
        if self._markings == "both":
            mask = np.asarray(cv2.max(mask, run_network(self._session, grey)), dtype=np.uint8)
        return mask

    def _resized(self, grey: Image) -> Image:
        """The image at the network's size."""
        h, w = grey.shape
        if (w, h) == (self.width_px, self.height_px):
            return grey
        skips = w > 2 * self.width_px or h > 2 * self.height_px  # linear interpolation would leave out pixels
        method = cv2.INTER_AREA if skips else cv2.INTER_LINEAR
        return np.asarray(cv2.resize(grey, (self.width_px, self.height_px), interpolation=method), dtype=np.uint8)

    def _no_mask(self) -> Image:
        self.faults += 1
        return np.zeros((self.height_px, self.width_px), np.uint8)


def read_network(config: UnetConfig) -> tuple[str, bytes]:
    """The name and the bytes of the network's file.

    Raises ConfigError when it cannot be read or is too large, or is meant to be one that ships and is not.
    """
    if config.model:
        name, file = config.model, Path(config.model)
    else:
        name = f"marking_{config.size}.onnx"
        file = Path(str(importlib.resources.files("automodel.perception") / "weights" / name))
    try:
        with file.open("rb") as stream:
            data = stream.read(MAX_BYTES + 1)
    except FileNotFoundError:
        raise ConfigError(f"{name}: no such file") from None
    except OSError as error:
        raise ConfigError(f"{name}: cannot be read: {error.strerror}") from None
    if len(data) > MAX_BYTES:
        raise ConfigError(f"{name}: larger than {MAX_BYTES // 1_000_000} MB, which no mask network is")
    if not config.model and hashlib.sha256(data).hexdigest() != SHIPPED[config.size]:
        raise ConfigError(f"{name}: is not the network that ships (another SHA-256); install automodel again")
    return name, data


def _first_session(config: UnetConfig, name: str, data: bytes, first_row: int) -> tuple[str, Any, str]:
    """The first provider on which the network passes its test, its session, and a notice of one line."""
    offered, failed = offered_providers(), []
    width, height = SIZES[config.size]
    for provider in (p for p in NETWORK_PROVIDERS if p in config.providers):
        if provider not in offered:
            own = provider == OPENVINO
            failed.append(
                missing_extra("provider openvino", OPENVINO) if own else f"{provider}: not in this onnxruntime"
            )
            continue
        try:
            session = open_session(data, provider, config.threads, config.engine_cache, rows=height - first_row)
            drawn = drawn_view(width, height) if config.size == BIRDSEYE else drawn_lines(width, height)
            self_test(functools.partial(run_network, session), *drawn, first_row)
        except session_errors() as error:
            failed.append(f"{provider}: {' '.join(str(error).split())[:300]}")
            continue
        why = f" ({'; '.join(failed)})" if failed else ""
        return provider, session, f"{name} runs on {provider}{why}"
    raise ConfigError(f"{name}: runs on none of the configured providers: {'; '.join(failed)}")


def offered_providers() -> list[str]:
    """Which of `NETWORK_PROVIDERS` are installed, in that order."""
    there = _runtime().get_available_providers()
    openvino = importlib.util.find_spec(OPENVINO) is not None
    return [name for name in NETWORK_PROVIDERS if (openvino if name == OPENVINO else PROVIDERS[name] in there)]


def open_session(data: bytes, provider: str, threads: int, engine_cache: str = "", *, rows: int = 0) -> Any:
    """A session of checked bytes on one of `NETWORK_PROVIDERS`; raises one of `session_errors()`.

    `threads` 0 is half of the cores: camera, recorder and link need the others, and a thread that waits for a core
    delays all threads. `rows` is the height of the images, for a network whose height is open; 0: it may change.
    """
    threads = threads or max(1, _cores() // 2)
    if provider == OPENVINO:
        return OpenvinoSession(data, threads, rows)
    onnxruntime = _runtime()
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads, options.inter_op_num_threads = threads, 1
    options.log_severity_level = _ERRORS
    if rows:
        options.add_free_dimension_override_by_name(ROWS, rows)
    options.add_session_config_entry("session.load_model_format", "ONNX")
    options.add_session_config_entry("session.force_spinning_stop", "1")  # frees its cores between images
    cache = {"trt_engine_cache_enable": True, "trt_engine_cache_path": engine_cache} if engine_cache else {}
    order: list[Any] = list(PROVIDERS.values())[
        list(PROVIDERS).index(provider) :
    ]  # the rest runs the operators it cannot
    if provider == "tensorrt":
        order[0] = (order[0], cache)
    session = onnxruntime.InferenceSession(data, options, order, enable_fallback=0, read_config_from_model=0)
    if session.get_providers()[0] != PROVIDERS[provider]:  # onnxruntime drops one whose libraries are missing
        raise RuntimeError("its libraries cannot be loaded")
    return session


def inferred_outputs(data: bytes, rows: int) -> Any:
    """What a network of checked bytes gives for `rows` of an image, as onnxruntime infers it without running anything.

    Raises ValueError where it cannot.
    """
    onnxruntime = _runtime()
    options = onnxruntime.SessionOptions()
    options.log_severity_level = _ERRORS
    options.graph_optimization_level = onnxruntime.GraphOptimizationLevel.ORT_DISABLE_ALL  # which would run constants
    options.add_free_dimension_override_by_name(ROWS, rows)
    try:
        return onnxruntime.InferenceSession(data, options, ["CPUExecutionProvider"]).get_outputs()
    except session_errors() as error:
        raise ValueError(f"onnxruntime cannot read it: {' '.join(str(error).split())[:300]}") from None


def run_network(session: Any, grey: Image) -> Image:
    """The mask (h, w) of one grey image of the network's size; raises one of `session_errors()`."""
    mask = session.run([OUTPUT], {INPUT: grey[None, None]})[0]
    if not isinstance(mask, np.ndarray) or mask.dtype != np.uint8 or mask.shape != (1, 1, *grey.shape):
        raise ValueError("its output is no mask of the image's size")
    return mask[0, 0]


def session_errors() -> tuple[type[Exception], ...]:
    """The errors of a network that onnxruntime cannot run; its own have no common base class."""
    state = _runtime().capi.onnxruntime_pybind11_state
    own = [error for error in vars(state).values() if isinstance(error, type) and issubclass(error, Exception)]
    return (RuntimeError, ValueError, TypeError, MemoryError, *own)


def _runtime() -> Any:
    """onnxruntime, imported when first needed (it is slow to import), with its telemetry off."""
    need_extra("the network", "onnxruntime")
    os.environ["ORT_DISABLE_TELEMETRY"] = "1"  # effective before the first import only
    import onnxruntime

    onnxruntime.disable_telemetry_events()
    onnxruntime.set_default_logger_severity(_ERRORS)
    return onnxruntime


def _cores() -> int:
    """The number of cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def self_test(network: Callable[[Image], Image], drawn: Image, marked: Image, first_row: int = 0) -> None:
    """Raise ValueError unless `network` marks the lines of a drawn image (h, w) and little else, and nothing in black.

    It is shown the rows from `first_row` on. `marked` (h, w) is 255 on the lines, else 0.
    """
    image, lines = (np.ascontiguousarray(whole[first_row:]) for whole in (drawn, marked))
    mask = network(image)
    around = cv2.dilate(lines, np.ones((9, 9), np.uint8))
    found = float((mask[lines > 0] >= _MARKING).mean())
    elsewhere = float((mask[around == 0] >= _MARKING).mean())
    if found < SELF_TEST_FOUND or elsewhere > SELF_TEST_ELSEWHERE:
        raise ValueError(
            f"it fails the self-test: marks {found:.0%} of two drawn lines ({SELF_TEST_FOUND:.0%} required)"
            f" and {elsewhere:.0%} of all other pixels ({SELF_TEST_ELSEWHERE:.0%} allowed)"
        )
    black = network(np.zeros_like(image))
    if float((black >= _MARKING).mean()) > SELF_TEST_ELSEWHERE:
        raise ValueError("it fails the self-test: marks a black image")


def drawn_lines(width_px: int, height_px: int) -> tuple[Image, Image]:
    """An image (h, w) of a grey floor below a brighter wall with two bright converging lines, and the lines alone."""
    horizon = 0.3 * height_px
    rows = np.arange(height_px)[:, None] + np.zeros((1, width_px))
    grey = np.where(rows < horizon, 135.0, 70.0 + 25.0 * rows / height_px)
    lines: Image = np.zeros((height_px, width_px), np.uint8)
    top = horizon + 0.12 * height_px
    for bottom_u, top_u in ((0.18, 0.42), (0.80, 0.56)):
        half_bottom, half_top = 0.018, 0.004  # of the width
        corners = [
            ((bottom_u - half_bottom) * width_px, height_px),
            ((bottom_u + half_bottom) * width_px, height_px),
            ((top_u + half_top) * width_px, top),
            ((top_u - half_top) * width_px, top),
        ]
        cv2.fillConvexPoly(lines, np.round(corners).astype(np.int32), 255)
    return _painted(grey, lines), lines


def drawn_view(width_px: int, height_px: int) -> tuple[Image, Image]:
    """The view (h, w) from above of a grey floor with the two bright lines of a lane, and the lines alone."""
    rows = np.arange(height_px)[:, None] + np.zeros((1, width_px))
    grey = 70.0 + 25.0 * rows / height_px
    lines: Image = np.zeros((height_px, width_px), np.uint8)
    half_lane, half_line = width_px // 7, width_px // 96
    for middle in (width_px // 2 - half_lane, width_px // 2 + half_lane):
        lines[:, middle - half_line : middle + half_line] = 255
    return _painted(grey, lines), lines


def _painted(grey: NDArray[np.float64], lines: Image) -> Image:
    """The floor `grey` (h, w) with bright `lines`, a little blurred and with a camera's noise; the same each time."""
    grey = np.where(lines > 0, 205.0, grey)
    noise = np.random.default_rng(1).normal(0.0, 3.0, grey.shape)
    return np.clip(cv2.GaussianBlur(grey, (3, 3), 0.0) + noise, 0, 255).astype(np.uint8)

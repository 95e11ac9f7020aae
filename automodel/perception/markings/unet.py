"""The marking network as it runs in the car: a grey picture in, the probability of "lane marking" of each pixel out.

A network is a file, and a file may be anybody's: it is read once, checked (`onnx_check`), and only the checked bytes
go to onnxruntime. Then it must find two lines in a drawn picture before it may see a road.
"""

from __future__ import annotations

import functools
import importlib.resources
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from automodel.config.toml_reader import ConfigError, not_negative
from automodel.perception.markings.onnx_check import INPUT, OUTPUT, check_onnx
from automodel.perception.markings.self_test import self_test
from automodel.types import Image

SIZES = {"512x256": (512, 256), "256x128": (256, 128)}  # width, height [px]
PROVIDERS = {"tensorrt": "TensorrtExecutionProvider", "cuda": "CUDAExecutionProvider", "cpu": "CPUExecutionProvider"}
MAX_BYTES = 8_000_000
_ERRORS = 3  # onnxruntime's log level: a provider that is missing is told in our own words


@dataclass(frozen=True, slots=True, kw_only=True)
class UnetConfig:
    """Which network, and where it runs."""

    model: str = ""  # an ONNX file; empty: the one that ships for this size
    size: str = "512x256"  # the network's picture; "256x128" is for small boards
    providers: tuple[str, ...] = ("tensorrt", "cuda", "cpu")  # tried in the order tensorrt, cuda, cpu
    threads: int = 0  # on the CPU; 0: half of the cores
    engine_cache: str = ""  # folder for TensorRT's compiled engines; empty: compiled at each start, which takes minutes

    def __post_init__(self) -> None:
        not_negative(self, "threads")
        if self.size not in SIZES:
            raise ValueError(f"size: {self.size!r} is none of {', '.join(SIZES)}")
        if not self.providers or not set(self.providers) <= set(PROVIDERS):
            raise ValueError(f"providers: {list(self.providers)} where some of {', '.join(PROVIDERS)} are wanted")


class MarkingNetwork:
    """`step` gives the mask of a picture of any size; the network is loaded and tested when the object is made.

    Raises ConfigError when the file is not a network that may be loaded, or fails the test on all of the providers.
    `provider` is the one that runs it, `told` says in one line which and why; `faults` counts outputs that could not
    be used, for each of which `step` gave an empty mask.
    """

    def __init__(self, config: UnetConfig | None = None) -> None:
        config = config or UnetConfig()
        self.width_px, self.height_px = SIZES[config.size]
        self.faults = 0
        name, data = read_network(config)
        try:
            check_onnx(data, self.width_px, self.height_px)
        except ValueError as error:
            raise ConfigError(f"{name}: {error}") from None
        self.provider, self._session, self.told = self._started(config, name, data)

    def step(self, grey: Image) -> Image:
        """Probability of marking times 255, uint8 (height_px, width_px), of a grey picture (h, w) of any size.

        The picture is stretched to the network's size: pixel u of w lies at (u + 0.5) width_px / w - 0.5 of the mask.
        """
        if grey.dtype != np.uint8 or grey.ndim != 2 or not grey.size:
            return self._no_mask()
        try:
            return run_network(self._session, self._fitted(grey))
        except session_errors():
            return self._no_mask()

    def _fitted(self, grey: Image) -> Image:
        """The picture at the network's size."""
        h, w = grey.shape
        if (w, h) == (self.width_px, self.height_px):
            return grey
        smaller = w >= self.width_px and h >= self.height_px
        way = cv2.INTER_AREA if smaller else cv2.INTER_LINEAR
        return np.asarray(cv2.resize(grey, (self.width_px, self.height_px), interpolation=way), dtype=np.uint8)

    def _no_mask(self) -> Image:
        self.faults += 1
        return np.zeros((self.height_px, self.width_px), np.uint8)

    def _started(self, config: UnetConfig, name: str, data: bytes) -> tuple[str, Any, str]:
        """(provider, session, what to tell) of the first provider on which the network passes its test."""
        there, passed_over = _runtime().get_available_providers(), []
        for provider in (p for p in PROVIDERS if p in config.providers):
            if PROVIDERS[provider] not in there:
                passed_over.append(f"{provider}: not in this onnxruntime")
                continue
            try:
                session = open_session(data, provider, config.threads, config.engine_cache)
                self_test(functools.partial(run_network, session), self.width_px, self.height_px)
            except session_errors() as error:
                passed_over.append(f"{provider}: {' '.join(str(error).split())[:300]}")
                continue
            why = f" ({'; '.join(passed_over)})" if passed_over else ""
            return provider, session, f"{name} runs on {provider}{why}"
        raise ConfigError(f"{name}: runs on none of the providers asked for: {'; '.join(passed_over)}")


def read_network(config: UnetConfig) -> tuple[str, bytes]:
    """(name, bytes) of the network's file; raises ConfigError when it cannot be read or is too large."""
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
        raise ConfigError(f"{name}: more than {MAX_BYTES // 1_000_000} MB; no mask network is as large")
    return name, data


def open_session(data: bytes, provider: str, threads: int, engine_cache: str = "") -> Any:
    """An onnxruntime session of checked bytes on one of PROVIDERS; raises one of `session_errors()`.

    `threads` 0 is half of the cores: camera, recorder and link need the others, and a thread that must wait for a core
    holds all of them up.
    """
    onnxruntime = _runtime()
    onnxruntime.set_default_logger_severity(_ERRORS)
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads, options.inter_op_num_threads = threads or max(1, _cores() // 2), 1
    options.log_severity_level = _ERRORS
    options.add_session_config_entry("session.load_model_format", "ONNX")
    options.add_session_config_entry("session.force_spinning_stop", "1")  # between pictures its cores are others'
    cache = {"trt_engine_cache_enable": True, "trt_engine_cache_path": engine_cache} if engine_cache else {}
    order: list[Any] = list(PROVIDERS.values())[list(PROVIDERS).index(provider) :]  # the rest takes what it cannot
    if provider == "tensorrt":
        order[0] = (order[0], cache)
    session = onnxruntime.InferenceSession(data, options, order, enable_fallback=0, read_config_from_model=0)
    if session.get_providers()[0] != PROVIDERS[provider]:  # onnxruntime drops one whose libraries are missing
        raise RuntimeError("its libraries cannot be loaded")
    return session


def run_network(session: Any, grey: Image) -> Image:
    """The mask (h, w) of one grey picture of the network's size; raises one of `session_errors()`."""
    mask = session.run([OUTPUT], {INPUT: grey[None, None]})[0]
    if not isinstance(mask, np.ndarray) or mask.dtype != np.uint8 or mask.shape != (1, 1, *grey.shape):
        raise ValueError("it gives no mask of the picture's size")
    return mask[0, 0]


def session_errors() -> tuple[type[Exception], ...]:
    """What onnxruntime raises on a network that it cannot run; its own errors have no common base."""
    state = _runtime().capi.onnxruntime_pybind11_state
    own = [error for error in vars(state).values() if isinstance(error, type) and issubclass(error, Exception)]
    return (RuntimeError, ValueError, TypeError, MemoryError, *own)


def _runtime() -> Any:
    """onnxruntime, which takes its time to import, and without its reports to its makers."""
    os.environ["ORT_DISABLE_TELEMETRY"] = "1"  # counts only before the first import
    import onnxruntime

    onnxruntime.disable_telemetry_events()
    return onnxruntime


def _cores() -> int:
    """Those that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1

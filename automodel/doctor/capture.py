"""What a camera delivered in about a second, and whether that is what car.toml says."""

from __future__ import annotations

import itertools
import statistics
from dataclasses import dataclass, field

from automodel.config import CarConfig
from automodel.doctor.findings import Finding, fail, okay, warn
from automodel.signals import Frame

RATE_OK = 0.1  # share by which the rate may be off
RATE_FAIL = 0.5  # share of it that may be missing


@dataclass(slots=True, kw_only=True)
class Capture:
    """The stamps of all pictures after the first ones, and the newest few pictures themselves."""

    stamps_ns: list[int] = field(default_factory=list)
    frames: list[Frame] = field(default_factory=list)
    repeated: int = 0  # pictures that were the same as the one before, bit for bit

    def add(self, frame: Frame, keep: int) -> None:
        """One more picture; the newest `keep` are kept."""
        if self.frames and (self.frames[-1].image.shape == frame.image.shape):
            self.repeated += int((self.frames[-1].image == frame.image).all())
        self.stamps_ns.append(frame.t_ns)
        self.frames = [*self.frames, frame][-keep:]


def judge_resolution(capture: Capture, car: CarConfig) -> Finding:
    """The pictures' size against car.toml."""
    name = "resolution"
    height, width = capture.frames[-1].image.shape[:2]
    wanted = car.camera.width_px, car.camera.height_px
    if (width, height) != wanted:
        do = "set [camera] width_px and height_px to what the camera gives, and calibrate for it"
        return fail(name, f"{width}x{height} pixels where car.toml says {wanted[0]}x{wanted[1]}", do)
    return okay(name, f"{width}x{height} pixels")


def judge_stamps(capture: Capture) -> Finding:
    """Whether time stamps rise and pictures change."""
    name = "time stamps"
    count = len(capture.stamps_ns)
    if count < 2:
        return fail(name, f"{count} picture came", "look at the cable; try another program with this camera")
    back = sum(b <= a for a, b in itertools.pairwise(capture.stamps_ns))
    if back:
        do = "another driver or kernel for this camera: the car holds on such frames"
        return fail(name, f"{back} of {count} are not later than the one before", do)
    if capture.repeated == count - 1:
        do = "plug the camera in again: a live picture is never the same twice (a drawn one is)"
        return warn(name, f"rise, but all {count} pictures are the same", do)
    return okay(name, f"{count} rise, and the pictures change")


def judge_rate(capture: Capture, car: CarConfig) -> Finding:
    """The rate [Hz] by the stamps, and the longest gap against the time after which the car holds."""
    name = "frame rate"
    steps = [(b - a) * 1e-9 for a, b in itertools.pairwise(capture.stamps_ns)]
    span_s = (capture.stamps_ns[-1] - capture.stamps_ns[0]) * 1e-9 if steps else 0.0
    if span_s <= 0.0:
        return fail(name, "no rate: the time stamps do not rise", "see time stamps")
    rate, wanted = len(steps) / span_s, car.camera.rate_hz
    longest, timeout_s = max(steps), car.safety.frame_timeout_s
    what = f"{rate:.1f} Hz (car.toml: {wanted:g}), {statistics.median(steps) * 1e3:.1f} ms apart, {longest * 1e3:.0f} "
    what += "at most"
    if rate < (1.0 - RATE_FAIL) * wanted or statistics.median(steps) > timeout_s:
        do = "more light, a smaller picture, another USB port; a camera that is as slow needs a smaller [camera] "
        do += f"rate_hz, and a [safety] frame_timeout_s above {1.5 / rate:.3f}"
        return fail(name, what, do)
    if abs(rate - wanted) > RATE_OK * wanted:
        do = f"more light, or [camera] rate_hz = {rate:.0f} (v4l2-ctl --list-formats-ext shows what the camera has)"
        return warn(name, what, do)
    if longest > timeout_s:
        do = f"close other programs; the car holds after {timeout_s * 1e3:.0f} ms without a frame"
        return warn(name, what, do)
    return okay(name, what)

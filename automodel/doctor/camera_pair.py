"""Checks the car's two cameras as a pair: the times of their frames, which is which, and whether it is this pair."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from automodel.config import CarConfig
from automodel.doctor.findings import Finding, bounded, fail, okay, skip, warn
from automodel.perception.stereo.points import ORDER_SIGMAS, RigCheck, check_rig
from automodel.pipelines.stereo import Stereo
from automodel.signals import SIDES, StereoFrame
from automodel.sources.images import with_channels
from automodel.sources.pairs import PairStatus

PAIRED_WARN, PAIRED_FAIL = 0.95, 0.5  # share of the frames; a car drives with half its rate, and is held for gaps
REPEATED = 0.5  # share of a camera's frames that are the one before
RIGID = 0.5  # share of the matches that belong together; of wrong ones alone it is up to 0.4
OFF_WARN_PX, OFF_FAIL_PX = 3.0, 10.0  # 0.4 and 1.2 deg at 480 px: what the ground plane takes in, and what it does not
LOOKED_AT = 3  # pairs
_PATIENCE_S = 20.0


def judge_times(begun: PairStatus | None, status: PairStatus, tolerance_s: float) -> Finding:
    """How the frames of two live cameras go together, from when both gave some (`begun`; None: they never did)."""
    name = "camera pair"
    for side, eye in zip(SIDES, status.eyes, strict=True):
        if not eye.frames:
            return fail(name, f"the {side} camera gives no frame", f"check its cable, and {_key(side)} device")
    for side, eye, repeated in zip(SIDES, status.eyes, status.repeated, strict=True):
        if repeated > REPEATED * eye.frames:
            what = f"the {side} camera repeats its image: {repeated} of {eye.frames}"
            return fail(name, what, "plug it in again; another USB port, a smaller image")
    paired, alone = 2 * status.pairs, status.alone
    unpaired = status.unpaired
    if begun is not None:  # one camera starts before the other one
        paired, alone, unpaired = paired - 2 * begun.pairs, alone - begun.alone, unpaired - begun.unpaired
    share = paired / max(paired + unpaired + alone, 1)
    rates = " and ".join("?" if eye.rate_hz is None else f"{eye.rate_hz:.1f}" for eye in status.eyes)
    what = f"{rates} Hz; {share:.0%} of the frames have a partner within {1e3 * tolerance_s:.1f} ms"
    if status.apart_s is not None and status.apart_max_s is not None:
        what += f", {1e3 * status.apart_s:.1f} ms apart, {1e3 * status.apart_max_s:.1f} at most"
    if status.missed_s is not None and share < PAIRED_WARN:
        what += f"; the others are {1e3 * status.missed_s:.1f} ms off"
    do = "trigger both cameras together, set both to one rate and exposure, or raise [camera.right] pair_tolerance_s"
    if share < PAIRED_FAIL:
        return fail(name, what, do)
    return warn(name, what, do) if share < PAIRED_WARN else okay(name, what)


def judge_order(check: RigCheck) -> Finding:
    """Whether the left camera is the left one."""
    name = "camera order"
    what = f"{check.as_given} points that both see fit the cameras as they are, {check.exchanged} if they were swapped"
    if check.order_sigmas < -ORDER_SIGMAS:
        do = "exchange [camera] device and [camera.right] device, or the cables"
        return fail(name, what, do)
    if check.order_sigmas < ORDER_SIGMAS:
        return skip(name, f"{what}: too few to tell", "point the cameras at something with edges, and run again")
    return okay(name, what)


def judge_rig(check: RigCheck) -> Finding:
    """Whether the calibration is that of these cameras."""
    name = "pair calibration"
    if not check.rigid or check.rigid < RIGID * check.matched:
        what = f"{check.rigid} of {check.matched} points that look alike belong together: too few to tell"
        return skip(name, what, "point the cameras at something with edges, and run again")
    what = f"points that both see are {check.error_px:.1f} px off their epipolar lines ({check.rigid} points)"
    if check.error_px > OFF_FAIL_PX:
        return fail(name, what, "it is that of another pair, or a camera was moved: calibrate both again")
    if check.error_px > OFF_WARN_PX:
        return warn(name, what, "calibrate both cameras again: one was moved, or its lens is another one")
    return okay(name, what)


def rig_findings(car: CarConfig, pairs: Sequence[StereoFrame]) -> Iterator[Finding]:
    """What the images of a pair say about the calibrated cameras."""
    try:
        rig = Stereo.rig(car)
    except ValueError as error:
        what, _, do = str(error).partition(": ")
        yield warn("pair calibration", what, do)
        return
    images = [(with_channels(pair.left, False), with_channels(pair.right, False)) for pair in pairs]
    step = max(len(images) // LOOKED_AT, 1)
    do = "report it, with the images"
    check = bounded("camera order", lambda: check_rig(images[::-step][:LOOKED_AT], rig), _PATIENCE_S, do)
    if isinstance(check, Finding):
        yield check
        return
    yield judge_order(check)
    yield judge_rig(check)


def _key(side: str) -> str:
    return "[camera.right]" if side == "right" else "[camera]"

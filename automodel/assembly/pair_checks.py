"""The input checks of a car with two cameras: those of any car, and that the cameras are not swapped."""

from __future__ import annotations

from automodel.config import CarConfig
from automodel.geometry.stereo_rig import StereoRig
from automodel.perception.stereo.points import ORDER_SIGMAS, check_rig
from automodel.runtime.input_checks import InputChecks
from automodel.signals import Frame, LaneEstimate, Motion, StereoFrame, VehicleState
from automodel.sources.images import with_channels

LOOK_S = 1.0  # between looks: one takes up to 0.1 s of a laptop, and arming takes 0.5 s of frames that are not late
SWAPPED = (
    "the left and the right camera are swapped: exchange [camera] device and [camera.right] device, or the cables, and "
    "start again"
)


class PairChecks(InputChecks):
    """Also refuses to arm a car whose cameras are swapped, by corners that both see.

    They are looked at while the car is not armed: in the first pair, before anybody can arm it, and every `LOOK_S`
    until they show the right order. The mean of all looks counts: the noise differs between them, the view need not.
    Where it says too little, nothing is refused. `noiseless` as in `InputChecks`.
    """

    def __init__(self, car: CarConfig, rig: StereoRig, *, noiseless: bool = False) -> None:
        super().__init__(car, noiseless=noiseless)
        self._rig = rig
        self._pair: StereoFrame | None = None  # the last frame, if it is a pair of two good images
        self._order_sigmas, self._looks = 0.0, 0  # mean over so many looks
        self._looked_ns = 0

    def of_frame(self, frame: Frame | StereoFrame, seen: Frame | StereoFrame) -> tuple[str, ...]:
        """As `InputChecks`."""
        self._pair = seen if isinstance(seen, StereoFrame) else None
        return super().of_frame(frame, seen)

    def of_estimate(self, estimate: LaneEstimate, motion: Motion, state: VehicleState | None) -> tuple[str, ...]:
        """As `InputChecks`, and that the cameras are swapped while the car is not armed."""
        found = super().of_estimate(estimate, motion, state)
        if state is not None and state.armed:
            return found
        self._look()
        return (*found, SWAPPED) if self._order_sigmas < -ORDER_SIGMAS else found

    def _look(self) -> None:
        pair = self._pair
        if pair is None or self._order_sigmas > ORDER_SIGMAS:
            return
        if self._looks and 0 <= pair.t_ns - self._looked_ns < LOOK_S * 1e9:
            return
        images = with_channels(pair.left, False), with_channels(pair.right, False)
        self._looks, self._looked_ns = self._looks + 1, pair.t_ns
        self._order_sigmas += (check_rig([images], self._rig).order_sigmas - self._order_sigmas) / self._looks

"""Whether the two cameras of a car that is not armed are those of car.toml, and which of them is the left one.

Corners that both see are weighed while the car may not drive: a comparison of hypotheses, see
`perception.stereo.pair_evidence`. The work of a look is spread over three frames, but for the first one: nobody can arm
a car before it.
"""

from __future__ import annotations

import math

import cv2
import numpy as np

from automodel.config import CarConfig
from automodel.estimation.parabola.plane_filter import PlaneFilter
from automodel.perception.stereo.pair_evidence import Corners, PairEvidence, find_corners, match_corners, weigh
from automodel.pipelines.stereo import Stereo
from automodel.signals import StereoFrame
from automodel.types import Image

KNOWN_RAD = math.radians(0.2)  # sigma of an angle between calibrated cameras; the doctor warns at twice that
ANY_RAD = math.radians(3.0)  # of one between the cameras of another car, of which both look ahead
# Sequential test (Wald 1947): the chances that a pair that is right is refused in one look, and that one which is not,
# and was refused, is taken to be right.
REFUSED, ACCEPTED = 1e-6, 1e-2
LOOK_S = 0.25  # between looks: there are two in the time of healthy input that arming takes

SWAPPED = (
    "the left and the right camera are swapped: exchange [camera] device and [camera.right] device, or the cables, and "
    "start again"
)
TURNED = (
    "a camera of the pair is turned by about {degrees:.0f} deg against car.toml: it was moved, or car.toml is that of "
    "another pair; calibrate both again"
)


class PairCheck:
    """Looks at pairs while the car is not armed; a refusal holds until a look shows that the pair is the right one.

    Raises ValueError for a car whose cameras are no pair.
    """

    def __init__(self, car: CarConfig) -> None:
        self._rig = Stereo.rig(car)
        self._height_sigma = PlaneFilter(float(self._rig.middle_m[2])).height_sigma_m
        self._refused: str | None = None
        self._looked_ns: int | None = None  # when the last look was completed
        self._pair: StereoFrame | None = None  # that is looked at
        self._left: Corners | None = None
        self._right: Corners | None = None

    def step(self, pair: StereoFrame, armed: bool) -> str | None:
        """Why the car must not be armed with these cameras, None where nothing speaks against them."""
        if armed:
            self._pair = None
        elif self._looked_ns is None:
            self._start(pair)
            while not self._advance(pair.t_ns):
                pass
        elif self._pair is not None:
            self._advance(pair.t_ns)
        elif not 0 <= pair.t_ns - self._looked_ns < LOOK_S * 1e9:
            self._start(pair)
            self._advance(pair.t_ns)
        return self._refused

    def _start(self, pair: StereoFrame) -> None:
        self._pair, self._left, self._right = pair, None, None

    def _advance(self, t_ns: int) -> bool:
        """One third of a look; whether it is complete."""
        pair = self._pair
        if pair is None:
            return True
        if self._left is None:
            self._left = find_corners(_grey(pair.left))
        elif self._right is None:
            self._right = find_corners(_grey(pair.right))
        else:
            matches = match_corners(self._left, self._right)
            self._judge(weigh(self._rig, matches, self._height_sigma, KNOWN_RAD, ANY_RAD))
            self._pair, self._looked_ns = None, t_ns
        return self._pair is None

    def _judge(self, evidence: PairEvidence) -> None:
        against = max(evidence.exchanged, evidence.turned)
        if evidence.exchanged > -math.log(REFUSED):
            self._refused = SWAPPED
        elif evidence.turned > -math.log(REFUSED):
            if self._refused is None or self._refused == SWAPPED:  # one text for as long as it lasts
                degrees = math.degrees(max(map(abs, evidence.turned_rad)))
                self._refused = TURNED.format(degrees=max(degrees, 1.0))
        elif against < math.log(ACCEPTED):
            self._refused = None


def pair_check(car: CarConfig) -> PairCheck | None:
    """The check of a car with two calibrated cameras, None for others: a pipeline that needs a pair says so."""
    try:
        return None if car.camera.right is None else PairCheck(car)
    except ValueError:
        return None


def _grey(image: Image) -> Image:
    return image if image.ndim == 2 else np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), dtype=np.uint8)

"""Which lane of its road is followed, by the kinds of the lines beside it: dashed, solid, or none.

What an intersection hides comes back as lines of the same shape, and the next lane fits them as well. But the road's
cross-section gives it away: where the lane had a dashed line and another lane to its left, and nothing beyond the solid
line to its right, the oncoming lane has them the other way round. A hidden Markov model over the lane that is followed
(cf. Ballardini et al. 2020, "Vehicle Ego-Lane Estimation with Sensor Failure Modeling"), each of its states with what
is known of the lines, which change along the road too.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from automodel.perception.line_scan import SightedLine
from automodel.tracking.stories import LEFT, LEFT_FAR, RIGHT, RIGHT_FAR
from automodel.types import FloatArray

SLOTS = (LEFT_FAR, LEFT, RIGHT, RIGHT_FAR)  # the lines of the followed lane and its neighbours, from left to right
NONE, DASHED, SOLID = range(3)  # kinds of a slot's line
SAME, LEFT_LANE, RIGHT_LANE = range(3)  # the lane that is followed, seen from the one that was
_SHIFTS = (0, -1, 1)  # by so many slots each lane's line lies elsewhere in the known lane


@dataclass(frozen=True, slots=True, kw_only=True)
class RoadProfileConfig:
    """`change`: lane widths of road after which a line is of another kind, on average: a no-passing zone.

    `slip`: probability, per lane width driven with no line seen, that another lane is followed from there on; with
    a line in view that must be missed too. `found`: probability that a line is found that is in view; `ghost`: that one
    is found where there is none.
    """

    change: float = 100.0
    slip: float = 1e-2
    found: float = 0.9
    ghost: float = 0.05


class RoadProfile:
    """The kinds of the lines beside the lane, and how probable it is that this lane is another one by now.

    `known` (4, 3): probabilities of the kinds of `SLOTS` about the lane that was followed; `lanes` (3,): those of the
    lane that is followed now.
    """

    def __init__(self, config: RoadProfileConfig | None = None) -> None:
        self.config = config or RoadProfileConfig()
        far, own = (0.5, 0.25, 0.25), (0.1, 0.45, 0.45)
        self._anything = np.array((far, own, own, far))
        self.reset()

    def reset(self) -> None:
        """Forget everything."""
        self._driven_lanes = 0.0
        self.keep(self._anything)

    @property
    def dashed(self) -> tuple[float, float]:
        """Log-odds [nats] that the left and right line of the lane that is followed are dashed, not solid."""
        now = np.einsum("l,lsk->sk", self.lanes, self._of_lane)
        left, right = (math.log(now[slot, DASHED] / now[slot, SOLID]) for slot in (1, 2))
        return left, right

    def move(self, lanes: float, lines_seen: int) -> None:
        """The car has driven so many lane widths, with so many of its lane's lines in view."""
        self._driven_lanes += lanes
        self._born += self.config.slip * (1.0 - self.config.found) ** lines_seen * lanes

    def land(self, left: float, right: float) -> None:
        """Behind a blind way a lane is so much likelier the left, and the right one, by dead reckoning."""
        self._born *= (left, right)

    def fade(self, share: float) -> None:
        """The lane is a new one with a probability: what was known of its lines counts for less."""
        self.keep((1.0 - share) * self.known + share * self._anything)

    def change_lane(self, side: int) -> None:
        """The lane on a side, +1 left or -1 right, is followed from now on."""
        self.keep(_shifted(self.known, -side, self._anything))

    def keep(self, known: FloatArray) -> None:
        """It was decided which lane is followed: it has these lines (4, 3)."""
        self.known = known
        self.lanes = np.array((1.0, 0.0, 0.0))
        self._of_lane = np.stack([_shifted(known, shift, self._anything) for shift in _SHIFTS])
        self._born = np.zeros(2)  # the left and the right lane's share since the last look

    def see(
        self, lines: Mapping[float, Sequence[SightedLine]], in_view_m: Mapping[float, float], unit_m: float
    ) -> None:
        """Take the lines that play the roles of `SLOTS` in a frame; what was in view before is no news.

        `in_view_m`: of a role whose line would be found, the length of it that is in view.
        """
        lanes, self._driven_lanes = self._driven_lanes, 0.0
        self._drift(lanes)
        for slot, role in enumerate(SLOTS):
            its = [line for line in lines.get(role, ()) if line.span_m > 0.0]
            span_m = sum(line.span_m for line in its) if its else in_view_m.get(role, 0.0)
            if its or span_m > unit_m:
                likely = self._likely(its, unit_m) ** min(lanes * unit_m / max(span_m, unit_m), 1.0)
                self._of_lane[:, slot] *= likely
                total = self._of_lane[:, slot].sum(axis=1)
                self._of_lane[:, slot] /= total[:, None]
                self.lanes *= total
        self.lanes /= self.lanes.sum()
        if self.lanes[SAME] > 0.95:
            self.known = self._of_lane[SAME].copy()

    def _drift(self, lanes: float) -> None:
        kept = math.exp(-lanes / self.config.change)
        born, self._born = 0.5 * np.minimum(self._born, 0.5) * self.lanes[SAME], np.zeros(2)
        self._of_lane = kept * self._of_lane + (1.0 - kept) * self._anything
        self.known = kept * self.known + (1.0 - kept) * self._anything
        for lane, new in zip((LEFT_LANE, RIGHT_LANE), born.tolist(), strict=True):
            share = new / max(self.lanes[lane] + new, 1e-12)
            newborn = _shifted(self._of_lane[SAME], _SHIFTS[lane], self._anything)
            self._of_lane[lane] = (1.0 - share) * self._of_lane[lane] + share * newborn
            self.lanes[lane] += new
        self.lanes[SAME] -= born.sum()

    def _likely(self, lines: Sequence[SightedLine], unit_m: float) -> FloatArray:
        """How likely it is to see these lines, or none, where there is none, a dashed and a solid one (3,)."""
        config = self.config
        if not lines:
            return np.array((1.0 - config.ghost, 1.0 - config.found, 1.0 - config.found))
        dashes = math.exp(max(min(sum(line.looks_dashed(unit_m) for line in lines), 5.0), -5.0))
        return np.array((config.ghost * 0.5 * (1.0 + dashes), config.found * dashes, config.found))


def _shifted(lines: FloatArray, shift: int, anything: FloatArray) -> FloatArray:
    """The lines of a lane whose slots are those of another, `shift` slots on; what lies beyond may be anything."""
    shifted = anything.copy()
    if shift > 0:
        shifted[:-shift] = lines[shift:]
    elif shift < 0:
        shifted[-shift:] = lines[:shift]
    else:
        shifted[:] = lines
    return shifted

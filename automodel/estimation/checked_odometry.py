"""The car's motion by its odometry, as long as the ground in the images bears it out.

An odometer that stands still, counts backwards or counts too much moves the believed lane away from the real one. A
lamp's reflection that is taken for a line contradicts a right odometry just as well: lines alone cannot tell which of
the two is wrong. The ground's texture can, and is asked where lines and odometry contradict each other.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from automodel.estimation.image_motion import ImageMotion
from automodel.geometry import GroundCamera
from automodel.signals import Frame, Motion, MotionSource

RETRY_NS = 5_000_000_000  # after this time an odometry that was wrong is used again
# Frames in which the ground contradicts a wrong odometry, and none bears it out; frames after which a suspicion that
# nothing bears out is dropped. A right one is contradicted in at most 1 % of the frames of each of seven drives, lamps
# and noise among them, and of the first kilometre of a circuit; one of half the speed in 78 to 100 %, in the heaviest
# noise in 9 %, and on the circuit, whose ground has no texture, in none.
DISSENT, ASKED = 6, 20


class CheckedOdometry:
    """The motion as given; the ground's own where none is given, or where the ground contradicts it.

    `wrong`: the step found that the odometry is. `borne_out`: by the ground, since anything contradicted it.
    """

    def __init__(self, camera: GroundCamera, lane_width_m: float) -> None:
        self._images = ImageMotion(camera, lane_width_m)
        self.reset()

    def reset(self) -> None:
        """Forget the last frame; the odometry is trusted."""
        self._images.reset()
        self.wrong, self.borne_out = False, True
        self._others: list[tuple[float, float]] | None = None  # speeds by it and by the ground that contradicts it
        self._asked = 0  # frames, while it is suspected
        self._rejected_ns: int | None = None

    def see_with(self, camera: GroundCamera) -> None:
        """From now on the camera is set so; by the ground as it was seen before, no odometry is wrong."""
        self._images.see_with(camera)
        self._others, self._rejected_ns, self.borne_out = None, None, True

    @property
    def trusted(self) -> bool:
        """Whether the odometry is used."""
        return self._rejected_ns is None

    def suspect(self) -> None:
        """What is seen in a frame contradicts the motion up to it; the next frames' ground is asked."""
        if self._others is None:
            self._others, self._asked, self.borne_out = [], 0, False

    def step(self, frame: Frame, motion: Motion) -> Motion:
        """The motion up to a frame: the odometry's, or the ground's; unknown where too little is seen of that."""
        self.wrong = False
        if motion.known:
            if self._rejected_ns is not None and not 0 <= frame.t_ns - self._rejected_ns < RETRY_NS:
                again = self._images.agrees(frame, motion) is False and frame.t_ns > self._rejected_ns
                self._rejected_ns = frame.t_ns if again else None
            elif self._rejected_ns is None and self._others is not None:
                self._ask(frame, motion)
        if motion.known and self._rejected_ns is not None:
            motion = replace(motion, speed_mps=0.0, yaw_rate_radps=0.0, source=MotionSource.NONE)
        return self._images.step(frame, motion)

    def _ask(self, frame: Frame, motion: Motion) -> None:
        """Judge a suspected odometry by the ground between the last frame and this one."""
        assert self._others is not None
        agrees = self._images.agrees(frame, motion)
        if agrees is False:
            self._others.append((motion.speed_mps, float(self._images.most[0])))
        self._asked, self.borne_out = self._asked + 1, agrees is True
        self.wrong = len(self._others) >= DISSENT and self._tell_one_speed(self._others)
        if self.wrong:
            self._rejected_ns = frame.t_ns
        if self.wrong or agrees or self._asked >= ASKED:
            self._others = None

    def _tell_one_speed(self, speeds_mps: list[tuple[float, float]]) -> bool:
        """Whether the ground tells one other speed, and not another in each frame, as that below a nodding body does.

        `speeds_mps`: by the odometry and by the ground, of each frame. Half of them differ by as much as a camera that
        is set a little wrong may be off, at most.
        """
        odometry, ground = np.array(speeds_mps).T
        low, high = np.quantile(ground - odometry, (0.25, 0.75))
        fastest = max(np.median(np.abs(odometry)), np.median(np.abs(ground)))
        return bool(0.5 * (high - low) <= 2.0 * self._images.config.camera * fastest)

"""The faults of cameras and of perception."""

from __future__ import annotations

import math
from random import Random

from automodel.bench.faults import camera, perception
from automodel.bench.faults.fault import Fault, Kind, Must
from automodel.bench.faults.hooks import At, CameraHook, Hooks, LaneHook, Stall

LONG = (0.5, 1.0)  # longer than a car is held
AGAIN_S = 0.7  # the right lane, too, is another one at first


def _time_jump(random: Random) -> int:
    return random.choice((-1, 1)) * round(random.uniform(0.1, 2.0) * 1e9)


def _blanked(random: Random) -> camera.Spoil:
    return camera.blank(random.choice((0.0, 128.0, 255.0)), random.uniform(0.0, 3.0), random)


def _one_wrong_picture(random: Random) -> CameraHook:
    spoil = random.choice((_blanked(random), camera.resized(random), camera.Frozen()))
    return camera.for_first(random.randint(1, 2), spoil)


def _late(random: Random, low_ms: int, high_ms: int) -> CameraHook:
    return camera.late(lambda: random.randint(low_ms, high_ms) * 1_000_000)


CAMERA = (
    Fault(
        name="camera-off", kind=Kind.OFF, must=Must.STOP, lasting_s=LONG,
        text="no frame comes any more",
        hooks=lambda random, end_ns: Hooks(camera=camera.at_once(camera.drop)),
    ),
    Fault(
        name="camera-gone", kind=Kind.OFF, must=Must.STOP, lasting_s=LONG, recovery_s=0.3, told="source-failed",
        text="the driver says that the camera is gone, and then that it is back",
        hooks=lambda random, end_ns: Hooks(camera=camera.at_once(camera.gone)),
    ),
    Fault(
        name="camera-blocks", kind=Kind.SLOW, must=Must.STOP, recovery_s=0.9,
        text="a read does not come back for 0.25 to 0.6 s: nothing else runs either",
        hooks=lambda random, end_ns: Hooks(stall=Stall(at=At.CAMERA, seconds=random.uniform(0.25, 0.6))),
    ),
    Fault(
        name="camera-pauses", kind=Kind.INTERMITTENT, must=Must.HOLD, lasting_s=(0.1, 0.27),
        text="no frame for 0.1 to 0.27 s",
        hooks=lambda random, end_ns: Hooks(camera=camera.at_once(camera.drop)),
    ),
    Fault(
        name="camera-drops-1", kind=Kind.INTERMITTENT, must=Must.NOTHING, lasting_s=LONG,
        text="every other frame is lost",
        hooks=lambda random, end_ns: Hooks(camera=camera.in_bursts(1, 1, camera.drop)),
    ),
    Fault(
        name="camera-drops-2", kind=Kind.INTERMITTENT, must=Must.NOTHING, lasting_s=LONG,
        text="two frames in a row are lost, again and again",
        hooks=lambda random, end_ns: Hooks(camera=camera.in_bursts(2, random.randint(1, 5), camera.drop)),
    ),
    Fault(
        name="camera-drops-3", kind=Kind.INTERMITTENT, must=Must.HOLD, lasting_s=LONG,
        within_s=math.inf,
        text="three to ten frames in a row are lost, again and again",
        hooks=lambda random, end_ns: Hooks(
            camera=camera.in_bursts(random.randint(3, 10), random.randint(3, 8), camera.drop)
        ),
    ),
    Fault(
        name="camera-stuck", kind=Kind.STUCK, must=Must.STOP, lasting_s=LONG,
        text="the same picture again and again, as if new",
        hooks=lambda random, end_ns: Hooks(camera=camera.at_once(camera.Frozen())),
    ),
    Fault(
        name="camera-black", kind=Kind.GARBAGE, must=Must.STOP, lasting_s=LONG,
        text="black pictures, with a sensor's noise",
        hooks=lambda random, end_ns: Hooks(camera=camera.at_once(camera.blank(2.0, 2.0, random))),
    ),
    Fault(
        name="camera-white", kind=Kind.GARBAGE, must=Must.STOP, lasting_s=LONG,
        text="white pictures",
        hooks=lambda random, end_ns: Hooks(camera=camera.at_once(camera.blank(255.0, 2.0, random))),
    ),
    Fault(
        name="camera-flat", kind=Kind.GARBAGE, must=Must.STOP, lasting_s=LONG,
        text="pictures of one grey, with a sensor's noise",
        hooks=lambda random, end_ns: Hooks(
            camera=camera.at_once(camera.blank(random.uniform(20.0, 230.0), random.uniform(0.0, 4.0), random))
        ),
    ),
    Fault(
        name="camera-size", kind=Kind.WRONG, must=Must.STOP, lasting_s=LONG,
        text="pictures of another size",
        hooks=lambda random, end_ns: Hooks(camera=camera.at_once(camera.resized(random))),
    ),
    Fault(
        name="camera-type", kind=Kind.WRONG, must=Must.STOP, lasting_s=LONG, recovery_s=0.3, told="source-failed",
        text="pictures of another type",
        hooks=lambda random, end_ns: Hooks(camera=camera.at_once(camera.of_another_type)),
    ),
    Fault(
        name="camera-blinks", kind=Kind.INTERMITTENT, must=Must.HOLD, lasting_s=(0.1, 0.1),
        text="one or two pictures are blank, frozen, or of another size",
        hooks=lambda random, end_ns: Hooks(camera=_one_wrong_picture(random)),
    ),
    Fault(
        name="camera-time-jumps", kind=Kind.WRONG, must=Must.STOP, lasting_s=LONG,
        text="the times of the frames jump back or ahead by 0.1 to 2 s",
        hooks=lambda random, end_ns: Hooks(camera=camera.at_once(camera.shifted_in_time(_time_jump(random)))),
    ),
    Fault(
        name="camera-time-once", kind=Kind.INTERMITTENT, must=Must.HOLD, lasting_s=(0.1, 0.1),
        text="one frame has another time",
        hooks=lambda random, end_ns: Hooks(camera=camera.for_first(1, camera.shifted_in_time(_time_jump(random)))),
    ),
    Fault(
        name="camera-late", kind=Kind.DELAYED, must=Must.STOP, lasting_s=LONG, recovery_s=0.4,
        text="frames come 65 to 150 ms after they were taken",
        hooks=lambda random, end_ns: Hooks(camera=_late(random, *random.choice(((65, 90), (90, 150))))),
    ),
    Fault(
        name="camera-jitter", kind=Kind.DELAYED, must=Must.NOTHING, lasting_s=LONG,
        text="frames come 4 to 25 ms after they were taken",
        hooks=lambda random, end_ns: Hooks(camera=_late(random, 4, 25)),
    ),
)  # fmt: skip


def _not_finite(random: Random) -> LaneHook:
    field = random.choice(("offset_m", "heading_rad", "width_m", "curvature_per_m"))
    return perception.with_pose(**{field: random.choice((math.nan, math.inf, -math.inf))})


def _blip(random: Random) -> LaneHook:
    wrong = (perception.raising, perception.without_pose, _not_finite(random))
    return perception.for_first(random.randint(1, 3), random.choice(wrong))


def _decoy(random: Random) -> LaneHook:
    return perception.decoy(random.choice((-1, 1)) * random.uniform(0.25, 0.5))


def _crossing(random: Random) -> LaneHook:
    return perception.crossing(random.choice((-1, 1)) * random.uniform(0.9, 1.5))


PERCEPTION = (
    Fault(
        name="perception-exception", kind=Kind.OFF, must=Must.STOP, lasting_s=LONG, told="fault",
        text="the pipeline raises",
        hooks=lambda random, end_ns: Hooks(lane=perception.raising),
    ),
    Fault(
        name="perception-not-finite", kind=Kind.GARBAGE, must=Must.STOP, lasting_s=LONG, told="fault",
        text="a number of the lane's pose is NaN or infinite",
        hooks=lambda random, end_ns: Hooks(lane=_not_finite(random)),
    ),
    Fault(
        name="perception-blip", kind=Kind.INTERMITTENT, must=Must.HOLD, lasting_s=(0.1, 0.1), told="fault",
        text="up to three estimates fail in any of these ways",
        hooks=lambda random, end_ns: Hooks(lane=_blip(random)),
    ),
    Fault(
        name="perception-decoy", kind=Kind.WRONG, must=Must.STOP, lasting_s=(0.5, 0.9), recovery_s=AGAIN_S,
        text="a line 0.25 to 0.5 m beside it is taken for the lane's",
        hooks=lambda random, end_ns: Hooks(lane=_decoy(random)),
    ),
    Fault(
        name="perception-crossing", kind=Kind.WRONG, must=Must.STOP, lasting_s=(0.5, 0.9), recovery_s=AGAIN_S,
        text="a line across the road is taken for the lane's",
        hooks=lambda random, end_ns: Hooks(lane=_crossing(random)),
    ),
    Fault(
        name="perception-wrong-short", kind=Kind.INTERMITTENT, must=Must.HOLD, lasting_s=(0.02, 0.2),
        text="either of these for 0.02 to 0.2 s",
        hooks=lambda random, end_ns: Hooks(lane=random.choice((_decoy, _crossing))(random)),
    ),
    Fault(
        name="perception-lost", kind=Kind.OFF, must=Must.STOP, lasting_s=(0.4, 5.0),
        text="no lane for 0.4 to 5 s",
        hooks=lambda random, end_ns: Hooks(lane=perception.lost),
    ),
    Fault(
        name="perception-lost-short", kind=Kind.INTERMITTENT, must=Must.HOLD, lasting_s=(0.1, 0.25),
        text="no lane for 0.1 to 0.25 s",
        hooks=lambda random, end_ns: Hooks(lane=perception.lost),
    ),
    Fault(
        name="perception-coasts", kind=Kind.WRONG, must=Must.NOTHING, lasting_s=LONG,
        text="no line is seen, but the pipeline carries the lane on",
        hooks=lambda random, end_ns: Hooks(lane=perception.coasting),
    ),
)  # fmt: skip

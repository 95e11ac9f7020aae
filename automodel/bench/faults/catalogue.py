"""All faults, by name."""

from __future__ import annotations

import difflib
import math
from collections.abc import Iterable, Sequence
from random import Random
from typing import Protocol, TypeVar

from automodel.assembly.simulated_car import LATENCY_NS
from automodel.bench.faults import hooks
from automodel.bench.faults.fault import (
    BOUND_S,
    At,
    CameraHook,
    Disk,
    Fault,
    Grip,
    Hooks,
    Kind,
    LaneHook,
    Moment,
    Must,
    PulseHook,
    Stall,
    WireHook,
)
from automodel.bench.faults.real_catalogue import REAL_FAULTS
from automodel.config import CameraConfig, CenterlineConfig, ConfigError
from firmware_link.can_port import BusTrouble
from firmware_link.emulator.can_vehicle import COMMAND_TIMEOUT_NS, FULL_LOAD_FRAMES, EmulatedCanVehicle

HELD_S = (0.5, 1.0)  # longer than a car is held
UNCERTAIN_S = CenterlineConfig().coast_s + BOUND_S  # what a car may drive on for without any line
OTHER_LANE_S = 0.7  # after a wrong lane the right one, too, is another lane at first
BOOT_S = 0.7  # until a board that has restarted has got the limits again
SHORT_S = (0.3, 0.8)
STATUS_S = 0.02  # the first status that repeats its time is still as a good one
COASTED_S = 0.25  # at most, before another line is taken for the lane's
FLAPS_S = 3.2  # 13 holds of at most 12 frames at 60 Hz, and the bound: 2.75 s, more where a hold lasts a frame longer
SERIAL_S = (0.2, 0.6)
REOPENED_S = 0.7  # a port that is opened again, and a board that starts: until it has got the limits again
HEARD_S = 0.3  # after a silent link: until the board's time is known again


def _frames(spoil: hooks.Spoil) -> Hooks:
    return Hooks(camera=hooks.at_once(spoil))


def _time_jump(random: Random) -> int:
    return random.choice((-1, 1)) * round(random.uniform(0.1, 2.0) * 1e9)


def _blanked(random: Random) -> hooks.Spoil:
    return hooks.blank(random.choice((0.0, 128.0, 255.0)), random.uniform(0.0, 3.0), random)


def _one_wrong_image(random: Random) -> CameraHook:
    spoil = random.choice((_blanked(random), hooks.resized(random), hooks.frozen()))
    return hooks.at_once(hooks.for_first(random.randint(1, 2), spoil))


def _late(random: Random, low_ms: int, high_ms: int) -> CameraHook:
    return hooks.late(lambda: random.randint(low_ms, high_ms) * 1_000_000)


CAMERA = (
    Fault(name="camera-off", kind=Kind.OFF, must=Must.STOP, duration_s=HELD_S, text="no frame comes any more",
          hooks=lambda random, end_ns: _frames(hooks.drop)),
    Fault(name="camera-gone", kind=Kind.OFF, must=Must.STOP, duration_s=HELD_S, recovery_s=0.3, event="source-failed",
          text="the driver reports that the camera is gone, and later that it is back",
          hooks=lambda random, end_ns: _frames(hooks.gone)),
    Fault(name="camera-blocks", kind=Kind.SLOW, must=Must.STOP, recovery_s=0.9,
          text="a read does not come back for 0.25 to 0.6 s: nothing else runs either",
          hooks=lambda random, end_ns: Hooks(stall=Stall(at=At.CAMERA, seconds=random.uniform(0.25, 0.6)))),
    Fault(name="camera-pauses", kind=Kind.INTERMITTENT, must=Must.HOLD, duration_s=(0.1, 0.27),
          text="no frame for 0.1 to 0.27 s", hooks=lambda random, end_ns: _frames(hooks.drop)),
    Fault(name="camera-drops-1", kind=Kind.INTERMITTENT, must=Must.NOTHING, duration_s=HELD_S,
          text="every other frame is lost",
          hooks=lambda random, end_ns: _frames(hooks.in_bursts(1, 1, hooks.drop))),
    Fault(name="camera-drops-2", kind=Kind.INTERMITTENT, must=Must.NOTHING, duration_s=HELD_S,
          text="two frames in a row are lost, again and again",
          hooks=lambda random, end_ns: _frames(hooks.in_bursts(2, random.randint(1, 5), hooks.drop))),
    Fault(name="camera-drops-3", kind=Kind.INTERMITTENT, must=Must.HOLD, duration_s=HELD_S, within_s=math.inf,
          text="three to ten frames in a row are lost, again and again",
          hooks=lambda random, end_ns: _frames(
              hooks.in_bursts(random.randint(3, 10), random.randint(3, 8), hooks.drop))),
    Fault(name="camera-flaps", kind=Kind.INTERMITTENT, must=Must.STOP, duration_s=(3.5, 3.5), within_s=FLAPS_S,
          holds_first=True, text="six frames in a row are lost, again and again: a stop with the 13th hold in 10 s",
          hooks=lambda random, end_ns: _frames(hooks.in_bursts(6, random.randint(4, 6), hooks.drop))),
    Fault(name="camera-stuck", kind=Kind.STUCK, must=Must.STOP, duration_s=HELD_S, both_eyes=True,
          text="the same image again and again, with new times",
          hooks=lambda random, end_ns: _frames(hooks.frozen())),
    Fault(name="camera-black", kind=Kind.GARBAGE, must=Must.STOP, duration_s=HELD_S, both_eyes=True,
          text="black images with sensor noise",
          hooks=lambda random, end_ns: _frames(hooks.blank(2.0, 2.0, random))),
    Fault(name="camera-white", kind=Kind.GARBAGE, must=Must.STOP, duration_s=HELD_S, both_eyes=True,
          text="white images", hooks=lambda random, end_ns: _frames(hooks.blank(255.0, 2.0, random))),
    Fault(name="camera-flat", kind=Kind.GARBAGE, must=Must.STOP, duration_s=HELD_S, both_eyes=True,
          text="images of one grey level with sensor noise",
          hooks=lambda random, end_ns: _frames(
              hooks.blank(random.uniform(20.0, 230.0), random.uniform(0.0, 4.0), random))),
    Fault(name="camera-size", kind=Kind.WRONG, must=Must.STOP, duration_s=HELD_S, text="images of another size",
          hooks=lambda random, end_ns: _frames(hooks.resized(random))),
    Fault(name="camera-type", kind=Kind.WRONG, must=Must.STOP, duration_s=HELD_S, recovery_s=0.3, event="source-failed",
          text="images of another type",
          hooks=lambda random, end_ns: _frames(hooks.of_another_type)),
    Fault(name="camera-blinks", kind=Kind.INTERMITTENT, must=Must.HOLD, duration_s=(0.1, 0.1),
          text="one or two images are blank, frozen or of another size",
          hooks=lambda random, end_ns: Hooks(camera=_one_wrong_image(random))),
    Fault(name="camera-time-jumps", kind=Kind.WRONG, must=Must.STOP, duration_s=HELD_S,
          text="the times of the frames jump back or ahead by 0.1 to 2 s",
          hooks=lambda random, end_ns: _frames(hooks.shifted_in_time(_time_jump(random)))),
    Fault(name="camera-time-once", kind=Kind.INTERMITTENT, must=Must.HOLD, duration_s=(0.1, 0.1),
          text="one frame has another time",
          hooks=lambda random, end_ns: _frames(hooks.for_first(1, hooks.shifted_in_time(_time_jump(random))))),
    Fault(name="camera-late", kind=Kind.DELAYED, must=Must.STOP, duration_s=HELD_S, recovery_s=0.4,
          text="frames come 65 to 150 ms after they were taken",
          hooks=lambda random, end_ns: Hooks(camera=_late(random, *random.choice(((65, 90), (90, 150)))))),
    Fault(name="camera-jitter", kind=Kind.DELAYED, must=Must.NOTHING, duration_s=HELD_S,
          text="frames come 4 to 25 ms after they were taken",
          hooks=lambda random, end_ns: Hooks(camera=_late(random, 4, 25))),
)  # fmt: skip


FRAME_NS = round(1e9 / CameraConfig().rate_hz)  # from one frame to the next


def _of_one_eye(random: Random, spoil: hooks.Spoil) -> Hooks:
    return Hooks(pair=hooks.of_eye(random.randrange(2), spoil))


RIG_S = (2.5, 3.5)  # a car that is well is armed and drives off within 1 s


def _rig_turned(random: Random) -> Hooks:
    """One of the eyes, about one of its axes."""
    angle, by_deg = random.choice(("yaw_rad", "pitch_rad", "roll_rad")), random.uniform(1.0, 2.0)
    return Hooks(rig=hooks.eye_turned(random.randrange(2), angle, random.choice((-1, 1)) * math.radians(by_deg)))


# One eye that gives no image, or one that is dark or stuck, leaves the other one alone. Pairs whose images cannot be a
# pair are another matter: a source that says that both eyes work, and gives what they cannot have seen together, is not
# believed. A pair that is not the calibrated one is refused before the car is armed, where it shows (`rig-`); while it
# drives only the ground plane tells, not always: what comes of that is reported.
PAIR = (
    Fault(name="pair-off", kind=Kind.OFF, must=Must.NOTHING, duration_s=(0.5, 4.0), pairs=True, event="camera-missing",
          text="no image of one of two cameras comes: those of the other one come alone",
          hooks=lambda random, end_ns: Hooks(pair=hooks.alone(random.randrange(2), FRAME_NS, LATENCY_NS))),
    Fault(name="pair-stuck", kind=Kind.STUCK, must=Must.NOTHING, duration_s=(0.5, 4.0), pairs=True,
          event="camera-missing", text="the same image of one of two cameras again and again, beside new ones",
          hooks=lambda random, end_ns: _of_one_eye(random, hooks.frozen())),
    Fault(name="pair-dark", kind=Kind.GARBAGE, must=Must.NOTHING, duration_s=(0.5, 4.0), pairs=True,
          event="camera-missing", text="black images with sensor noise of one of two cameras",
          hooks=lambda random, end_ns: _of_one_eye(random, hooks.blank(2.0, 2.0, random))),
    Fault(name="pair-times", kind=Kind.WRONG, must=Must.STOP, duration_s=HELD_S, pairs=True,
          text="the right image of each pair is one to six frames older than the left one",
          hooks=lambda random, end_ns: Hooks(pair=hooks.falling_apart(random.randint(1, 6)))),
    Fault(name="pair-swapped", kind=Kind.WRONG, must=Must.STAY, duration_s=(0.5, 4.0), outside_m=math.inf,
          pairs=True, text="the left image is the right camera's, and the other way round",
          hooks=lambda random, end_ns: Hooks(pair=hooks.exchanged)),
    Fault(name="pair-turned", kind=Kind.WRONG, must=Must.STAY, duration_s=(0.5, 4.0), outside_m=math.inf,
          pairs=True, text="one of two cameras is turned about its optical axis by 1 to 5 degrees",
          hooks=lambda random, end_ns: _of_one_eye(
              random, hooks.turned(random.choice((-1, 1)) * math.radians(random.uniform(1.0, 5.0))))),
    Fault(name="rig-swapped", kind=Kind.WRONG, must=Must.REFUSE, duration_s=RIG_S, pairs=True, from_start=True,
          text="the left camera is the right one, and the right one the left one, before the car is armed",
          hooks=lambda random, end_ns: Hooks(rig=lambda eyes: eyes[::-1])),
    Fault(name="rig-turned", kind=Kind.WRONG, must=Must.STAY, duration_s=RIG_S, pairs=True, from_start=True,
          outside_m=0.1,
          text="one of two cameras is turned by 1 to 2 degrees against car.toml before the car is armed: refused,"
          " stopped, or taken in by the ground plane",
          hooks=lambda random, end_ns: _rig_turned(random)),
)  # fmt: skip


def _not_finite(random: Random) -> LaneHook:
    field = random.choice(("offset_m", "heading_rad", "width_m", "curvature_per_m"))
    return hooks.with_pose(**{field: random.choice((math.nan, math.inf, -math.inf))})


def _blip(random: Random) -> LaneHook:
    wrong = (hooks.raising, hooks.without_pose, _not_finite(random))
    return hooks.for_first(random.randint(1, 3), random.choice(wrong))


def _decoy(random: Random) -> LaneHook:
    return hooks.decoy(random.choice((-1, 1)) * random.uniform(0.25, 0.5))


def _jump_after_coasting(random: Random) -> LaneHook:
    sure, wrong = hooks.uncertain(0.03), _decoy(random)
    return hooks.after(
        random.randint(3, round(COASTED_S * 60.0)),
        lambda estimate: sure(hooks.coasting(estimate)),
        lambda estimate: sure(wrong(estimate)),
    )


def _crossing(random: Random) -> LaneHook:
    return hooks.crossing(random.choice((-1, 1)) * random.uniform(0.9, 1.5))


PERCEPTION = (
    Fault(name="perception-exception", kind=Kind.OFF, must=Must.STOP, duration_s=HELD_S, event="fault",
          text="the pipeline raises an exception", hooks=lambda random, end_ns: Hooks(lane=hooks.raising)),
    Fault(name="perception-not-finite", kind=Kind.GARBAGE, must=Must.STOP, duration_s=HELD_S, event="fault",
          text="a value of the lane's pose is NaN or infinite",
          hooks=lambda random, end_ns: Hooks(lane=_not_finite(random))),
    Fault(name="perception-blip", kind=Kind.INTERMITTENT, must=Must.HOLD, duration_s=(0.1, 0.1), event="fault",
          text="up to three estimates fail in any of these ways",
          hooks=lambda random, end_ns: Hooks(lane=_blip(random))),
    Fault(name="perception-decoy", kind=Kind.WRONG, must=Must.STOP, duration_s=(0.5, 0.9), recovery_s=OTHER_LANE_S,
          text="a line 0.25 to 0.5 m beside it is taken for the lane's",
          hooks=lambda random, end_ns: Hooks(lane=_decoy(random))),
    Fault(name="perception-jump", kind=Kind.WRONG, must=Must.STOP, duration_s=(1.0, 1.2), recovery_s=OTHER_LANE_S,
          within_s=COASTED_S + BOUND_S, text="no line for up to 0.25 s, then a line 0.25 to 0.5 m beside it",
          hooks=lambda random, end_ns: Hooks(lane=_jump_after_coasting(random))),
    Fault(name="perception-width", kind=Kind.WRONG, must=Must.STOP, duration_s=HELD_S,
          text="a lane narrower than the car, or 15 times as wide as it is",
          hooks=lambda random, end_ns: Hooks(lane=hooks.times_width(random.choice((0.2, 15.0))))),
    Fault(name="perception-one-line", kind=Kind.OFF, must=Must.NOTHING, duration_s=(2.0, 4.0),
          text="one of the lines is seen for 2 to 4 s", hooks=lambda random, end_ns: Hooks(lane=hooks.one_line)),
    Fault(name="perception-crossing", kind=Kind.WRONG, must=Must.STOP, duration_s=(0.5, 0.9), recovery_s=OTHER_LANE_S,
          text="a line across the road is taken for the lane's",
          hooks=lambda random, end_ns: Hooks(lane=_crossing(random))),
    Fault(name="perception-wrong-short", kind=Kind.INTERMITTENT, must=Must.HOLD, duration_s=(0.02, 0.2),
          text="a line beside or across the road is taken for the lane's, for 0.02 to 0.2 s",
          hooks=lambda random, end_ns: Hooks(lane=random.choice((_decoy, _crossing))(random))),
    Fault(name="perception-lost", kind=Kind.OFF, must=Must.STOP, duration_s=(0.4, 5.0), text="no lane for 0.4 to 5 s",
          hooks=lambda random, end_ns: Hooks(lane=hooks.lost)),
    Fault(name="perception-lost-short", kind=Kind.INTERMITTENT, must=Must.HOLD, duration_s=(0.1, 0.25),
          text="no lane for 0.1 to 0.25 s", hooks=lambda random, end_ns: Hooks(lane=hooks.lost)),
    # A car at rest is well where it is known which lane it stands in, as it is by the smaller of these bounds.
    Fault(name="perception-uncertain", kind=Kind.WRONG, must=Must.STOP, duration_s=(3.0, 3.5), within_s=UNCERTAIN_S,
          host_notices=False, text="the offset's bound grows beyond the free space beside the car",
          hooks=lambda random, end_ns: Hooks(lane=hooks.uncertain(random.uniform(0.12, 0.5)))),
    Fault(name="perception-uncertain-short", kind=Kind.INTERMITTENT, must=Must.NOTHING, duration_s=(0.2, 1.2),
          text="the offset's bound is beyond the free space beside the car for 0.2 to 1.2 s",
          hooks=lambda random, end_ns: Hooks(lane=hooks.uncertain(random.uniform(0.12, 0.5)))),
    Fault(name="perception-coasts", kind=Kind.WRONG, must=Must.NOTHING, duration_s=HELD_S,
          text="no line is seen, but the pipeline predicts the lane",
          hooks=lambda random, end_ns: Hooks(lane=hooks.coasting)),
)  # fmt: skip


def _stalled(random: Random, seconds: float) -> Hooks:
    return Hooks(stall=Stall(at=random.choice((At.PIPELINE, At.AFTER)), seconds=seconds))


def _impossible(random: Random) -> PulseHook:
    wrong_us = random.choice((0.0, 499.5, 2500.5, 32767.5))
    return lambda servo_us, motor_us: (servo_us, wrong_us) if random.random() < 0.5 else (wrong_us, motor_us)


def _extreme_twice(random: Random) -> PulseHook:
    extreme_us = (random.choice((500.0, 2500.0)), random.choice((1600.0, 2500.0)))
    left = [extreme_us] * 2  # a single one might be followed by a good one in the same servo frame
    return lambda servo_us, motor_us: left.pop() if left else (servo_us, motor_us)


def _sliding(random: Random, end_ns: int, seconds: float, rate_px: tuple[float, float], most_px: float) -> Hooks:
    """Sliding at a rate [px/s] for `seconds`, up to `most_px` at most."""
    start_ns, rate = end_ns - round(seconds * 1e9), random.choice((-1, 1)) * random.uniform(*rate_px)
    return _frames(hooks.sliding(lambda t_ns: min(max(rate * (t_ns - start_ns) * 1e-9, -most_px), most_px)))


NETWORK = (
    Fault(name="network-slides", kind=Kind.WRONG, must=Must.STAY, duration_s=(2.0, 2.0), images=True, outside_m=0.02,
          text="the network's mask slides sideways by 2 to 20 px a second, up to 5 px, 1.2 degrees of the view",
          hooks=lambda random, end_ns: _sliding(random, end_ns, 2.0, (2.0, 20.0), 5.0)),
    Fault(name="network-jumps", kind=Kind.WRONG, must=Must.STAY, duration_s=(1.0, 1.0), images=True,
          outside_m=0.2, text="the network's mask slides by 100 to 400 px a second, up to 80 px, 18 degrees",
          hooks=lambda random, end_ns: _sliding(random, end_ns, 1.0, (100.0, 400.0), 80.0)),
    Fault(name="network-adds", kind=Kind.WRONG, must=Must.STAY, duration_s=(0.5, 2.0), images=True, outside_m=0.1,
          text="the network sees one to four lines that are not there",
          hooks=lambda random, end_ns: _frames(hooks.with_lines(random, random.randint(1, 4)))),
)  # fmt: skip


FLOOR = (
    Fault(name="slip-wet", kind=Kind.WRONG, must=Must.NOTHING, duration_s=(1.5, 2.5),
          text="a wet floor: the car turns by 10 to 25 % less than it is steered",
          hooks=lambda random, end_ns: Hooks(slip=Grip(share=random.uniform(0.75, 0.9)))),
    Fault(name="slip-slides", kind=Kind.WRONG, must=Must.STOP, duration_s=(3.0, 3.0), within_s=0.45, ends=False,
          timed_from_motion=True,
          text="ice: tyres hold 0.05 to 0.2 m/s^2: a stop within 0.45 s of the car not turning as it is steered",
          hooks=lambda random, end_ns: Hooks(slip=Grip(lateral_max_mps2=random.uniform(0.05, 0.2)))),
)  # fmt: skip


LOOP = (
    Fault(name="loop-overrun", kind=Kind.SLOW, must=Must.NOTHING, duration_s=SHORT_S,
          text="every frame takes 20 to 35 ms of work",
          hooks=lambda random, end_ns: Hooks(
              stall=Stall(at=At.PIPELINE, seconds=random.uniform(0.020, 0.035), again=True))),
    Fault(name="loop-stall", kind=Kind.SLOW, must=Must.STOP, recovery_s=1.0,
          text="the loop stands still for 0.2 to 0.4 s, in the pipeline or after the command",
          hooks=lambda random, end_ns: _stalled(random, random.uniform(0.2, 0.4))),
    Fault(name="loop-collector", kind=Kind.INTERMITTENT, must=Must.NOTHING, duration_s=(0.1, 0.1),
          text="a garbage collection of 10 to 40 ms after a command",
          hooks=lambda random, end_ns: Hooks(stall=Stall(at=At.AFTER, seconds=random.uniform(0.010, 0.040)))),
    Fault(name="loop-person-stops", kind=Kind.OFF, must=Must.STOP, recovery_s=0.1,
          text="a person asks for a stop, as on the run's page",
          hooks=lambda random, end_ns: Hooks(moments=((0.0, Moment.PERSON_STOPS),))),
    Fault(name="loop-stop-request", kind=Kind.OFF, must=Must.STOP, ends=False, event="end",
          text="SIGINT, SIGTERM or SIGHUP: neutral, disarmed, and the run has ended",
          hooks=lambda random, end_ns: Hooks(moments=((0.0, Moment.STOP_REQUEST),))),
)  # fmt: skip

BOARD = (
    Fault(name="board-brown-out", kind=Kind.OFF, must=Must.STOP, recovery_s=BOOT_S,
          text="the board's supply dips: it restarts",
          hooks=lambda random, end_ns: Hooks(moments=((0.0, Moment.BROWN_OUT),))),
    Fault(name="board-hang", kind=Kind.STUCK, must=Must.STOP, recovery_s=BOOT_S,
          text="the board's program hangs until its watchdog restarts it",
          hooks=lambda random, end_ns: Hooks(moments=((0.0, Moment.HANG),))),
    Fault(name="board-restart", kind=Kind.INTERMITTENT, must=Must.STOP, recovery_s=BOOT_S,
          text="the board is reset while the car drives",
          hooks=lambda random, end_ns: Hooks(moments=((0.0, Moment.RESTART),))),
    Fault(name="command-impossible", kind=Kind.GARBAGE, must=Must.STOP, duration_s=(0.2, 0.6), recovery_s=0.3,
          host_notices=False, text="commands with impossible pulses",
          hooks=lambda random, end_ns: Hooks(pulses=_impossible(random))),
    Fault(name="command-extreme", kind=Kind.WRONG, must=Must.NOTHING, duration_s=(0.1, 0.1),
          text="two commands far beyond the car's limits: the board limits them",
          hooks=lambda random, end_ns: Hooks(pulses=_extreme_twice(random))),
    Fault(name="board-time-stuck", kind=Kind.STUCK, must=Must.STOP, duration_s=SERIAL_S, recovery_s=HEARD_S,
          within_s=BOUND_S + STATUS_S,
          text="the board's messages come, but its time in them stands still",
          hooks=lambda random, end_ns: Hooks(from_board=hooks.time_stuck())),
    Fault(name="servo-stuck", kind=Kind.STUCK, must=Must.STOP, duration_s=(3.0, 3.0), within_s=0.45, ends=False,
          timed_from_motion=True,
          text="the servo does not move: a stop within 0.45 s of the car not turning as it is steered",
          hooks=lambda random, end_ns: Hooks(servo_stuck=True)),
    Fault(name="battery-low", kind=Kind.WRONG, must=Must.NOTHING, duration_s=(1.5, 1.5), event="vehicle-fault",
          text="the battery is nearly empty: a person is warned",
          hooks=lambda random, end_ns: Hooks(sensors=hooks.battery(random.uniform(5.0, 6.3)))),
    Fault(name="sonar-dropouts", kind=Kind.INTERMITTENT, must=Must.NOTHING, duration_s=SHORT_S,
          text="ultrasonic readings without an echo",
          hooks=lambda random, end_ns: Hooks(sensors=hooks.dropouts(random, random.uniform(0.1, 0.9)))),
    Fault(name="sonar-spikes", kind=Kind.GARBAGE, must=Must.NOTHING, duration_s=SHORT_S,
          text="an ultrasonic reading of 2 to 30 cm, every third at most",
          hooks=lambda random, end_ns: Hooks(sensors=hooks.spikes(random, random.randint(3, 10)))),
    Fault(name="sonar-stuck", kind=Kind.STUCK, must=Must.HOLD, duration_s=SHORT_S,
          text="an ultrasonic echo of 2 to 30 cm that stays",
          hooks=lambda random, end_ns: Hooks(sensors=hooks.stuck_echo(random.uniform(0.02, 0.3)))),
)  # fmt: skip

RECORDING = (
    Fault(name="disk-full", kind=Kind.OFF, must=Must.NOTHING, duration_s=(0.3, 0.3), same_pulses=True,
          text="no space is left for the recording: its thread gets the error, or the loop does",
          hooks=lambda random, end_ns: Hooks(disk=random.choice((Disk.FULL, Disk.RAISES)))),
    Fault(name="disk-slow", kind=Kind.SLOW, must=Must.NOTHING, duration_s=(0.3, 0.3), same_pulses=True,
          text="the disk writes nothing before the run is over", hooks=lambda random, end_ns: Hooks(disk=Disk.SLOW)),
    Fault(name="clock-set-back", kind=Kind.WRONG, must=Must.NOTHING, duration_s=(0.3, 0.3), same_pulses=True,
          text="the wall clock is set back by an hour: only the monotonic one counts",
          hooks=lambda random, end_ns: Hooks(moments=((0.0, Moment.WALL_CLOCK_BACK),))),
)  # fmt: skip


def _either_direction(random: Random, hook: WireHook) -> Hooks:
    return Hooks(to_board=hook) if random.random() < 0.5 else Hooks(from_board=hook)


def _replugged(random: Random, end_ns: int) -> Hooks:
    out_s = random.uniform(0.02, 0.5)
    return Hooks(moments=((0.0, Moment.UNPLUG), (out_s, Moment.REPLUG)))


def _other_firmware(random: Random, end_ns: int) -> Hooks:
    out_s = random.uniform(0.05, 0.4)
    return Hooks(moments=((0.0, Moment.UNPLUG), (out_s, Moment.OTHER_FIRMWARE), (out_s, Moment.REPLUG)))


def _falling_behind(random: Random, end_ns: int) -> Hooks:
    return Hooks(to_board=hooks.falling_behind(end_ns - 500_000_000, random.uniform(1.0, 2.0)))


SERIAL = (
    Fault(name="serial-unplugged", kind=Kind.OFF, must=Must.STOP, ends=False, event="link-lost",
          text="the cable is unplugged", hooks=lambda random, end_ns: Hooks(moments=((0.0, Moment.UNPLUG),))),
    Fault(name="serial-replugged", kind=Kind.INTERMITTENT, must=Must.STOP, duration_s=(0.5, 0.5), recovery_s=REOPENED_S,
          event="link-lost", text="the cable is unplugged and plugged in again", hooks=_replugged),
    Fault(name="serial-other-firmware", kind=Kind.WRONG, must=Must.STOP, ends=False, event="link-lost",
          text="the board that is plugged in again has another message table", hooks=_other_firmware),
    Fault(name="serial-deaf", kind=Kind.OFF, must=Must.STOP, duration_s=SERIAL_S, recovery_s=HEARD_S,
          host_notices=False, text="nothing arrives at the board",
          hooks=lambda random, end_ns: Hooks(to_board=hooks.silent)),
    Fault(name="serial-mute", kind=Kind.OFF, must=Must.STOP, duration_s=SERIAL_S, recovery_s=HEARD_S,
          text="nothing comes from the board", hooks=lambda random, end_ns: Hooks(from_board=hooks.silent)),
    Fault(name="serial-backlog", kind=Kind.STUCK, must=Must.STOP, duration_s=SERIAL_S, recovery_s=HEARD_S,
          host_notices=False, text="nothing is read at one end; later all that has waited arrives at once",
          hooks=lambda random, end_ns: _either_direction(random, hooks.held_back(end_ns))),
    Fault(name="serial-noise", kind=Kind.GARBAGE, must=Must.NOTHING, duration_s=(0.3, 1.0),
          text="up to 60 random bytes ahead of each frame to the board",
          hooks=lambda random, end_ns: Hooks(to_board=hooks.noise_before(random, 60))),
    Fault(name="serial-random", kind=Kind.GARBAGE, must=Must.STOP, duration_s=SERIAL_S, recovery_s=HEARD_S,
          host_notices=False, text="nothing but random bytes",
          hooks=lambda random, end_ns: _either_direction(random, hooks.random_bytes(random))),
    Fault(name="serial-cut", kind=Kind.GARBAGE, must=Must.STOP, duration_s=SERIAL_S, recovery_s=HEARD_S,
          host_notices=False, text="every frame to the board is cut",
          hooks=lambda random, end_ns: Hooks(to_board=hooks.cut(random))),
    Fault(name="serial-doubled", kind=Kind.WRONG, must=Must.NOTHING, duration_s=(0.3, 1.0),
          text="every frame to the board comes twice", hooks=lambda random, end_ns: Hooks(to_board=hooks.doubled)),
    Fault(name="serial-swapped", kind=Kind.WRONG, must=Must.NOTHING, duration_s=(0.3, 1.0),
          text="frames to the board come in another order",
          hooks=lambda random, end_ns: Hooks(to_board=hooks.swapped())),
    Fault(name="serial-delayed", kind=Kind.DELAYED, must=Must.STOP, duration_s=(0.3, 0.6), recovery_s=1.2,
          host_notices=False, text="everything comes 0.12 to 0.5 s later, in one direction",
          hooks=lambda random, end_ns: _either_direction(random, hooks.delayed(round(random.uniform(0.12e9, 0.5e9))))),
    Fault(name="serial-falls-behind", kind=Kind.DELAYED, must=Must.STOP, duration_s=(0.5, 0.5), within_s=0.35,
          recovery_s=1.3, host_notices=False,
          text="frames to the board come later and later, by 1 to 2 s a second: a stop within 0.35 s",
          hooks=_falling_behind),
    Fault(name="serial-late", kind=Kind.DELAYED, must=Must.NOTHING, duration_s=(0.3, 1.0),
          text="everything comes 20 to 50 ms later, in one direction",
          hooks=lambda random, end_ns: _either_direction(random, hooks.delayed(round(random.uniform(20e6, 50e6))))),
    Fault(name="serial-crc", kind=Kind.GARBAGE, must=Must.STOP, duration_s=(0.1, 0.1), recovery_s=HEARD_S,
          host_notices=False, text="wrong bits in every frame to the board for 100 ms",
          hooks=lambda random, end_ns: Hooks(to_board=hooks.corrupt(random))),
    Fault(name="serial-byte", kind=Kind.INTERMITTENT, must=Must.NOTHING, duration_s=(0.1, 0.1),
          text="one wrong byte, or one frame cut",
          hooks=lambda random, end_ns: _either_direction(
              random, random.choice((hooks.one_byte(random), hooks.once(hooks.cut(random)))))),
)  # fmt: skip


def _wrong(**changes: object) -> Hooks:
    """These of the bus's misbehaviours."""

    def hook(vehicle: EmulatedCanVehicle) -> None:
        for name, value in changes.items():
            setattr(vehicle.wrong, name, value)

    return Hooks(can=hook)


def _override(random: Random) -> Hooks:
    what, value = random.choice(
        (("torque_nm", random.choice((-1, 1)) * random.uniform(3.1, 20.0)), ("brake", True),
         ("accelerator", random.uniform(0.06, 1.0)), ("gear", random.choice("PRN")))
    )  # fmt: skip

    def hook(vehicle: EmulatedCanVehicle) -> None:
        vehicle.wrong.ignores_driver = True
        setattr(vehicle.driver, what, value)

    return Hooks(can=hook)


def _restarted(vehicle: EmulatedCanVehicle) -> None:
    vehicle.restart()
    vehicle.wrong.missing = set(MESSAGES)


def _once(random: Random) -> Hooks:
    name = random.choice(MESSAGES)
    wrong: tuple[dict[str, object], ...] = (
        {"missing": {name}}, {"bad_checksum": {name}}, {"longer_by": {name: -1}}, {"jumping_counter": {name}}
    )  # fmt: skip
    return _wrong(**random.choice(wrong))


MESSAGES = ("AM_STATE", "AM_DRIVER", "AM_HEARTBEAT")
STATE = MESSAGES[:1]
CYCLE_S = 0.02  # of the loop, and of the command
TURN_S = CYCLE_S + LATENCY_NS * 1e-9  # at most until the loop has looked, and its command has arrived
MISSED_S = 3 * 0.01 + TURN_S  # AM_STATE stays away, or three of its frames are bad
SLOW_S = 3 * 0.02 + TURN_S  # the same of the messages of 50 Hz
LET_GO_S = COMMAND_TIMEOUT_NS * 1e-9  # the vehicle lets go by itself when nothing reaches it
BUS_S = (0.2, 0.6)
REJOINED_S = 0.7  # a bus that is joined again, and every message good; a counter's fault ends after ten good frames
CAN = (
    Fault(name="can-bus-off", kind=Kind.OFF, must=Must.STOP, duration_s=BUS_S, within_s=LET_GO_S, recovery_s=REJOINED_S,
          event="link-lost", text="the controller leaves the bus (bus-off), and joins it again later",
          hooks=lambda random, end_ns: _wrong(trouble=BusTrouble.OFF)),
    Fault(name="can-error-passive", kind=Kind.OFF, must=Must.STOP, duration_s=BUS_S, within_s=LET_GO_S,
          recovery_s=REJOINED_S, text="the controller is error-passive, and no frame comes through",
          hooks=lambda random, end_ns: _wrong(trouble=BusTrouble.PASSIVE)),
    Fault(name="can-wrong-bitrate", kind=Kind.GARBAGE, must=Must.STOP, duration_s=BUS_S, within_s=LET_GO_S,
          recovery_s=REJOINED_S, text="nothing but error frames, as from a node of another bit rate",
          hooks=lambda random, end_ns: _wrong(trouble=BusTrouble.ERROR)),
    Fault(name="can-queue-full", kind=Kind.STUCK, must=Must.STOP, duration_s=BUS_S, within_s=LET_GO_S,
          recovery_s=REJOINED_S, event="link-lost", text="no frame can be sent: the queue is full",
          hooks=lambda random, end_ns: _wrong(queue_full=True)),
    Fault(name="can-flooded", kind=Kind.GARBAGE, must=Must.STOP, duration_s=BUS_S, within_s=LET_GO_S,
          recovery_s=REJOINED_S, text="frames of the highest priority fill the bus: no others come through",
          hooks=lambda random, end_ns: _wrong(flooded=True)),
    Fault(name="can-full-load", kind=Kind.SLOW, must=Must.NOTHING, duration_s=BUS_S,
          text="frames of the lowest priority fill the bus",
          hooks=lambda random, end_ns: _wrong(load_frames=FULL_LOAD_FRAMES)),
    Fault(name="can-state-missing", kind=Kind.OFF, must=Must.STOP, duration_s=BUS_S, within_s=MISSED_S,
          recovery_s=REJOINED_S, text="the vehicle's state does not come",
          hooks=lambda random, end_ns: _wrong(missing=set(STATE))),
    Fault(name="can-missing", kind=Kind.OFF, must=Must.STOP, duration_s=BUS_S, within_s=SLOW_S, recovery_s=REJOINED_S,
          text="the driver's message or the heartbeat does not come",
          hooks=lambda random, end_ns: _wrong(missing={random.choice(MESSAGES[1:])})),
    Fault(name="can-counter-stuck", kind=Kind.STUCK, must=Must.STOP, duration_s=BUS_S, within_s=SLOW_S,
          recovery_s=REJOINED_S, text="a message's counter stands still",
          hooks=lambda random, end_ns: _wrong(stuck_counter={random.choice(MESSAGES)})),
    Fault(name="can-counter-jumps", kind=Kind.WRONG, must=Must.STOP, duration_s=BUS_S, within_s=SLOW_S,
          recovery_s=REJOINED_S, text="a message's counter jumps again and again",
          hooks=lambda random, end_ns: _wrong(jumping_counter={random.choice(MESSAGES)})),
    Fault(name="can-checksum", kind=Kind.GARBAGE, must=Must.STOP, duration_s=BUS_S, within_s=SLOW_S,
          recovery_s=REJOINED_S, text="a message's checksum is wrong",
          hooks=lambda random, end_ns: _wrong(bad_checksum={random.choice(MESSAGES)})),
    Fault(name="can-short", kind=Kind.WRONG, must=Must.STOP, duration_s=BUS_S, within_s=SLOW_S, recovery_s=REJOINED_S,
          text="a message is 1 to 8 bytes shorter",
          hooks=lambda random, end_ns: _wrong(longer_by={random.choice(MESSAGES): -random.randint(1, 8)})),
    Fault(name="can-long", kind=Kind.WRONG, must=Must.STOP, duration_s=BUS_S, within_s=SLOW_S, recovery_s=REJOINED_S,
          text="a message is 1 to 56 bytes longer",
          hooks=lambda random, end_ns: _wrong(longer_by={random.choice(MESSAGES): random.randint(1, 56)})),
    Fault(name="can-stale", kind=Kind.STUCK, must=Must.STOP, duration_s=BUS_S, within_s=MISSED_S,
          recovery_s=REJOINED_S, text="the vehicle's state is the same frame again and again",
          hooks=lambda random, end_ns: _wrong(frozen=set(STATE))),
    Fault(name="can-range", kind=Kind.WRONG, must=Must.STOP, duration_s=BUS_S, within_s=MISSED_S,
          recovery_s=REJOINED_S, text="speed, yaw rate or steering angle is out of range",
          hooks=lambda random, end_ns: _wrong(offset=random.choice(
              ({"speed_mps": 90.0}, {"yaw_rate_radps": 3.2}, {"steering_rad": -1.2})))),
    Fault(name="can-quality", kind=Kind.WRONG, must=Must.STOP, duration_s=BUS_S, within_s=0.01 + TURN_S,
          recovery_s=REJOINED_S, text="the vehicle says that its state is invalid",
          hooks=lambda random, end_ns: _wrong(invalid=set(STATE))),
    Fault(name="can-second-sender", kind=Kind.WRONG, must=Must.STOP, duration_s=BUS_S, within_s=0.01 + TURN_S,
          recovery_s=REJOINED_S, text="somebody else sends our command",
          hooks=lambda random, end_ns: _wrong(second_sender=True)),
    Fault(name="can-restart", kind=Kind.INTERMITTENT, must=Must.STOP, duration_s=BUS_S, within_s=SLOW_S,
          recovery_s=REJOINED_S, text="the vehicle's controller restarts",
          hooks=lambda random, end_ns: Hooks(can=_restarted)),
    Fault(name="can-override", kind=Kind.WRONG, must=Must.STOP, duration_s=BUS_S, within_s=TURN_S,
          recovery_s=REJOINED_S, shown_by=("AM_DRIVER",),
          text="the driver acts, and only the host obeys: one cycle from the first frame that says so",
          hooks=lambda random, end_ns: _override(random)),
    Fault(name="can-disengaged", kind=Kind.OFF, must=Must.STOP, within_s=TURN_S, host_notices=False, shown_by=STATE,
          text="the vehicle lets go by itself: one cycle from the first frame that says so",
          hooks=lambda random, end_ns: Hooks(can=lambda vehicle: vehicle.refuse())),
    Fault(name="can-frame", kind=Kind.INTERMITTENT, must=Must.NOTHING, duration_s=(0.005, 0.015),
          text="one or two frames are missing or wrong", hooks=lambda random, end_ns: _once(random)),
)  # fmt: skip

NOMINAL = Fault(name="nominal", kind=Kind.NONE, must=Must.NOTHING, duration_s=(60.0, 60.0), anywhere=True,
                text="nothing goes wrong for a minute, on any track in any light (only when asked for)",
                hooks=lambda random, end_ns: Hooks())  # fmt: skip
# What the firmware on its chip is tried with; its sonars time echoes, whose faults are not those of single readings.
ON_CHIP = tuple(fault for fault in (*SERIAL, *BOARD) if not fault.name.startswith("sonar-"))
FAULTS = (*CAMERA, *PAIR, *PERCEPTION, *NETWORK, *FLOOR, *LOOP, *SERIAL, *BOARD, *RECORDING)
BY_LINK = {"arduino": FAULTS, "avr": ON_CHIP, "can": CAN}


class Named(Protocol):
    """What can be asked for by name."""

    @property
    def name(self) -> str:
        """The name."""
        ...


Fitting = TypeVar("Fitting", bound=Named)


def named(names: Iterable[str], faults: Sequence[Fitting]) -> tuple[Fitting, ...]:
    """The faults of these names, in the order of `faults`; raises ConfigError for an unknown one, with similar ones."""
    known = {fault.name: fault for fault in faults}
    asked = set(names)
    for name in sorted(asked - set(known)):
        close = difflib.get_close_matches(name, known, 3, 0.5) or [k for k in known if name in k][:3]
        hint = f"near: {', '.join(close)}" if close else "see --list"
        raise ConfigError(f"--only {name!r}: no such fault; {hint}")
    return tuple(fault for fault in known.values() if fault.name in asked)


def chosen(names: Iterable[str], images: bool = True, link: str | None = None, pairs: bool = True) -> tuple[Fault, ...]:
    """The faults of these names in the catalogue's order; without names those of `link`, or all but `nominal`.

    Raises ConfigError for an unknown name, with similar ones; and, where the pipeline looks at no `images`, or at none
    of `pairs` of cameras, for a fault that needs them.
    """
    asked, pairs = named(names, (*FAULTS, *CAN, NOMINAL)), pairs and images
    for fault in asked:
        if fault.images and not images:
            raise ConfigError(f"--only {fault.name!r}: needs a pipeline that looks at images")
        if fault.pairs and not pairs:
            raise ConfigError(f"--only {fault.name!r}: needs a pipeline of two cameras: --pipeline stereo")
    without = (*FAULTS, *CAN) if link is None else BY_LINK[link]
    return asked or tuple(fault for fault in without if (images or not fault.images) and (pairs or not fault.pairs))


_TIMED = (Must.STOP, Must.HOLD)


def listing(names: Iterable[str], real_time: bool = False) -> list[dict[str, object]]:
    """A row a fault: what it is, and what the car must do."""
    faults = (named(names, REAL_FAULTS) or REAL_FAULTS) if real_time else chosen(names)
    return [
        {
            "fault": fault.name,
            "kind": fault.kind.value,
            "must": fault.must.value,
            "within_ms": fault.within_s * 1e3 if fault.must in _TIMED and math.isfinite(fault.within_s) else None,
            "what": fault.text,
        }
        for fault in faults
    ]

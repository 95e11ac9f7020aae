"""The faults of the loop, of the board and what hangs on it, and of the recording."""

from __future__ import annotations

from random import Random

from automodel.bench.faults import sensors
from automodel.bench.faults.fault import Fault, Kind, Must
from automodel.bench.faults.hooks import At, Disk, Hooks, Moment, PulseHook, Stall

BOOT_S = 0.7  # until a board that has started again has taken the limits over
GO_S = (0.3, 0.8)


def _stalled(random: Random, seconds: float) -> Hooks:
    return Hooks(stall=Stall(at=random.choice((At.PIPELINE, At.AFTER)), seconds=seconds))


def _impossible(random: Random) -> PulseHook:
    wrong_us = random.choice((0.0, 499.5, 2500.5, 32767.5))
    return lambda servo_us, motor_us: (servo_us, wrong_us) if random.random() < 0.5 else (wrong_us, motor_us)


def _extreme_twice(random: Random) -> PulseHook:
    extreme_us = (random.choice((500.0, 2500.0)), random.choice((1600.0, 2500.0)))
    left = [extreme_us] * 2  # a single one might be followed by a good one in the same servo frame
    return lambda servo_us, motor_us: left.pop() if left else (servo_us, motor_us)


LOOP = (
    Fault(
        name="loop-overrun", kind=Kind.SLOW, must=Must.NOTHING, lasting_s=GO_S,
        text="every frame takes 20 to 35 ms of work",
        hooks=lambda random, end_ns: Hooks(
            stall=Stall(at=At.PIPELINE, seconds=random.uniform(0.020, 0.035), again=True)
        ),
    ),
    Fault(
        name="loop-stall", kind=Kind.SLOW, must=Must.STOP, recovery_s=1.0,
        text="the loop stands still for 0.1 to 0.4 s, while it sees or after it has sent",
        hooks=lambda random, end_ns: _stalled(random, random.uniform(0.1, 0.4)),
    ),
    Fault(
        name="loop-collector", kind=Kind.INTERMITTENT, must=Must.NOTHING, lasting_s=(0.1, 0.1),
        text="a garbage collection of 10 to 40 ms after a command",
        hooks=lambda random, end_ns: Hooks(stall=Stall(at=At.AFTER, seconds=random.uniform(0.010, 0.040))),
    ),
    Fault(
        name="loop-stop-request", kind=Kind.OFF, must=Must.STOP, ends=False, told="end",
        text="SIGINT, SIGTERM or SIGHUP: neutral, disarmed, and the run has ended",
        hooks=lambda random, end_ns: Hooks(moments=((0.0, Moment.STOP_REQUEST),)),
    ),
)  # fmt: skip

BOARD = (
    Fault(
        name="board-brown-out", kind=Kind.OFF, must=Must.STOP, recovery_s=BOOT_S,
        text="the board's supply dips: it starts again",
        hooks=lambda random, end_ns: Hooks(moments=((0.0, Moment.BROWN_OUT),)),
    ),
    Fault(
        name="board-hang", kind=Kind.STUCK, must=Must.STOP, recovery_s=BOOT_S,
        text="the board's program hangs until its watchdog starts it again",
        hooks=lambda random, end_ns: Hooks(moments=((0.0, Moment.HANG),)),
    ),
    Fault(
        name="board-restart", kind=Kind.INTERMITTENT, must=Must.STOP, recovery_s=BOOT_S,
        text="the board is reset while the car drives",
        hooks=lambda random, end_ns: Hooks(moments=((0.0, Moment.RESTART),)),
    ),
    Fault(
        name="command-impossible", kind=Kind.GARBAGE, must=Must.STOP, lasting_s=(0.2, 0.6), recovery_s=0.3,
        heard=False,
        text="commands whose pulses are none",
        hooks=lambda random, end_ns: Hooks(pulses=_impossible(random)),
    ),
    Fault(
        name="command-extreme", kind=Kind.WRONG, must=Must.NOTHING, lasting_s=(0.1, 0.1),
        text="two commands far beyond the car's limits: the board keeps them",
        hooks=lambda random, end_ns: Hooks(pulses=_extreme_twice(random)),
    ),
    Fault(
        name="servo-stuck", kind=Kind.STUCK, must=Must.STOP, lasting_s=(3.0, 3.0), within_s=0.45, ends=False,
        when_shown=True,
        text="the servo stays where it is: a stop within 0.45 s of the car not turning as it is steered",
        hooks=lambda random, end_ns: Hooks(servo_stuck=True),
    ),
    Fault(
        name="battery-low", kind=Kind.WRONG, must=Must.NOTHING, lasting_s=(1.5, 1.5), told="vehicle-fault",
        text="the battery is nearly empty: a person is told",
        hooks=lambda random, end_ns: Hooks(sensors=sensors.battery(random.uniform(5.0, 6.3))),
    ),
    Fault(
        name="sonar-dropouts", kind=Kind.INTERMITTENT, must=Must.NOTHING, lasting_s=GO_S,
        text="ultrasonic readings without an echo",
        hooks=lambda random, end_ns: Hooks(sensors=sensors.dropouts(random, random.uniform(0.1, 0.9))),
    ),
    Fault(
        name="sonar-spikes", kind=Kind.GARBAGE, must=Must.NOTHING, lasting_s=GO_S,
        text="an ultrasonic reading of 2 to 30 cm, every third at most",
        hooks=lambda random, end_ns: Hooks(sensors=sensors.spikes(random, random.randint(3, 10))),
    ),
    Fault(
        name="sonar-stuck", kind=Kind.STUCK, must=Must.HOLD, lasting_s=GO_S,
        text="an ultrasonic echo of 2 to 30 cm that stays",
        hooks=lambda random, end_ns: Hooks(sensors=sensors.stuck_echo(random.uniform(0.02, 0.3))),
    ),
)  # fmt: skip

RECORDING = (
    Fault(
        name="disk-full", kind=Kind.OFF, must=Must.NOTHING, lasting_s=(0.3, 0.3), the_same=True,
        text="no space is left for the recording: its own thread meets the error, or the loop does",
        hooks=lambda random, end_ns: Hooks(disk=random.choice((Disk.FULL, Disk.RAISES))),
    ),
    Fault(
        name="disk-slow", kind=Kind.SLOW, must=Must.NOTHING, lasting_s=(0.3, 0.3), the_same=True,
        text="the disk writes nothing before the run is over",
        hooks=lambda random, end_ns: Hooks(disk=Disk.SLOW),
    ),
    Fault(
        name="clock-set-back", kind=Kind.WRONG, must=Must.NOTHING, lasting_s=(0.3, 0.3), the_same=True,
        text="the wall clock is set back by an hour: only the monotonic one counts",
        hooks=lambda random, end_ns: Hooks(moments=((0.0, Moment.WALL_CLOCK_BACK),)),
    ),
)  # fmt: skip

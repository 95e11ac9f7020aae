"""Values of every kind that is recorded, made from a seed, and a recorder that is fed with them."""

from __future__ import annotations

import numpy as np

from automodel.curves import GraphCurve, JoinedCurve, TabulatedCurve, ThetaCurve
from automodel.recording.writer import McapRecorder
from automodel.signals import (
    Command,
    Crossing,
    DriverInput,
    Event,
    Frame,
    LaneEstimate,
    LaneLine,
    LanePose,
    LaneStatus,
    Motion,
    MotionSource,
    VehicleState,
)

CAR_TEXT = "[camera]\nwidth_px = 64\nheight_px = 36\n# a remark that stays\n"
SYNTHETIC_NS = 16_666_667


def make_frame(index: int, colour: bool = False) -> Frame:
    rng = np.random.default_rng(index)
    shape = (36, 64, 3) if colour else (36, 64)
    return Frame(t_ns=1_000_000_000 + index * SYNTHETIC_NS, index=index, image=rng.integers(0, 256, shape, np.uint8))


def make_motion(index: int) -> Motion:
    rng = np.random.default_rng(1000 + index)
    t_ns = 1_000_000_000 + index * SYNTHETIC_NS
    return Motion(t_ns=t_ns, speed_mps=rng.normal(), yaw_rate_radps=rng.normal(), source=MotionSource.MODEL)


def make_estimate(index: int) -> LaneEstimate:
    rng = np.random.default_rng(2000 + index)
    root = rng.normal(size=(3, 3))
    s = np.linspace(0.0, 1.2, 25)
    turn = np.linspace(0.0, 0.5, 25) * rng.normal()
    table = TabulatedCurve(s, np.stack((s + rng.normal(), rng.normal(size=25)), axis=1), turn, turn / 3.0)
    theta = ThetaCurve(rng.normal(), rng.normal(), rng.normal(size=4) * 0.3, 1.3)
    joined = JoinedCurve((theta, GraphCurve(rng.normal(size=3), 0.1, 0.9)))
    return LaneEstimate(
        t_ns=1_000_000_000 + index * SYNTHETIC_NS,
        status=LaneStatus.ONE_LINE,
        left=LaneLine(curve=table, points_m=rng.normal(size=(9, 2)), seen=True),
        right=LaneLine(curve=GraphCurve(rng.normal(size=3), 0.1, 1.7), points_m=np.empty((0, 2)), seen=False),
        centerline=joined,
        pose=LanePose(
            offset_m=rng.normal(),
            heading_rad=rng.normal(),
            width_m=0.1 + 0.2,
            curvature_per_m=-0.0,
            covariance=root @ root.T,
        ),
        crossing=Crossing(distance_m=rng.normal(), angle_rad=1e-300),
        frame_age_ns=int(rng.integers(10**9)),
        camera_pitch_rad=0.02 * rng.normal(),
    )


def make_command(index: int) -> Command:
    t_ns = 1_003_000_000 + index * SYNTHETIC_NS
    steering = float(np.random.default_rng(3000 + index).normal())
    return Command(t_ns=t_ns, steering_rad=steering, speed_mps=1.0, valid_until_ns=t_ns + 10**8)


def make_driver(index: int) -> DriverInput:
    steering, speed = np.random.default_rng(5000 + index).uniform(-1.0, 1.0, 2).tolist()
    return DriverInput(t_ns=1_002_500_000 + index * SYNTHETIC_NS, steering=steering, speed=speed)


def make_state(index: int) -> VehicleState:
    return VehicleState(
        t_ns=1_001_000_000 + index * SYNTHETIC_NS,
        speed_mps=1 / 3,
        steering_rad=-0.1,
        ranges_m=(None, 0.7, None),
        battery_v=7.4,
        armed=True,
        faults=("watchdog", "brown-out"),
        boot_id=4_000_000_000 + index,
    )


def make_event(index: int) -> Event:
    return Event(t_ns=1_002_000_000 + index * SYNTHETIC_NS, kind="hold", text=f'no frame "{index}" for 60 ms: µ')


def record_turn(recorder: McapRecorder, index: int) -> None:
    """One turn of a runner's loop."""
    recorder.frame(make_frame(index))
    recorder.motion(make_motion(index))
    recorder.state(make_state(index))
    recorder.estimate(make_estimate(index))
    recorder.command(make_command(index))

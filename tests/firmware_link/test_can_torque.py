"""Steering by torque: the loop on the measured angle, its limits, and the emulated vehicle that it turns."""

from __future__ import annotations

import dataclasses
import itertools
import math

import pytest

from automodel.assembly.can_parts import can_functions
from automodel.config import CanConfig, VehicleConfig
from automodel.config.can import CanCommand
from automodel.geometry.se2 import SE2
from automodel.signals import Command
from automodel.sim.full_size import FullSizeConfig, FullSizePlant
from automodel.sim.plant import CarState
from firmware_link.can_limits import DT_MAX_S, lateral_accel_mps2, limited_torque_nm
from firmware_link.can_link import CanLink
from firmware_link.can_receiver import load_dbc
from firmware_link.can_torque import TorqueSteering
from firmware_link.emulator.can_vehicle import Column, EmulatedCanVehicle, MemoryCanPort

MS = 1_000_000
USUAL = CanConfig()
SIGNALS = {"enable": "ENABLE", "torque_nm": "STEERING_TORQUE", "accel_mps2": "ACCELERATION_REQUEST"}
CONFIG = dataclasses.replace(
    USUAL,
    send=(dataclasses.replace(USUAL.send[0], name="AM_TORQUE", counter_signal="TORQUE_COUNTER"),),
    command=tuple(CanCommand(value=value, message="AM_TORQUE", signal=signal) for value, signal in SIGNALS.items()),
)
VEHICLE = VehicleConfig(wheelbase_m=2.65, reference_x_m=1.3, width_m=1.8)


class Body:
    """The car of the simulation."""

    def __init__(self, speed_mps: float) -> None:
        self.plant = FullSizePlant(FullSizeConfig(), SE2(), speed_mps)

    def drive(self, t_ns: int, steering_rad: float | None, accel_mps2: float) -> None:
        self.plant.demand(t_ns, steering_rad, accel_mps2)

    def measure(self, t_ns: int) -> CarState:
        return self.plant.predicted(t_ns)


class Rig:
    """Link and vehicle on one virtual clock, armed, at a speed."""

    def __init__(self, speed_mps: float) -> None:
        self.t_ns, self.speed_mps = 0, speed_mps
        database, functions = load_dbc(()), can_functions(CONFIG)
        self.body = Body(speed_mps)
        self.vehicle = EmulatedCanVehicle(self.body, database, CONFIG, functions)
        self.link = CanLink(MemoryCanPort(self.vehicle, self), database, CONFIG, VEHICLE, functions)
        self.link.open()
        for _ in range(5):
            self.cycle(0.0)
        self.link.arm(self.t_ns)
        for _ in range(50):
            self.cycle(0.0)
        assert self.vehicle.engaged

    def now_ns(self) -> int:
        return self.t_ns

    def cycle(self, steering_rad: float) -> CarState:
        self.t_ns += 20 * MS
        self.link.poll(self.t_ns)
        until_ns = self.t_ns + 100 * MS
        command = Command(t_ns=self.t_ns, steering_rad=steering_rad, speed_mps=self.speed_mps, valid_until_ns=until_ns)
        self.link.send(command, self.t_ns)
        return self.body.measure(self.t_ns)

    def torques(self) -> list[float]:
        return [told["torque_nm"] for _, told in self.vehicle.accepted]


@pytest.mark.parametrize("speed_mps", [5.0, 10.0, 15.0, 25.0])
@pytest.mark.parametrize("side", [-1, 1])
def test_the_wheels_come_to_the_wanted_angle_and_stay(speed_mps: float, side: int) -> None:
    rig = Rig(speed_mps)
    wanted = side * math.atan(1.2 * VEHICLE.wheelbase_m / speed_mps**2) if speed_mps > 5 else side * 0.05
    angles = [rig.cycle(wanted).steering_rad for _ in range(250)]
    assert angles[-100:] == pytest.approx([wanted] * 100, rel=0.05), "3 s later it is there, and does not swing"
    assert max(side * angle for angle in angles) < side * wanted * 1.15


def test_the_torque_is_limited_in_size_and_rate_whatever_is_wanted() -> None:
    rig = Rig(15.0)
    start = len(rig.torques())
    for index in range(300):
        rig.cycle(0.4 if index % 100 < 50 else -0.4)
    torques = rig.torques()[start:]
    resolution = 0.001
    assert max(map(abs, torques)) <= CONFIG.torque_max_nm
    steps = [abs(b - a) for a, b in itertools.pairwise(torques)]
    assert max(steps) <= CONFIG.torque_rate_max_nmps * 0.02 + resolution
    assert max(map(abs, torques)) > 1.5
    state = rig.body.measure(rig.t_ns)
    assert abs(lateral_accel_mps2(state.steering_rad, 15.0, VEHICLE.wheelbase_m)) < 3.0


def test_a_car_that_is_let_go_gets_no_torque() -> None:
    rig = Rig(15.0)
    for _ in range(100):
        rig.cycle(0.02)
    assert abs(rig.torques()[-1]) > 0.5
    rig.vehicle.driver.brake = True
    for _ in range(5):
        rig.cycle(0.02)
    assert rig.torques()[-1] == 0.0
    assert not rig.vehicle.engaged


def test_a_new_arming_starts_without_torque() -> None:
    rig = Rig(15.0)
    for _ in range(100):
        rig.cycle(0.02)
    assert rig.torques()[-1] > 0.5
    rig.link.disarm(rig.t_ns)
    for _ in range(10):
        rig.cycle(0.0)
    taken = len(rig.vehicle.accepted)
    rig.link.arm(rig.t_ns)
    for _ in range(3):
        rig.cycle(0.0)
    enabled = [told["torque_nm"] for _, told in rig.vehicle.accepted[taken:] if told["enable"]]
    assert enabled
    assert abs(enabled[0]) <= CONFIG.torque_rate_max_nmps * DT_MAX_S


@pytest.mark.parametrize("dt_s", [-1.0, 0.0, 0.01, 0.02, DT_MAX_S, 3.0])
@pytest.mark.parametrize("before_nm", [-3.0, -0.5, 0.0, 3.0])
@pytest.mark.parametrize("request_nm", [-50.0, -0.1, 0.0, 2.9, 50.0, math.nan, math.inf, -math.inf])
def test_torque_bounds_are_reached_and_never_exceeded(dt_s: float, before_nm: float, request_nm: float) -> None:
    after = limited_torque_nm(request_nm, before_nm, dt_s, 3.0, 6.0)
    step = 6.0 * min(max(dt_s, 0.0), DT_MAX_S)
    assert abs(after) <= 3.0
    assert abs(after - before_nm) <= step + 1e-12
    wanted = request_nm if math.isfinite(request_nm) else 0.0
    reached = (wanted, before_nm - step, before_nm + step, -3.0, 3.0)
    assert any(after == pytest.approx(bound, abs=1e-12) for bound in reached)


def test_the_integral_does_not_wind_up() -> None:
    steering = TorqueSteering(CONFIG, VEHICLE.wheelbase_m)
    for _ in range(1000):
        assert steering.step(0.5, 0.0, 0.0, 0.02) <= CONFIG.torque_max_nm
    back = next(index for index in range(1000) if steering.step(-0.05, 0.0, 0.0, 0.02) < 0)
    assert back * 0.02 < 1.2 * CONFIG.torque_max_nm / CONFIG.torque_rate_max_nmps + 0.1


def test_the_column_rests_where_torque_and_tyres_agree() -> None:
    column = Column()
    angle = 0.0
    for _ in range(5000):
        angle = column.turned_rad(angle, 2.0, 15.0, 0.001)
    back_nm = (column.centring_nmprad + column.per_accel_nms2pm * 15.0**2 / column.wheelbase_m) * angle
    assert back_nm == pytest.approx(2.0, rel=1e-3)
    slope = (column.turned_rad(0.0, 1.0, 0.0, 1e-6)) / 1e-6
    assert slope == pytest.approx(1.0 / column.damping_nmsprad, rel=1e-3)

"""`automodel bench faults`: the product passes, the figures repeat, and a product that is broken is found out."""

from __future__ import annotations

import math
from collections.abc import Callable

import pytest

from automodel.bench.faults import faulty_parts
from automodel.bench.faults import measure as fault_rig
from automodel.bench.faults.catalogue import CAN, CYCLE_S, FAULTS, chosen
from automodel.bench.faults.fault import Must
from automodel.config import PipelineConfig
from automodel.config import can as can_config
from automodel.control import longitudinal as speed_module
from automodel.runtime import safety
from automodel.runtime.eye_check import EyeCheck
from automodel.runtime.input_checks import (
    ImageCheck,
    InputChecks,
    LaneJumpCheck,
    OffsetBoundCheck,
    PairTimesCheck,
    SteeringCheck,
)
from automodel.runtime.supervised_source import SupervisedSource
from firmware_link import arduino, can_link, can_receiver
from firmware_link.emulator import can_vehicle, logic
from firmware_link.emulator.avr import missing_tools
from tests.support.command_line import Cli, cli

__all__ = ["cli"]

KEYS = ["fault", "runs", "violations", "reaction_p50_ms", "reaction_max_ms", "left_lane", "left_max_m", "moved"]
BENCH = ["bench", "faults", "--pipeline", "truth", "--jobs", "1"]


def test_a_run_of_each_fault_has_no_violation(cli: Cli) -> None:
    faults = [fault for fault in FAULTS if not fault.images and not fault.pairs]
    said = cli(*BENCH, "--runs", len(faults), "--json")
    assert (said.code, said.err) == (0, "")
    rows = {row["fault"]: row for row in said.rows}
    assert all(list(row) == KEYS for row in rows.values())
    assert list(rows) == [fault.name for fault in faults]
    for fault in faults:
        row = rows[fault.name]
        assert (row["runs"], row["violations"]) == (1, 0)
        if fault.must is Must.STOP and not fault.timed_from_motion:
            assert 0 <= row["reaction_p50_ms"] <= row["reaction_max_ms"] <= fault.within_s * 1e3
        elif fault.must in (Must.NOTHING, Must.STAY):
            assert row["reaction_max_ms"] is None


def test_a_run_of_each_fault_of_the_can_bus_has_no_violation(cli: Cli) -> None:
    said = cli(*BENCH, "--link", "can", "--runs", len(CAN), "--json")
    assert (said.code, said.err) == (0, "")
    rows = {row["fault"]: row for row in said.rows}
    assert list(rows) == [fault.name for fault in CAN]
    for fault in CAN:
        row = rows[fault.name]
        assert (row["runs"], row["violations"]) == (1, 0)
        assert fault.within_s <= 0.1 or fault.must is Must.NOTHING
        if fault.must is Must.STOP:
            assert 0 <= row["reaction_max_ms"] <= fault.within_s * 1e3
    assert rows["can-override"]["reaction_max_ms"] <= 1.2 * CYCLE_S * 1e3
    assert any(fault.must is Must.NOTHING and rows[fault.name]["reaction_max_ms"] is None for fault in CAN)


def test_a_network_that_lies_is_looked_at(cli: Cli) -> None:
    """The pipeline sees what the fault makes of the image: without a limit the car would be found outside its lane.

    Of 90 runs of three pipelines 12 leave it by more than the limit; these two do not.
    """
    only = ["--only", "network-jumps", "--runs", "2", "--seed", "7", "--pipeline", "windows", "--jobs", "1", "--json"]
    (row,) = cli("bench", "faults", *only).rows
    assert row["violations"] == 0
    assert 0 < row["left_max_m"] < 0.2


@pytest.mark.parametrize("name", ["rig-swapped", "rig-turned"])
def test_a_pair_that_is_wrong_before_the_car_is_armed(name: str) -> None:
    (fault,) = chosen((name,))
    verdict = fault_rig.judged("stereo", fault, 3, 0)
    assert (verdict.violations, verdict.reaction_s) == ((), None)


@pytest.mark.slow
def test_of_a_pair_the_left_camera_fails_and_both_where_one_would_go_on(cli: Cli) -> None:
    names = ("camera-off", "camera-stuck", "camera-flat", "camera-size")
    only = [argument for name in names for argument in ("--only", name)]
    said = cli("bench", "faults", "--pipeline", "stereo", "--jobs", "1", *only, "--runs", "4", "--json")
    assert (said.code, [row["violations"] for row in said.rows]) == (0, [0, 0, 0, 0])


OF_PAIRS = ("pair-off", "pair-stuck", "pair-dark", "pair-times")
ONLY_PAIRS = [argument for name in OF_PAIRS for argument in ("--only", name)]


@pytest.mark.slow
def test_faults_of_pairs_have_no_violation(cli: Cli) -> None:
    said = cli("bench", "faults", "--pipeline", "stereo", "--jobs", "1", *ONLY_PAIRS, "--runs", 16, "--json")
    assert (said.code, [row["violations"] for row in said.rows]) == (0, [0, 0, 0, 0])
    assert [row["reaction_max_ms"] is None for row in said.rows] == [True, True, True, False]


@pytest.mark.parametrize(
    ("name", "owner", "check", "text"),
    [
        ("pair-times", PairTimesCheck, "step", "never went neutral"),
        ("pair-off", SupervisedSource, "report_eyes", "no 'camera-missing' was reported"),
    ],
)
def test_a_product_that_believes_any_pair_is_found_out(
    cli: Cli, monkeypatch: pytest.MonkeyPatch, name: str, owner: type, check: str, text: str
) -> None:
    monkeypatch.setattr(owner, check, _nothing)
    said = cli("bench", "faults", "--pipeline", "stereo", "--jobs", "1", "--only", name, "--runs", "1")
    assert said.code == 1
    assert text in said.err


def test_a_product_that_looks_through_a_dark_eye_is_found_out(cli: Cli, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(EyeCheck, "step", lambda self, frame: frame)
    said = cli("bench", "faults", "--pipeline", "stereo", "--jobs", "1", "--only", "pair-dark", "--runs", "1")
    assert said.code == 1
    assert "pair-dark, run 0" in said.err


SOME_FAULTS = ("camera-black", "serial-random", "disk-slow", "perception-blip", "can-frame")
SOME = [argument for name in SOME_FAULTS for argument in ("--only", name)]
RUNS = ["--runs", len(SOME_FAULTS), "--json"]


def test_the_same_seed_gives_the_same_bytes(cli: Cli) -> None:
    first, again = (cli(*BENCH, *SOME, *RUNS, "--seed", "5").out for _ in range(2))
    assert first == again
    assert first != cli(*BENCH, *SOME, *RUNS, "--seed", "6").out


def test_runs_are_shared_out_and_a_run_does_not_depend_on_the_others(cli: Cli) -> None:
    rows = cli(*BENCH, "--only", "board-hang", "--only", "camera-size", "--runs", "5", "--json").rows
    assert [(row["fault"], row["runs"]) for row in rows] == [("camera-size", 3), ("board-hang", 2)]
    (alone,) = cli(*BENCH, "--only", "board-hang", "--runs", "2", "--json").rows
    assert alone == rows[1]


@pytest.mark.slow
def test_other_processes_give_the_same_figures(cli: Cli) -> None:
    one = cli("bench", "faults", *SOME, *RUNS, "--jobs", "1")
    two = cli("bench", "faults", *SOME, *RUNS, "--jobs", "2")
    assert (one.code, two.code) == (0, 0)  # with pictures, and the pipeline that is the default
    assert one.rows == two.rows


ON_THE_CHIP = ("serial-deaf", "serial-noise", "board-brown-out", "board-hang", "command-extreme")


def test_the_firmware_on_its_chip_does_what_it_must(cli: Cli) -> None:
    if missing_tools():
        pytest.skip(f"{', '.join(missing_tools())}: missing for the simulated AVR")
    only = [argument for name in ON_THE_CHIP for argument in ("--only", name)]
    said = cli(*BENCH, *only, "--link", "avr", "--runs", len(ON_THE_CHIP), "--json")
    assert (said.code, said.err) == (0, "")
    rows = {row["fault"]: row for row in said.rows}
    assert {name: row["violations"] for name, row in rows.items()} == dict.fromkeys(rows, 0)
    assert 0 < rows["board-brown-out"]["reaction_max_ms"] < 50  # no pulses: neutral once the servo misses one


def test_the_list_names_every_fault_and_what_it_demands(cli: Cli) -> None:
    lines = cli("bench", "faults", "--list").out.splitlines()
    named = [line.split()[:3] for line in lines if line[:1].isalpha()]
    assert named[1:-1] == [[fault.name, fault.kind.value, fault.must.value] for fault in (*FAULTS, *CAN)]
    assert max(map(len, lines)) <= 80
    (row,) = cli("bench", "faults", "--list", "--only", "servo-stuck", "--json").rows
    assert (row["fault"], row["must"], row["within_ms"]) == ("servo-stuck", "stop", 450.0)


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (["--only", "camera-of"], "automodel: --only 'camera-of': no such fault; near: camera-off, camera-gone"),
        (["--only", "camera-off", "--only", "zzz"], "automodel: --only 'zzz': no such fault; see --list"),
        (["--runs", "0"], "automodel bench faults: Invalid value for '--runs'"),
        (["--only", "network-adds", "--pipeline", "truth"], "automodel: --only 'network-adds': needs a pipeline"),
        (["--real-time", "--pipeline", "truth"], "automodel: --real-time: drives a pipeline that looks at images"),
        (["--real-time", "--link", "avr"], "automodel: --real-time: drives a pipeline that looks at images"),
        (["--real-time", "--only", "real-kill"], "automodel: --only 'real-kill': no such fault; near: real-killed"),
        (["--only", "pair-off"], "automodel: --only 'pair-off': needs a pipeline of two cameras: --pipeline stereo"),
        (["--pipeline", "lidar"], "automodel bench faults: Invalid value for '--pipeline'"),
    ],
)
def test_wrong_arguments_are_one_line(cli: Cli, arguments: list[str], text: str) -> None:
    said = cli("bench", "faults", *arguments)
    assert (said.code, said.out) == (2, "")
    assert said.line().startswith(text)


def _nothing(*_: object, **__: object) -> None:
    return None


def _restarting(self: safety.Safety, *arguments: object) -> tuple[object, ...]:
    """A safety machine that needs nobody's wish once it has driven."""
    self._auto_arm = True
    return _AT_REST(self, *arguments)  # type: ignore[arg-type]


def _remembering(self: safety.Safety, inputs: safety.SafetyInputs, *rest: object) -> tuple[object, ...]:
    """A safety machine that does not forget who has asked to arm."""
    self._auto_arm = self._auto_arm or inputs.arm
    return _AT_REST(self, inputs, *rest)  # type: ignore[arg-type]


def _no_coasting(self: PipelineConfig, lane_width_m: float) -> tuple[float, float]:
    return 0.0, 0.0


def _newest(self: speed_module.ObstacleGuard) -> float:
    return self._readings[-1] if self._readings else math.inf


_AT_REST = safety.Safety._at_rest


def _always(*_: object) -> bool:
    return True


def _as_it_is(self: can_receiver.MessageReader, data: bytes) -> int:
    return self.checksum_in(data)


def _as_asked(requested_rad: float, *_: float) -> float:
    return 20.0 * requested_rad


def _at_once(requested_mps2: float, *_: float) -> float:
    return requested_mps2


Break = Callable[[pytest.MonkeyPatch], None]
BROKEN: list[tuple[str, int, Break, str]] = [  # the fault, how many runs, how the product is broken, what is said
    ("camera-stuck", 1, lambda m: m.setattr(ImageCheck, "step", _nothing), "never went neutral"),
    ("camera-flat", 1, lambda m: m.setattr(ImageCheck, "step", _nothing), "never went neutral"),
    ("camera-size", 1, lambda m: m.setattr(ImageCheck, "misfit", _nothing), "never went neutral"),
    ("perception-decoy", 1, lambda m: m.setattr(LaneJumpCheck, "step", _nothing), "never went neutral"),
    ("perception-uncertain", 1, lambda m: m.setattr(OffsetBoundCheck, "step", _nothing), "never went neutral"),
    ("perception-uncertain-short", 1, lambda m: m.setattr(PipelineConfig, "coasting", _no_coasting), "hold after"),
    ("servo-stuck", 4, lambda m: m.setattr(SteeringCheck, "step", _nothing), "neutral"),
    ("loop-person-stops", 1, lambda m: m.setattr(faulty_parts.Person, "stop_asked", _nothing), "never went neutral"),
    ("slip-slides", 8, lambda m: m.setattr(SteeringCheck, "step", _nothing), "neutral"),
    ("serial-mute", 1, lambda m: m.setattr(safety, "LINK_SILENCE_S", 0.25), "expected at most"),
    ("serial-deaf", 1, lambda m: m.setattr(logic, "COMMAND_TIMEOUT_MS", 160), "expected at most"),
    ("serial-falls-behind", 2, lambda m: m.setattr(logic, "MAX_DEADLINE_MS", 0x10000), "neutral"),
    ("command-impossible", 1, lambda m: m.setattr(logic, "PULSE_RANGE_US", (0.0, 40000.0)), "neutral"),
    ("command-extreme", 2, lambda m: m.setattr(logic.Pulses, "set_target", _unlimited), "beyond the car's limits"),
    ("camera-off", 1, lambda m: m.setattr(safety.Safety, "_at_rest", _restarting), "drove off by itself"),
    ("camera-off", 6, lambda m: m.setattr(safety.Safety, "_at_rest", _remembering), "drove off by itself"),
    ("camera-pauses", 1, lambda m: m.setattr(safety.Safety, "_held", _nothing_held), "stop after"),
    ("camera-drops-1", 1, lambda m: m.setattr(fault_rig, "make_checks", _strict_checks), "hold after"),
    ("perception-blip", 1, lambda m: m.setattr(SupervisedSource, "read", _raising), "the run ended by"),
    ("sonar-spikes", 3, lambda m: m.setattr(speed_module.ObstacleGuard, "range_m", property(_newest)), "neutral"),
    ("battery-low", 1, lambda m: m.setattr(arduino.BatteryMeter, "step", _nothing), "was reported"),
    ("can-override", 1, lambda m: m.setattr(can_link.CanLink, "_overridden", _nothing), "never went disengaged"),
    ("can-missing", 1, lambda m: m.setattr(can_config, "TIMEOUT_PERIODS", 4.5), "expected at most"),
    ("can-counter-jumps", 1, lambda m: m.setattr(can_receiver.MessageWatch, "_counted", _always), "never went"),
    ("can-checksum", 1, lambda m: m.setattr(can_receiver.MessageReader, "checksum_for", _as_it_is), "never went"),
    ("can-second-sender", 1, lambda m: m.setattr(can_link.CanLink, "_bus_fault", _nothing), "never went disengaged"),
    ("can-wrong-bitrate", 1, lambda m: m.setattr(can_vehicle, "COMMAND_TIMEOUT_NS", 150_000_000), "expected at most"),
    ("can-frame", 6, lambda m: m.setattr(can_receiver, "BAD_MAX", 1), "stop after"),
    ("can-state-missing", 1, lambda m: m.setattr(can_link, "limited_steering_rad", _as_asked), "beyond the limit"),
    ("can-full-load", 1, lambda m: m.setattr(can_link, "limited_acceleration_mps2", _at_once), "limit of the jerk"),
]


def _unlimited(self: logic.Pulses, servo_us: float, motor_us: float) -> None:
    self.servo_us = self._servo_target_us = servo_us
    self.motor_us = self._motor_target_us = motor_us


def _nothing_held(self: safety.Safety, inputs: object, unwell: str | None, now_ns: int) -> tuple[object, ...]:
    return self._enter(safety.SafetyMode.STOPPED, "stop", "at once", now_ns)


def _strict_checks(car: object) -> object:
    """Checks that take one dropped frame for a fault."""

    class Strict(InputChecks):
        last_ns: int | None = None

        def of_frame(self, frame, seen):
            before, self.last_ns = self.last_ns, frame.t_ns
            return ("late",) if before is not None and frame.t_ns - before > 25_000_000 else ()

    return Strict(car)  # type: ignore[arg-type]


def _raising(self: SupervisedSource, timeout_s: float, at_rest: bool) -> object:
    frame = self._source.read(timeout_s)
    if frame is not None and frame.t_ns > 1_950_000_000:
        raise LookupError("a bug")
    return frame


@pytest.mark.parametrize(("name", "runs", "break_it", "text"), BROKEN, ids=[f"{row[0]}-{row[3]}" for row in BROKEN])
def test_a_product_that_is_broken_is_found_out(
    cli: Cli, monkeypatch: pytest.MonkeyPatch, name: str, runs: int, break_it: Break, text: str
) -> None:
    break_it(monkeypatch)
    said = cli(*BENCH, "--only", name, "--runs", runs, "--json")
    assert said.code == 1
    assert said.rows[0]["violations"] > 0
    assert text in said.err

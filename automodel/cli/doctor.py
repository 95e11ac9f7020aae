"""`automodel doctor`: everything between the battery and the lane, looked at one by one, with what to do."""

from __future__ import annotations

import contextlib
import datetime
import sys
from collections.abc import Callable, Generator, Iterator
from dataclasses import dataclass
from pathlib import Path

import click

from automodel.cli.options import FILE
from automodel.config import CarConfig
from automodel.console.messages import say
from automodel.console.tables import show, terminal_width, wrapped
from automodel.doctor.board import Board, Consent
from automodel.doctor.findings import Finding, Verdict, fail, failed, skip, summary, warn
from automodel.interfaces import Source
from automodel.runtime.clocks import MonotonicClock, SleepingClock
from automodel.signals import Frame

_COLOURS = {Verdict.OK: "green", Verdict.WARN: "yellow", Verdict.FAIL: "red", Verdict.SKIP: "bright_black"}
_NAME_WIDTH = 20


@dataclass(frozen=True, slots=True, kw_only=True)
class Devices:
    """What the car has: how to open its camera, its link, and the clock that both live by."""

    open_camera: Callable[[], Source]
    link: Board
    clock: SleepingClock


@click.command("doctor")
@click.option("--car", "car_file", type=FILE, help="car.toml (default: this machine only, and the simulated car).")
@click.option("--move", is_flag=True, help="Also turn the steering; asks first. Lift the wheels off the ground.")
@click.option("--yes", is_flag=True, help="With --move: do not ask. The wheels are off the ground.")
@click.option("--json", "as_json", is_flag=True, help="Findings as JSON on stdout.")
def command(car_file: Path | None, move: bool, yes: bool, as_json: bool) -> int:
    """Look at machine, camera, board and calibration: OK, WARN, FAIL or SKIP, and what to do.

    Nothing moves without --move. Exit code 0 when nothing FAILs, 1 when something does.
    """
    from automodel.assembly.parts import car_of

    if yes and not move:
        raise click.UsageError("--yes: is for --move")
    car = car_of(car_file)
    if car_file is None:
        say("without --car: this machine, and the simulated car")
    ask = _asked if sys.stdin is not None and not sys.stdin.closed and sys.stdin.isatty() else None
    consent = Consent(given=yes or car.link.port == "sim", ask=ask) if move else None
    findings = []
    with contextlib.closing(_examined(car, consent)) as coming:
        for finding in coming:
            findings.append(finding)
            if not as_json:
                _print(finding)
    if as_json:
        rows = [{"check": f.name, "verdict": f.verdict.value, "what": f.what, "do": f.do} for f in findings]
        show("doctor", rows, as_json)
    else:
        print(summary(findings))
    return 1 if failed(findings) else 0


def _examined(car: CarConfig, consent: Consent | None) -> Generator[Finding, None, None]:
    """All findings in order, as they come."""
    from automodel.doctor.calibrations import judge_lens, judge_records, judge_steering
    from automodel.doctor.machine import disk_finding, machine_findings

    yield from machine_findings(car)
    frames: list[Frame] = []
    yield from _car_findings(car, consent, frames)
    yield disk_finding(car, frames[-1].image if frames else None)
    yield judge_lens(car)
    yield judge_steering(car)
    yield from judge_records(car, datetime.date.today())


def _car_findings(car: CarConfig, consent: Consent | None, frames: list[Frame]) -> Iterator[Finding]:
    """Board, camera and lane; the camera's newest pictures are put into `frames`.

    The board comes first: it is left alone while the camera is looked through, and would say so.
    """
    from automodel.doctor.board import board_findings, can_finding, servo_finding
    from automodel.doctor.camera import camera_findings, lane_finding

    source, port = car.camera.source, car.link.port
    if (source == "sim") != (port == "sim"):
        what = f'[camera] source is "{source}" and [link] port "{port}"'
        yield fail("car.toml", what, 'set both to "sim", or neither')
        return
    if source not in ("sim", "csi", "usb"):
        do = '"csi" or "usb" drives; for a recording see automodel replay'
        yield warn("car.toml", f'[camera] source "{source}" is no camera', do)
    with contextlib.ExitStack() as leaving:
        devices = _devices(car, leaving)
        answers = yield from board_findings(car, devices.link, devices.clock)
        if consent is None:
            yield skip("servo", "not moved", "--move turns it, and asks first")
        elif answers:
            yield servo_finding(car, devices.link, devices.clock, consent)
        else:
            yield skip("servo", "not moved: the board does not answer")
        yield can_finding()
        devices.link.close()
        yield from camera_findings(car, devices.open_camera, frames)
        if frames:
            yield lane_finding(car, frames)


def _devices(car: CarConfig, leaving: contextlib.ExitStack) -> Devices:
    """The car's own, or those of the simulated car in virtual time; `leaving` gives them back."""
    if car.link.port == "sim":
        from automodel.assembly.simulated_car import Simulation, lock_step

        board = "autonomos" if car.link.kind == "autonomos" else "emulated"
        simulated = lock_step(car, Simulation(link=board), lambda scene: None)
        leaving.callback(simulated.close)
        open_camera, link, clock = (lambda: simulated.source), simulated.link, simulated.clock
    else:
        from automodel.assembly.parts import make_camera, make_link

        open_camera, link, clock = (lambda: make_camera(car)), make_link(car), MonotonicClock()
    assert isinstance(link, Board)
    leaving.callback(link.close)
    return Devices(open_camera=open_camera, link=link, clock=clock)


def _asked(question: str) -> bool:
    return click.confirm(question, default=False, err=True)


def _print(finding: Finding) -> None:
    """One entry in the terminal's width; colours only where a terminal shows them."""
    verdict, do = f"{finding.verdict.value:<4}", f" -> {finding.do}" if finding.do else ""
    text = wrapped(f"{verdict}  {finding.name:<{_NAME_WIDTH}}  {finding.what}{do}", terminal_width(), _NAME_WIDTH + 8)
    click.echo(click.style(verdict, fg=_COLOURS[finding.verdict]) + text[len(verdict) :])

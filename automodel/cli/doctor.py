"""`automodel doctor`: checks everything between the battery and the lane, and says what to do."""

from __future__ import annotations

import contextlib
from pathlib import Path

import click

from automodel.cli.options import FILE
from automodel.console.keys import has_terminal
from automodel.console.messages import say
from automodel.console.tables import show, terminal_width, wrapped
from automodel.doctor.findings import Finding, Verdict, failed, summary

_COLOURS = {Verdict.OK: "green", Verdict.WARN: "yellow", Verdict.FAIL: "red", Verdict.SKIP: "bright_black"}
_NAME_WIDTH = 20


@click.command("doctor")
@click.option("--car", "car_file", type=FILE, help="car.toml (default: this machine only, and the simulated car).")
@click.option("--move", is_flag=True, help="Also turn the steering; asks first. Lift the wheels off the ground.")
@click.option("--yes", is_flag=True, help="With --move: do not ask. The wheels are off the ground.")
@click.option(
    "--latency",
    metavar="LIGHT",
    help="Also measure the camera's latency, which sees `screen` (this terminal) or an LED of /sys/class/leds blink.",
)
@click.option("--json", "as_json", is_flag=True, help="Findings as JSON on stdout.")
def command(car_file: Path | None, move: bool, yes: bool, latency: str | None, as_json: bool) -> int:
    """Check machine, camera, board and calibration: OK, WARN, FAIL or SKIP, and what to do.

    Nothing moves without --move. The exit code is 1 if a check says FAIL, else 0.

    Example:

    automodel doctor --car car.toml --move
    """
    from automodel.assembly.parts import car_of
    from automodel.doctor.board import Consent
    from automodel.doctor.examination import examine

    if yes and not move:
        raise click.UsageError("--yes: is for --move")
    if latency is not None and car_file is None:
        raise click.UsageError("--latency: needs --car, whose camera is looked at")
    car = car_of(car_file)
    if car_file is None:
        say("without --car: this machine, and the simulated car")
    ask = _ask if has_terminal() else None
    consent = Consent(given=yes or car.link.port == "sim", ask=ask) if move else None
    findings = []
    with contextlib.closing(examine(car, consent, latency)) as coming:
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


def _ask(question: str) -> bool:
    return click.confirm(question, default=False, err=True)


def _print(finding: Finding) -> None:
    """One entry in the terminal's width; colours only where a terminal shows them."""
    verdict, do = f"{finding.verdict.value:<4}", f" -> {finding.do}" if finding.do else ""
    text = wrapped(f"{verdict}  {finding.name:<{_NAME_WIDTH}}  {finding.what}{do}", terminal_width(), _NAME_WIDTH + 8)
    click.echo(click.style(verdict, fg=_COLOURS[finding.verdict]) + text[len(verdict) :])

"""`automodel service`: the car as a service of systemd."""

from __future__ import annotations

from pathlib import Path

import click

from automodel.cli.options import FILE
from automodel.config import ConfigError
from automodel.console.messages import say

ROOT = click.option(
    "--root", type=FILE, default=Path("/"), metavar="DIR", help="Of the file system, for an image of a card.  [/]"
)


@click.group("service")
def command() -> None:
    """Run the car as a service of systemd: at boot, watched, started again, shut down on a low battery.

    Example:

    automodel service install --help
    """


@command.command("install")
@click.option("--car", "car_file", type=FILE, required=True, help="The car.toml that is driven.")
@click.option("--user", help="Who runs it (default: who called sudo).")
@click.option("--poweroff/--no-poweroff", default=True, help="Shut down when the battery stays low.  [poweroff]")
@ROOT
@click.argument("options", nargs=-1, type=click.UNPROCESSED)
def install(car_file: Path, user: str | None, poweroff: bool, root: Path, options: tuple[str, ...]) -> int:
    """Write unit and udev rules, and start the car at each boot. What follows -- are options of `automodel run`.

    Nothing drives by itself: a person arms, by the page, a gamepad or --manual.

    Example:

    automodel service install --car car.toml -- --web 0.0.0.0:8765
    """
    from automodel.assembly.parts import car_of
    from automodel.cli.run import command as run
    from automodel.service import installation

    car = car_of(car_file)
    if car.link.port == "sim":
        raise ConfigError(f'{car_file}: [link] port is "sim": a service drives a real car')
    run.make_context("automodel run", ["--car", str(car_file), *options])  # what is wrong is told now, not at boot
    service = installation.service_of(car_file, options, user, poweroff)
    for path in installation.install(service, root):
        say(f"wrote {path}")
    if car.link.port.startswith(("/dev/ttyUSB", "/dev/ttyACM")):
        say(f'[link] port = "{car.link.port}" may get another number; /dev/automodel-board stays the board\'s')
    say("it starts at the next boot; now: sudo systemctl start automodel; then: automodel service status")
    return 0


@command.command("status")
@ROOT
@click.option("--json", "as_json", is_flag=True, help="As JSON on stdout.")
def status(root: Path, as_json: bool) -> int:
    """Say how the service is; the exit code is 1 where it does not run.

    Example:

    automodel service status --json
    """
    from automodel.console.tables import show
    from automodel.service import installation

    row = installation.status(root)
    show("service", [row], as_json)
    return 0 if str(row.get("state", "")).startswith("active") else 1


@command.command("logs")
@click.option("--lines", type=click.IntRange(1), default=50, show_default=True, help="How many of the newest.")
@click.option("--follow", is_flag=True, help="Go on with what comes; Ctrl-C ends it.")
def logs(lines: int, follow: bool) -> int:
    """Show what the service has said: its web address with the token, events, how a run ended.

    Example:

    automodel service logs --follow
    """
    from automodel.service import installation

    return 1 if installation.logs(lines, follow) else 0


@command.command("remove")
@ROOT
def remove(root: Path) -> int:
    """Stop the service and delete what install wrote.

    Example:

    automodel service remove
    """
    from automodel.service import installation

    gone = installation.remove(root)
    for path in gone:
        say(f"deleted {path}")
    if not gone:
        say("there is no service here")
    return 0

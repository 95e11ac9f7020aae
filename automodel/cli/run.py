"""`automodel run`: drive, a real car or a simulated one, by the same loop."""

from __future__ import annotations

import contextlib
import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING

import click
from click.core import ParameterSource

from automodel.cli.options import ABOVE_ZERO, FILE, PIPELINE, check_outputs, finite
from automodel.config import CarConfig, ConfigError

if TYPE_CHECKING:
    from automodel.assembly.drive import Operator, RunOptions, Viewer

SIMULATED_ONLY = ("laps", "track", "direction", "seed", "style", "board", "realtime", "truth")
REAL_COLUMNS = ("frames", "skipped", "stops", "latency_p50_ms", "latency_p99_ms")  # the others need the truth


@click.command("run")
@click.option("--car", "car_file", type=FILE, help="car.toml (default: the simulated car).")
@click.option("--pipeline", type=PIPELINE, help="Which paper sees the lane.")
@click.option(
    "--speed", "speed_mps", type=ABOVE_ZERO, callback=finite, help="Wanted speed [m/s] (default: that of car.toml)."
)
@click.option("--laps", type=click.IntRange(1), help="End after so many laps (simulated car; default 1).")
@click.option("--duration", "duration_s", type=ABOVE_ZERO, callback=finite, help="End after so many seconds.")
@click.option(
    "--track",
    default="tmr",
    show_default=True,
    help="Simulated: tmr, oval, chicane, circuit, ring, a .toml or .csv file.",
)
@click.option(
    "--direction",
    type=click.Choice(["forward", "reverse"]),
    default="forward",
    show_default=True,
    help="Simulated: which lane.",
)
@click.option("--seed", type=click.IntRange(0), default=0, show_default=True, help="Simulated: light, floor, noise.")
@click.option(
    "--style",
    type=click.Choice(["clean", "competition", "varied"]),
    default="competition",
    show_default=True,
    help="Simulated: light and floor.",
)
@click.option(
    "--link",
    "board",
    type=click.Choice(("emulated", "avr", "autonomos", "can", "serial")),
    help="Simulated: the board; avr is the firmware on a simulated ATmega328P (needs avr-gcc and simavr), autonomos "
    "that of an AutoNOMOS car, can a full-size car (without --car that of `init full-size` on the track ring), serial "
    "the real one at car.toml's port, with --sim-camera.  "
    "[default: as [link] kind says, emulated]",
)
@click.option(
    "--realtime", is_flag=True, help="Simulated: against the real clock, camera and board in another process."
)
@click.option(
    "--sim-camera",
    is_flag=True,
    help="With --car of a real car: its board makes the pulses, the world is simulated (hardware in the loop).",
)
@click.option("--arm", is_flag=True, help="Real board: arm once without asking, as soon as all is well.")
@click.option(
    "--manual",
    "device",
    is_flag=False,
    flag_value="gamepad",
    metavar="[DEVICE]",
    help="Drive by hand while a button is held: gamepad (the default), keyboard, a device in /dev/input, or none for "
    "the page of --web alone. Simulated: with --realtime.",
)
@click.option("--record", type=FILE, help="Write the run here (.mcap); a real car always records.")
@click.option(
    "--lossless", is_flag=True, help="Record every bit of the frames (PNG): a replay is the drive to the bit."
)
@click.option("--truth", type=FILE, help="Simulated: write truth.csv here.")
@click.option(
    "--web",
    "web_address",
    is_flag=False,
    flag_value="127.0.0.1:8765",
    metavar="[HOST:PORT]",
    help="Serve the run's web page, by default on 127.0.0.1:8765; its address with the token is printed.",
)
@click.option(
    "--web-tls",
    type=(FILE, FILE),
    metavar="CERT KEY",
    help="Serve the page by TLS with this certificate and key (PEM).",
)
@click.option(
    "--foxglove",
    "foxglove_port",
    is_flag=False,
    flag_value=8766,  # 8765, which Foxglove offers first, is the page's
    type=click.IntRange(0, 65535),
    metavar="[PORT]",
    help="Serve the run to Foxglove on this machine, by default at ws://127.0.0.1:8766; it can only look.",
)
@click.option("--until-battery-low", is_flag=True, help="End when the battery has been low for 10 s: for the service.")
@click.option("--json", "as_json", is_flag=True, help="Figures as JSON on stdout.")
@click.pass_context
def command(
    ctx: click.Context,
    /,
    car_file: Path | None,
    pipeline: str | None,
    speed_mps: float | None,
    device: str | None,
    sim_camera: bool,
    lossless: bool,
    web_address: str | None,
    web_tls: tuple[Path, Path] | None,
    foxglove_port: int | None,
    until_battery_low: bool,
    as_json: bool,
    **rest: object,
) -> int:
    """Drive. Without --car: a simulated car on a simulated track, as fast as the machine can (or --realtime).

    Example:

    automodel run --track oval --laps 2 --record lap.mcap
    """
    from automodel.assembly.drive import RunOptions, drive_real, drive_simulated
    from automodel.assembly.parts import is_live_camera, read_car
    from automodel.console.messages import say
    from automodel.console.tables import show
    from automodel.service.battery import LowBattery
    from automodel.service.notify import Notifier, ServiceViewer

    if rest["board"] == "can" and car_file is None:
        from automodel.cli.init import kit_path

        car_file = kit_path("full-size")
        if ctx.get_parameter_source("track") is not ParameterSource.COMMANDLINE:
            rest["track"] = "ring"
    car, text = read_car(car_file, pipeline, speed_mps, lossless)
    options = RunOptions(by_hand=device is not None, **rest)  # type: ignore[arg-type]
    check_outputs({"--truth": options.truth}, {"--car": car_file, "--record": options.record})
    name = str(car_file)
    if sim_camera or options.on_desk:
        options = _desk_options(options, car, name if car_file else "the default car", sim_camera)
    simulated = car.camera.source == "sim" or sim_camera
    if not sim_camera and simulated != (car.link.port == "sim"):
        raise ConfigError(f'{name}: [camera] source and [link] port: either both are "sim" or neither is')
    if not simulated:
        given = [key for key in SIMULATED_ONLY if ctx.get_parameter_source(key) is ParameterSource.COMMANDLINE]
        if given:
            option = next(p.opts[0] for p in ctx.command.params if p.name == given[0])
            raise ConfigError(f"{option}: is for the simulated car, and {name} names a real one")
        if not is_live_camera(car):
            raise ConfigError(
                f"{name}: [camera] source {car.camera.source!r}: a car drives with csi or usb; see replay"
            )
    if device is not None and simulated and not options.realtime:
        raise ConfigError("--manual: the simulated car is driven by hand in real time; give --realtime, too")
    if device == "none" and web_address is None:
        raise ConfigError("--manual none: drives from the web page alone; give --web, too")
    drive = drive_simulated if simulated else drive_real
    if web_tls is not None and web_address is None:
        raise ConfigError("--web-tls: is for the web page; give --web too")
    with contextlib.ExitStack() as shown:
        operators: list[Operator] = [_device(device, shown)] if device not in (None, "none") else []
        viewers: list[Viewer] = []
        notifier = Notifier()  # before any process is started, which must not speak in this one's name
        if notifier.heard:
            viewers.append(shown.enter_context(ServiceViewer(notifier)))
        if web_address is not None:
            operators.append(_page(car, web_address, web_tls, device is not None, shown))
        if foxglove_port is not None:
            from automodel.recording.foxglove import layout_file
            from automodel.web.foxglove import FoxgloveLive

            live = shown.enter_context(FoxgloveLive(car, foxglove_port))
            viewers.append(live)
            say(f"foxglove: {live.url}; in Foxglove: Open connection, then import the layout {layout_file()}")
        battery = LowBattery()
        if until_battery_low:
            viewers.append(battery)
        report = drive(car, text, options, operators, viewers, battery.over)
    show("run", [report.row], as_json, None if simulated or as_json else REAL_COLUMNS)
    say(report.ended)
    return 1 if report.failed else 0


def _desk_options(options: RunOptions, car: CarConfig, name: str, sim_camera: bool) -> RunOptions:
    """Those of a run in which the board at car.toml's port drives the simulated car; raises ConfigError."""
    if not sim_camera or options.board not in (None, "serial"):
        raise ConfigError("--link serial and --sim-camera: a real board in a simulated world; give both")
    if car.link.port == "sim":
        raise ConfigError(f'--sim-camera: [link] port of {name} is "sim"; give --car of a car with a real board')
    if car.link.kind != "arduino":
        raise ConfigError(
            f"--sim-camera: {name}: [link] kind {car.link.kind!r} does not say which pulses it makes; arduino does"
        )
    return dataclasses.replace(options, board="serial", realtime=True)


def _device(name: str, shown: contextlib.ExitStack) -> Operator:
    """The person at a gamepad or keyboard of this machine."""
    from automodel.console.messages import say
    from automodel.manual.device import open_device, reopen_device
    from automodel.manual.operator import DeviceOperator

    device = open_device(name)
    say(f"by hand: {device.name}: {device.controls.how}")
    return shown.enter_context(DeviceOperator(device, lambda: reopen_device(name)))


def _page(
    car: CarConfig, address: str, tls: tuple[Path, Path] | None, by_hand: bool, shown: contextlib.ExitStack
) -> Operator:
    """The person at the web page, which is served while `shown` is open."""
    from automodel.console.messages import say
    from automodel.web.access import PageOptions
    from automodel.web.remote import WebRemote

    host, port = host_and_port(address)
    page = shown.enter_context(WebRemote(car, PageOptions(host=host, port=port, tls=tls, by_hand=by_hand)))
    say(f"web page: {page.url}")
    if tls is None and host not in ("127.0.0.1", "::1", "localhost"):
        say("the page is not encrypted: on a network that others use, give --web-tls CERT KEY")
    return page


def host_and_port(address: str) -> tuple[str, int]:
    """HOST:PORT, the host in brackets where it is an IPv6 address; port 0 takes a free one. Raises ConfigError."""
    host, colon, port = address.rpartition(":")
    host = host.removeprefix("[").removesuffix("]")
    if not (colon and host and port.isascii() and port.isdecimal() and int(port) <= 65535):
        raise ConfigError(f"--web: expected HOST:PORT, for example 0.0.0.0:8765, got {address!r}")
    return host, int(port)

"""The `automodel` command: loads one command's module at a time, turns errors into one line and an exit code."""

from __future__ import annotations

import contextlib
import errno
import importlib
import logging
import os
import signal
import sys
import traceback
from pathlib import Path

# One thread for BLAS: its matrices are tiny here, waking a second core costs more than it saves, and jitters.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("OPENCV_IO_MAX_IMAGE_PIXELS", str(8192**2))  # a few kB of PNG may unpack to gigabytes

import click

from automodel import __version__
from automodel.runtime.os_signals import interrupt, raise_if_interrupted

COMMANDS = {
    "run": "Drive: the car of car.toml, or a simulated one.",
    "replay": "Lane poses of a recording, a video, a folder of images or a donkeycar tub.",
    "calibrate": "Camera, ground, servo, odometry: measured, with the error, into car.toml.",
    "init": "Write a commented car.toml for a kit.",
    "doctor": "Look at machine, camera, board and calibration, and say what to do.",
    "bench": "Measure accuracy, speed, latency and the reaction to faults.",
    "report": "Runs as one page: map, plots, pipelines side by side, the worst moments.",
    "view": "A run in the browser, on its time line.",
    "export": "A recording as CSV and video.",
    "service": "The car as a service of systemd: install, status, logs, remove.",
    "recover": "Make a recording readable that was cut by a power loss.",
    "train": "Train the network that finds lane markings.",
}

TRACEBACK = "AUTOMODEL_TRACEBACK"  # an environment variable: errors that are mistakes of ours, with their traceback
_LONGEST = 400  # characters of such an error's text


class LazyGroup(click.Group):
    """Imports a command's module only when it is called: start-up stays under 0.3 s."""

    commands_help = COMMANDS
    modules = "automodel.cli."  # a command's module is this and its name

    def list_commands(self, ctx: click.Context) -> list[str]:
        """The commands' names, in the order of use."""
        return list(self.commands_help)

    def get_command(self, ctx: click.Context, name: str) -> click.Command | None:
        """The `command` of the command's module."""
        if name not in self.commands_help:
            return None
        command: click.Command = importlib.import_module(self.modules + name).command
        raise_if_interrupted()
        return command

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """The list in --help, without importing any command."""
        with formatter.section("Commands"):
            formatter.write_dl(list(self.commands_help.items()))


@click.group(cls=LazyGroup, context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(__version__, prog_name="automodel")
def cli() -> None:
    """Lane following for scale cars: the lane in metres, and a safe command."""


def main() -> None:
    """Run the command line; the process ends with 0 (done), 1 (the run failed) or 2 (arguments or files are wrong)."""
    for name in ("SIGINT", "SIGTERM", "SIGHUP"):  # all as Ctrl-C: files are closed, other processes ended
        number = getattr(signal, name, None)
        if number is not None and signal.getsignal(number) is not signal.SIG_IGN:  # nohup ignores SIGHUP: leave that
            signal.signal(number, interrupt)
    if sys.stderr is not None and sys.stderr.isatty():  # what a program reads has results and errors only
        logging.basicConfig(format="automodel: %(message)s")
        logging.getLogger("automodel").setLevel(logging.INFO)
    code = run(sys.argv[1:])
    sys.exit(_flushed(code))


def run(arguments: list[str]) -> int:
    """The exit code of one command line; errors that a user can mend are one line on stderr."""
    try:
        code = cli.main(args=arguments, prog_name="automodel", standalone_mode=False)
    except (click.Abort, KeyboardInterrupt):
        return _error("automodel: interrupted", 1)
    except click.exceptions.NoArgsIsHelpError as error:
        return _error(error.format_message(), 2)
    except click.UsageError as error:
        path = error.ctx.command_path if error.ctx else "automodel"
        return _error(f"{path}: {error.format_message()} (see {path} --help)", 2)
    except click.ClickException as error:
        return _error(f"automodel: {error.format_message()}", error.exit_code)
    except SystemExit as error:  # how click ends when the reader of a pipe goes away
        return error.code if isinstance(error.code, int) else 1
    except (ValueError, OSError) as error:
        gone = isinstance(error, OSError) and error.errno == errno.EIO and not error.filename  # a closed terminal
        return _error(f"automodel: {_one_line(error)}", 1 if gone else 2)
    except Exception as error:  # a mistake of ours: a user is helped by its line, we by its traceback
        from automodel.config.extras import INSTALLED_BY, missing_extra

        if isinstance(error, ModuleNotFoundError) and error.name in INSTALLED_BY:
            return _error(f"automodel: {missing_extra('this', error.name)}", 2)
        if os.environ.get(TRACEBACK):
            raise
        place = traceback.extract_tb(error.__traceback__)[-1]
        cause = f"{type(error).__name__} at {Path(place.filename).name}:{place.lineno}: {_one_line(error)}"
        return _error(f"automodel: unexpected {cause[:_LONGEST]} (set {TRACEBACK}=1 for the traceback)", 1)
    return code if isinstance(code, int) else 0


def _error(line: str, code: int) -> int:
    """Print the line and return the code."""
    if sys.stderr is not None:  # print would take stdout instead
        with contextlib.suppress(OSError, ValueError):  # it is closed
            print(line, file=sys.stderr)
    return code


def _flushed(code: int) -> int:
    """Flush the streams while an error can still be reported in one line; Python would print a traceback."""
    for stream in (sys.stdout, sys.stderr):
        if stream is None:  # closed by the parent process
            continue
        try:
            stream.flush()
        except OSError as error:
            os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())
            # A reader that stops early is no error, and what has failed was told.
            if not isinstance(error, BrokenPipeError) and not code:
                _error(f"automodel: the output cannot be written: {error.strerror}", 1)
            code = code or 1
    return code


def _one_line(error: Exception) -> str:
    if isinstance(error, OSError) and error.strerror:  # the operating system's; ours have a text only
        return f"{error.filename or 'the output cannot be written'}: {error.strerror}"
    return " ".join(str(error).split()) or type(error).__name__

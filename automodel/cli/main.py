"""The `automodel` command: loads one command's module at a time, turns errors into one line and an exit code."""

from __future__ import annotations

import importlib
import sys

import click

from automodel import __version__

COMMANDS = {
    "run": "Drive: the car of car.toml, or a simulated one.",
    "replay": "Lane poses of a recording, a video, a folder of pictures or a donkeycar tub.",
    "bench": "Measure: accuracy against the simulator's truth, and speed.",
    "export": "A recording as CSV and video.",
    "recover": "Make a recording readable that was cut by a power loss.",
}


class LazyGroup(click.Group):
    """Imports a command's module only when it is called: start-up stays under 0.3 s."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        """The commands' names, in the order of use."""
        return list(COMMANDS)

    def get_command(self, ctx: click.Context, name: str) -> click.Command | None:
        """The command, imported from `automodel.cli.<name>`."""
        if name not in COMMANDS:
            return None
        command: click.Command = importlib.import_module(f"automodel.cli.{name}").command
        return command

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """The list in --help, without importing any command."""
        with formatter.section("Commands"):
            formatter.write_dl(list(COMMANDS.items()))


@click.group(cls=LazyGroup, context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(__version__, prog_name="automodel")
def cli() -> None:
    """Lane following for scale cars: the lane in metres, and a safe command."""


def main() -> None:
    """Run the command line; the process ends with 0 (done), 1 (the run failed) or 2 (arguments or files are wrong)."""
    sys.exit(run(sys.argv[1:]))


def run(arguments: list[str]) -> int:
    """The exit code of one command line; errors that a user can mend are one line on stderr."""
    try:
        code = cli.main(args=arguments, prog_name="automodel", standalone_mode=False)
    except click.exceptions.Exit as error:
        return error.exit_code
    except click.Abort:
        print("automodel: interrupted", file=sys.stderr)
        return 1
    except click.UsageError as error:
        path = error.ctx.command_path if error.ctx else "automodel"
        print(f"{path}: {error.format_message()} (see {path} --help)", file=sys.stderr)
        return 2
    except BrokenPipeError:  # the reader of a pipe went away: nothing is wrong here
        sys.stderr.close()
        return 1
    except (ValueError, OSError, click.ClickException) as error:
        print(f"automodel: {_one_line(error)}", file=sys.stderr)
        return 2
    return code if isinstance(code, int) else 0


def _one_line(error: Exception) -> str:
    if isinstance(error, OSError) and error.filename is not None and error.strerror:
        return f"{error.filename}: {error.strerror}"
    text = error.format_message() if isinstance(error, click.ClickException) else str(error)
    return " ".join(text.split()) or type(error).__name__

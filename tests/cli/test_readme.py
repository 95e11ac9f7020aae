"""What the README shows works as it is written."""

from __future__ import annotations

import os
import re
import shlex
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import click
import pytest

from automodel.assembly.simulated_car import appearance, renderer
from automodel.cli.main import cli as commands
from automodel.config import CarConfig, parse_car
from automodel.recording.export import COLUMNS
from automodel.sim.track_files import load_track
from automodel.sources.files import read_motion_csv

ROOT = Path(__file__).resolve().parents[2]


FOLDERS = (".github", "automodel", "calibration", "firmware_link", "tracks")
PAGES = sorted([*ROOT.glob("*.md"), *(page for folder in FOLDERS for page in (ROOT / folder).rglob("*.md"))])
SHORT = 250  # lines of README.md, at most
README = "\n".join(
    (ROOT / name).read_text(encoding="utf-8")
    for name in (
        "README.md",
        "automodel/cli/README.md",
        "automodel/pipelines/README.md",
        "automodel/recording/README.md",
        "automodel/runtime/README.md",
        "automodel/web/README.md",
        "calibration/README.md",
    )
)


def blocks(language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```", README, re.MULTILINE | re.DOTALL)


LINES = [line for block in blocks("sh") for line in block.splitlines()]
AUTOMODEL = [line for line in LINES if line.startswith("automodel")]
(CHAIN,) = {block for block in blocks("sh") if "--record my.mcap" in block}


def anchors(page: Path) -> set[str]:
    """What a link to a heading of a page ends in, as GitHub makes it."""
    titles = re.findall(r"^#+ (.*)$", page.read_text(encoding="utf-8"), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", title.lower()).replace(" ", "-") for title in titles}


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_every_link_leads_somewhere(page: Path) -> None:
    for link in re.findall(r"\]\(([^)\s]+)\)", page.read_text(encoding="utf-8")):
        if not link.startswith("http"):
            name, _, anchor = link.partition("#")
            target = (page.parent / name).resolve() if name else page
            assert target.exists(), link
            assert not anchor or anchor in anchors(target), link


def test_the_readme_is_short() -> None:
    assert len((ROOT / "README.md").read_text(encoding="utf-8").splitlines()) < SHORT


def test_there_is_something_to_test() -> None:
    assert len(AUTOMODEL) > 10
    assert {line.split()[0] for line in LINES} == {"python3", "pip", "automodel", "bash"}


def test_the_program_runs_as_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys) -> None:
    car = CarConfig()
    view = renderer(load_track("oval"), car, appearance("clean", 0))
    pose = load_track("oval").lane().pose(1.0)
    monkeypatch.chdir(tmp_path)
    Path("car.toml").write_text('[pipeline]\nname = "windows"\n')
    (program,) = blocks("python")
    exec(program, {"image": view.render(pose.x_m, pose.y_m, pose.yaw_rad, 0.0, 0.0, 0), "t_s": 0.0})
    status, offset_m, heading_rad = capsys.readouterr().out.split()
    assert status == "LaneStatus.TRACKING"
    assert abs(float(offset_m)) < 0.01
    assert abs(float(heading_rad)) < 0.03  # of one frame, which does not show the ground beside the car


def leaves(command: click.Command, name: str = "automodel") -> Iterator[tuple[str, click.Command]]:
    """All commands that do something, with their names."""
    if isinstance(command, click.Group):
        context = click.Context(command)
        for each in command.list_commands(context):
            found = command.get_command(context, each)
            assert found is not None
            yield from leaves(found, f"{name} {each}")
    else:
        yield name, command


HELP = {name: command.help or "" for name, command in leaves(commands)}
EXAMPLES = [
    line.strip() for text in HELP.values() for line in text.splitlines() if line.strip().startswith("automodel")
]


@pytest.mark.parametrize("name", HELP)
def test_every_command_has_an_example_in_its_help(name: str) -> None:
    (example,) = (line.strip() for line in HELP[name].splitlines() if line.strip().startswith("automodel"))
    assert example == name or example.startswith(f"{name} ")
    assert len(example) < 78  # a terminal shows it on one line


def test_the_shell_completes_commands_and_options() -> None:
    words = {"COMP_WORDS": "automodel bench f", "COMP_CWORD": "2", "_AUTOMODEL_COMPLETE": "bash_complete"}
    program = Path(sys.executable).with_name("automodel")
    said = subprocess.run([program], env=os.environ | words, capture_output=True, text=True, check=True)
    assert said.stdout == "plain,faults\n"


@pytest.mark.parametrize("line", AUTOMODEL + EXAMPLES)
def test_every_command_and_option_exists(line: str) -> None:
    words = shlex.split(line)[1:]
    command: click.Command = commands
    context = click.Context(commands, info_name="automodel")
    while isinstance(command, click.Group):
        name, found, words = command.resolve_command(context, words)
        assert found is not None
        command, context = found, click.Context(found, parent=context, info_name=name)
    command.make_context(line, words, parent=context)  # raises for an option or a value that does not exist


def test_the_first_examples_run_as_written(tmp_path: Path, cli, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    for line in CHAIN.splitlines():
        line = line.replace("--duration 5", "--duration 1")
        assert cli(*shlex.split(line)[1:]).code == 0, line
    assert {path.name for path in tmp_path.iterdir()} == {
        "my.mcap", "truth.csv", "poses.csv", "overlay.mp4", "report.html", "driven.csv", "my.foxglove.mcap",
        "my.foxglove.layout.json",
    }  # fmt: skip


@pytest.mark.slow
def test_the_accuracy_example_runs_as_written(cli) -> None:
    (line,) = (line for line in AUTOMODEL if line.startswith("automodel bench accuracy --track oval"))
    said = cli(*shlex.split(line)[1:], "--json")
    assert said.code == 0
    assert said.rows[0]["frames"] > 500


@pytest.mark.slow
def test_the_quick_start_drives_a_lap_of_tmr(cli) -> None:
    said = cli("run", "--json")
    assert said.code == 0, said.err
    (row,) = said.rows
    assert (row["laps"], row["left_lane"], row["stops"]) == (1, 0, 0)


def test_the_car_file_is_one() -> None:
    pipeline, kinds, text = blocks("toml")
    assert parse_car(pipeline, "README.md").pipeline == CarConfig().pipeline
    lane = parse_car(kinds, "README.md").lane
    assert (lane.left, lane.right) == ("dashed", "solid")
    car = parse_car(text, "README.md")
    assert (car.camera.source, car.link.port) == ("usb", "/dev/ttyUSB0")


def test_the_motion_file_is_one(tmp_path: Path) -> None:
    (text,) = blocks("csv")
    (tmp_path / "motion.csv").write_text(text)
    assert read_motion_csv(tmp_path / "motion.csv").at(0).speed_mps == 1.0


def test_columns_and_paths_are_those_of_the_code() -> None:
    assert ",".join(COLUMNS) in README
    for path in re.findall(r"`((?:automodel|firmware_link|tracks|tests)/[\w./]*)`", README):
        assert (ROOT / path).exists(), path
    assert shutil.which("bash")
    assert (ROOT / ".ci" / "check").exists()


def test_times_are_those_of_the_defaults() -> None:
    car = parse_car("", "car.toml")
    safety = car.safety
    assert (safety.command_validity_s, safety.frame_timeout_s, safety.hold_s, safety.rearm_s) == (0.1, 0.06, 0.3, 0.5)
    for shown in ("100 ms from its frame's capture", "no frame for 60 ms", "within 0.3 s", "well for 0.5 s"):
        assert shown in README

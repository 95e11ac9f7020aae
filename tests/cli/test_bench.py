from __future__ import annotations

import csv
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from automodel.bench.machine import this_machine

ACCURACY_KEYS = [
    "pipeline", "track", "style", "seed", "frames", "heading_mae_deg", "heading_p99_deg", "offset_mae_m",
    "offset_mae_pct", "offset_p99_m", "availability_pct", "false_lane_pct", "misled_pct", "bound_exceeded_pct",
    "bound_median_m",
]  # fmt: skip
SPEED_KEYS = ["pipeline", "stage", "width_px", "height_px", "p50_ms", "p99_ms", "threads"]
QUICK = ["bench", "accuracy", "--track", "oval", "--style", "centred", "--speed", "5", "--pipeline", "windows"]


def test_accuracy_has_its_keys_and_a_picture(tmp_path: Path, cli) -> None:
    plot = tmp_path / "plot.png"
    said = cli(*QUICK, "--jobs", "1", "--plot", plot, "--json")
    assert (said.code, said.err) == (0, "")
    (row,) = said.rows
    assert list(row) == ACCURACY_KEYS
    assert (row["track"], row["style"], row["seed"]) == ("oval", "centred", 0)
    assert row["frames"] > 50
    assert plot.read_bytes().startswith(b"\x89PNG")


def test_a_sharded_sweep_is_put_together_with_commit_seed_and_machine(tmp_path: Path, cli) -> None:
    quick = ["bench", "accuracy", "--world", "random", "--pipeline", "contour", "--frames", "3", "--seed", "7"]
    quick += ["--seeds", "3", "--jobs", "1"]
    for shard in ("1/2", "2/2"):
        said = cli(*quick, "--keep", tmp_path / "kept", "--shard", shard, "--json")
        assert (said.code, said.out) == (0, "")
    assert len(list((tmp_path / "kept").iterdir())) == 3
    whole = cli(*quick, "--keep", tmp_path / "kept", "--csv", tmp_path / "all.csv", "--json")
    assert whole.rows == cli(*quick, "--json").rows
    with open(tmp_path / "all.csv", newline="") as file:
        table = list(csv.DictReader(file))
    assert [row["seed"] for row in table][:3] == ["7", "8", "9"]
    assert {row["seed"] for row in table[3:]} == {""}  # of several worlds
    assert {*whole.rows[0], "automodel", "commit", "machine"} == set(table[0])
    assert str(this_machine()["cores"]) in table[0]["machine"]


@pytest.mark.parametrize(
    ("options", "why"),
    [
        (["--shard", "1/2"], "--shard needs --keep DIR"),
        (["--shard", "3/2", "--keep", "kept"], "expected i/n with i from 1 to n, such as 1/4; got '3/2'"),
        (["--scheduler", "tcp://127.0.0.1:9", "--jobs", "2"], "--jobs and --scheduler"),
    ],
)
def test_what_makes_no_sweep_is_one_line(options: list[str], why: str, cli) -> None:
    said = cli(*QUICK, *options)
    assert said.code == 2
    assert why in said.line()


@pytest.mark.slow
def test_accuracy_is_the_same_in_other_processes(cli) -> None:
    one = cli(*QUICK, "--seeds", "2", "--jobs", "1", "--json")
    two = cli(*QUICK, "--seeds", "2", "--jobs", "2", "--json")
    assert (one.code, two.code) == (0, 0)
    assert one.rows == two.rows
    assert one.rows[0] != {**one.rows[1], "seed": 0}  # another light is another figure


def test_speed_has_its_keys(cli) -> None:
    said = cli("bench", "speed", "--frames", "10", "--json")
    assert said.code == 0
    assert all(list(row) == SPEED_KEYS for row in said.rows)
    assert said.rows[0]["stage"] == "total"
    assert all(0 <= row["p50_ms"] <= row["p99_ms"] for row in said.rows)
    machine = json.loads(said.out)["machine"]
    assert machine == {**this_machine(), "load_1min": machine["load_1min"]}


def test_the_machine_is_said_to_people_too(cli) -> None:
    said = cli("bench", "speed", "--frames", "10", "--pipeline", "contour")
    assert said.code == 0
    machine = this_machine()
    assert f"{machine['cores_usable']} of {machine['cores']} cores" in said.line()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("after_s", "arguments"),
    [
        (0.4, "accuracy --seeds 20 --jobs 2"),
        (1.0, "accuracy --seeds 20 --jobs 2"),
        (2.5, "accuracy --seeds 20 --jobs 2"),
        (4.0, "faults --pipeline truth --runs 100 --jobs 1"),  # a drive is under way, and has its own handlers
        (4.0, "latency --frames 3000"),
    ],
)
def test_ctrl_c_ends_the_bench_and_its_workers(after_s: float, arguments: str) -> None:
    child = subprocess.Popen(
        [sys.executable, "-m", "automodel", "bench", *arguments.split()],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
    )
    time.sleep(after_s)
    os.killpg(child.pid, signal.SIGINT)
    out, err = child.communicate(timeout=60)  # the pipes close when the last process has ended
    assert (child.returncode, out) == (1, "")
    assert [line for line in err.splitlines() if line] == ["automodel: interrupted"]


def test_random_worlds_have_their_keys_and_pictures(tmp_path: Path, cli) -> None:
    quick = ["bench", "accuracy", "--world", "random", "--pipeline", "windows", "--frames", "5", "--jobs", "1"]
    quick += ["--seed", "4", "--seeds", "2", "--kind", "plain"]
    said = cli(*quick, "--save-worst", tmp_path / "worst", "--plot", tmp_path / "plot.png", "--json")
    assert (said.code, said.err) == (0, "")
    keys = ["pipeline", "seed", "world", *ACCURACY_KEYS[4:], "phantom_pct", "estimate_pct"]
    assert [list(row) for row in said.rows] == 3 * [keys]
    assert [(row["seed"], row["frames"]) for row in said.rows] == [(4, 5), (5, 5), (None, 10)]
    assert len(list((tmp_path / "worst").glob("windows-*.png"))) == 2
    assert (tmp_path / "plot.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--world", "random", "--track", "tmr"), "--world random has its own drives: leave out --track"),
        (("--world", "random", "--table", "windows-paper"), "--world random has its own drives: leave out --table"),
        (("--kind", "plain"), "--kind is for --world random alone"),
        (("--save-worst", "x"), "--save-worst is for --world random alone"),
    ],
)
def test_options_of_other_drives_are_refused(options: tuple[str, ...], message: str, cli) -> None:
    said = cli("bench", "accuracy", *options)
    assert said.code == 2
    assert message in said.err


def test_sensitivity_names_the_numbers(cli) -> None:
    said = cli("bench", "sensitivity", "--list", "--only", "lane_motion", "--json")
    assert said.code == 0
    assert [row["pipelines"] for row in said.rows] == ["centerline windows contour"]
    assert cli("bench", "sensitivity", "--only", "no such number").code == 2

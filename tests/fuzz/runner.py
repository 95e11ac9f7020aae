"""Runs damaged files through the command line in this process, and looks at what comes of it."""

from __future__ import annotations

import contextlib
import faulthandler
import io
import os
import shutil
import signal
import sys
import tempfile
import traceback
from collections.abc import Iterator
from pathlib import Path
from random import Random

from automodel.cli.main import TRACEBACK
from tests.fuzz.damage import damaged
from tests.fuzz.targets import Target

CODES = (0, 1, 2)
OLDER = b"an older result"
HANG_S, HANG_CPU_S = 900.0, 60.0  # the process ends with a traceback then: by the clock, and by its own work


def trials(target: Target, count: int, seed: int, folder: Path) -> Iterator[tuple[int, str]]:
    """Numbers and texts of what was wrong, of `count` damaged files; empty where nothing was.

    A damaged file that was wrong is kept in `folder` as TARGET-SEED-NUMBER.
    """
    good = folder / f"{target.name}.good"
    good.mkdir()
    nothing = io.StringIO()
    with contextlib.redirect_stdout(nothing), contextlib.redirect_stderr(nothing):
        target.build(good)
    names = [str(path.relative_to(good)) for name in target.damaged for path in sorted(good.glob(name))]
    for number in range(count):
        random = Random(f"{target.name}/{seed}/{number}")
        name = random.choice(names)
        spoilt = damaged((good / name).read_bytes(), random)
        trial = folder / f"{target.name}.trial"
        shutil.copytree(good, trial)
        (trial / name).write_bytes(_moved(spoilt, good, trial))
        if name != "car.toml" and (trial / "car.toml").exists():
            (trial / "car.toml").write_bytes(_moved((good / "car.toml").read_bytes(), good, trial))
        if number % 2:  # an older result is there
            for out in target.out:
                (trial / out).write_bytes(OLDER)
        text = _wrong(target, trial, trial / name)
        if text:
            shutil.copy(trial / name, folder / f"{target.name}-{seed}-{number}")
        shutil.rmtree(trial)
        yield number, text


def _moved(data: bytes, good: Path, trial: Path) -> bytes:
    return data.replace(str(good).encode(), str(trial).encode())


def _wrong(target: Target, trial: Path, file: Path) -> str:
    """What was wrong with how a command took its files; empty where nothing was."""
    before = {path.name for path in trial.iterdir()}
    given = [argument.replace("{}", str(trial)).replace("{file}", str(file)) for argument in target.arguments]
    code, said = _said(target, trial, given)
    left = {path.name for path in trial.iterdir()} - before
    lines = [line for line in said.splitlines() if not line.startswith("replay: ")]  # its progress, where it is shown
    if "Traceback" in said:
        return f"traceback: {lines[-1]}"
    if code not in CODES:
        return f"exit code {code}"
    if code == 2 and len(lines) != 1:
        return f"{len(lines)} lines: {said[:300]!r}"
    if code == 2 and left:
        return f"left behind: {left}"
    lost = {name for name in before & set(target.out) if code == 2 and (trial / name).read_bytes() != OLDER}
    if lost:
        return f"an older one is lost: {lost}"
    return f"half written: {left}" if left - set(target.out) else ""


def _said(target: Target, trial: Path, arguments: list[str]) -> tuple[int, str]:
    """The exit code, and what came on stderr, from libraries as well."""
    os.environ[TRACEBACK] = "1"
    with tempfile.TemporaryFile() as file, open(os.devnull, "w", encoding="utf-8") as nothing:
        kept, out, err, before = os.dup(2), sys.stdout, sys.stderr, os.getcwd()
        os.dup2(file.fileno(), 2)
        faulthandler.dump_traceback_later(HANG_S, exit=True, file=kept)
        faulthandler.register(signal.SIGPROF, file=kept, chain=True)  # and then the process ends
        signal.setitimer(signal.ITIMER_PROF, HANG_CPU_S)
        sys.stdout, sys.stderr = nothing, open(2, "w", encoding="utf-8", closefd=False)  # noqa: SIM115 - until below
        try:
            os.chdir(trial)  # what is written where one stands
            code = target.call(arguments)
        except Exception:  # noqa: BLE001 - what the variable lets through
            code = 1
            traceback.print_exc()
        finally:
            sys.stderr.flush()
            sys.stdout, sys.stderr = out, err
            os.chdir(before)
            faulthandler.cancel_dump_traceback_later()
            signal.setitimer(signal.ITIMER_PROF, 0.0)
            faulthandler.unregister(signal.SIGPROF)
            os.dup2(kept, 2)
            os.close(kept)
            del os.environ[TRACEBACK]
        file.seek(0)
        return code, file.read().decode(errors="replace")

"""The catalogue of mistakes fits the tree, and some of them are tried."""

from __future__ import annotations

import hashlib
import random
import shutil
from pathlib import Path

import pytest

from tests.mutations.__main__ import main
from tests.mutations.catalogue import LAYERS, MUTATIONS, Mutation
from tests.mutations.runner import ROOT, Copy, Outcome

SAMPLE = 3  # two minutes: the copy's loops are compiled first; ten on a machine that is busy with other work


@pytest.mark.parametrize("mutation", MUTATIONS, ids=[mutation.name for mutation in MUTATIONS])
def test_a_mutation_fits_the_tree(mutation: Mutation) -> None:
    assert (ROOT / mutation.file).read_text(encoding="utf-8").count(mutation.old) == 1
    assert mutation.old != mutation.new
    assert all((ROOT / tests).exists() for tests in mutation.tests)


def test_names_are_given_once_and_unknown_ones_refused(capsys: pytest.CaptureFixture[str]) -> None:
    assert len({mutation.name for mutation in MUTATIONS}) == len(MUTATIONS)
    assert main(["no-such"]) == 2
    assert capsys.readouterr().err == "mutations: no-such: no such mutation\n"


def test_what_covers_a_mistake_is_said_of_one_that_is_there(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    names = {mutation.name for mutation in MUTATIONS}
    assert set(LAYERS) <= names
    covered, bare = next(iter(LAYERS)), next(name for name in sorted(names) if name not in LAYERS)

    class NoCopy:
        def __init__(self, folder: Path) -> None: ...
        def by_bench(self, mutation: Mutation) -> str | None:
            return "camera-off: late" if mutation.name not in (covered, bare) else None

    monkeypatch.setattr("tests.mutations.__main__.Copy", NoCopy)
    assert main(["--bench", covered]) == 0
    assert f"covered: {LAYERS[covered]}" in capsys.readouterr().out
    assert main(["--bench", bare]) == 1
    assert "SURVIVED" in capsys.readouterr().out
    assert main(["--bench", next(name for name in sorted(names) if name not in (covered, bare))]) == 0
    assert "found: camera-off: late" in capsys.readouterr().out


def sampled() -> list[Mutation]:
    """Others after each change of a file that is mutated; without the firmware where it cannot be built."""
    texts = [(ROOT / file).read_bytes() for file in sorted({mutation.file for mutation in MUTATIONS})]
    builds = all(map(shutil.which, ("make", "g++", "avr-g++")))
    possible = [mutation for mutation in MUTATIONS if builds or mutation.file.endswith(".py")]
    return random.Random(hashlib.sha256(b"".join(texts)).digest()).sample(possible, SAMPLE)


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_some_mistakes_are_found(tmp_path: Path) -> None:
    copy = Copy(tmp_path)
    survivors = [mutation.name for mutation in sampled() if copy.outcome(mutation) is not Outcome.FOUND]
    assert survivors == []


@pytest.mark.slow
def test_a_mistake_that_no_test_looks_for_survives(tmp_path: Path) -> None:
    harmless = Mutation(
        name="harmless",
        file="automodel/runtime/clocks.py",
        old="from __future__ import annotations",
        new="from __future__ import annotations  # changed",
        tests=("tests/runtime/test_clocks.py",),
    )
    assert Copy(tmp_path).outcome(harmless) is Outcome.SURVIVED

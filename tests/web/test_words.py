from __future__ import annotations

import pytest

from automodel.web.words import LONGEST, Word, from_bytes, from_page, to_bytes


@pytest.mark.parametrize("word", Word)
def test_each_word_comes_through(word: Word) -> None:
    said = from_page(word.name.lower())
    assert said is word
    assert from_bytes(to_bytes(word)) is word


def test_what_a_hand_wants_comes_through_to_the_bit() -> None:
    said = from_page("drive -0.123 1")
    assert said == (-0.123, 1.0)
    assert len(to_bytes((-0.123, 1.0))) == LONGEST
    assert from_bytes(to_bytes((-0.123, 1.0))) == said


@pytest.mark.parametrize(
    "text",
    [
        "", "STOP", "stop ", "drive", "drive 0", "drive 0 0 0", "drive nan 0", "drive 0 nan", "drive inf 0",
        "drive 0 -inf", "drive 1.001 0", "drive 0 -1.001", "drive a b", "steer 0 0", "drive  0", "drive 1e400 0",
    ],
)  # fmt: skip
def test_anything_else_is_no_word(text: str) -> None:
    assert from_page(text) is None


@pytest.mark.parametrize("data", [b"", b"X", b"SS", b"D" * (LONGEST - 1)])
def test_other_bytes_are_refused(data: bytes) -> None:
    with pytest.raises(ValueError):
        from_bytes(data)

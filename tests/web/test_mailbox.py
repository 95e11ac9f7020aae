from __future__ import annotations

import multiprocessing

from automodel.web.mailbox import Mailbox


def mailbox(capacity: int = 16) -> Mailbox:
    return Mailbox(multiprocessing.get_context("spawn"), capacity)


def both_ends(box: Mailbox) -> Mailbox:
    """The reader's end: the same memory, its own count of what it has taken."""
    reader = object.__new__(Mailbox)
    reader.__dict__.update(box.__dict__)
    return reader


def test_the_newest_message_is_taken_once() -> None:
    box = mailbox()
    reader = both_ends(box)
    assert reader.take() is None
    assert box.put(b"first")
    assert box.put(b"second")
    assert reader.take() == b"second"
    assert reader.take() is None
    assert box.put(b"third")
    assert reader.take() == b"third"


def test_a_side_that_holds_the_lock_costs_a_message_and_no_wait() -> None:
    box = mailbox()
    reader = both_ends(box)
    assert box.put(b"before")
    with box._lock:  # both return at all: a side that waited would stand here for ever
        assert not box.put(b"lost")
        assert reader.take() is None
    assert reader.take() == b"before"
    assert box.put(b"after")
    assert reader.take() == b"after"


def test_what_is_too_long_is_refused_and_the_last_stays() -> None:
    box = mailbox(4)
    reader = both_ends(box)
    assert box.put(b"1234")
    assert not box.put(b"12345")
    assert reader.take() == b"1234"

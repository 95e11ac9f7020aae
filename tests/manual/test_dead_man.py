from __future__ import annotations

from collections.abc import Callable

import pytest

from automodel.manual.dead_man import HOLD_TIMEOUT_S, DeadMan

MS = 1_000_000
PLACE = "the web page"


def held_at(now_ns: int) -> DeadMan:
    dead_man = DeadMan(PLACE)
    dead_man.press(now_ns)
    return dead_man


def test_pressing_arms_once() -> None:
    dead_man = held_at(0)
    assert dead_man.take_arm()
    dead_man.press(100 * MS)
    dead_man.hold(200 * MS)
    assert not dead_man.take_arm()


def test_a_held_button_that_is_heard_of_never_stops() -> None:
    dead_man = held_at(0)
    for now_ms in range(100, 10_000, 100):
        dead_man.hold(now_ms * MS)
        assert dead_man.overdue(now_ms * MS + 99 * MS) is None


def test_silence_stops_after_500_ms_and_says_so_once() -> None:
    dead_man = held_at(0)
    limit_ns = round(HOLD_TIMEOUT_S * 1e9)
    assert limit_ns == 500 * MS
    assert dead_man.overdue(limit_ns - 1) is None
    assert dead_man.overdue(limit_ns) == "the web page's button has not been heard of for 0.5 s"
    assert dead_man.overdue(2 * limit_ns) is None
    assert not dead_man.take_arm()  # a request that nobody stands behind any more


@pytest.mark.parametrize("end", [DeadMan.release, DeadMan.stop])
def test_letting_go_and_stop_stop_at_once_and_take_the_request_back(end: Callable[[DeadMan], str | None]) -> None:
    dead_man = held_at(0)
    assert end(dead_man) is not None
    assert not dead_man.held
    assert not dead_man.take_arm()
    assert dead_man.overdue(10_000 * MS) is None


def test_holding_without_a_press_arms_nothing() -> None:
    dead_man = DeadMan(PLACE)
    dead_man.hold(0)
    assert not dead_man.held
    assert not dead_man.take_arm()
    assert dead_man.release() is None  # nothing was held: a car armed at the terminal drives on


def test_stop_stops_a_car_that_the_button_did_not_arm() -> None:
    assert DeadMan(PLACE).stop() == "STOP on the web page"

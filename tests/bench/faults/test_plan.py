from __future__ import annotations

import math
from dataclasses import replace

import pytest

from automodel.bench.faults import page
from automodel.bench.faults.catalogue import CAN, FAULTS, NOMINAL, ON_CHIP, chosen
from automodel.bench.faults.fault import Kind, Must
from automodel.bench.faults.judge import REARM_S, START_NS, at_another_place, draw_plan

PLANS = [(fault, draw_plan(fault, 7, index, 4)) for fault in (*FAULTS, *CAN) for index in range(30)]


def test_the_same_seed_gives_the_same_plan_and_another_one_another() -> None:
    for fault in FAULTS:
        assert draw_plan(fault, 7, 3, 4) == draw_plan(fault, 7, 3, 4)
        assert len({draw_plan(fault, seed, index, 4) for seed in (7, 8) for index in (0, 1)}) == 4
        plan = draw_plan(fault, 7, 3, 4)
        assert plan.hooks_random().random() == plan.hooks_random().random()


def test_a_fault_starts_at_any_time_of_a_servo_frame_and_of_a_frame() -> None:
    starts = [plan.start_ns for fault, plan in PLANS if not fault.from_start]
    assert all(START_NS[0] <= start <= START_NS[1] for start in starts)
    for period_ns in (20_000_000, 16_666_667):
        assert {start % period_ns * 8 // period_ns for start in starts} == set(range(8))


def test_a_request_is_either_too_early_or_in_time() -> None:
    seen = set()
    for fault, plan in PLANS:
        if fault.must is not Must.STOP or plan.press_ns is None:
            assert not plan.drives_again
            continue
        if plan.drives_again:
            assert plan.press_ns >= plan.end_ns + (REARM_S + fault.recovery_s) * 1e9
        else:
            assert fault.host_notices
            assert not fault.ends or plan.press_ns < plan.end_ns + REARM_S * 1e9
        assert plan.press_ns < plan.until_ns
        seen.add(plan.drives_again)
    assert seen == {True, False}


def test_a_stopped_car_is_watched_for_longer_than_arming_takes() -> None:
    for fault, plan in PLANS:
        if fault.must is Must.STOP and fault.ends:
            assert plan.until_ns >= plan.end_ns + (REARM_S + fault.recovery_s) * 1e9


def test_every_way_of_failing_is_there_and_every_name_once() -> None:
    assert {fault.kind for fault in FAULTS} == set(Kind) - {Kind.NONE}
    names = [fault.name for fault in (*FAULTS, *CAN, NOMINAL)]
    assert len(names) == len(set(names))
    assert sum(not fault.pairs for fault in FAULTS) <= 73  # a run of each in the fast lane
    for fault in FAULTS:
        assert fault.duration_s[0] <= fault.duration_s[1]
        assert math.isfinite(fault.recovery_s)


def test_the_bound_is_150_ms_but_for_what_shows_later_or_grows() -> None:
    assert all(fault.within_s <= 0.1 for fault in CAN if fault.must is Must.STOP)
    longer = [fault.name for fault in FAULTS if fault.must in (Must.STOP, Must.HOLD) and fault.within_s != 0.15]
    assert sorted(longer) == [
        "board-time-stuck",
        "camera-drops-3",
        "camera-flaps",
        "perception-jump",
        "perception-uncertain",
        "serial-falls-behind",
        "servo-stuck",
        "slip-slides",
    ]


def test_faults_are_chosen_by_name() -> None:
    assert chosen(()) == (*FAULTS, *CAN)
    assert [chosen((), link=link) for link in ("arduino", "avr", "can")] == [FAULTS, ON_CHIP, CAN]
    assert [fault.name for fault in chosen(("disk-full", "camera-off", "disk-full"))] == ["camera-off", "disk-full"]
    assert chosen(("nominal",)) == (NOMINAL,)
    with pytest.raises(ValueError, match=r"'camera-of': no such fault; near: camera-off"):
        chosen(("camera-of",))
    with pytest.raises(ValueError, match=r"'hang': no such fault; near: board-hang"):
        chosen(("hang",))
    with pytest.raises(ValueError, match=r"'zzz': no such fault; see --list"):
        chosen(("zzz",))


def test_what_needs_images_is_left_out_where_there_are_none() -> None:
    needing = {fault.name for fault in FAULTS if fault.images}
    assert needing == {"network-slides", "network-jumps", "network-adds"}
    assert needing.isdisjoint(fault.name for fault in chosen((), images=False))
    with pytest.raises(ValueError, match=r"'network-adds': needs a pipeline that looks at images"):
        chosen(("network-adds",), images=False)


def test_what_needs_two_cameras_is_left_out_where_there_is_one() -> None:
    needing = {fault.name for fault in FAULTS if fault.pairs}
    assert needing == {
        *("pair-off", "pair-stuck", "pair-dark", "pair-times", "pair-swapped", "pair-turned"),
        *("rig-swapped", "rig-turned"),
    }
    assert needing.isdisjoint(fault.name for fault in chosen((), pairs=False))
    reported = {fault.name for fault in FAULTS if fault.must is Must.STAY and math.isinf(fault.outside_m)}
    assert reported == {"pair-swapped", "pair-turned"}
    assert needing.isdisjoint(fault.name for fault in chosen((), images=False))
    with pytest.raises(ValueError, match=r"'pair-off': needs a pipeline of two cameras"):
        chosen(("pair-off",), pairs=False)


def test_what_is_there_from_the_start_is_asked_about_while_it_lasts() -> None:
    found = [plan for fault, plan in PLANS if fault.from_start]
    assert len(found) == 60
    for plan in found:
        assert (plan.start_ns, plan.rendered_ns, plan.pipeline_ns, plan.drives_again) == (0, 0, 0, False)
        assert plan.press_ns is not None
        assert plan.press_ns < plan.until_ns - 0.4e9
        assert plan.until_ns >= 2.5e9


def test_a_person_asks_to_arm_a_car_that_stands() -> None:
    for fault, plan in PLANS:
        if plan.drives_again and plan.press_ns is not None:
            stopped_s = min(fault.within_s, 4.0) + plan.coast_s
            assert plan.press_ns >= plan.start_ns + (stopped_s + REARM_S) * 1e9


def test_a_minute_without_a_fault_is_anywhere_in_any_light() -> None:
    plans = [draw_plan(NOMINAL, 7, index, 4) for index in range(40)]
    assert {plan.track for plan in plans} == {"oval", "chicane", "tmr"}
    assert len({plan.look for plan in plans}) == 40
    assert {plan.track for _, plan in PLANS} == {"oval"}
    assert {plan.look for _, plan in PLANS} == {0, 1, 2, 3}


def test_a_run_at_another_place_is_the_same_one_elsewhere() -> None:
    plan = draw_plan(chosen(("camera-off",))[0], 3, 5, 4)
    assert at_another_place(plan, 0) == plan
    places = [at_another_place(plan, attempt).place for attempt in range(8)]
    assert len(set(places)) == 8
    assert replace(at_another_place(plan, 7), place=plan.place) == plan


def test_the_readme_has_the_table_of_the_faults() -> None:
    """`automodel bench faults --list` and the page say the same; `python -m automodel.bench.faults.page` writes it."""
    assert page.PAGE.read_text(encoding="utf-8") == page.text()

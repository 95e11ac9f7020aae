"""Which of a pipeline's lane changes are taken, missed and false."""

from __future__ import annotations

from automodel.bench.lane_changes import KINDS, SECONDS, LaneDrive, cases_of, judged, measure_drive, planned, summary
from automodel.sim.highway import LaneChange

TWO = (LaneChange(from_s=2.0, lasts_s=4.0, to=1), LaneChange(from_s=8.0, lasts_s=4.0, to=-1))


def test_a_change_is_taken_once_and_all_else_is_false() -> None:
    found = judged(TWO, [(4.5, 1, 0.8), (10.5, -1, 1.2)])
    assert (found["taken"], found["missed"], found["false"]) == (2, 0, 0)
    assert found["change_at_pct"] is not None
    assert abs(found["change_at_pct"] - 80.0) < 1e-9  # 0.8 of half a lane to the left, then 2.0 - 1.2 to the right
    twice = judged(TWO, [(4.5, 1, 0.8), (4.6, 1, 0.9), (10.5, 1, 1.2)])
    assert (twice["taken"], twice["missed"], twice["false"]) == (1, 1, 2)  # again, and to the wrong side
    early = judged(TWO, [(1.9, 1, 0.0), (7.1, 1, 2.0)])
    assert (early["taken"], early["missed"], early["false"]) == (0, 2, 2)
    assert judged((), [])["change_at_pct"] is None


def test_the_drives_have_as_many_changes_and_minutes_as_asked_for() -> None:
    cases = cases_of(20, 2.0, 5)
    changes = [planned(case, 3) for case in cases if case.kind == "changes"]
    assert 20 <= sum(len(plan[1]) for plan in changes) < 25
    for first, plan, _, _ in changes:
        lanes = [first]
        for change in plan:
            lanes.append(lanes[-1] + change.to)
        assert set(lanes) <= {0, 1, 2}
        ends = [change.from_s + change.lasts_s for change in plan]
        assert all(one < other.from_s for one, other in zip(ends, plan[1:], strict=False))
    weaving = [case for case in cases if case.kind == "weaving"]
    assert sum(case.seconds for case in weaving) >= 120.0
    assert all(planned(case, 3)[1] == () and planned(case, 3)[2] < 0.75 * 1.75 for case in weaving)


def test_a_short_drive_is_measured() -> None:
    row = measure_drive(LaneDrive(kind="weaving", seed=1, seconds=1.0), lambda share: None)
    assert (row["changes"], row["false"], row["seconds"]) == (0, 0, 1.0)
    total = summary("weaving", [row, row])
    assert (total["drives"], total["minutes"], total["change_at_pct"]) == (2, 2.0 / 60.0, None)
    assert SECONDS == 25.0
    assert KINDS == ("changes", "weaving")

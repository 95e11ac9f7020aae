"""Finding a servo with keys: the dialog as a value."""

from __future__ import annotations

import pytest

from automodel.config import ServoConfig
from calibration.servo_dialogue import Dialog, DialogError, ends_of, keys_of, side_angles


def typed(text: str) -> Dialog:
    dialog = Dialog(low_us=1000.0, high_us=2000.0, pulse_us=1500.0)
    for key in keys_of(text):
        dialog = dialog.key(key)
    return dialog


LEFT, RIGHT = "\x1b[D", "\x1bOC"  # arrows come in both forms


def test_keys_move_the_pulse() -> None:
    assert typed(LEFT + LEFT + RIGHT + ",").pulse_us == 1494.0
    assert typed("]]..[").pulse_us == 1527.0


def test_the_pulse_stays_within_the_span_and_says_so() -> None:
    dialog = typed("[" * 30)
    assert dialog.pulse_us == 1000.0
    assert "limit reached" in dialog.line()
    assert typed("]" * 30).pulse_us == 2000.0


def test_a_whole_dialog() -> None:
    dialog = typed("..c" + "[" * 12 + "l" + "g" + "]" * 10 + "r" + "\r")
    assert dialog.done
    ends = ends_of(dialog)
    assert (ends.left_us, ends.centre_us, ends.right_us) == (1202.0, 1502.0, 1752.0)
    pulse_us, steering_rad = ends.table(0.4, 0.3)
    assert (pulse_us, steering_rad) == ((1202.0, 1502.0, 1752.0), (0.4, 0.0, -0.3))
    ServoConfig(pulse_us=pulse_us, steering_rad=steering_rad)


def test_a_servo_that_turns_the_other_way_has_its_left_end_above() -> None:
    ends = ends_of(typed("c" + "[" * 10 + "r" + "g" + "]" * 8 + "l"))
    assert ends.table(0.4, 0.3) == ((1250.0, 1500.0, 1700.0), (-0.3, 0.0, 0.4))


def test_enter_does_not_end_before_all_is_found() -> None:
    dialog = typed("c\n")
    assert not dialog.done
    assert "still to be found: left (l), right (r)" in dialog.line()


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("l]]]cr", "does not lie between"),
        ("[[[l]]]c]]]]]l[r", "does not lie between"),
        ("c[[[[l]]]]]r", "only 25 us from straight"),
    ],
)
def test_what_is_no_servo_is_refused(text: str, said: str) -> None:
    with pytest.raises(DialogError, match=said):
        ends_of(typed(text))
    assert not typed(text + "\r").done


def test_other_keys_change_nothing() -> None:
    assert typed("xyz\x1b[A\x1b[B g") == Dialog(low_us=1000.0, high_us=2000.0, pulse_us=1500.0)
    assert typed("q").given_up


def test_angles_of_the_ends_are_given_or_stay() -> None:
    assert side_angles((0.4, 0.0, -0.3), (None, None)) == (0.4, 0.3)
    assert side_angles((-0.3, 0.0, 0.4), (20.0, None)) == pytest.approx((0.349066, 0.3))

"""car.toml is changed whole or not at all, and keeps what people wrote into it."""

from __future__ import annotations

import datetime
import os
import stat
from pathlib import Path

import numpy as np
import pytest

from automodel.config import CalibrationRecord, ConfigError, load_car
from calibration.car_file import update_car_file

DAY = datetime.date(2026, 2, 3)
TEXT = """\
# the car of team 7
[camera]  # front
source = "usb" # under the roof
width_px = 640

[camera.intrinsics]
fx_px = 480.0   # a guess

# the lane of our hall
[lane]
width_m = 0.42

[camera.extrinsics]
z_m = 0.2
"""


def update(path: Path, values=None, **changed) -> Path | None:
    values = values or {"camera.intrinsics": {"fx_px": 500.5, "fy_px": 501.0}}
    return update_car_file(path, values, **{"residual": "0.3 px", "date": DAY, "method": "board", **changed})


@pytest.fixture
def car(tmp_path: Path) -> Path:
    path = tmp_path / "car.toml"
    path.write_text(TEXT)
    return path


def test_values_change_and_all_else_stays_line_by_line(car: Path) -> None:
    backup = update(car)
    assert backup == car.with_name("car.toml.bak")
    assert backup.read_text() == TEXT
    assert car.read_text() == TEXT.replace("fx_px = 480.0 ", "fx_px = 500.5 ").replace(
        "# a guess\n", "# a guess\nfy_px = 501.0\n"
    ) + (
        '\n[calibration.camera]\ndate = 2026-02-03\nmethod = "board"\nresidual = "0.3 px"\n'
        'mode = "usb 640x360, the driver\'s sensor mode"\n'
    )
    assert sorted(p.name for p in car.parent.iterdir()) == ["car.toml", "car.toml.bak"]


def test_the_record_can_be_read(car: Path) -> None:
    update(car, residual="0.84 px rms", method="chessboard 9x6, 15 views")
    found = load_car(car)
    record = CalibrationRecord(
        date=DAY, method="chessboard 9x6, 15 views", residual="0.84 px rms", mode=found.camera.mode
    )
    assert found.calibration.camera == record
    assert found.other_mode is None
    assert found.calibration.ground is None
    assert found.camera.intrinsics.fy_px == 501.0
    assert found.lane.width_m == 0.42


def test_only_the_lens_belongs_to_a_mode(car: Path) -> None:
    update(car, {"link.servo": {"pulse_us": (1000.0, 1500.0), "steering_rad": (0.3, 0.0)}})
    servo = load_car(car).calibration.servo
    assert servo is not None
    assert servo.mode == ""


def test_the_right_camera_s_record_says_its_own_mode(car: Path) -> None:
    update(car, {"camera.right": {"flip": "rotate-180"}, "camera.right.intrinsics": {"fx_px": 500.0}})
    found = load_car(car)
    assert found.calibration.stereo is not None
    assert found.calibration.stereo.mode == "usb 640x360, the driver's sensor mode, flip rotate-180"
    assert found.calibration.camera is None
    assert found.other_right_mode is None


def test_a_new_section_stands_with_its_relatives(car: Path) -> None:
    update(car, {"link.servo": {"pulse_us": (1000.0, 1500.0), "steering_rad": np.array([0.3, 0.0])}})
    update(car, {"link.motor": {"pulse_us": [1400.0, 1500.0], "speed_mps": [-1.0, 0.0]}})
    headers = [line.split()[0] for line in car.read_text().splitlines() if line.startswith("[")]
    assert headers[-4:] == ["[link.servo]", "[link.motor]", "[calibration.servo]", "[calibration.odometry]"]
    assert load_car(car).link.servo.steering_rad == (0.3, 0.0)


def test_every_update_keeps_its_own_backup(car: Path) -> None:
    texts = [car.read_text()]
    for number in range(3):
        update(car, {"camera.intrinsics": {"fx_px": 500.0 + number}})
        texts.append(car.read_text())
    names = ["car.toml.bak", "car.toml.bak.2", "car.toml.bak.3"]
    assert [car.with_name(name).read_text() for name in names] == texts[:3]


@pytest.mark.parametrize(
    "text",
    [
        "camera = {width_px = 640, intrinsics = {fx_px = 470.0}}  # one line\n",
        "[camera]\nwidth_px = 640\nintrinsics.fx_px = 470.0 # dotted\n",
        "camera.intrinsics.fx_px = 470.0\nlane.width_m = 0.4\n",
        "[camera]\r\nwidth_px = 640 # dos\r\n[camera.intrinsics]\r\nfx_px = 1.0\r\n",
        "[camera.intrinsics]\nfx_px = 470.0",
        '["camera" . "intrinsics"]\nfx_px = 470.0\n',
        "",
        "# only a comment",
        "[lane]\nwidth_m = 0.4\n[calibration.camera]\ndate = 2020-01-01\nmethod = ''\nresidual = ''\n",
        "[link.servo]\npulse_us = [\n  1000, # left\n  2000,\n]\nsteering_rad = [0.4,\n -0.4]\n",
    ],
)
def test_any_way_to_write_toml(tmp_path: Path, text: str) -> None:
    path = tmp_path / "car.toml"
    path.write_bytes(text.encode())
    before = load_car(path)
    update(path, {"camera.intrinsics": {"fx_px": 500.5, "distortion": [0.1, 0.0, 0.0, 0.0, 0.0]}})
    after = load_car(path)
    assert after.camera.intrinsics.fx_px == 500.5
    assert after.camera.intrinsics.distortion[0] == 0.1
    assert after.calibration.camera is not None
    assert after.calibration.camera.date == DAY
    assert (after.lane, after.link, after.camera.width_px) == (before.lane, before.link, before.camera.width_px)
    for comment in (part.split("\n")[0].strip() for part in text.split("#")[1:]):
        assert f"# {comment}" in path.read_text()


def test_a_file_that_is_not_there_is_made(tmp_path: Path) -> None:
    path = tmp_path / "car.toml"
    assert update(path) is None
    assert load_car(path).camera.intrinsics.fx_px == 500.5
    assert [p.name for p in tmp_path.iterdir()] == ["car.toml"]


def test_a_link_stays_a_link(tmp_path: Path) -> None:
    real = tmp_path / "cars" / "seven.toml"
    real.parent.mkdir()
    real.write_text(TEXT)
    real.chmod(0o640)
    link = tmp_path / "car.toml"
    link.symlink_to(real)
    backup = update(link)
    assert link.is_symlink()
    assert backup == real.with_name("seven.toml.bak")
    assert stat.S_IMODE(real.stat().st_mode) == 0o640
    assert load_car(link).camera.intrinsics.fx_px == 500.5


def untouched(folder: Path, before: dict[str, bytes]) -> bool:
    return {p.name: p.read_bytes() for p in folder.iterdir() if p.is_file()} == before


def test_values_that_do_not_load_change_nothing(car: Path) -> None:
    before = {"car.toml": TEXT.encode()}
    with pytest.raises(ConfigError, match=r"fx_px: expected .*\(with the new values; .* is unchanged\)"):
        update(car, {"camera.intrinsics": {"fx_px": -1.0}})
    with pytest.raises(ConfigError, match="focal_px: unknown key"):
        update(car, {"camera.intrinsics": {"focal_px": 1.0}})
    with pytest.raises(ValueError, match="expected a section that a calibration writes, got lane"):
        update(car, {"lane": {"width_m": 0.5}})
    assert untouched(car.parent, before)


def test_a_wrong_file_is_named_and_left(car: Path) -> None:
    car.write_text("[camera]\nwidht_px = 640\n")
    with pytest.raises(ConfigError, match=r"car.toml:2: \[camera\] widht_px: unknown key; did you mean width_px\?$"):
        update(car)
    assert untouched(car.parent, {"car.toml": b"[camera]\nwidht_px = 640\n"})


@pytest.mark.parametrize("failing", ["replace", "fsync"])
@pytest.mark.parametrize("error", [KeyboardInterrupt(), OSError(28, "No space left on device")])
def test_what_breaks_in_leaves_everything_as_it_was(car: Path, monkeypatch, failing: str, error: BaseException) -> None:
    def fail(*_: object) -> None:
        raise error

    monkeypatch.setattr(os, failing, fail)
    with pytest.raises((KeyboardInterrupt, ConfigError)) as caught:
        update(car)
    monkeypatch.undo()
    if isinstance(error, OSError):
        assert str(caught.value) == f"{car}: cannot be written: No space left on device; it is unchanged"
    assert untouched(car.parent, {"car.toml": TEXT.encode()})


def test_an_interrupt_after_the_change_keeps_the_backup(car: Path, monkeypatch) -> None:
    def replace_and_fail(source: Path, target: Path) -> None:
        os.rename(source, target)
        raise KeyboardInterrupt

    monkeypatch.setattr(os, "replace", replace_and_fail)
    with pytest.raises(KeyboardInterrupt):
        update(car)
    assert car.with_name("car.toml.bak").read_text() == TEXT
    assert load_car(car).camera.intrinsics.fx_px == 500.5


def test_what_cannot_be_written_is_one_line(car: Path, tmp_path: Path) -> None:
    car.chmod(0o444)
    with pytest.raises(ConfigError, match="cannot be written: the file is read-only; it is unchanged"):
        update(car)
    assert untouched(tmp_path, {"car.toml": TEXT.encode()})
    with pytest.raises(ConfigError, match="cannot be written: No such file or directory"):
        update(tmp_path / "nowhere" / "car.toml")
    with pytest.raises(ConfigError, match="Is a directory"):
        update(tmp_path)


@pytest.mark.parametrize("date", ['"2026-02-03"', "2026-02-03T10:00:00", "20260203"])
def test_a_date_is_a_date(tmp_path: Path, date: str) -> None:
    path = tmp_path / "car.toml"
    path.write_text(f'[calibration.camera]\ndate = {date}\nmethod = "x"\nresidual = "y"\n')
    with pytest.raises(ConfigError, match=r"car.toml:2: \[calibration.camera\] date: expected a date"):
        load_car(path)

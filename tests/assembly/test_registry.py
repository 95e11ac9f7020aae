from __future__ import annotations

import sys
from importlib import metadata
from pathlib import Path

import numpy as np
import pytest

from automodel import Command, Frame, LaneEstimate, LaneStatus, Motion, MotionSource
from automodel.assembly.parts import (
    is_live_camera,
    left_alone,
    make_camera,
    make_controller,
    make_link,
    make_pipeline,
)
from automodel.assembly.registry import find_part
from automodel.config import CarConfig, ConfigError, parse_car
from automodel.config.parts import CAMERAS, CONTROLLERS, LINKS, PIPELINES, PartKind

TEAM = """
from automodel import Command, LaneEstimate, LaneStatus

class Blind:
    name = "blind"
    def __init__(self, car):
        self.width_m = car.lane.width_m
    def step(self, frame, motion):
        return LaneEstimate(t_ns=frame.t_ns, status=LaneStatus.LOST)
    def reset(self):
        pass

class Straight:
    def __init__(self, car):
        self.speed_mps = car.control.speed_mps
    def step(self, estimate, motion, state, t_ns):
        return Command(t_ns=t_ns, steering_rad=0.0, speed_mps=self.speed_mps, valid_until_ns=t_ns + 10**8)
    def reset(self):
        pass

class Pipe:
    def __init__(self, car):
        self.port = car.link.port
    def open(self): ...
    def poll(self, now_ns): ...
    def send(self, command, now_ns): ...
    def arm(self, now_ns): ...
    def disarm(self, now_ns): ...
    def close(self): ...

class Webcam:
    def __init__(self, camera):
        self.size = (camera.width_px, camera.height_px)
    def read(self, timeout_s): ...
    def close(self): ...

class Half:
    def __init__(self, car): ...
    def step(self, frame, motion): ...

class Bare:
    pass

class Refuses:
    def __init__(self, car):
        raise ValueError("needs a camera of 1 m height")

NUMBER = 3
"""


@pytest.fixture
def team(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    """A module of a team in the current folder, which is not installed."""
    name = f"team_{tmp_path.name.replace('-', '_')}"
    (tmp_path / f"{name}.py").write_text(TEAM)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", list(sys.path))
    return name


@pytest.mark.parametrize("kind", [PIPELINES, CONTROLLERS, LINKS, CAMERAS], ids=lambda kind: kind.kind)
def test_every_name_of_ours_is_something_that_can_be_made(kind: PartKind) -> None:
    for name in kind.names:
        assert callable(find_part(kind, name))


def test_a_part_in_the_current_folder_is_made(team: str) -> None:
    car = parse_car(
        f'[pipeline]\nname = "{team}:Blind"\n[control]\ncontroller = "{team}:Straight"\nspeed_mps = 0.7\n'
        f'[link]\nkind = "{team}:Pipe"\nport = "/dev/ttyX"\n[camera]\nsource = "{team}:Webcam"\nwidth_px = 320\n',
        "car.toml",
    )
    motion = Motion(t_ns=5, speed_mps=0.0, yaw_rate_radps=0.0, source=MotionSource.NONE)
    frame = Frame(t_ns=5, index=0, image=np.zeros((360, 320), np.uint8))
    estimate = make_pipeline(car.pipeline.name, car).step(frame, motion)
    assert estimate.status is LaneStatus.LOST
    command = make_controller(car).step(LaneEstimate(t_ns=5, status=LaneStatus.LOST), motion, None, 5)
    assert isinstance(command, Command)
    assert command.speed_mps == 0.7
    assert make_link(car).port == "/dev/ttyX"  # type: ignore[attr-defined]
    assert is_live_camera(car)
    assert make_camera(car).size == (320, 360)  # type: ignore[attr-defined]


def test_a_part_of_an_installed_package_is_found_by_its_entry_point(
    team: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    folder = tmp_path / "team_lane-1.0.dist-info"
    folder.mkdir()
    (folder / "METADATA").write_text("Metadata-Version: 2.1\nName: team-lane\nVersion: 1.0\n")
    (folder / "entry_points.txt").write_text(f"[automodel.pipelines]\nblind = {team}:Blind\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    assert "blind" in {entry.name for entry in metadata.entry_points(group="automodel.pipelines")}
    car = parse_car('[pipeline]\nname = "blind"\n', "car.toml")
    assert make_pipeline(car.pipeline.name, car).name == "blind"


@pytest.mark.parametrize(
    ("attribute", "reason"),
    [
        ("Half", "pipeline {name}: has no reset(); a pipeline needs step(), reset()"),
        ("Bare", "pipeline {name}: cannot be made from the configuration: Bare() takes no arguments"),
        ("Refuses", "pipeline {name}: needs a camera of 1 m height"),
        ("Missing", "[pipeline] name '{name}': there is no class Missing in {team}"),
        ("NUMBER", "[pipeline] name '{name}': there is no class NUMBER in {team}"),
    ],
)
def test_a_part_that_does_not_fit_gets_one_line(attribute: str, reason: str, team: str) -> None:
    name = f"{team}:{attribute}"
    with pytest.raises(ConfigError) as caught:
        make_pipeline(name, CarConfig())
    assert str(caught.value) == reason.format(name=name, team=team)


def test_a_module_that_is_not_there_gets_one_line(team: str) -> None:
    with pytest.raises(ConfigError, match=r"^\[pipeline\] name 'nowhere\.to_be:Found': nowhere\.to_be cannot be"):
        make_pipeline("nowhere.to_be:Found", CarConfig())


def test_a_path_is_no_camera() -> None:
    for source in ("sim", "videos/drive.mp4", "/data/tub"):
        assert not is_live_camera(parse_car(f'[camera]\nsource = "{source}"\n', "car.toml"))


def test_a_camera_in_another_mode_than_its_lens_was_calibrated_in_is_not_made(team: str) -> None:
    text = f'[camera]\nsource = "{team}:Webcam"\nsensor_mode = 4\n[calibration.camera]\ndate = 2026-01-01\n'
    car = parse_car(f'{text}method = "board"\nresidual = "0.3 px"\nmode = "csi 640x360, sensor mode 2"\n', "car.toml")
    with pytest.raises(
        ConfigError, match=r"is set to .*sensor mode 4, and its lens was calibrated for csi 640x360, sen"
    ):
        make_camera(car)
    assert make_camera(car, any_mode=True).size == (640, 360)  # type: ignore[attr-defined]


def test_a_right_camera_in_another_mode_than_it_was_calibrated_in_is_not_made(team: str) -> None:
    text = f'[camera]\nsource = "{team}:Webcam"\n[camera.right]\nflip = "vertical"\n[calibration.stereo]\n'
    car = parse_car(f'{text}date = 2026-01-01\nmethod = "board"\nresidual = "0.3 px"\nmode = "csi"\n', "car.toml")
    with pytest.raises(
        ConfigError, match=r"\[camera.right\] is set to .*flip vertical, and it was calibrated for csi: "
    ):
        make_camera(car)
    assert make_camera(car, any_mode=True) is not None
    assert make_camera(left_alone(car)) is not None

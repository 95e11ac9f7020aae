from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import pytest
import tomlkit

from automodel.config import (
    CarConfig,
    CenterlineConfig,
    ConfigError,
    ContourConfig,
    Intrinsics,
    PipelineConfig,
    VehicleConfig,
    WindowsConfig,
    load_car,
    parse_car,
)
from automodel.config.parts import PIPELINES

CARS = Path(__file__).resolve().parents[1] / "cars"

# text | the error, file and line first
REFUSED = {
    '[camera]\nwidth_px = "640"': "car.toml:2: [camera] width_px: expected a whole number, got '640'",
    "[camera]\nwidth_px = 640.5": "car.toml:2: [camera] width_px: expected a whole number, got 640.5",
    "[camera]\nwidth_px = true": "car.toml:2: [camera] width_px: expected a whole number, got True",
    "[camera]\n\nwidth_px = 0": "car.toml:3: [camera] width_px: expected a positive number, got 0",
    "[camera]\nrate_hz = inf": "car.toml:2: [camera] rate_hz: expected a finite number, got inf",
    "[camera]\nrate_hz = -1": "car.toml:2: [camera] rate_hz: expected a positive number, got -1.0",
    "[camera]\ndevice = -1": "car.toml:2: [camera] device: expected a number >= 0, got -1",
    "[camera]\nsource = 3": "car.toml:2: [camera] source: expected a string, got 3",
    "[camera]\ncolour = 1": "car.toml:2: [camera] colour: expected true or false, got 1",
    "[camera]\nwidht_px = 640": "car.toml:2: [camera] widht_px: unknown key; did you mean width_px?",
    "camera = 3": "car.toml:1: camera: expected a table, got 3",
    "[cammera]\nwidth_px = 640": "car.toml:1: cammera: unknown key; did you mean camera?",
    "[camera.intrinsics]\nfx_px = nan": "car.toml:2: [camera.intrinsics] fx_px: expected a finite number, got nan",
    "[camera.intrinsics]\nfy_px = 0.0": "car.toml:2: [camera.intrinsics] fy_px: expected a positive number, got 0.0",
    "[camera.intrinsics]\ndistortion = [0.1]": "car.toml:2: [camera.intrinsics] distortion: expected "
    "k1 k2 p1 p2 k3, got 1 numbers",
    "[camera.intrinsics]\ndistortion = 0.1": "car.toml:2: [camera.intrinsics] distortion: expected a list, got 0.1",
    '[camera.intrinsics]\ndistortion = ["a"]': "car.toml:2: [camera.intrinsics] distortion: expected a finite "
    "number, got 'a'",
    "[camera.extrinsics]\nz_m = 0": "car.toml:2: [camera.extrinsics] z_m: expected a positive number, got 0.0",
    "[camera.extrinsics]\npitch_rad = 15": "car.toml:2: [camera.extrinsics] pitch_rad: expected -1.5 .. 1.5 "
    "(radians, positive looks down), got 15.0",
    "[camera.right.extrinsics]\nz_m = -1": "car.toml:2: [camera.right.extrinsics] z_m: expected a positive number, "
    "got -1.0",
    "[camera.right]\ndevice = -1": "car.toml:2: [camera.right] device: expected a number >= 0, got -1",
    '[camera.right]\ndevice = "1"': "car.toml:2: [camera.right] device: expected a whole number, got '1'",
    "[camera]\ndevice = 2\n[camera.right]\ndevice = 2": "car.toml:3: [camera] right: device 2 is the left camera's, "
    "too ([camera] device); give another",
    "[camera.right]\npair_tolerance_s = -0.001": "car.toml:2: [camera.right] pair_tolerance_s: expected a number >= 0, "
    "got -0.001",
    "[camera.right]\npair_tolerance_s = 0.01": "car.toml:1: [camera] right: pair_tolerance_s 0.01 is more than half "
    "the time between two frames, 0.0083: an image would fit two others",
    "[camera]\nright = 1": "car.toml:2: [camera] right: expected a table, got 1",
    "[vehicle]\nwheelbase_m = 0": "car.toml:2: [vehicle] wheelbase_m: expected a positive number, got 0.0",
    "[vehicle]\nfront_overhang_m = -0.1": "car.toml:2: [vehicle] front_overhang_m: expected a number >= 0, got -0.1",
    "[lane]\nmarking_width_m = 0.3": "car.toml:2: [lane] marking_width_m: 0.3 is more than half the lane's width",
    "[lane]\nwidth_sigma_m = 0.2": "car.toml:2: [lane] width_sigma_m: expected 0 to 30 % of width_m, got 0.2",
    "[lane]\nwidth_sigma_m = -0.01": "car.toml:2: [lane] width_sigma_m: expected 0 to 30 % of width_m, got -0.01",
    '[lane]\nmarkings = "darkk"': "car.toml:2: [lane] markings: expected one of light, dark, both, got 'darkk'; "
    "did you mean 'dark'?",
    '[lane]\nleft = "dotted"': "car.toml:2: [lane] left: expected one of any, dashed, solid, got 'dotted'",
    '[lane]\nmarkings = "dark"\ndark_markings = true': "car.toml:3: [lane] dark_markings: remove it; [lane] markings "
    "is given",
    '[pipeline]\nname = "window"': (
        f"car.toml:2: [pipeline] name: expected one of {', '.join(PIPELINES.names)}, "
        "or package.module:Class, got 'window'; did you mean 'windows'?"
    ),
    "[pipeline.windows]\nmarking_px = 0": "car.toml:2: [pipeline.windows] marking_px: expected a positive "
    "number, got 0.0",
    '[control]\ncontroller = "pid"': "car.toml:2: [control] controller: expected one of stanley, pure_pursuit, "
    "or package.module:Class, got 'pid'",
    "[control]\nspeed_mps = -1": "car.toml:2: [control] speed_mps: expected a number >= 0, got -1.0",
    "[control]\nobstacle_stop_m = 0.4\nobstacle_go_m = 0.3": "car.toml:3: [control] obstacle_go_m: 0.3 is less than "
    "obstacle_stop_m",
    '[link]\nkind = "ardiuno"': "car.toml:2: [link] kind: expected one of arduino, autonomos, can, or "
    "package.module:Class, got 'ardiuno'; did you mean 'arduino'?",
    "[link]\nbaud = 0": "car.toml:2: [link] baud: expected a positive number, got 0",
    "[link.servo]\npulse_us = [1500, 1400, 1300]": "car.toml:2: [link.servo] pulse_us: must rise from entry to entry",
    "[link.servo]\npulse_us = [100, 1500, 2000]": "car.toml:2: [link.servo] pulse_us: servo pulses lie between "
    "500 and 2500 us",
    "[link.servo]\nsteering_rad = [0.4, 0.0]": "car.toml:2: [link.servo] steering_rad: expected a value for "
    "each of at least two pulses, got 2 for 3",
    "[link.servo]\nsteering_rad = [0.4, 0.1, 0.2]": "car.toml:2: [link.servo] steering_rad: must rise throughout or "
    "fall throughout",
    "[link.motor]\nspeed_mps = [1.0, 2.0, 3.0]": "car.toml:2: [link.motor] speed_mps: must span 0, "
    "the neutral position",
    "[safety]\nhold_s = 0": "car.toml:2: [safety] hold_s: expected a positive number, got 0.0",
    '[recording]\nimage = "gif"': "car.toml:2: [recording] image: expected one of png, jpeg, got 'gif'",
    "[recording]\njpeg_quality = 101": "car.toml:2: [recording] jpeg_quality: expected 1 .. 100, got 101",
}


@pytest.mark.parametrize("text", REFUSED)
def test_what_is_wrong_is_refused_with_file_line_and_key(text: str) -> None:
    with pytest.raises(ConfigError) as caught:
        parse_car(text, "car.toml")
    assert str(caught.value) == REFUSED[text]


def test_an_empty_file_is_the_simulated_car() -> None:
    car = parse_car("", "car.toml")
    assert car == CarConfig()
    assert (car.camera.source, car.link.port) == ("sim", "sim")


def as_toml(section: object) -> dict[str, Any]:
    """A section as the table that gives it."""
    table: dict[str, Any] = {}
    for field in dataclasses.fields(section):  # type: ignore[arg-type]
        value = getattr(section, field.name)
        if dataclasses.is_dataclass(value):
            table[field.name] = as_toml(value)
        elif value is not None:
            table[field.name] = in_toml(value)
    return table


def in_toml(value: Any) -> Any:
    """A key's value as the file gives it."""
    if isinstance(value, tuple):
        return [as_toml(item) if dataclasses.is_dataclass(item) else item for item in value]
    return value


def test_every_default_comes_back_from_a_file() -> None:
    assert parse_car(tomlkit.dumps(as_toml(CarConfig())), "car.toml") == CarConfig()


def leaves(section: object, path: tuple[str, ...] = ()) -> list[tuple[tuple[str, ...], Any]]:
    """Every key of every section with its default."""
    found = []
    for field in dataclasses.fields(section):  # type: ignore[arg-type]
        value = getattr(section, field.name)
        inner = leaves(value, (*path, field.name)) if dataclasses.is_dataclass(value) else None
        found += [((*path, field.name), value)] if inner is None else inner
    return found


KEYS = leaves(CarConfig())


def _one_line(value: Any) -> str:
    if isinstance(value, list):
        return f"[{', '.join(map(_one_line, value))}]"
    if isinstance(value, dict):
        return f"{{{', '.join(f'{key} = {_one_line(item)}' for key, item in value.items())}}}"
    return tomlkit.item(value).as_string()


@pytest.mark.parametrize(("path", "value"), KEYS, ids=[".".join(path) for path, _ in KEYS])
def test_every_key_is_read_and_checked_for_its_type(path: tuple[str, ...], value: object) -> None:
    header = f"[{'.'.join(path[:-1])}]"
    with pytest.raises(ConfigError, match=rf"car\.toml:2: \[{'.'.join(path[:-1])}\] {path[-1]}: "):
        parse_car(f"{header}\n{path[-1]} = 1979-05-27", "car.toml")
    if value is not None:
        written = _one_line(in_toml(value))
        assert parse_car(f"{header}\n{path[-1]} = {written}", "car.toml") == CarConfig()


@pytest.mark.parametrize(
    ("name", "coasting"),
    [("windows", (1.1, 1.2)), ("contour", (2.5, 1.4)), ("centerline", (3.5, 1.6)), ("my_team:Blind", (3.5, 1.6))],
)
def test_each_pipeline_says_how_far_and_how_long_it_coasts(name: str, coasting: tuple[float, float]) -> None:
    pipeline = PipelineConfig(
        name=name,
        windows=WindowsConfig(coast_lanes=2.2, coast_s=1.2),
        contour=ContourConfig(coast_lanes=5.0, coast_s=1.4),
        centerline=CenterlineConfig(coast_lanes=7.0, coast_s=1.6),
    )
    assert pipeline.coasting(0.5) == coasting


def test_the_free_space_beside_a_car_is_none_where_it_is_wider_than_its_lane() -> None:
    vehicle = VehicleConfig(width_m=0.2)
    assert vehicle.free_space_m(0.5) == pytest.approx(0.15)  # 0.25 to the edge, 0.1 of it is the car's
    assert vehicle.free_space_m(0.1) == 0.0


def test_units_are_in_every_name() -> None:
    """A number without a unit is a count, a share, a level or a name's number, and listed here."""
    units = (
        "_m",
        "_rad",
        "_s",
        "_hz",
        "_px",
        "_us",
        "_v",
        "_mps",
        "_mps2",
        "_mps3",
        "_radps",
        "_per_m",
        "_per_s",
        "_lanes",
        "_nm",
        "_nmps",
        "_nmprad",
        "_nmprads",
        "_nms2pm",
    )
    plain = {
        "device",
        "distortion",
        "baud",
        "jpeg_quality",
        "holds_max",
        "contrast",
        "rows",
        "view_ahead_lanes",
        "view_half_lanes",
    }
    plain |= {"one_line_speed", "coasting_speed", "uncertain_speed"}
    plain |= {
        "dbc",
        "steering_ratio",
        "receive",
        "state",
        "send",
        "command",
        "gears",
        "bitrate",
        "override_accelerator",
    }
    plain |= {"providers", "threads", "threshold", "nodes"}
    plain |= {"sensor_mode", "gain"}
    for path, value in leaves(CarConfig()):
        if isinstance(value, float | int | tuple) and not isinstance(value, bool):
            assert path[-1].endswith(units) or path[-1] in plain, ".".join(path)


@pytest.mark.parametrize("path", sorted(CARS.glob("*.toml")), ids=lambda path: path.stem)
def test_the_cars_of_the_real_recordings_load(path: Path) -> None:
    car = load_car(path)
    assert car.link.port == "none"  # they are for replays
    assert car.camera.source != "sim"


def test_an_error_names_the_file_that_was_asked_for(tmp_path: Path) -> None:
    path = tmp_path / "my car.toml"
    with pytest.raises(ConfigError, match="no such file"):
        load_car(path)
    path.write_text("[lane]\nwidth_m = -1")
    with pytest.raises(ConfigError) as caught:
        load_car(path)
    assert str(caught.value) == f"{path}:2: [lane] width_m: expected a positive number, got -1.0"


@pytest.mark.parametrize(
    ("given", "markings"),
    [
        ("", "light"),
        ("dark_markings = true", "dark"),
        ("dark_markings = false", "light"),
        ('markings = "both"', "both"),
    ],
)
def test_markings_and_its_older_key(given: str, markings: str) -> None:
    lane = parse_car(f"[lane]\n{given}\n", "car.toml").lane
    assert lane.markings == markings
    assert dataclasses.replace(lane, width_m=0.5).markings == markings


@pytest.mark.parametrize(
    ("line", "wrong"),
    [
        ("latency_s = 0.6", "latency_s: expected at most 0.5, got 0.6"),
        ("latency_s = -0.01", "latency_s: expected a number >= 0, got -0.01"),
        ("sensor_mode = -2", "sensor_mode: expected -1 (the driver chooses) or 0 and more, got -2"),
        ('flip = "rotate"', "flip: expected one of none, rotate-180, horizontal, vertical, got 'rotate'"),
        ('pixel_format = "H264"', "pixel_format: expected one of MJPG, YUYV, GREY, got 'H264'"),
        ("flicker_hz = 55", "flicker_hz: expected 50 or 60, or 0 (the camera's own choice), got 55"),
        ("exposure_s = 0.02", "exposure_s: 0.02 is longer than the time between two frames, 0.0167"),
        ("gain = 1e6", "gain: expected at most 65535, got 1000000.0"),
    ],
)
def test_a_wrong_camera_is_one_line(line: str, wrong: str) -> None:
    with pytest.raises(ConfigError) as raised:
        parse_car(f"[camera]\n{line}\n", "car.toml")
    assert str(raised.value).startswith(f"car.toml:2: [camera] {wrong}")


def test_each_eye_of_a_pair_has_its_own_device() -> None:
    def devices(text: str) -> list[int]:
        return [eye.device for eye in parse_car(text, "car.toml").camera.eyes]

    assert devices("[camera]\ndevice = 2") == [2]
    assert devices("[camera]\ndevice = 2\n[camera.right]\ndevice = 0") == [2, 0]
    assert devices("[camera]\ndevice = 2\n[camera.right.extrinsics]\ny_m = -0.1") == [2, 2]  # of before it had one
    right = parse_car("[camera.right]\ndevice = 1", "car.toml").camera.right
    assert right is not None
    assert (right.intrinsics, right.measured(), right.tolerance_s(50.0)) == (Intrinsics(), False, 0.005)


def test_each_eye_of_a_pair_is_mounted_and_late_in_its_own_way_or_as_the_left_one() -> None:
    def eyes(right: str) -> list[tuple[str, float]]:
        text = f'[camera]\nflip = "vertical"\nlatency_s = 0.05\n[camera.right]\ndevice = 1\n{right}'
        return [(eye.flip, eye.latency_s) for eye in parse_car(text, "car.toml").camera.eyes]

    assert eyes("") == [("vertical", 0.05)] * 2
    assert eyes('flip = "none"\nlatency_s = 0.0') == [("vertical", 0.05), ("none", 0.0)]
    assert eyes('flip = "rotate-180"') == [("vertical", 0.05), ("rotate-180", 0.05)]
    for line, wrong in (
        ('flip = "up"', "flip: expected one of none, rotate-180, horizontal, vertical, got 'up'"),
        ("latency_s = -0.1", "latency_s: expected a number >= 0, got -0.1"),
        ("latency_s = 0.6", "latency_s: expected at most 0.5, got 0.6"),
    ):
        with pytest.raises(ConfigError) as raised:
            parse_car(f"[camera.right]\n{line}\n", "car.toml")
        assert str(raised.value).startswith(f"car.toml:2: [camera.right] {wrong}")


def test_the_right_camera_s_mode_is_what_it_was_calibrated_for() -> None:
    def other(right: str, mode: str) -> str | None:
        text = f'[camera]\nsource = "usb"\n{right}\n[calibration.stereo]\ndate = 2026-01-01\nmethod = "x"\n'
        return parse_car(f'{text}residual = "y"\n{mode}', "car.toml").other_right_mode

    turned = '[camera.right]\nflip = "rotate-180"'
    mode = "usb 640x360, the driver's sensor mode"
    assert other(turned, f'mode = "{mode}, flip rotate-180"') is None
    assert other(turned, f'mode = "{mode}"') == mode
    assert other(turned, "") is None  # of before modes were noted down
    assert other("", f'mode = "{mode}"') is None  # it has no right camera


def test_the_mode_of_a_camera_is_what_its_lens_was_calibrated_for() -> None:
    def other(camera: str, record: str) -> str | None:
        text = f'[camera]\n{camera}\n[calibration.camera]\ndate = 2026-01-01\nmethod = "x"\nresidual = "y"\n{record}'
        return parse_car(text, "car.toml").other_mode

    mode = parse_car('[camera]\nsource = "csi"\nsensor_mode = 4\n', "car.toml").camera.mode
    assert mode == "csi 640x360, sensor mode 4"
    record = f'mode = "{mode}"\n'
    assert other('source = "csi"\nsensor_mode = 4\nrate_hz = 30', record) is None
    assert other('source = "csi"\nsensor_mode = 4', "") is None  # of before modes were noted down
    for changed in ("sensor_mode = 3", "", "sensor_mode = 4\nwidth_px = 320", 'sensor_mode = 4\nflip = "vertical"'):
        assert other(f'source = "csi"\n{changed}', record) == mode
    assert CarConfig().other_mode is None

"""From a car's configuration to the parts of a run, for every command alike."""

from __future__ import annotations

import dataclasses
import functools
import time
from pathlib import Path

import cv2

from automodel.assembly.registry import make_part
from automodel.config import CarConfig, ConfigError, load_car, parse_car
from automodel.config.camera import SecondCamera
from automodel.config.parts import CAMERAS, CONTROLLERS, LINKS, PAIR_PIPELINES, PIPELINES
from automodel.config.toml_reader import read_text
from automodel.console.messages import say
from automodel.control.limits import Limits
from automodel.control.manual import ManualDriver
from automodel.estimation.ego_motion import MotionEstimator
from automodel.interfaces import Controller, Pipeline, Recorder, Source, VehicleLink
from automodel.recording.reader import RecordingSource
from automodel.recording.writer import McapRecorder
from automodel.runtime.clocks import SleepingClock
from automodel.runtime.input_checks import InputChecks
from automodel.runtime.loop import Checks, Loop
from automodel.runtime.run_types import RunConfig, RunParts
from automodel.runtime.safety import Safety
from automodel.sources.errors import SourceError
from automodel.sources.files import ImageSource, TubSource, VideoSource, is_tub
from automodel.sources.pairs import LivePair, PairSource

FOLDER_RATE_HZ = 20.0  # frames a second of images in a folder, which carry no time


def car_of(path: Path | None, pipeline: str | None = None) -> CarConfig:
    """car.toml, or the defaults (the simulated car) without one; `pipeline` replaces the file's."""
    return with_pipeline(CarConfig() if path is None else load_car(path), pipeline)


def with_pipeline(car: CarConfig, name: str | None) -> CarConfig:
    """The same car with the pipeline `name`, unless that is None; raises ConfigError for one that there is not."""
    if name is None:
        return car
    try:
        return dataclasses.replace(car, pipeline=dataclasses.replace(car.pipeline, name=name))
    except ValueError as error:
        raise ConfigError(f"--pipeline {error}") from None


def read_car(
    path: Path | None, pipeline: str | None, speed_mps: float | None, lossless: bool = False
) -> tuple[CarConfig, str]:
    """What is driven, and the text of car.toml that says so: a replay of the recording must find what was in force.

    `pipeline` and `speed_mps` override the file's; `lossless` records every bit of the frames, whatever the file says.
    """
    text = "" if path is None else read_text(path)
    name = "car.toml" if path is None else str(path)
    car = parse_car(text, name)
    if speed_mps is not None and speed_mps > car.safety.speed_max_mps:
        raise ConfigError(f"--speed {speed_mps}: {name} allows {car.safety.speed_max_mps} ([safety] speed_max_mps)")
    image = "png" if lossless else None
    wanted = (("pipeline", "name", pipeline), ("control", "speed_mps", speed_mps), ("recording", "image", image))
    for section, key, value in wanted:
        if value is not None:
            text = _with_key(text, section, key, value)
    return parse_car(text, name), text


def _with_key(text: str, section: str, key: str, value: str | float) -> str:
    import tomlkit

    document = tomlkit.parse(text)
    if section not in document:
        document[section] = tomlkit.table()
    document[section][key] = value
    return tomlkit.dumps(document)


def make_pipeline(name: str, car: CarConfig) -> Pipeline:
    """The pipeline `name` for a car; raises ConfigError for an unknown name or a camera that it cannot work with.

    What one pipeline needs (a network's runtime, a compiler) is loaded for that one alone.
    """
    pipeline: Pipeline = make_part(PIPELINES, name, car)
    return pipeline


def make_controller(car: CarConfig) -> Controller:
    """The controller that car.toml names."""
    controller: Controller = make_part(CONTROLLERS, car.control.controller, car)
    return controller


def make_link(car: CarConfig) -> VehicleLink:
    """The vehicle behind the serial ports that car.toml names, in the language that its [link] kind says."""
    link: VehicleLink = make_part(LINKS, car.link.kind, car)
    return link


def is_live_camera(car: CarConfig) -> bool:
    """Whether car.toml names a camera, and not the simulator or something recorded."""
    return CAMERAS.target(car.camera.source) is not None


def make_camera(car: CarConfig, *, any_mode: bool = False) -> Source:
    """The camera that car.toml names, both of a pair, or what is recorded at the path that it names.

    Raises ConfigError for a camera in another mode than the one that its lens was calibrated in, and for one camera
    where the pipeline needs two, unless `any_mode`: that is for who calibrates it, or looks at it. Raises SourceError
    where one cannot be opened; then none is open.
    """
    if not is_live_camera(car):
        return open_source(Path(car.camera.source), car, car.camera.rate_hz)
    if car.other_mode is not None and not any_mode:
        raise ConfigError(
            f"[camera] is set to {car.camera.mode}, and its lens was calibrated for {car.other_mode}: another "
            "field of view; set [camera] back, or run automodel calibrate camera"
        )
    if car.other_right_mode is not None and not any_mode:
        raise ConfigError(
            f"[camera.right] is set to {car.camera.eyes[1].mode}, and it was calibrated for {car.other_right_mode}: "
            "set it back, or run automodel calibrate stereo"
        )
    if not any_mode and lacks_device(car):
        raise ConfigError(
            f'[camera.right] device is missing: [camera] source "{car.camera.source}" is one camera, and the pipeline '
            f"{car.pipeline.name} sees through two; set it to the right one's number"
        )
    if car.camera.right is None or car.camera.right.device is None:
        camera: Source = make_part(CAMERAS, car.camera.source, car.camera)
        return camera
    eyes = [functools.partial(make_part, CAMERAS, car.camera.source, eye) for eye in car.camera.eyes]
    return LivePair(eyes, car.camera.right.tolerance_s(car.camera.rate_hz), car.camera.rate_hz)


def lacks_device(car: CarConfig) -> bool:
    """Whether the pipeline needs a second camera, and nothing says which device that is.

    A source of a team's own may give pairs by itself.
    """
    right, needed = car.camera.right, car.pipeline.name in PAIR_PIPELINES
    return needed and right is not None and right.device is None and car.camera.source in CAMERAS.targets


def left_alone(car: CarConfig) -> CarConfig:
    """The same car without its right camera, for what needs one camera only."""
    return dataclasses.replace(car, camera=car.camera.eyes[0])


def open_source(path: Path, car: CarConfig, rate_hz: float | None) -> Source:
    """What is recorded at `path`: a recording, a video, a folder of images or a tub; raises SourceError.

    `rate_hz` replaces the frame rate of a video, and is that of a folder (default 20 Hz).
    """
    if not path.exists():
        raise SourceError(f"{path}: no such file or folder")
    if path.is_dir():
        folder = TubSource if is_tub(path) else ImageSource
        return folder(path, rate_hz or FOLDER_RATE_HZ, car.camera.colour)
    if path.suffix.lower() == ".mcap":
        return RecordingSource(path)
    return VideoSource(path, rate_hz, car.camera.colour)


def open_pair(left: Path, right: Path, car: CarConfig, rate_hz: float | None) -> PairSource:
    """Two videos, or two folders of images, as the pictures of two cameras; raises SourceError.

    Images in folders carry no time: both folders must have the same number of them.
    """
    sides: list[Source] = []
    for path in (left, right):
        if path.suffix.lower() == ".mcap":
            raise SourceError(f"{path}: a recording holds both cameras of a pair by itself; give it alone")
        sides.append(open_source(path, car, rate_hz))
    counts = [len(side.files) for side in sides if isinstance(side, ImageSource)]
    if len(set(counts)) > 1:
        raise SourceError(
            f"{right}: expected {counts[0]} images as in {left}, got {counts[1]}: without times nothing tells which "
            "belong together; remove those without a partner"
        )
    rate = getattr(sides[0], "rate_hz", 0.0) or car.camera.rate_hz
    return PairSource(sides[0], sides[1], (car.camera.right or SecondCamera()).tolerance_s(rate))


def make_recorder(path: Path, text: str, car: CarConfig) -> McapRecorder:
    """A recorder into a new file at `path`; `text` is the car.toml of the run."""
    return McapRecorder(path, text, car.recording)


def make_loop(car: CarConfig, *, pipeline: Pipeline | None = None, checks: Checks | None = None) -> Loop:
    """Pipeline, controller and limits of a car; `pipeline` replaces the one that car.toml names.

    OpenCV is kept to one thread: handing out so little work costs more. `checks` are for a car that drives.
    """
    cv2.setNumThreads(1)
    pipeline = make_pipeline(car.pipeline.name, car) if pipeline is None else pipeline
    notice = getattr(pipeline, "notice", "")
    if notice:  # for example a network that runs on another processor than configured
        say(notice)
    return Loop(
        pipeline,
        make_controller(car),
        Limits(car.safety, car.vehicle),
        validity_s=car.safety.command_validity_s,
        stopwatch=time.perf_counter_ns,
        checks=checks,
        driver=ManualDriver(car),
    )


def make_checks(car: CarConfig, *, noiseless: bool = False) -> InputChecks:
    """The checks of what a car that drives is given; `noiseless` as in `InputChecks`."""
    if car.camera.right is None:
        return InputChecks(car, noiseless=noiseless)
    from automodel.assembly.pair_checks import PairChecks  # compiled code, which a single camera does not need
    from automodel.pipelines.stereo import Stereo

    try:
        rig = Stereo.rig(car)
    except ValueError:  # not calibrated: a pipeline that needs both cameras says so
        return InputChecks(car, noiseless=noiseless)
    return PairChecks(car, rig, noiseless=noiseless)


def build_run(
    car: CarConfig,
    *,
    source: Source,
    link: VehicleLink,
    clock: SleepingClock,
    loop: Loop,
    recorder: Recorder | None = None,
    auto_arm: bool = True,
) -> RunParts:
    """The parts of a run with `car`: the one place where they are put together.

    `source`, `link` and `clock` belong together (a real car's, or those of one simulator). `auto_arm` arms once
    without a person, as soon as all is well.
    """
    return RunParts(
        source=source,
        link=link,
        recorder=recorder,
        motion=MotionEstimator(car.vehicle),
        loop=loop,
        safety=Safety(car.safety, auto_arm, blind_m=car.vehicle.free_space_m(car.lane.width_m)),
        clock=clock,
    )


def run_config(car: CarConfig, *, collector_off: bool, period_s: float | None = None) -> RunConfig:
    """The times of a run with `car`; `period_s` is that of turns which no camera paces."""
    return RunConfig(
        command_validity_s=car.safety.command_validity_s,
        period_s=1.0 / car.camera.rate_hz if period_s is None else period_s,
        collector_off=collector_off,
    )

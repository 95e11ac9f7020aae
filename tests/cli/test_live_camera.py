"""`run` with cameras as they are on a car: GStreamer's own process, and a camera that freezes."""

from __future__ import annotations

import dataclasses
import itertools
import os
import shutil
import signal
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from automodel.assembly import drive
from automodel.assembly.parts import make_camera
from automodel.assembly.simulated_car import Simulation, build_world
from automodel.cli.init import kit_path
from automodel.config import CameraConfig, CarConfig, load_car
from automodel.recording.reader import Recording
from automodel.signals import Event, Frame, StereoFrame
from automodel.sources import csi, usb
from automodel.sources.csi import GstPipeSource
from automodel.sources.errors import SourceError
from firmware_link.emulator.board import EmulatedArduino
from firmware_link.emulator.pty import BenchPeripherals, PtyBoard
from tests.support.fake_cars import StillCamera, TriggeredCamera, car_toml, road

TURNS = 1500  # of the loop, at most 20 ms each: a test that hangs ends


@pytest.fixture
def port() -> Iterator[PtyBoard]:
    with PtyBoard(EmulatedArduino(BenchPeripherals(), 115200)) as board:
        yield board


class Bystander:
    """Looks at every turn of a car that nobody arms, and ends the run when `until` says so."""

    def __init__(self, until: Callable[[list[Event]], bool]) -> None:
        self.events: list[Event] = []
        self._until, self._turns = until, 0

    def on_tick(self, record: object) -> None:
        pass

    def on_event(self, event: Event) -> None:
        self.events.append(event)

    def arm_requested(self) -> bool:
        return False

    def stop_requested(self) -> str | None:
        self._turns += 1
        if self._until(self.events) or self._turns > TURNS:
            signal.raise_signal(signal.SIGINT)
        return None

    def wanted_by_hand(self) -> None:
        return None


def drive_until(car_file: Path, until: Callable[[list[Event]], bool]) -> tuple[dict[str, object], list[Event]]:
    """The run's row, and the events in its recording."""
    car_file.write_text(car_file.read_text().replace("frame_timeout_s = 2.0", "frame_timeout_s = 0.06"))
    options = drive.RunOptions(record=car_file.parent / "run.mcap")
    report = drive.drive_real(load_car(car_file), car_file.read_text(), options, (Bystander(until),))
    recording = Recording(car_file.parent / "run.mcap")
    return report.row, [message.value for message in recording if isinstance(message.value, Event)]


def settled(turns: int) -> Callable[[bool], bool]:
    """Whether what is passed has been true so often."""
    count = [0]

    def step(true: bool) -> bool:
        count[0] += true
        return count[0] >= turns

    return step


@pytest.mark.realtime
@pytest.mark.skipif(shutil.which("gst-launch-1.0") is None, reason="needs GStreamer")
def test_frames_of_gstreamer_are_driven_on_and_a_killed_one_is_started_again(
    port: PtyBoard, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(csi, "jetson_elements", csi.synthetic_elements)
    monkeypatch.setattr(csi, "_gstreamer", lambda: None)
    sources: list[GstPipeSource] = []

    class Kept(GstPipeSource):
        def __init__(self, *arguments: object) -> None:
            super().__init__(*arguments)  # type: ignore[arg-type]
            sources.append(self)

    monkeypatch.setattr(csi, "GstPipeSource", Kept)
    path = car_toml(tmp_path, port.path)
    path.write_text(path.read_text().replace('source = "usb"', 'source = "csi"\nrate_hz = 30\nlatency_s = 0.02'))
    again, before = settled(60), list[int]()  # the latter: how many events, when it was killed
    flowing = {"turns": 0, "events": 0}  # turns since the newest event, of which there were so many

    def until(events: list[Event]) -> bool:
        turns = flowing["turns"] + 1 if flowing["events"] == len(events) else 0
        flowing.update(turns=turns, events=len(events))
        if turns >= 60 and not before:
            os.kill(sources[-1]._process.pid, signal.SIGKILL)
            before.append(len(events))
        return again(bool(before) and "source-back" in [event.kind for event in events[before[0] :]])

    row, events = drive_until(path, until)
    kinds = [event.kind for event in events]  # a busy machine may take its time with the first frames
    failed = next(i for i, event in enumerate(events) if "CSI camera 0: no more frames" in event.text)
    assert kinds[failed] == "source-failed"
    assert "source-back" in kinds[failed:]
    assert all(source._process.poll() is not None for source in sources)  # nothing is left behind
    assert row["camera_restarts"] == len(sources) - 1 >= 1  # one for want of frames may have come before
    assert isinstance(row["camera_hz"], float)
    frames = [message.value for message in Recording(tmp_path / "run.mcap") if isinstance(message.value, Frame)]
    assert len(frames) > 20
    assert all(frame.image.shape == (360, 640) for frame in frames)
    assert sum(b.t_ns > a.t_ns for a, b in itertools.pairwise(frames)) == len(frames) - 1


class FreezingCamera(StillCamera):
    """From its 60th frame on it gives the same one again and again, with success, as some drivers do."""

    def read(self, timeout_s: float) -> Frame:
        frame = super().read(timeout_s)
        if frame.index < 60:
            self._frozen = frame.image
            return frame
        return Frame(t_ns=frame.t_ns, index=frame.index, image=self._frozen)


@pytest.mark.realtime
def test_a_camera_that_repeats_its_last_frame_is_started_again(
    port: PtyBoard, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A machine that stands still may stop a camera first, for want of frames: the next one freezes, too."""
    opened: list[StillCamera] = []
    noticed: list[int] = []  # how many events there were then

    def freezing(car: CarConfig) -> StillCamera:
        opened.append(StillCamera(road()) if noticed else FreezingCamera(road()))
        return opened[-1]

    monkeypatch.setattr(drive, "make_camera", freezing)
    again = settled(20)

    def until(events: list[Event]) -> bool:
        if not noticed and any(event.text.startswith("the same frame again and again for 0.") for event in events):
            noticed.append(len(events))
        return again(bool(noticed) and any(event.kind == "source-back" for event in events[noticed[0] :]))

    row, events = drive_until(car_toml(tmp_path, port.path), until)
    failed = next(event for event in events if event.text.startswith("the same frame again and again"))
    assert failed.kind == "source-failed"
    assert type(opened[-1]) is StillCamera
    assert len(opened) == row["camera_restarts"] + 1  # type: ignore[operator]


@pytest.mark.realtime
@pytest.mark.parametrize("why", ["/dev/video1: no more frames", "the image is blank"])
def test_one_camera_of_a_pair_fails_and_the_run_goes_on_with_the_other_until_it_is_back(
    why: str, port: PtyBoard, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    pair = load_car(kit_path("sim-stereo"))
    images = build_world(pair, Simulation(track="oval", style="clean")).capture(0, 0)[0]
    noticed: list[int] = []  # how many events there were when it was said that it is gone

    class Camera(TriggeredCamera):
        """The right one comes 3 ms later, and is gone until that is said: a machine that stands still is said first."""

        def __init__(self, camera: CameraConfig) -> None:
            super().__init__(images[camera.device], 20.0, 3_000_000 * camera.device)

        def read(self, timeout_s: float) -> Frame:
            fails, dark = bool(self._late_ns) and self._index >= 30 and not noticed, why == "the image is blank"
            if fails and not dark:
                raise SourceError(why)
            frame = super().read(timeout_s)
            return dataclasses.replace(frame, image=frame.image // 100) if fails else frame

    monkeypatch.setattr(usb, "UsbSource", Camera)
    path = car_toml(tmp_path, port.path)
    right = "[camera.extrinsics]\ny_m = 0.125\n[camera.right]\ndevice = 1\n"
    right += "[camera.right.intrinsics]\nfx_px = 480.1\n[camera.right.extrinsics]\ny_m = -0.125\n"
    usual = path.read_text().replace('source = "usb"', 'source = "usb"\nrate_hz = 20')
    path.write_text(f'{usual}{right}[pipeline]\nname = "stereo"\n')
    again = settled(20)
    missing = f"right camera: {why}; the other one goes on alone"

    def until(events: list[Event]) -> bool:
        if not noticed and any(event.text == missing for event in events):
            noticed.append(len(events))
        return again(bool(noticed) and any(event.kind == "camera-back" for event in events[noticed[0] :]))

    row, events = drive_until(path, until)
    texts = [event.text for event in events if event.kind.startswith("camera-")]
    assert "pairs of frames come again" in texts[texts.index(missing) :]
    frames = [m.value for m in Recording(tmp_path / "run.mcap") if isinstance(m.value, Frame | StereoFrame)]
    alone = {frame.eye for frame in frames if isinstance(frame, Frame)}
    assert 0 in alone or why == "the image is blank"  # which is recorded as it came
    assert any(isinstance(frame, StereoFrame) for frame in frames[-20:])
    late = [frame.right_late_ns for frame in frames if isinstance(frame, StereoFrame)]
    assert set(late) == {3_000_000}
    said = capsys.readouterr().err
    assert "images of a pair 3.0 ms apart, 3.0 at most" in said
    assert row["frames"] == len(frames)
    assert f" pairs, {row['unpaired']} frames without a partner" in said


def test_a_pair_that_cannot_be_is_one_line(tmp_path: Path, cli) -> None:
    for keys, said_of_it in (
        ("device = 0", "[camera] right: device 0 is the left camera's, too ([camera] device); give another"),
        ("devise = 1", "[camera.right] devise: unknown key; did you mean device?"),
        ("", '[camera.right] device is missing: [camera] source "usb" is one camera, and the pipeline stereo sees '),
    ):
        path = car_toml(tmp_path, "/dev/ttyMISSING")
        path.write_text(f'{path.read_text()}[camera.right]\n{keys}\n[pipeline]\nname = "stereo"\n')
        said = cli("run", "--car", path)
        assert (said.code, said.out) == (2, "")
        assert said_of_it in said.err.splitlines()[-1]


def test_a_camera_in_another_mode_than_its_lens_was_calibrated_in_is_refused(tmp_path: Path, cli) -> None:
    path = car_toml(tmp_path, "/dev/ttyMISSING")
    mode = load_car(path).camera.mode
    record = '[calibration.camera]\ndate = 2026-01-01\nmethod = "board"\nresidual = "0.3 px"\n'
    path.write_text(f'{path.read_text()}{record}mode = "csi 640x360, sensor mode 2"\n')
    said = cli("run", "--car", path)
    assert (said.code, said.out) == (2, "")
    assert said.err.splitlines()[-1] == (
        f"automodel: [camera] is set to {mode}, and its lens was calibrated for csi 640x360, sensor mode 2: another "
        "field of view; set [camera] back, or run automodel calibrate camera"
    )
    assert not list((tmp_path / "recordings").glob("*"))
    said = cli("calibrate", "camera", "live", "--board", "9x6", "--square-mm", "25", "--car", path)
    assert (said.code, "/dev/video0: cannot be opened" in said.err) == (2, True)  # that it may
    path.write_text(path.read_text().replace("csi 640x360, sensor mode 2", mode))
    with pytest.raises(SourceError, match="/dev/video0: cannot be opened"):  # the same mode comes as far as that
        make_camera(load_car(path))

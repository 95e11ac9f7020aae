"""What is damaged: a folder of good files, the one that is damaged in it, and the command that reads it."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path

import can
import cv2
import numpy as np

from automodel.assembly.simulated_car import Simulation, build_world
from automodel.cli.init import kit_path
from automodel.cli.main import run
from automodel.config import CameraConfig, CarConfig, Intrinsics
from automodel.types import Image
from automodel.viewer.video import VideoWriter
from tests.fuzz.pages import Sender, get, send_to_page, send_to_view, words
from tests.support import onnx_files
from tests.support.can_logs import candump

CAR_TOML = """[camera]
width_px = 64
height_px = 36
[camera.intrinsics]
fx_px = 48.0
fy_px = 48.0
cx_px = 31.5
cy_px = 17.5
distortion = [0.0, 0.0, 0.0, 0.0, 0.0]
[lane]
width_m = 0.4
markings = "light"
[safety]
hold_s = 0.3
[pipeline]
name = "contour"
"""
IMAGES = 2


@dataclass(frozen=True, slots=True, kw_only=True)
class Target:
    """`build` fills a folder with good files; `damaged` of these (names or patterns) are damaged in turn.

    `arguments` read them, by the command line or by `call`, which gives an exit code. `{}` in the arguments is the
    folder, `{file}` the file that is damaged; of `out` nothing may appear, or must be whole, where the command fails.
    """

    name: str
    build: Callable[[Path], None]
    damaged: tuple[str, ...]
    arguments: tuple[str, ...]
    out: tuple[str, ...] = ("out.csv",)
    call: Sender = run


def _image(index: int) -> Image:
    image = np.random.default_rng(index).integers(20, 60, (36, 64, 3)).astype(np.uint8)
    cv2.line(image, (20, 35), (28, 10), (220, 220, 220), 2)
    cv2.line(image, (44, 35), (36, 10), (220, 220, 220), 2)
    return image


def _images(folder: Path) -> None:
    (folder / "images").mkdir()
    for index in range(IMAGES):
        cv2.imwrite(str(folder / "images" / f"{index}.png"), _image(index))
    (folder / "car.toml").write_text(CAR_TOML)
    rows = "".join(f"{0.05 * index},1.0,0.1\n" for index in range(4))
    (folder / "motion.csv").write_text(f"t_s,speed_mps,yaw_rate_radps\n{rows}")


def _tub(folder: Path) -> None:
    _images(folder)
    tub = folder / "tub"
    (tub / "images").mkdir(parents=True)
    records = []
    for index in range(IMAGES):
        name = f"{index}_cam_image_array_.jpg"
        cv2.imwrite(str(tub / "images" / name), _image(index))
        records.append(
            json.dumps({"_index": index, "cam/image_array": name, "user/angle": 0.1, "_timestamp_ms": 50 * index})
        )
    lines = [["cam/image_array", "user/angle"], ["image_array", "float"], {}, {"created_at": 1.0}]
    last = {"paths": ["catalog_0.catalog"], "current_index": IMAGES, "max_len": 1000, "deleted_indexes": [7]}
    (tub / "manifest.json").write_text("\n".join(json.dumps(line) for line in [*lines, last]) + "\n")
    (tub / "catalog_0.catalog").write_text("\n".join(records) + "\n")


def _recording(folder: Path) -> None:
    (folder / "car.toml").write_text(CAR_TOML)
    options = ["--car", str(folder / "car.toml"), "--track", "oval", "--duration", "0.3"]
    if run(["run", *options, "--record", str(folder / "run.mcap")]) not in (0, 1):
        raise RuntimeError("no recording was made")


def _standing(folder: Path) -> None:
    """Images in which a lane can be seen."""
    (folder / "images").mkdir()
    camera = CameraConfig(
        width_px=320, height_px=180, intrinsics=Intrinsics(fx_px=240.0, fy_px=240.0, cx_px=159.5, cy_px=89.5)
    )
    world = build_world(CarConfig(camera=camera), Simulation(track="oval", style="competition"))
    for index in range(3):
        cv2.imwrite(str(folder / "images" / f"{index}.png"), world.capture(0, index)[0])


def _video(folder: Path) -> None:
    _images(folder)
    with VideoWriter(folder / "drive.mp4", 20.0) as video:
        for index in range(4):
            video.write(_image(index))


def _track(folder: Path) -> None:
    shutil.copy(str(files("tracks").joinpath("oval.toml")), folder / "track.toml")


def _network(folder: Path) -> None:
    _images(folder)
    (folder / "net.onnx").write_bytes(onnx_files.model())
    text = CAR_TOML.replace(
        'name = "contour"',
        f'name = "centerline"\n[pipeline.centerline]\nnetwork = "256x128"\nmodel = "{folder}/net.onnx"',
    )
    (folder / "car.toml").write_text(text)


MAPPING = """[link]
kind = "can"
[link.can]
dbc = []
[[link.can.receive]]
name = "AM_STATE"
period_s = 0.01
checksum = "autosar_e2e_2"
counter = "autosar_e2e_2"
counter_signal = "STATE_COUNTER"
quality_signal = "STATE_VALID"
[[link.can.state]]
value = "speed_mps"
message = "AM_STATE"
signal = "SPEED"
minimum = -10.0
maximum = 90.0
[[link.can.state]]
value = "yaw_rate_radps"
message = "AM_STATE"
signal = "YAW_RATE"
"""


def _bus(folder: Path) -> None:
    (folder / "car.toml").write_text('[link]\nkind = "arduino"\n[link.can]\ndbc = []\n')
    (folder / "mapping.toml").write_text(MAPPING)
    shutil.copy(str(files("firmware_link").joinpath("dbc/automodel.dbc")), folder / "bus.dbc")
    candump(folder / "bus.log", 0.5)
    for kind in ("asc", "blf", "trc"):
        with can.LogReader(folder / "bus.log") as frames, can.Logger(folder / f"bus.{kind}") as log:
            for frame in frames:
                log(frame)


def _stereo(folder: Path) -> None:
    """A recording of two cameras, and their car.toml."""
    shutil.copy(kit_path("sim-stereo"), folder / "car.toml")
    options = ["--car", str(folder / "car.toml"), "--track", "oval", "--duration", "0.1"]
    if run(["run", *options, "--record", str(folder / "run.mcap")]) not in (0, 1):
        raise RuntimeError("no recording was made")


def _requests(folder: Path) -> None:
    (folder / "requests").mkdir()
    said = (get("/page.js"), get("/socket"), words("arm", "hold", "release", "stop"), words("stop"))
    for number, data in enumerate(said):
        (folder / "requests" / f"{number}").write_bytes(data)


def _view_requests(folder: Path) -> None:
    _recording(folder)
    (folder / "requests").mkdir()
    said = (get("/view.js"), words("0 recorded", "3 recorded"), words("-1 recorded"))
    for number, data in enumerate(said):
        (folder / "requests" / f"{number}").write_bytes(data)


def _kept(folder: Path) -> None:
    """Results of a sweep that goes on from there."""
    if run([argument.replace("{}", str(folder)) for argument in _SWEEP]) != 0:
        raise RuntimeError("nothing was kept")
    (folder / "out.csv").unlink()


def _bench(folder: Path) -> None:
    rows = [
        {"table": "lines", "section": "curve", "mae_px": 0.5 * index, "paper_mae_px": 1.5, "frames": 3 + index}
        for index in range(2)
    ]
    results = {"version": "0.1.0", "command": "bench accuracy", "rows": rows, "machine": {"model": "a board"}}
    (folder / "bench.json").write_text(json.dumps(results))


_REPLAY = ("--car", "{}/car.toml", "--csv", "{}/out.csv", "--json")
_BUS = ("--dbc", "{}/bus.dbc", "--motion-csv", "{}/out.csv")
_SWEEP = ("bench", "faults", "--only", "disk-full", "--only", "camera-type", "--runs", "2", "--pipeline", "truth",
          "--jobs", "1", "--keep", "{}/kept", "--csv", "{}/out.csv", "--json")  # fmt: skip
TARGETS = (
    Target(name="car", build=_images, damaged=("car.toml",), arguments=("replay", "{}/images", *_REPLAY)),
    Target(name="track", build=_track, damaged=("track.toml",), out=("truth.csv",),
           arguments=("run", "--track", "{}/track.toml", "--duration", "0.05", "--truth", "{}/truth.csv")),
    Target(name="motion", build=_images, damaged=("motion.csv",),
           arguments=("replay", "{}/images", "--motion", "{}/motion.csv", *_REPLAY)),
    Target(name="images", build=_images, damaged=("images/0.png", "images/1.png"),
           arguments=("replay", "{}/images", *_REPLAY)),
    Target(name="tub", build=_tub,
           damaged=("tub/manifest.json", "tub/catalog_0.catalog", "tub/images/0_cam_image_array_.jpg"),
           arguments=("replay", "{}/tub", *_REPLAY)),
    Target(name="mcap", build=_recording, damaged=("run.mcap",), arguments=("replay", "{}/run.mcap", *_REPLAY)),
    Target(name="export", build=_recording, damaged=("run.mcap",),
           arguments=("export", "{}/run.mcap", "--csv", "{}/out.csv")),
    Target(name="recover", build=_recording, damaged=("run.mcap",), out=("whole.mcap",),
           arguments=("recover", "{}/run.mcap", "-o", "{}/whole.mcap")),
    Target(name="video", build=_video, damaged=("drive.mp4",), arguments=("replay", "{}/drive.mp4", *_REPLAY)),
    Target(name="onnx", build=_network, damaged=("net.onnx",), arguments=("replay", "{}/images", *_REPLAY)),
    Target(name="bench", build=_bench, damaged=("bench.json",), out=("out.html",),
           arguments=("report", "{}/bench.json", "--html", "{}/out.html", "--json")),
    Target(name="can", build=_bus, damaged=("bus.log", "bus.dbc"),
           arguments=("replay", "--can", "{}/bus.log", "--mapping", "{}/car.toml", *_BUS)),
    Target(name="can-logs", build=_bus, damaged=("bus.asc", "bus.blf", "bus.trc"),
           arguments=("replay", "--can", "{file}", "--mapping", "{}/car.toml", *_BUS)),
    Target(name="can-mapping", build=_bus, damaged=("mapping.toml",),
           arguments=("replay", "--can", "{}/bus.log", "--mapping", "{}/mapping.toml", *_BUS)),
    Target(name="stereo", build=_stereo, damaged=("run.mcap",), arguments=("replay", "{}/run.mcap", *_REPLAY)),
    Target(name="stereo-car", build=_stereo, damaged=("car.toml",), arguments=("replay", "{}/run.mcap", *_REPLAY)),
    Target(name="foxglove", build=_recording, damaged=("run.mcap",), out=("shown.mcap", "shown.layout.json"),
           arguments=("export", "{}/run.mcap", "--foxglove", "{}/shown.mcap")),
    Target(name="report", build=_recording, damaged=("run.mcap",), out=("page.html",),
           arguments=("report", "{}/run.mcap", "--html", "{}/page.html")),
    Target(name="guess", build=_standing, damaged=("images/*",),
           out=("out.csv", "images.car.toml", "images.overlay.mp4"),
           arguments=("replay", "{}/images", "--guess", "--lane-width-m", "0.4", "--pipeline", "contour",
                      "--csv", "{}/out.csv")),
    Target(name="keep", build=_kept, damaged=("kept/*",), arguments=_SWEEP),
    Target(name="web", build=_requests, damaged=("requests/*",), arguments=("{file}",), call=send_to_page),
    Target(name="view", build=_view_requests, damaged=("requests/*",), arguments=("{file}", "{}/run.mcap"),
           call=send_to_view),
)  # fmt: skip

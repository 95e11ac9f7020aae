"""What is damaged: a folder of good files, the one that is damaged in it, and the command that reads it."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path

import cv2
import numpy as np

from automodel.cli.main import run
from automodel.types import Image
from automodel.viewer.video import VideoWriter
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
    """`build` fills a folder with good files; `damaged` of these are damaged in turn, and `arguments` read them.

    `{}` in the arguments is the folder; `out` must not appear, or must be whole, where the command fails.
    """

    name: str
    build: Callable[[Path], None]
    damaged: tuple[str, ...]
    arguments: tuple[str, ...]
    out: str = "out.csv"


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


def _bus(folder: Path) -> None:
    (folder / "car.toml").write_text('[link]\nkind = "arduino"\n[link.can]\ndbc = []\n')
    shutil.copy(str(files("firmware_link").joinpath("dbc/automodel.dbc")), folder / "bus.dbc")
    candump(folder / "bus.log", 0.5)


def _bench(folder: Path) -> None:
    rows = [
        {"table": "lines", "section": "curve", "mae_px": 0.5 * index, "paper_mae_px": 1.5, "frames": 3 + index}
        for index in range(2)
    ]
    results = {"version": "0.1.0", "command": "bench accuracy", "rows": rows, "machine": {"model": "a board"}}
    (folder / "bench.json").write_text(json.dumps(results))


_REPLAY = ("--car", "{}/car.toml", "--csv", "{}/out.csv", "--json")
_BUS = (
    "replay",
    "--can",
    "{}/bus.log",
    "--dbc",
    "{}/bus.dbc",
    "--mapping",
    "{}/car.toml",
    "--motion-csv",
    "{}/out.csv",
)
TARGETS = (
    Target(name="car", build=_images, damaged=("car.toml",), arguments=("replay", "{}/images", *_REPLAY)),
    Target(name="track", build=_track, damaged=("track.toml",), out="truth.csv",
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
    Target(name="recover", build=_recording, damaged=("run.mcap",), out="whole.mcap",
           arguments=("recover", "{}/run.mcap", "-o", "{}/whole.mcap")),
    Target(name="video", build=_video, damaged=("drive.mp4",), arguments=("replay", "{}/drive.mp4", *_REPLAY)),
    Target(name="onnx", build=_network, damaged=("net.onnx",), arguments=("replay", "{}/images", *_REPLAY)),
    Target(name="bench", build=_bench, damaged=("bench.json",), out="out.html",
           arguments=("report", "{}/bench.json", "--html", "{}/out.html", "--json")),
    Target(name="can", build=_bus, damaged=("bus.log", "bus.dbc"), arguments=_BUS),
)  # fmt: skip

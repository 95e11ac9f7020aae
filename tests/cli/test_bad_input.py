# ruff: noqa: E501 - lines as they are printed
"""What is wrong with arguments or files: exit code 2, nothing on stdout, one line on stderr: what, where, what to do."""

from __future__ import annotations

import os
import shutil
import struct
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest

from automodel.config.parts import PIPELINES
from automodel.sources.errors import SourceError
from automodel.sources.images import read_image
from tests.support.command_line import as_ordinary_user

CARS = Path(__file__).resolve().parents[1] / "cars"
TEXTS = {
    "typo.toml": "[camera]\nwidht_px = 640\n",
    "type.toml": '[camera]\nwidth_px = "640"\n',
    "nan.toml": "[camera.intrinsics]\nfx_px = nan\n",
    "cut.toml": "[camera]\nwidth_px = 640\n[camera.intr",
    "empty.toml": "",
    "pipeline.toml": '[pipeline]\nname = "window"\n',
    "half.toml": '[camera]\nsource = "usb"\n',
    "tub.toml": '[camera]\nsource = "a/tub"\n[link]\nport = "/dev/ttyUSB0"\n',
    "usb.toml": '[camera]\nsource = "usb"\ndevice = 97\n[link]\nport = "/dev/ttyUSB0"\n',
    "autonomos.toml": '[camera]\nsource = "usb"\n[link]\nkind = "autonomos"\nport = "/dev/ttyUSB0"\n',
    "track.toml": 'name = "x"\nclosed = true\n[floor]\nx0_m = 0.0\ny0_m = 0.0\nx1_m = 1.0\ny1_m = 1.0\n'
    '[[pieces]]\nkind = "line"\nlength_m = 2.0\n',
    "open.toml": 'name = "x"\nclosed = false\n[floor]\nx0_m = 0.0\ny0_m = 0.0\nx1_m = 1.0\ny1_m = 1.0\n'
    '[[pieces]]\nkind = "line"\nlength_m = 2.0\n',
    "digits.toml": f"[camera]\nrate_hz = 1{'0' * 400}\n",
    "more_digits.toml": f"[camera]\nwidth_px = {'1' * 5000}\n",
    "deep.toml": f"x = {'[' * 100_000}",
    "hold.toml": "[safety]\nhold_s = 30.0\n",
    "point.toml": "[vehicle]\nwheelbase_m = 1e-300\n",
    "columns.csv": "x_m,y_m\n1,2\n",
    "motion.csv": "t_s,speed_mps,yaw_rate_radps\n0.0,1.0,nan\n",
    "text.mcap": "hello",
    "empty.mcap": "",
    "text.mp4": "hello",
    "empty.mp4": "",
}

CASES = {  # arguments -> the line on stderr
    "run --web 8765": "automodel: --web: expected HOST:PORT, for example 0.0.0.0:8765, got '8765'",
    "run --web 127.0.0.1:99999": "automodel: --web: expected HOST:PORT, for example 0.0.0.0:8765, got '127.0.0.1:99999'",
    "run --web 127.0.0.1:0 --web-tls missing.pem missing.pem": "automodel: --web-tls: missing.pem missing.pem: No such file or directory; expected PEM files of both",
    "run --web-tls missing.pem missing.pem": "automodel: --web-tls: is for the web page; give --web too",
    "run --sim-camera": 'automodel: --sim-camera: [link] port of the default car is "sim"; give --car of a car with a real board',
    "run --sim-camera --link avr --car usb.toml": "automodel: --link serial and --sim-camera: a real board in a simulated world; give both",
    "run --link serial --car usb.toml": "automodel: --link serial and --sim-camera: a real board in a simulated world; give both",
    "run --sim-camera --car autonomos.toml": "automodel: --sim-camera: autonomos.toml: [link] kind 'autonomos' does not say which pulses it makes; arduino does",
    "run --manual": "automodel: --manual: the simulated car is driven by hand in real time; give --realtime, too",
    "run --realtime --manual none": "automodel: --manual none: drives from the web page alone; give --web, too",
    "run --realtime --manual missing": "automodel: --manual missing: No such file or directory; give gamepad, keyboard or a device in /dev/input",
    "run --car missing.toml": "automodel: missing.toml: no such file",
    "run --car typo.toml": "automodel: typo.toml:2: [camera] widht_px: unknown key; did you mean width_px?",
    "run --car type.toml": "automodel: type.toml:2: [camera] width_px: expected a whole number, got '640'",
    "run --car nan.toml": "automodel: nan.toml:2: [camera.intrinsics] fx_px: expected a finite number, got nan",
    "run --car cut.toml": "automodel: cut.toml:3: not TOML: Expected ']' at the end of a table declaration",
    "run --car digits.toml": f"automodel: digits.toml:2: [camera] rate_hz: expected at most 1000, got 1{'0' * 39}...",
    "run --car more_digits.toml": "automodel: more_digits.toml: not TOML: Exceeds the limit (4300 digits) for integer string "
    "conversion: value has 5000 digits",
    "run --car deep.toml": "automodel: deep.toml: nested too deep; is this the right file?",
    "run --car hold.toml": "automodel: hold.toml:2: [safety] hold_s: expected at most 2, got 30.0",
    "run --car point.toml": "automodel: point.toml:2: [vehicle] wheelbase_m: expected at least 0.02, got 1e-300",
    "run --car pipe": "automodel: pipe: is a device or a pipe; give the name of a file",
    "run --car /dev/zero": "automodel: /dev/zero: is a device or a pipe; give the name of a file",
    "run --track pipe.toml": "automodel: pipe.toml: is a device or a pipe; give the name of a file",
    "replay pipe.mcap": "automodel: pipe.mcap: is a device or a pipe; give the name of a file",
    "recover pipe.mcap": "automodel: pipe.mcap: is a device or a pipe; give the name of a file",
    "replay mixed --motion pipe": "automodel: pipe: is a device or a pipe; give the name of a file",
    "replay bomb": "automodel: bomb/0.png: not an image, or a damaged one; replace or remove it",
    "run --car binary.toml": "automodel: binary.toml: cannot be read: not a text file in UTF-8",
    "run --car folder": "automodel: folder: cannot be read: Is a directory",
    "run --car pipeline.toml": "automodel: pipeline.toml:2: [pipeline] name: expected one of "
    f"{', '.join(PIPELINES.names)}, or package.module:Class, got 'window'; did you mean 'windows'?",
    "run --car half.toml": 'automodel: half.toml: [camera] source and [link] port: either both are "sim" or neither is',
    "run --car tub.toml": "automodel: tub.toml: [camera] source 'a/tub': a car drives with csi or usb; see replay",
    "run --car usb.toml": "automodel: /dev/video97: cannot be opened; is the camera plugged in, and [camera] device right?",
    "run --car usb.toml --laps 3": "automodel: --laps: is for the simulated car, and usb.toml names a real one",
    "run --car usb.toml --seed 0": "automodel: --seed: is for the simulated car, and usb.toml names a real one",
    "run --track tmrr": "automodel: tmrr: no such track; expected one of chicane, circuit, oval, ring, tmr, or "
    "the path of a .toml or .csv file",
    "run --track missing.toml": "automodel: missing.toml: no such file",
    "run --track track.toml": "automodel: track.toml:2: closed: true, but the road's end misses its "
    "start by 2000.00 mm and 0.000 deg; at most 1 mm and 0.1 deg are allowed",
    "run --track cut.toml": "automodel: cut.toml:3: not TOML: Expected ']' at the end of a table declaration",
    "run --track columns.csv": "automodel: columns.csv:1: expected the columns x_m,y_m,w_tr_right_m,w_tr_left_m, got 2",
    "run --track open.toml": "automodel: open.toml: the road is not closed, there are no laps; give --duration",
    "run --speed 99": "automodel: --speed 99.0: car.toml allows 2.0 ([safety] speed_max_mps)",
    "run --truth missing/truth.csv": "automodel: --truth missing/truth.csv: there is no folder missing",
    "run --truth folder": "automodel: --truth folder: is a folder; give the name of a file",
    "run --truth x.csv --record x.csv": "automodel: --truth x.csv: is the same file as --record; choose another name",
    "run --track oval --record text.mcap": "automodel: text.mcap: already exists; choose another name or delete it",
    "replay missing": "automodel: missing: no such file or folder",
    "replay missing.mcap": "automodel: missing.mcap: no such file",
    "replay empty.mcap": "automodel: empty.mcap: not an MCAP file",
    "replay text.mcap": "automodel: text.mcap: not an MCAP file",
    "replay cut.mcap": "automodel: cut.mcap: the file is cut; run: automodel recover cut.mcap",
    "replay empty.mp4": "automodel: empty.mp4: cannot be opened as a video: it is cut, damaged or something else",
    "replay text.mp4": "automodel: text.mp4: cannot be opened as a video: it is cut, damaged or something else",
    "replay folder": "automodel: folder: no images in this folder (.jpg, .jpeg, .png, "
    ".bmp, .webp, .tif, .tiff, .pgm, .ppm)",
    "replay mixed": "automodel: mixed/2.png: expected 640x360 pixels as in the other images, "
    "got 160x120; use one size per folder",
    "replay small": "automodel: small: frame 0 has 160x120 pixels, and without --car the camera is the simulated car's of "
    "640x360; give a car.toml with --car, or let one be guessed: automodel replay small --guess",
    "replay small --guess": "automodel: small: no car.toml can be guessed: images: expected 3 or more of a straight road, "
    "got 1",
    "replay small --guess --lane-width-m nan": "automodel replay: Invalid value for '--lane-width-m': expected a finite "
    "number, got nan (see automodel replay --help)",
    "replay small --lane-width-m 0.4": "automodel replay: --lane-width-m and --view-deg are for --guess; otherwise car.toml "
    "says both (see automodel replay --help)",
    "replay missing --guess": "automodel: missing: no such file or folder",
    "replay cutpng": "automodel: cutpng/0.png: the image is cut; replace or remove it",
    "replay mixed --car typo.toml": "automodel: typo.toml:2: [camera] widht_px: unknown key; did you mean width_px?",
    "replay mixed --motion missing.csv": "automodel: missing.csv: no such file",
    "replay mixed --motion motion.csv": "automodel: motion.csv:2: yaw_rate_radps: expected a finite number, got 'nan'",
    "replay mixed --csv missing/poses.csv": "automodel: --csv missing/poses.csv: there is no folder missing",
    "replay mixed --video x.avi": "automodel: x.avi: videos are written as MP4; choose a name that ends in .mp4",
    "replay run.mcap --csv run.mcap": "automodel: --csv run.mcap: is the same file as SOURCE; choose another name",
    "replay run.mcap --csv ./folder/../run.mcap": "automodel: --csv folder/../run.mcap: is the same file as SOURCE; choose another name",
    "export missing.mcap --csv x.csv": "automodel: missing.mcap: no such file",
    "export cut.mcap --csv x.csv": "automodel: cut.mcap: the file is cut; run: automodel recover cut.mcap",
    "export run.mcap --video run.mcap": "automodel: --video run.mcap: is the same file as RECORDING; choose another name",
    "recover missing.mcap": "automodel: missing.mcap: no such file",
    "recover text.mcap": "automodel: text.mcap: not an MCAP file",
    "recover run.mcap -o run.mcap": "automodel: run.mcap: is the file to recover; choose another name for the output",
    "recover head.mcap": "automodel: head.mcap: nothing to recover: no complete message before the cut",
    "bench accuracy --track tmrr --jobs 1": "automodel: tmrr: no such track; expected one of chicane, circuit, oval, ring, tmr, or "
    "the path of a .toml or .csv file",
    "bench accuracy --plot missing/x.png": "automodel: --plot missing/x.png: there is no folder missing",
}

USAGE = {  # arguments -> how the line begins, and what it names
    "run --pipeline window": ("automodel run: ", "--pipeline"),
    "run --laps 0": ("automodel run: ", "--laps"),
    "run --duration nan": ("automodel run: ", "--duration"),
    "run --speed -1": ("automodel run: ", "--speed"),
    "run --nonsense": ("automodel run: ", "--nonsense"),
    "drive": ("automodel: ", "drive"),
    "replay": ("automodel replay: ", "SOURCE"),
    "replay mixed --rate inf": ("automodel replay: ", "--rate"),
    "export run.mcap": ("automodel export: ", "--csv"),
    "bench accuracy --speed nan": ("automodel bench accuracy: ", "--speed"),
    "bench speed --frames 1": ("automodel bench speed: ", "--frames"),
}


def png_of_size(width_px: int, height_px: int) -> bytes:
    """A PNG that says it has this size, with next to no data."""
    parts = [(b"IHDR", struct.pack(">IIBBBBB", width_px, height_px, 8, 0, 0, 0, 0)), (b"IDAT", zlib.compress(b"\0"))]
    chunks = (
        struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
        for kind, data in (*parts, (b"IEND", b""))
    )
    return b"\x89PNG\r\n\x1a\n" + b"".join(chunks)


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory, driven: Path) -> Path:
    """A folder full of files that are wrong."""
    folder = tmp_path_factory.mktemp("wrong")
    for name, text in TEXTS.items():
        (folder / name).write_text(text)
    (folder / "binary.toml").write_bytes(b"\xff\xfe\x00")
    shutil.copy(driven / "run.mcap", folder / "run.mcap")
    whole = (driven / "run.mcap").read_bytes()
    (folder / "cut.mcap").write_bytes(whole[: len(whole) // 2])
    (folder / "head.mcap").write_bytes(whole[:3000])
    for name, sizes in {"folder": [], "mixed": [(360, 640), (360, 640), (120, 160)], "small": [(120, 160)]}.items():
        (folder / name).mkdir()
        for number, size in enumerate(sizes):
            cv2.imwrite(str(folder / name / f"{number}.png"), np.zeros(size, np.uint8))
    for name in ("pipe", "pipe.toml", "pipe.mcap"):
        os.mkfifo(folder / name)
    (folder / "bomb").mkdir()
    (folder / "bomb" / "0.png").write_bytes(png_of_size(65_000, 65_000))
    (folder / "cutpng").mkdir()
    picture = (folder / "mixed" / "0.png").read_bytes()
    (folder / "cutpng" / "0.png").write_bytes(picture[: len(picture) // 2])
    return folder


@pytest.mark.parametrize("arguments", CASES)
def test_one_line_and_exit_code_2(arguments: str, files: Path, cli, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(files)
    before = sorted(files.rglob("*"))
    said = cli(*arguments.split())
    assert (said.code, said.out, said.line()) == (2, "", CASES[arguments])
    assert sorted(files.rglob("*")) == before  # nothing half done lies about


@pytest.mark.parametrize("arguments", USAGE)
def test_wrong_arguments_name_themselves_and_the_help(arguments: str, files: Path, cli, monkeypatch) -> None:
    monkeypatch.chdir(files)
    said = cli(*arguments.split())
    command, named = USAGE[arguments]
    assert (said.code, said.out) == (2, "")
    assert said.line().startswith(command)
    assert named in said.line()
    assert said.line().endswith(f"(see {command[:-2]} --help)")


@pytest.mark.parametrize("size", [(65_000, 65_000), (640, 360)])
def test_decoders_write_nothing_of_their_own(size: tuple[int, int], tmp_path: Path, capfd) -> None:
    (tmp_path / "0.png").write_bytes(png_of_size(*size))
    with pytest.raises(SourceError, match="not an image, or a damaged one"):
        read_image(tmp_path / "0.png", colour=False)
    assert capfd.readouterr().err == ""


def test_a_mistake_of_ours_is_one_line_too(cli, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("automodel.cli.main.importlib.import_module", lambda name: 1 // 0)
    said = cli("init", "--list")
    assert said.code == 1
    assert said.line().startswith("automodel: unexpected ZeroDivisionError at test_bad_input.py:")
    assert said.line().endswith("(set AUTOMODEL_TRACEBACK=1 for the traceback)")
    monkeypatch.setenv("AUTOMODEL_TRACEBACK", "1")
    with pytest.raises(ZeroDivisionError):
        cli("init", "--list")


def test_an_input_is_never_overwritten(files: Path, cli, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(files)
    before = (files / "run.mcap").read_bytes()
    os.link("run.mcap", "same.mcap")
    try:
        for name in ("run.mcap", "same.mcap"):
            assert cli("replay", "run.mcap", "--csv", name).code == 2
    finally:
        os.unlink("same.mcap")
    assert (files / "run.mcap").read_bytes() == before


SECRET_INPUTS = [
    (("run", "--car"), "car.toml"),
    (("run", "--track"), "track.toml"),
    (("replay",), "run.mcap"),
    (("replay",), "bus.log"),
    (("replay", "--car", CARS / "solid_white_right.toml"), "road.mp4"),
    (("replay", "--car", CARS / "solid_white_right.toml"), "road.png"),
    (("replay", "--car", CARS / "solid_white_right.toml"), "pictures"),
    (("recover",), "run.mcap"),
    (("report", "--html", "page.html"), "run.mcap"),
    (("doctor", "--car"), "car.toml"),
]


@pytest.mark.parametrize(("command", "name"), SECRET_INPUTS)
def test_an_input_without_permission_is_refused(command: tuple[object, ...], name: str, tmp_path: Path) -> None:
    secret = tmp_path / name
    secret.touch() if secret.suffix else secret.mkdir()
    secret.chmod(0)
    said = as_ordinary_user(*command, secret)
    assert (said.code, said.out) == (2, "")
    assert str(secret) in said.line()
    assert "Permission denied" in said.line()


def test_an_output_without_permission_is_refused(tmp_path: Path) -> None:
    secret = tmp_path / "secret.csv"
    secret.touch()
    secret.chmod(0)
    said = as_ordinary_user("run", "--truth", secret)
    assert (said.code, said.line()) == (2, f"automodel: --truth {secret}: cannot be written; look at the permissions")
    assert secret.stat().st_size == 0


def test_a_cut_video(tmp_path: Path, data_root: Path, cli) -> None:
    whole = (data_root / "udacity" / "solidWhiteRight.mp4").read_bytes()
    cut = tmp_path / "cut.mp4"
    cut.write_bytes(whole[:300_000])
    table = tmp_path / "poses.csv"
    said = cli("replay", cut, "--car", CARS / "solid_white_right.toml", "--csv", table)
    assert said.code == 2
    assert os.listdir(tmp_path) == ["cut.mp4"]
    assert said.line().startswith(f"automodel: {cut}: ends after ")
    assert said.line().endswith(" of 221 frames: the file is cut")


def test_a_group_without_a_command_shows_its_help(cli) -> None:
    said = cli("bench")
    assert (said.code, said.out) == (2, "")
    assert said.err.startswith("Usage: automodel bench")


def test_the_examples_of_cars_do_not_drive(cli) -> None:
    for path in CARS.glob("*.toml"):
        assert cli("run", "--car", path).line().endswith("a car drives with csi or usb; see replay")

"""The firmware as a whole: its header is current, all its decisions are tested, and sanitizers find nothing."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from firmware_link import messages, protocol_files
from tests.support.firmware_build import FIRMWARE, host_library, need

TESTS = Path(__file__).parent
LOGIC_TESTS = (
    "test_firmware_frames.py",
    "test_firmware_logic.py",
    "test_firmware_memory.py",
    "test_firmware_sensors.py",
)


def test_header_is_current() -> None:
    assert protocol_files.HEADER.read_text(encoding="utf-8") == protocol_files.protocol_header(), (
        "make it anew: python -m firmware_link.protocol_files"
    )


def test_header_is_that_of_the_table() -> None:
    text = protocol_files.HEADER.read_text(encoding="utf-8")
    assert f"kTableHash = {messages.TABLE_HASH:#06x};" in text
    assert re.search(
        r"struct Status \{\n  static constexpr uint8_t kType = 0x82;\n  static constexpr uint8_t kBytes = 14;", text
    )
    assert "constexpr uint16_t kGyroFailed = 512;" in text


def test_decisions_know_no_registers() -> None:
    for path in (FIRMWARE / "src" / "logic").iterdir():
        assert not re.search(r"avr/|util/|F_CPU|\bISR\b|PORT[A-D]\b", path.read_text(encoding="utf-8")), path.name


def run_logic_tests(library: Path, **environment: str) -> None:
    """The tests of the decisions once more, in another Python, on this library."""
    command = [sys.executable, "-m", "pytest", "-q", "-x", "-p", "no:cacheprovider", "-m", "not slow"]
    done = subprocess.run(
        [*command, *[str(TESTS / name) for name in LOGIC_TESTS]],
        env={**os.environ, "FIRMWARE_LIBRARY": str(library), **environment},
        cwd=TESTS.parents[1],
        capture_output=True,
        text=True,
        timeout=280,
        check=False,
    )
    assert done.returncode == 0, done.stdout[-4000:] + done.stderr[-4000:]
    assert " skipped" not in done.stdout


@pytest.mark.slow
def test_every_line_of_the_decisions_is_run(tmp_path: Path) -> None:
    need("gcov", package="gcc")
    run_logic_tests(host_library(tmp_path, "--coverage -O0"))
    notes = [str(path) for path in tmp_path.glob("*.gcno")]
    done = subprocess.run(
        ["gcov", "--json-format", "--stdout", *notes], cwd=tmp_path, capture_output=True, text=True, check=True
    )
    runs: dict[tuple[str, int], int] = {}  # a header's line comes once for each file that includes it
    for line in done.stdout.splitlines():
        for file in json.loads(line)["files"]:
            path = Path(file["file"])
            if path.parent.name == "logic":
                for entry in file["lines"]:
                    place = path.name, entry["line_number"]
                    runs[place] = runs.get(place, 0) + entry["count"]
    assert {name for name, _ in runs} >= {path.name for path in (FIRMWARE / "src" / "logic").glob("*.cpp")}
    assert len(runs) > 250
    assert [place for place, count in sorted(runs.items()) if count == 0] == []


@pytest.mark.slow
def test_sanitizers_find_nothing(tmp_path: Path) -> None:
    need("gcc", package="gcc")
    library = host_library(tmp_path, "-O1 -fsanitize=address,undefined -fno-sanitize-recover=all")
    asan = subprocess.run(["gcc", "-print-file-name=libasan.so"], capture_output=True, text=True, check=True).stdout
    if not Path(asan.strip()).is_absolute():
        pytest.skip("gcc's address sanitizer is not installed (Debian: apt-get install libgcc-12-dev)")
    run_logic_tests(library, LD_PRELOAD=asan.strip(), ASAN_OPTIONS="detect_leaks=0")


ARDUINO = Path("/usr/share/arduino/hardware/arduino/avr")
SKETCH_FLAGS = (
    "-c -g -Os -w -std=gnu++11 -fpermissive -fno-exceptions -ffunction-sections -fdata-sections "
    "-fno-threadsafe-statics -flto -mmcu=atmega328p -DF_CPU=16000000L "
    "-DARDUINO=10819 -DARDUINO_AVR_NANO -DARDUINO_ARCH_AVR "
    f"-I{ARDUINO}/cores/arduino -I{ARDUINO}/variants/eightanaloginputs"
).split()


@pytest.mark.slow
def test_it_builds_as_an_arduino_sketch(tmp_path: Path) -> None:
    """As the IDE does it: the sketch behind Arduino.h, src/ and the core by the flags of its platform.txt, one link."""
    need("avr-g++", "avr-gcc-ar", package="gcc-avr avr-libc")
    if not ARDUINO.is_dir():
        pytest.skip("the Arduino core is not installed (Debian: apt-get install arduino-core-avr)")
    sketch = tmp_path / "firmware.ino.cpp"
    sketch.write_text("#include <Arduino.h>\n" + (FIRMWARE / "firmware.ino").read_text(encoding="utf-8"))
    ours = compiled([sketch, *sorted(FIRMWARE.glob("src/*/*.cpp"))], tmp_path)
    core = [ARDUINO / "cores" / "arduino" / name for name in ("main.cpp", "abi.cpp", "hooks.c", "wiring.c")]
    archive = tmp_path / "core.a"
    subprocess.run(["avr-gcc-ar", "rcs", archive, *compiled(core, tmp_path)], check=True)
    elf = tmp_path / "sketch.elf"
    link = ["avr-gcc", "-w", "-Os", "-flto", "-fuse-linker-plugin", "-Wl,--gc-sections", "-mmcu=atmega328p"]
    subprocess.run([*link, "-o", elf, *ours, archive, "-lm"], check=True)
    symbols = subprocess.run(["avr-nm", elf], capture_output=True, text=True, check=True).stdout
    assert "save_reset_cause" in symbols
    assert not re.search(r"\b(setup|loop|timer0_millis)\b", symbols)  # the core's own main and clock are not in it


def compiled(sources: list[Path], folder: Path) -> list[Path]:
    objects = []
    for source in sources:
        objects.append(folder / f"{source.parent.name}_{source.name}.o")
        compiler = ["avr-gcc", "-x", "c++"] if source.suffix == ".cpp" else ["avr-gcc"]
        flags = [
            flag for flag in SKETCH_FLAGS if source.suffix == ".cpp" or flag not in ("-std=gnu++11", "-fpermissive")
        ]
        subprocess.run([*compiler, *flags, str(source), "-o", str(objects[-1])], check=True)
    return objects

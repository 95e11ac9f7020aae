"""Checks the car's computer: how warm it is, what its power mode and supply let it do, and whether it starts by itself.

Everything is read from files below `root`, which is the machine's own except in tests.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from automodel.doctor.findings import Finding, okay, skip, warn

HOT_C, SCORCHING_C = 75.0, 90.0  # boards slow down from 80 to 97 degrees on
_ROOT = Path("/")
_CPUS = "sys/devices/system/cpu"
_PI_SUPPLY = "sys/devices/platform/soc/soc:firmware/get_throttled"
_PI_DIPS = 0x1 | 0x10000  # the voltage is low, and it has been since the start
_CAPPED = 0.95  # of the processor's highest clock rate: below it something holds it down


def computer_findings(root: Path = _ROOT) -> Iterator[Finding]:
    """Temperature, power mode, supply and service."""
    yield temperature_finding(root)
    yield power_finding(root)
    yield supply_finding(root)
    yield service_finding(root)


def board_name(root: Path = _ROOT) -> str | None:
    """The name of a Jetson or Raspberry Pi, None on any other machine."""
    name = (_text(root / "proc/device-tree/model") or "").rstrip("\0")
    if name.startswith("Raspberry Pi") or "Jetson" in name:
        return name
    return "Jetson" if (root / "etc/nv_tegra_release").exists() else None


def temperature_finding(root: Path = _ROOT) -> Finding:
    """The hottest of the kernel's thermal zones."""
    name = "temperature"
    zones = []
    for place in sorted((root / "sys/class/thermal").glob("thermal_zone*")):
        milli = _number(place / "temp")  # some zones of a Jetson cannot be read while their part is off
        if milli is not None and -50_000 < milli < 150_000:
            zones.append((milli / 1000.0, _text(place / "type") or place.name))
    if not zones:
        return skip(name, "this machine does not say")
    hottest_c, zone = max(zones)
    what = f"{hottest_c:.0f} degrees C ({zone})"
    if hottest_c >= SCORCHING_C:
        return warn(name, what, "switch it off and let it cool: it slows down, then switches itself off; fit a fan")
    if hottest_c >= HOT_C:
        return warn(name, what, "fit a fan or a larger heat sink: it slows down when it gets hotter")
    return okay(name, what)


def power_finding(root: Path = _ROOT) -> Finding:
    """Whether a Jetson or a Pi uses all its cores, at their full clock rate."""
    name, board = "power mode", board_name(root)
    if board is None:
        return skip(name, "no Jetson and no Raspberry Pi")
    mode = _nvpmodel(root)
    there, used = _count(root / _CPUS / "present"), _count(root / _CPUS / "online")
    policies = sorted((root / _CPUS / "cpufreq").glob("policy*"))
    rates = [(_number(p / "scaling_max_freq"), _number(p / "cpuinfo_max_freq")) for p in policies]
    share = min((allowed / most for allowed, most in rates if allowed and most), default=1.0)
    governors = sorted({_text(policy / "scaling_governor") or "?" for policy in policies})
    what = f"{board}{f', mode {mode}' if mode else ''}: {used} of {there} cores, {share:.0%} of their clock rate"
    what += f", governor {'/'.join(governors)}" if governors else ""
    if used < there or share < _CAPPED:
        do = "choose the mode with the most power: sudo nvpmodel -m N (/etc/nvpmodel.conf lists them)"
        return warn(name, what, do if mode else "remove what caps it (arm_freq in config.txt, cpufreq-set)")
    if governors and governors != ["performance"]:
        do = (
            "sudo jetson_clocks"
            if mode
            else "echo performance | sudo tee /sys/devices/system/cpu/cpufreq/*/scaling_governor"
        )
        return warn(name, f"{what}: the rate follows the load, which is late by frames", do)
    return okay(name, what)


def supply_finding(root: Path = _ROOT) -> Finding:
    """Whether the supply has dipped since the board was switched on (Raspberry Pi: low voltage; Orin: over-current)."""
    name = "supply"
    state = _text(root / _PI_SUPPLY)
    counts = [_number(path) for path in sorted((root / "sys/class/hwmon").glob("*/oc*_event_cnt"))]
    dips = sum(count for count in counts if count)
    try:
        low = state is not None and int(state, 16) & _PI_DIPS != 0
    except ValueError:
        state, low = None, False
    if state is None and not counts:
        return skip(name, "this machine does not say")
    if low or dips:
        what = (
            "its voltage has been low since it was switched on"
            if low
            else f"it was held back {dips} times for its current"
        )
        return warn(name, what, "a stronger regulator, shorter and thicker wires; a supply of its own for the servo")
    return okay(name, "no dips since it was switched on")


def service_finding(root: Path = _ROOT) -> Finding:
    """Whether a unit of systemd starts the car at boot."""
    name = "service"
    units = sorted((root / "etc/systemd/system").glob("automodel*.service"))
    if not units:
        return skip(name, "the car is started by hand", "automodel service install starts it at boot")
    started = [unit.name for unit in units if list((root / "etc/systemd/system").glob(f"*.wants/{unit.name}"))]
    if not started:
        do = f"sudo systemctl enable {units[0].name}"
        return warn(name, f"{units[0].name} is there, and is not started at boot", do)
    return okay(name, f"{', '.join(started)} starts at boot")


def _nvpmodel(root: Path) -> str | None:
    """The name of a Jetson's power mode, or its number where the name is not known; None on other machines."""
    status = _text(root / "var/lib/nvpmodel/status") or ""
    number = status.partition("pmode:")[2][:4]
    if not number.isdigit():
        return None
    for line in (_text(root / "etc/nvpmodel.conf") or "").splitlines():
        words = dict(word.split("=", 1) for word in line.replace("<", "").replace(">", "").split() if "=" in word)
        if "POWER_MODEL" in line and words.get("ID") == str(int(number)) and "NAME" in words:
            return words["NAME"]
    return str(int(number))


def _count(path: Path) -> int:
    """How many cores a list as "0-3,5" names; 0 where it cannot be read."""
    count = 0
    for part in (_text(path) or "").split(","):
        first, _, last = part.partition("-")
        if first.isdigit() and (last or first).isdigit():
            count += int(last or first) - int(first) + 1
    return count


def _text(path: Path) -> str | None:
    try:
        return path.read_text(encoding="utf-8", errors="replace").strip()
    except OSError:
        return None


def _number(path: Path) -> int | None:
    try:
        return int(_text(path) or "")
    except ValueError:
        return None

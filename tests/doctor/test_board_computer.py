"""The car's computer, from files as a Jetson and a Raspberry Pi have them, below a folder of the test's."""

from __future__ import annotations

from pathlib import Path

import pytest

from automodel.doctor.board_computer import (
    board_name,
    computer_findings,
    power_finding,
    service_finding,
    supply_finding,
    temperature_finding,
)
from automodel.doctor.findings import Verdict

OK, WARN, SKIP = Verdict.OK, Verdict.WARN, Verdict.SKIP
ORIN = {
    "proc/device-tree/model": "NVIDIA Jetson Orin Nano Developer Kit\0",
    "etc/nvpmodel.conf": "# comment\n< POWER_MODEL ID=0 NAME=15W >\nCPU_ONLINE CORE_0 1\n"
    "< POWER_MODEL ID=2 NAME=MAXN_SUPER >\n",
    "var/lib/nvpmodel/status": "pmode:0002 fmode:quiet\n",
    "sys/devices/system/cpu/present": "0-5\n",
    "sys/devices/system/cpu/online": "0-5\n",
    "sys/devices/system/cpu/cpufreq/policy0/scaling_max_freq": "1728000\n",
    "sys/devices/system/cpu/cpufreq/policy0/cpuinfo_max_freq": "1728000\n",
    "sys/devices/system/cpu/cpufreq/policy0/scaling_governor": "performance\n",
    "sys/class/thermal/thermal_zone0/temp": "48500\n",
    "sys/class/thermal/thermal_zone0/type": "cpu-thermal\n",
    "sys/class/thermal/thermal_zone1/temp": "",  # of a part that is off
    "sys/class/thermal/thermal_zone1/type": "cv0-thermal\n",
    "sys/class/hwmon/hwmon1/oc1_event_cnt": "0\n",
    "sys/class/hwmon/hwmon1/oc2_event_cnt": "0\n",
}
PI = {
    "proc/device-tree/model": "Raspberry Pi 5 Model B Rev 1.0\0",
    "sys/devices/system/cpu/present": "0-3\n",
    "sys/devices/system/cpu/online": "0-3\n",
    "sys/devices/system/cpu/cpufreq/policy0/scaling_max_freq": "2400000\n",
    "sys/devices/system/cpu/cpufreq/policy0/cpuinfo_max_freq": "2400000\n",
    "sys/devices/system/cpu/cpufreq/policy0/scaling_governor": "ondemand\n",
    "sys/devices/platform/soc/soc:firmware/get_throttled": "0\n",
}


def machine(root: Path, files: dict[str, str], **changed: str) -> Path:
    """The files below `root`; `changed` replaces those whose path ends so."""
    for name, text in files.items():
        new = next((value for key, value in changed.items() if name.endswith(key)), text)
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).write_text(new)
    return root


def test_a_jetson_that_is_well(tmp_path: Path) -> None:
    found = list(computer_findings(machine(tmp_path, ORIN)))
    assert [(f.name, f.verdict) for f in found] == [
        ("temperature", OK), ("power mode", OK), ("supply", OK), ("service", SKIP)
    ]  # fmt: skip
    assert found[0].what == "48 degrees C (cpu-thermal)"
    assert found[1].what == (
        "NVIDIA Jetson Orin Nano Developer Kit, mode MAXN_SUPER: 6 of 6 cores, 100% of their clock rate, "
        "governor performance"
    )


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        ({"online": "0-3"}, "4 of 6 cores"),
        ({"online": "0,2-3,5"}, "4 of 6 cores"),
        ({"scaling_max_freq": "806400"}, "47% of their clock rate"),
        ({"scaling_governor": "schedutil"}, "governor schedutil: the rate follows the load"),
        ({"status": "pmode:0000", "online": "0-3"}, "mode 15W"),
        ({"status": "pmode:0007", "online": "0-3"}, "mode 7"),
    ],
)
def test_a_jetson_that_is_held_down(changed: dict[str, str], said: str, tmp_path: Path) -> None:
    found = power_finding(machine(tmp_path, ORIN, **changed))
    assert (found.verdict, said in found.what) == (WARN, True), found
    assert "nvpmodel" in found.do or "jetson_clocks" in found.do


@pytest.mark.parametrize(("milli", "verdict"), [("74900", OK), ("75000", WARN), ("93000", WARN), ("junk", SKIP)])
def test_temperature(milli: str, verdict: Verdict, tmp_path: Path) -> None:
    assert temperature_finding(machine(tmp_path, ORIN, temp=milli)).verdict is verdict


def test_an_old_nano_is_known_by_its_release(tmp_path: Path) -> None:
    assert board_name(machine(tmp_path, {"etc/nv_tegra_release": "# R32 (release), REVISION: 7.4"})) == "Jetson"


def test_a_raspberry_pi(tmp_path: Path) -> None:
    root = machine(tmp_path, PI)
    assert [f.verdict for f in computer_findings(root)] == [SKIP, WARN, OK, SKIP]
    assert "scaling_governor" in power_finding(root).do
    for state, verdict in (("50005", WARN), ("10000", WARN), ("20000", OK), ("?", SKIP)):
        assert supply_finding(machine(tmp_path, PI, get_throttled=state)).verdict is verdict, state


def test_a_jetson_whose_current_was_too_high(tmp_path: Path) -> None:
    found = supply_finding(machine(tmp_path, ORIN, oc2_event_cnt="3\n"))
    assert (found.verdict, found.what) == (WARN, "it was held back 3 times for its current")


def test_any_other_machine_says_nothing(tmp_path: Path) -> None:
    assert [f.verdict for f in computer_findings(tmp_path)] == [SKIP] * 4
    assert len(list(computer_findings())) == 4  # this one, whatever it is


def test_service(tmp_path: Path) -> None:
    units = tmp_path / "etc/systemd/system"
    units.mkdir(parents=True)
    assert service_finding(tmp_path).verdict is SKIP
    (units / "automodel.service").write_text("[Unit]\n")
    found = service_finding(tmp_path)
    assert (found.verdict, found.do) == (WARN, "sudo systemctl enable automodel.service")
    (units / "multi-user.target.wants").mkdir()
    (units / "multi-user.target.wants/automodel.service").symlink_to(units / "automodel.service")
    found = service_finding(tmp_path)
    assert (found.verdict, found.what) == (OK, "automodel.service starts at boot")

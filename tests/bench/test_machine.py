from __future__ import annotations

from pathlib import Path

import pytest

from automodel.bench import machine


def test_a_jetson_says_its_model_cores_and_governor(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "model").write_bytes(b"NVIDIA Jetson Nano Developer Kit\0")
    (tmp_path / "scaling_governor").write_text("schedutil\n")
    (tmp_path / "scaling_max_freq").write_text("1479000\n")
    monkeypatch.setattr(machine, "_MODEL", tmp_path / "model")
    monkeypatch.setattr(machine, "_FREQUENCY", tmp_path)
    said = machine.this_machine()
    assert (said["model"], said["governor"], said["max_mhz"]) == ("NVIDIA Jetson Nano Developer Kit", "schedutil", 1479)
    assert machine.described(said).startswith("NVIDIA Jetson Nano Developer Kit, ")
    assert ", up to 1479 MHz, governor schedutil, load " in machine.described(said)


def test_a_machine_that_says_nothing_has_none(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("_MODEL", "_CPUINFO", "_FREQUENCY"):
        monkeypatch.setattr(machine, name, tmp_path / "none")
    monkeypatch.setattr(machine, "_PACKAGES", ("numpy", "no-such-package"))
    said = machine.this_machine()
    assert [said[key] for key in ("model", "governor", "max_mhz", "no-such-package")] == [None] * 4
    assert machine.described(said).startswith(said["architecture"])


@pytest.mark.parametrize(
    ("cpuinfo", "name"),
    [("processor\t: 0\nmodel name\t: ARMv8 Processor\n", "ARMv8 Processor"), ("processor\t: 0\n", None), (None, None)],
)
def test_the_processors_name(cpuinfo: str | None, name: str | None) -> None:
    assert machine._cpu_name(cpuinfo) == name

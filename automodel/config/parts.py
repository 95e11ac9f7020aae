"""The parts that car.toml chooses by name: pipelines, controllers, links and cameras.

Each kind has a table from a name to "module:attribute", which is imported only when the part is made
(`automodel.assembly.registry`). A team's own part needs no change here: an installed package offers it by an entry
point of the kind's group, or car.toml names it as "package.module:Class".
"""

from __future__ import annotations

import difflib
import re
from collections.abc import Mapping
from dataclasses import dataclass
from importlib import metadata

_TARGET = re.compile(r"[A-Za-z_]\w*(\.[A-Za-z_]\w*)*:[A-Za-z_]\w*")


@dataclass(frozen=True, slots=True, kw_only=True)
class PartKind:
    """One kind of part: `key` is its place in car.toml, `group` the entry points of installed packages.

    `targets` maps the names of the parts that come with automodel to "module:attribute"; `methods` are those that
    every part of this kind has.
    """

    kind: str
    key: str
    group: str
    targets: Mapping[str, str]
    methods: tuple[str, ...]

    @property
    def names(self) -> tuple[str, ...]:
        """The parts that come with automodel."""
        return tuple(self.targets)

    def target(self, name: str) -> str | None:
        """Where the part `name` is, as "module:attribute"; None where nothing is known by that name."""
        if name in self.targets:
            return self.targets[name]
        if _TARGET.fullmatch(name):
            return name
        return next((entry.value for entry in metadata.entry_points(group=self.group) if entry.name == name), None)

    def check(self, field: str, name: str) -> None:
        """Raise ValueError, `field` first, for a name behind which there is no part."""
        if self.target(name) is not None:
            return
        known = [*self.targets, *(entry.name for entry in metadata.entry_points(group=self.group))]
        close = difflib.get_close_matches(name, known, 1)
        hint = f"; did you mean {close[0]!r}?" if close else ""
        raise ValueError(f"{field}: expected one of {', '.join(known)}, or package.module:Class, got {name!r}{hint}")


PIPELINES = PartKind(
    kind="pipeline",
    key="[pipeline] name",
    group="automodel.pipelines",
    targets={
        "centerline": "automodel.pipelines.centerline:Centerline",
        "windows": "automodel.pipelines.windows:Windows",
        "contour": "automodel.pipelines.contour:Contour",
        "stereo": "automodel.pipelines.stereo:Stereo",
    },
    methods=("step", "reset"),
)
PAIR_PIPELINES = ("stereo",)  # those of ours that need two cameras
CONTROLLERS = PartKind(
    kind="controller",
    key="[control] controller",
    group="automodel.controllers",
    targets={
        "stanley": "automodel.control.controller:LaneController",
        "pure_pursuit": "automodel.control.controller:LaneController",
    },
    methods=("step", "reset"),
)
LINKS = PartKind(
    kind="link",
    key="[link] kind",
    group="automodel.links",
    targets={
        "arduino": "automodel.assembly.links:arduino_link",
        "autonomos": "automodel.assembly.links:autonomos_link",
        "can": "automodel.assembly.links:can_link",
    },
    methods=("open", "poll", "send", "arm", "disarm", "close"),
)
CAMERAS = PartKind(
    kind="camera",
    key="[camera] source",
    group="automodel.sources",
    targets={
        "csi": "automodel.sources.csi:csi_source",
        "usb": "automodel.sources.usb:UsbSource",
    },
    methods=("read", "close"),
)
CAN_CHECKSUMS = PartKind(
    kind="checksum",
    key="[[link.can.receive]] checksum",
    group="automodel.can_checksums",
    targets={
        name: f"firmware_link.can_checks:{name}"
        for name in (
            "autosar_e2e_1", "autosar_e2e_2", "toyota", "honda", "hyundai", "hyundai_crc8", "chrysler", "sum8", "xor8"
        )
    },
    methods=(),
)  # fmt: skip
CAN_COUNTERS = PartKind(
    kind="counter",
    key="[[link.can.receive]] counter",
    group="automodel.can_counters",
    targets={
        "rolling": "firmware_link.can_checks:rolling",
        "autosar_e2e_1": "firmware_link.can_checks:rolling_to_14",
        "autosar_e2e_2": "firmware_link.can_checks:rolling",
    },
    methods=(),
)

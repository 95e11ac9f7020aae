"""The texts of the service: systemd's unit, and udev's rules for the board and the camera."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from automodel.service.battery import FLAG

NAME = "automodel.service"
MARK = "# Written by automodel service install; it is written anew by each."
GROUPS = ("dialout", "video", "input")  # serial port, cameras, gamepad
# USB serial converters and boards: vendor, product (empty: all of it)
BOARDS = (("2341", ""), ("2a03", ""), ("1a86", "7523"), ("0403", "6001"))


@dataclass(frozen=True, slots=True, kw_only=True)
class Service:
    """What is run, as whom: `command` is the whole line, `groups` those that the user gets besides their own."""

    command: Sequence[str]
    folder: Path
    user: str
    groups: Sequence[str] = ()
    poweroff: bool = True


def unit_text(service: Service) -> str:
    """The unit.

    The loop has to show signs of life within `WatchdogSec`; a camera that is opened anew may take nearly that long. It
    is started again for ever: a board that is plugged in later, or a camera that was not there yet, is no reason to
    give up. Ready is when frames come and the board has answered; the first start compiles the loops before that, for
    minutes on a small board.
    """
    poweroff = f"""ExecStopPost=+/bin/sh -c 'if [ -e "$$RUNTIME_DIRECTORY/{FLAG}" ]; then systemctl poweroff; fi'\n"""
    groups = f"SupplementaryGroups={' '.join(service.groups)}\n" if service.groups else ""
    return f"""{MARK}
[Unit]
Description=automodel drives the car
After=local-fs.target network.target
StartLimitIntervalSec=0

[Service]
Type=notify
NotifyAccess=main
ExecStart={" ".join(map(quoted, service.command))}
WorkingDirectory={_escaped(str(service.folder))}
User={service.user}
{groups}Environment=PYTHONUNBUFFERED=1
RuntimeDirectory=automodel
Restart=always
RestartSec=5
TimeoutStartSec=900
TimeoutStopSec=10
WatchdogSec=20
KillMode=mixed
LimitNICE=-15
LimitMEMLOCK=infinity
NoNewPrivileges=yes
ProtectSystem=full
PrivateTmp=yes
{poweroff if service.poweroff else ""}
[Install]
WantedBy=multi-user.target
"""


def rules_text() -> str:
    """udev's rules: names that stay, the service started when the board comes, and no ModemManager on its port."""
    rules = [MARK]
    for vendor, product in BOARDS:
        model = f', ATTRS{{idProduct}}=="{product}"' if product else ""
        rules.append(
            f'SUBSYSTEM=="tty", ATTRS{{idVendor}}=="{vendor}"{model}, SYMLINK+="automodel-board", '
            f'ENV{{ID_MM_DEVICE_IGNORE}}="1", TAG+="systemd", ENV{{SYSTEMD_WANTS}}+="{NAME}"'
        )
    rules.append('SUBSYSTEM=="video4linux", ATTR{index}=="0", ENV{ID_BUS}=="usb", SYMLINK+="automodel-camera"')
    return "\n".join(rules) + "\n"


def quoted(word: str) -> str:
    """A word of a command in a unit: systemd takes it for itself again, whatever is in it."""
    escaped = _escaped(word).replace("\\", "\\\\").replace('"', '\\"').replace("$", "$$")
    return escaped if escaped and not any(letter in escaped for letter in " \t'\";") else f'"{escaped}"'


def _escaped(text: str) -> str:
    return text.replace("%", "%%")  # systemd's own placeholders

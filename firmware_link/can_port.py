"""A CAN bus as a port: frames in with the time of their arrival, whitelisted frames out."""

from __future__ import annotations

import enum
from collections import deque
from dataclasses import dataclass
from typing import Any, Protocol

from automodel.config.extras import need_extra
from firmware_link.can_receiver import CanFrame
from firmware_link.errors import LinkError, PortLost, PortNotFound

FRAMES_MAX = 1000  # in one go: five times what a bus of 500 kbit/s can carry in a cycle of 20 ms
OFFSET_WINDOW_NS = 1_000_000_000  # the smallest delay of this time tells the offset between the clocks
_NO_BITRATE = frozenset({"virtual", "udp_multicast", "socketcan"})  # the last one's is set by `ip link`
_ECHOING = frozenset({"udp_multicast"})  # hears its own frames, as no controller does
_ECHOES_MAX = 100  # two seconds of the own frames
_EXTRA: dict[str, dict[str, Any]] = {"udp_multicast": {"hop_limit": 0}}  # never beyond this machine
_BUS_OFF, _CONTROLLER, _PASSIVE = 0x40, 0x04, 0x30  # linux/can/error.h: classes in the id, and data[1]


class BusTrouble(enum.Enum):
    """What a controller reports of the bus itself."""

    ERROR = "error"  # a frame that was no frame: wrong bit rate, a broken wire
    PASSIVE = "passive"  # so many errors that the controller may no longer signal them
    OFF = "off"  # the controller has left the bus


@dataclass(frozen=True, slots=True, kw_only=True)
class Received:
    """What came since the last time, in order."""

    frames: tuple[CanFrame, ...] = ()
    troubles: tuple[BusTrouble, ...] = ()


class CanPort(Protocol):
    """A bus. Every call may raise a LinkError; none blocks."""

    place: str

    def open(self) -> None:
        """Join the bus."""

    def receive(self, now_ns: int) -> Received:
        """What has come."""

    def send(self, frame_id: int, data: bytes, extended: bool) -> None:
        """Send a frame; raises PortLost where the queue is full."""

    def close(self) -> None:
        """Leave the bus; may be called twice."""


class PythonCanPort:
    """A bus of any kind that python-can knows."""

    def __init__(self, interface: str, channel: str, bitrate: int) -> None:
        self._interface, self._channel, self._bitrate = interface, channel, bitrate
        self.place = f"{channel} ({interface})"
        self._bus: Any = None
        self._offsets: deque[tuple[int, int]] = deque()  # when seen, and monotonic less bus time
        self._echoes: deque[tuple[int, bytes, bool]] = deque(maxlen=_ECHOES_MAX)  # sent, and not heard yet

    def open(self) -> None:
        """Join the bus; raises PortNotFound."""
        need_extra("CAN", "can")
        import can

        arguments = dict(_EXTRA.get(self._interface, {}))
        if self._interface not in _NO_BITRATE:
            arguments["bitrate"] = self._bitrate
        self._offsets.clear()
        self._echoes.clear()
        try:
            self._bus = can.Bus(interface=self._interface, channel=self._channel, **arguments)
        except (can.CanError, OSError, ValueError, ImportError) as error:
            reason = " ".join(str(error).split())
            raise PortNotFound(f"{self.place}: the CAN bus cannot be opened: {reason}") from None

    def receive(self, now_ns: int) -> Received:
        """What has come; each frame with the time of its arrival, on the caller's clock."""
        import can

        frames: list[CanFrame] = []
        troubles: list[BusTrouble] = []
        try:
            for _ in range(FRAMES_MAX):
                message = self._live().recv(timeout=0)
                if message is None:
                    break
                if message.is_error_frame:
                    troubles.append(trouble_of(message.arbitration_id, bytes(message.data)))
                elif not message.is_remote_frame:
                    t_ns = self._arrival_ns(round(message.timestamp * 1e9), now_ns)
                    data, extended = bytes(message.data), message.is_extended_id
                    if (message.arbitration_id, data, extended) in self._echoes:
                        self._echoes.remove((message.arbitration_id, data, extended))
                        continue
                    frames.append(CanFrame(t_ns=t_ns, frame_id=message.arbitration_id, data=data, extended=extended))
            state = self._live().state
        except NotImplementedError:
            state = None
        except (can.CanError, OSError, ValueError) as error:
            raise PortLost(f"{self.place}: {' '.join(str(error).split())}") from None
        if state is can.BusState.ERROR:
            troubles.append(BusTrouble.OFF)
        elif state is can.BusState.PASSIVE and self._interface != "virtual":
            troubles.append(BusTrouble.PASSIVE)
        return Received(frames=tuple(frames), troubles=tuple(troubles))

    def send(self, frame_id: int, data: bytes, extended: bool) -> None:
        """Send a frame at once."""
        import can

        message = can.Message(arbitration_id=frame_id, data=data, is_extended_id=extended)
        try:
            self._live().send(message, timeout=0)
            if self._interface in _ECHOING:
                self._echoes.append((frame_id, data, extended))
        except (can.CanError, OSError) as error:
            reason = " ".join(str(error).split())
            raise PortLost(
                f"{self.place}: a frame cannot be sent, the queue is full or the bus down: {reason}"
            ) from None

    def close(self) -> None:
        """Leave the bus."""
        bus, self._bus = self._bus, None
        if bus is not None:
            bus.shutdown()

    def _live(self) -> Any:
        if self._bus is None:
            raise PortLost(f"{self.place}: not open")
        return self._bus

    def _arrival_ns(self, bus_ns: int, now_ns: int) -> int:
        """The bus's time stamp on the caller's clock: what waited in a queue while the loop was busy is not late."""
        offsets = self._offsets
        while offsets and now_ns - offsets[0][0] > OFFSET_WINDOW_NS:
            offsets.popleft()
        offset = now_ns - bus_ns
        while offsets and offsets[-1][1] >= offset:  # the window's minimum stays in front
            offsets.pop()
        offsets.append((now_ns, offset))
        return min(bus_ns + offsets[0][1], now_ns)


def trouble_of(error_id: int, data: bytes) -> BusTrouble:
    """What an error frame of Linux's SocketCAN says; other drivers' frames are errors without a class."""
    if error_id & _BUS_OFF:
        return BusTrouble.OFF
    if error_id & _CONTROLLER and len(data) > 1 and data[1] & _PASSIVE:
        return BusTrouble.PASSIVE
    return BusTrouble.ERROR


class WhitelistedPort:
    """Lets through only frames of the identifiers and lengths that the mapping names; raises LinkError for others."""

    def __init__(self, port: CanPort, allowed: frozenset[tuple[int, bool, int]]) -> None:
        self._port = port
        self._allowed = allowed
        self.place = port.place
        self.open, self.receive, self.close = port.open, port.receive, port.close

    def send(self, frame_id: int, data: bytes, extended: bool) -> None:
        """Send a frame that may be sent."""
        if (frame_id, extended, len(data)) not in self._allowed:
            raise LinkError(f"{self.place}: frame {frame_id:#x} of {len(data)} bytes is not one that may be sent")
        self._port.send(frame_id, data, extended)

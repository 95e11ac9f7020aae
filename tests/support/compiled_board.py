"""The board's C++ decisions behind Python: the library's calls, and a board that runs them on virtual time."""

from __future__ import annotations

import ctypes
from pathlib import Path
from typing import Any

from firmware_link import messages
from firmware_link.emulator.board import SERVO_FRAME_NS, TICK_NS, EmulatedArduino, Peripherals, _State
from firmware_link.emulator.logic import BoardOptions
from firmware_link.messages import PULSE_STEP_US, ResetCause

COMMAND_BYTES = 7
LIMITS_BYTES = 14
_SENSOR_PHASE_MS = 11
_CODECS = {entry.codec.cls: entry.codec for entry in messages.TABLE}


class Turn(ctypes.Structure):
    """`Turn` of host/host.cpp."""

    _fields_ = [
        ("t_ms", ctypes.c_uint32),
        ("rx_count", ctypes.c_uint16),
        ("tx_room", ctypes.c_uint16),
        ("wheel_ticks", ctypes.c_int32),
        ("yaw_rate", ctypes.c_int16),
        ("ranges", ctypes.c_uint16 * 3),
        ("battery_v", ctypes.c_uint16),
        ("sensor_faults", ctypes.c_uint16),
        ("servo_us", ctypes.c_uint16),
        ("motor_us", ctypes.c_uint16),
        ("tx_count", ctypes.c_uint16),
        ("tx_frames", ctypes.c_uint16),
        ("limits_kept", ctypes.c_uint16),
        ("limits", ctypes.c_uint8 * LIMITS_BYTES),
        ("tx", ctypes.c_uint8 * 256),
    ]


def load(path: Path) -> Any:
    """The library; a ctypes.CDLL that knows its pointers and narrow numbers."""
    library = ctypes.CDLL(str(path))
    for name in ("board_new", "ranging_new", "gyro_new"):
        getattr(library, name).restype = ctypes.c_void_p
    for name in ("board_delete", "ranging_delete", "gyro_delete"):
        getattr(library, name).argtypes = [ctypes.c_void_p]
    narrow = {
        ctypes.c_uint8: ("encode_frame", "cause_of", "kept_slot", "ranging_tick"),
        ctypes.c_int8: ("wheel_step",),
        ctypes.c_uint16: ("crc", "kept_next_boot_id", "ranging_range", "gyro_tick", "gyro_status"),
        ctypes.c_int16: ("gyro_yaw_rate",),
        ctypes.c_bool: ("gyro_failed",),
    }
    for kind, names in narrow.items():
        for name in names:
            getattr(library, name).restype = kind
    handle, u8, u16, u32, flag = ctypes.c_void_p, ctypes.c_uint8, ctypes.c_uint16, ctypes.c_uint32, ctypes.c_bool
    library.board_turn.argtypes = [handle, ctypes.POINTER(Turn), ctypes.c_char_p]
    library.ranging_tick.argtypes = [handle, u32, u8]
    library.ranging_edge.argtypes = [handle, u8, flag, u16]
    library.ranging_range.argtypes = [handle, u8]
    library.gyro_tick.argtypes = [handle, u32]
    library.gyro_status.argtypes = [handle, u8, u8]
    library.gyro_yaw_rate.argtypes = library.gyro_failed.argtypes = [handle]
    return library


class CompiledArduino(EmulatedArduino):
    """The emulated board with the main loop's decisions made by the library: same line, same power, same time."""

    def __init__(
        self, library: Any, peripherals: Peripherals, baud: int = 115200, options: BoardOptions | None = None
    ) -> None:
        super().__init__(peripherals, baud, options)
        self._library = library
        self._board: int | None = None
        self._turn = Turn()
        self._tick_ns = 0

    def close(self) -> None:
        if self._board is not None:
            self._library.board_delete(self._board)
            self._board = None

    def _restart(self, t_ns: int, cause: ResetCause) -> None:
        super()._restart(t_ns, cause)
        self.close()

    def _run(self, t_ns: int) -> None:
        super()._run(t_ns)
        payload = _CODECS[messages.Limits].pack(self._limits)
        self._board = self._library.board_new(self._boot_id, int(self._cause), payload)
        self._tick_ns = t_ns

    def _next_ns(self) -> int:
        return self._tick_ns if self._state is _State.RUN else self._until_ns

    def _loop(self, t_ns: int) -> None:
        turn, data = self._turn, self._rx.take(t_ns)
        turn.t_ms = ((t_ns - self._start_ns) // TICK_NS) & 0xFFFFFFFF
        turn.rx_count, turn.tx_room = len(data), self._tx.room(t_ns)
        if turn.t_ms % (SERVO_FRAME_NS // TICK_NS) == _SENSOR_PHASE_MS:
            self._sense(t_ns)
        self._library.board_turn(self._board, ctypes.byref(turn), data)
        if turn.t_ms % (SERVO_FRAME_NS // TICK_NS) == 0:
            self._peripherals.set_pulses(t_ns, turn.servo_us * PULSE_STEP_US, turn.motor_us * PULSE_STEP_US)
        self._collect(t_ns)
        for chunk in bytes(turn.tx[: turn.tx_count]).split(b"\0"):
            if chunk:
                self._tx.put(b"\0" + chunk + b"\0", t_ns)
        if turn.limits_kept:
            limits = _CODECS[messages.Limits].unpack(bytes(turn.limits))
            assert isinstance(limits, messages.Limits)
            self._limits = limits
        self._tick_ns += TICK_NS

    def _sense(self, t_ns: int) -> None:
        sensors, turn = self._peripherals.read_sensors(t_ns), self._turn
        odometry = messages.Odometry(time_us=0, wheel_ticks=sensors.wheel_ticks, yaw_rate_radps=sensors.yaw_rate_radps)
        payload = _CODECS[messages.Odometry].pack(odometry)
        turn.wheel_ticks = int.from_bytes(payload[4:8], "little", signed=True)
        turn.yaw_rate = int.from_bytes(payload[8:10], "little", signed=True)
        left_m, centre_m, right_m = sensors.ranges_m
        ranges = messages.Ranges(
            time_us=0, left_m=left_m, centre_m=centre_m, right_m=right_m, battery_v=sensors.battery_v
        )
        numbers = _CODECS[messages.Ranges].pack(ranges)[4:]
        for index in range(3):
            turn.ranges[index] = int.from_bytes(numbers[2 * index : 2 * index + 2], "little")
        turn.battery_v = int.from_bytes(numbers[6:8], "little")

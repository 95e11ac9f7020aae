"""poses.csv: the car's pose in the lane, frame by frame."""

from __future__ import annotations

from pathlib import Path
from types import TracebackType

from automodel.config import ConfigError
from automodel.signals import Command, Frame, LaneEstimate, LaneLine, StereoFrame

COLUMNS = (
    "t_s",
    "frame",
    "status",
    "offset_m",
    "heading_rad",
    "curvature_per_m",
    "width_m",
    "left_seen",
    "right_seen",
    "crossing_distance_m",
    "crossing_angle_rad",
    "steering_rad",
    "latency_ms",
)


class PosesCsv:
    """Writes poses.csv, a row a frame; a field that does not exist is empty, never 0.

    Lengths and angles have six decimals (micrometres, microradians). Raises ConfigError where the file cannot be made.
    """

    def __init__(self, path: str | Path) -> None:
        try:
            self._file = open(path, "w", encoding="utf-8", newline="")  # noqa: SIM115 - closed by close()
        except OSError as error:
            raise ConfigError(f"{path}: cannot be written: {error.strerror}") from None
        self._file.write(",".join(COLUMNS) + "\n")

    def __enter__(self) -> PosesCsv:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def row(
        self,
        frame: Frame | StereoFrame,
        estimate: LaneEstimate | None,
        command: Command | None = None,
        latency_ms: float | None = None,
    ) -> None:
        """Write a frame's row. `t_s` is the frame's time in its source, with every nanosecond."""
        fields = [f"{frame.t_ns // 10**9}.{frame.t_ns % 10**9:09d}", str(frame.index)]
        fields += [""] * 9 if estimate is None else _fields(estimate)
        fields.append("" if command is None else _decimal(command.steering_rad))
        fields.append("" if latency_ms is None else f"{latency_ms:.3f}")
        self._file.write(",".join(fields) + "\n")

    def close(self) -> None:
        """Close the file; may be called twice."""
        self._file.close()


def _fields(estimate: LaneEstimate) -> list[str]:
    pose, crossing = estimate.pose, estimate.crossing
    fields = [estimate.status.value]
    if pose is None:
        fields += [""] * 4
    else:
        fields += [_decimal(v) for v in (pose.offset_m, pose.heading_rad, pose.curvature_per_m, pose.width_m)]
    fields += [_seen(estimate.left), _seen(estimate.right)]
    fields += ["", ""] if crossing is None else [_decimal(crossing.distance_m), _decimal(crossing.angle_rad)]
    return fields


def _decimal(value: float) -> str:
    return f"{value:.6f}"


def _seen(line: LaneLine | None) -> str:
    return "" if line is None else str(int(line.seen))

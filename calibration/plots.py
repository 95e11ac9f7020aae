"""Plots of a calibration, as images (h, w, 3) BGR."""

from __future__ import annotations

import io
from collections.abc import Sequence
from typing import TYPE_CHECKING

import cv2
import numpy as np

from automodel.types import Image
from calibration.actuator import Actuator, modelled_yaw_rates
from calibration.camera import CameraCalibration
from calibration.odometry import MeasuredRun, MotorTable, SteadySpeed, TicksPerMetre
from calibration.servo import ServoLog, ServoTable, holds_of

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_SHOWN_S = 6.0


def _new_figure(width_in: float, height_in: float) -> Figure:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width_in, height_in), layout="constrained", dpi=90)
    FigureCanvasAgg(figure)
    return figure


def _image_of(figure: Figure) -> Image:
    """The figure as it would be saved."""
    file = io.BytesIO()
    figure.savefig(file, format="png")
    return np.asarray(cv2.imdecode(np.frombuffer(file.getvalue(), np.uint8), cv2.IMREAD_COLOR), dtype=np.uint8)


def residual_picture(found: CameraCalibration) -> Image:
    """The residual of every corner as an arrow, and the error of every view in the fit and left out of it."""
    figure = _new_figure(14, 5.2)
    plane, bars = figure.subplots(1, 2, width_ratios=(3, 2))
    corners = np.concatenate([error.view.found.corners_px for error in found.views])
    residuals = np.concatenate([error.residuals_px for error in found.views])
    grow = 0.04 * found.width_px / max(float(np.quantile(np.linalg.norm(residuals, axis=1), 0.95)), 1e-6)
    lengths = np.linalg.norm(residuals, axis=1)
    arrows = plane.quiver(
        *corners.T, *(grow * residuals).T, lengths, angles="xy", scale_units="xy", scale=1, width=0.002, cmap="viridis"
    )
    figure.colorbar(arrows, ax=plane, label="residual [px]")
    plane.set(xlim=(0, found.width_px), ylim=(found.height_px, 0), aspect="equal", xlabel="u [px]", ylabel="v [px]")
    plane.set_title(f"corners seen minus projected, {grow:.0f} times", fontsize=10)
    place = np.arange(len(found.views))
    bars.barh(place - 0.2, [error.rms_px for error in found.views], 0.4, label=f"in the fit: {found.rms_px:.2f} px")
    label = f"left out of it: {found.cross_validated_px:.2f} px"
    bars.barh(place + 0.2, [error.held_out_px for error in found.views], 0.4, label=label)
    bars.set_yticks(place, [error.view.name for error in found.views], fontsize=7 if len(place) < 40 else 4)
    bars.invert_yaxis()
    bars.set_xlabel("rms [px]")
    bars.legend(fontsize=8)
    return _image_of(figure)


def servo_picture(log: ServoLog, table: ServoTable, actuator: Actuator, wheelbase_m: float) -> Image:
    """The table with its measurements, their residuals, and the fastest steps with the actuator's model."""
    holds = holds_of(log, wheelbase_m)
    pulses = np.array([hold.pulse_us for hold in holds])
    angles = np.degrees([hold.steering_rad for hold in holds])
    rose = np.array([hold.rose for hold in holds])
    middle = np.degrees(table.angle_rad(pulses))
    figure = _new_figure(11, 9)
    grid = figure.add_gridspec(3, 1, height_ratios=(5, 2, 4))
    top, left, steps = (figure.add_subplot(grid[i]) for i in range(3))
    half = 0.5 * np.degrees(table.play_rad)
    nodes = np.degrees(table.steering_rad)
    top.fill_between(table.pulse_us, nodes - half, nodes + half, color="tab:blue", alpha=0.15, label="play")
    top.plot(table.pulse_us, nodes, "o-", color="tab:blue", markersize=4, label="table")
    for axis, values in ((top, angles), (left, angles - middle)):
        for chosen, marker, colour, label in (
            (rose, "^", "tab:green", "pulse came from below"),
            (~rose, "v", "tab:orange", "from above"),
        ):
            axis.plot(pulses[chosen], values[chosen], marker, color=colour, markersize=5, label=label)
        axis.grid(alpha=0.3)
    top.axvline(table.centre_us, color="grey", linewidth=0.8, linestyle=":")
    top.set_ylabel("road wheels, left positive [deg]")
    top.set_title(
        f"centre {table.centre_us:.0f} us   play {2 * half:.1f} deg   scatter {np.degrees(table.rms_rad):.2f} deg",
        loc="left",
    )
    top.legend(fontsize=8)
    left.axhline(half, color="tab:blue", linewidth=0.8, linestyle=":")
    left.axhline(-half, color="tab:blue", linewidth=0.8, linestyle=":")
    left.set(xlabel="pulse [us]", ylabel="from the table [deg]")
    _plot_steps(steps, log, table, actuator, wheelbase_m)
    return _image_of(figure)


def _plot_steps(axis: Axes, log: ServoLog, table: ServoTable, actuator: Actuator, wheelbase_m: float) -> None:
    """The part of the drive with the largest steps: commanded, measured and modelled yaw rate."""
    t_ns, model = modelled_yaw_rates(log, table, actuator, wheelbase_m)
    seconds = (log.t_ns - t_ns[0]) * 1e-9
    commanded = np.interp((t_ns - t_ns[0]) * 1e-9, (log.pulse_t_ns - t_ns[0]) * 1e-9, table.angle_rad(log.pulse_us))
    gain = np.interp((t_ns - t_ns[0]) * 1e-9, seconds, log.speed_mps) / wheelbase_m
    jumps = np.abs(np.diff(table.angle_rad(log.pulse_us)))
    score = np.convolve(jumps, np.ones(int(_SHOWN_S / 0.02)), mode="valid")
    first_s = float((log.pulse_t_ns[int(np.argmax(score))] - t_ns[0]) * 1e-9) if len(score) else 0.0
    seen = [a & b for a, b in ((s >= first_s, s <= first_s + _SHOWN_S) for s in (seconds, (t_ns - t_ns[0]) * 1e-9))]
    draw = axis.plot
    shown_s = ((t_ns - t_ns[0]) * 1e-9)[seen[1]]
    draw(shown_s, (gain * np.tan(commanded))[seen[1]], color="grey", linewidth=0.8, label="pulse at the pin")
    draw(seconds[seen[0]], log.yaw_rate_radps[seen[0]], ".", color="tab:green", markersize=4, label="measured")
    draw(shown_s, model[seen[1]], color="tab:blue", linewidth=1.2, label="model")
    rate = actuator.rate_max_radps
    limit = f"at most {rate:.1f} rad/s" if rate is not None else f"no limit up to {actuator.rate_seen_radps:.1f} rad/s"
    axis.set_title(
        f"dead time {1e3 * actuator.delay_s:.0f} ms   lag {1e3 * actuator.lag_s:.0f} ms   {limit}", loc="left"
    )
    axis.set(xlabel="time [s]", ylabel="yaw rate [rad/s]")
    axis.grid(alpha=0.3)
    axis.legend(fontsize=8)


def odometry_picture(
    runs: Sequence[MeasuredRun], ticks: TicksPerMetre, steady: Sequence[SteadySpeed], motor: MotorTable | None
) -> Image:
    """The ticks a metre of each run with their mean, and the motor's table with the measured speeds."""
    figure = _new_figure(11, 4.5)
    axes = figure.subplots(1, 1 if motor is None else 2, squeeze=False)[0]
    numbers = np.arange(1, len(runs) + 1)
    # a count starts and ends anywhere between two ticks
    axes[0].errorbar(
        numbers,
        [run.ticks / run.distance_m for run in runs],
        yerr=[1.0 / run.distance_m for run in runs],
        fmt="o",
        capsize=4,
        color="tab:green",
        label="run, one tick either way",
    )
    axes[0].axhline(ticks.ticks_per_m, color="tab:blue", label="mean")
    low, high = ticks.ticks_per_m - ticks.scatter_per_m, ticks.ticks_per_m + ticks.scatter_per_m
    axes[0].axhspan(low, high, color="tab:blue", alpha=0.15)
    axes[0].set(xticks=numbers, xlabel="run", ylabel="ticks a metre")
    axes[0].set_title(f"{ticks.ticks_per_m:.1f} +/- {ticks.sd_per_m:.1f} ticks a metre", loc="left")
    if motor is not None:
        axes[1].plot(motor.pulse_us, motor.speed_mps, "o-", color="tab:blue", markersize=4, label="table")
        axes[1].plot(
            [s.pulse_us for s in steady], [s.speed_mps for s in steady], "^", color="tab:green", label="driven"
        )
        reach = 1.3 * max(s.speed_mps for s in steady)
        middle = motor.pulse_us[motor.speed_mps.index(0.0)]
        far = 2.0 * max(abs(s.pulse_us - middle) for s in steady)
        axes[1].set(xlim=(middle - far, middle + far), ylim=(-reach, reach), xlabel="pulse [us]", ylabel="speed [m/s]")
        axes[1].set_title(f"band {motor.band_us:.0f} us   scatter {motor.rms_mps:.3f} m/s", loc="left")
    for axis in axes:
        axis.grid(alpha=0.3)
        axis.legend(fontsize=8)
    return _image_of(figure)

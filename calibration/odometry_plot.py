"""The picture of an odometry's calibration."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from automodel.types import Image
from calibration.figure_picture import picture_of
from calibration.odometry import MotorTable, SteadySpeed, TicksPerMetre, Way


def odometry_picture(
    ways: Sequence[Way], ticks: TicksPerMetre, steady: Sequence[SteadySpeed], motor: MotorTable | None
) -> Image:
    """Each run's ticks a metre with their mean, and the motor's table with the speeds driven (h, w, 3) BGR."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(11, 4.5), layout="constrained", dpi=90)
    axes = figure.subplots(1, 1 if motor is None else 2, squeeze=False)[0]
    numbers = np.arange(1, len(ways) + 1)
    # a count starts and ends anywhere between two ticks
    axes[0].errorbar(
        numbers,
        [way.ticks / way.distance_m for way in ways],
        yerr=[1.0 / way.distance_m for way in ways],
        fmt="o",
        capsize=4,
        color="tab:green",
        label="run, one tick either way",
    )
    axes[0].axhline(ticks.ticks_per_m, color="tab:blue", label="mean")
    axes[0].axhspan(
        ticks.ticks_per_m - ticks.scatter_per_m, ticks.ticks_per_m + ticks.scatter_per_m, color="tab:blue", alpha=0.15
    )
    axes[0].set_xticks(numbers)
    axes[0].set_xlabel("run")
    axes[0].set_ylabel("ticks a metre")
    axes[0].set_title(f"{ticks.ticks_per_m:.1f} +/- {ticks.sd_per_m:.1f} ticks a metre", loc="left")
    if motor is not None:
        axes[1].plot(motor.pulse_us, motor.speed_mps, "o-", color="tab:blue", markersize=4, label="table")
        axes[1].plot(
            [s.pulse_us for s in steady], [s.speed_mps for s in steady], "^", color="tab:green", label="driven"
        )
        reach = 1.3 * max(s.speed_mps for s in steady)
        far = max(abs(s.pulse_us - motor.pulse_us[motor.speed_mps.index(0.0)]) for s in steady)
        middle = motor.pulse_us[motor.speed_mps.index(0.0)]
        axes[1].set_xlim(middle - 2.0 * far, middle + 2.0 * far)
        axes[1].set_ylim(-reach, reach)
        axes[1].set_xlabel("pulse [us]")
        axes[1].set_ylabel("speed [m/s]")
        axes[1].set_title(f"band {motor.band_us:.0f} us   scatter {motor.rms_mps:.3f} m/s", loc="left")
    for axis in axes:
        axis.grid(alpha=0.3)
        axis.legend(fontsize=8)
    return picture_of(figure)

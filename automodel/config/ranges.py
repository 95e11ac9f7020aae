"""The physical range of every number in a file that a user writes: car.toml and track files.

Beyond these ranges a value is a slip of the unit or of the keyboard, and what is computed from it overflows, takes
forever or fills the memory. They are wide: whether a value fits this car or this track, the section itself checks.
"""

from __future__ import annotations

# Size [of the key's unit] of a value that is not 0, by the end of its key: the longest end that fits counts.
BY_UNIT = {
    "_m": (1e-4, 1e5),  # a paint's edge to a race track with its floor
    "_px": (1e-3, 1e5),
    "_rad": (1e-9, 100.0),
    "_hz": (0.1, 1000.0),
    "_s": (1e-4, 3600.0),
    "_mps": (1e-3, 100.0),
    "_mps2": (1e-3, 100.0),
    "_mps3": (1e-3, 10_000.0),
    "_radps": (1e-3, 1000.0),
    "_per_m": (1e-9, 1e5),  # a race track's curvature to wheel ticks
    "_per_s": (1e-3, 1000.0),
    "_v": (0.1, 1000.0),
    "": (1e-12, 2.0**64),  # shares, factors, seeds, distortion
}
BY_KEY = {
    "vehicle.wheelbase_m": (0.02, 20.0),
    "vehicle.width_m": (0.01, 10.0),
    "vehicle.reference_x_m": (1e-4, 50.0),
    "vehicle.front_overhang_m": (1e-4, 10.0),
    "vehicle.rear_overhang_m": (1e-4, 10.0),
    "lane.width_m": (0.02, 20.0),
    "lane.marking_width_m": (0.001, 2.0),
    "camera.width_px": (8, 8192),  # what images of a source may have, too
    "camera.height_px": (8, 8192),
    "camera.latency_s": (1e-4, 0.5),  # a car that acts on older frames is not driven
    "camera.exposure_s": (1e-5, 1.0),
    "camera.gain": (0.01, 65_535.0),  # a factor, or a driver's own number
    "camera.sensor_mode": (1, 255),
    "camera.intrinsics.fx_px": (1.0, 1e5),
    "camera.intrinsics.fy_px": (1.0, 1e5),
    "camera.intrinsics.cx_px": (1e-3, 16_384.0),
    "camera.intrinsics.cy_px": (1e-3, 16_384.0),
    "camera.intrinsics.distortion": (1e-12, 1000.0),  # k3 of long lenses is in the hundreds
    "camera.extrinsics.x_m": (1e-4, 20.0),
    "camera.extrinsics.y_m": (1e-4, 20.0),
    "camera.extrinsics.z_m": (0.005, 20.0),
    # The longest times after which a car may still go on by itself, or go on without news.
    "safety.frame_timeout_s": (0.005, 2.0),
    "safety.command_validity_s": (0.01, 0.5),
    "safety.hold_s": (0.01, 2.0),
    "safety.holds_max": (1, 50),
    "safety.holds_window_s": (1.0, 600.0),
    "safety.rearm_s": (0.05, 60.0),
    "safety.steering_max_rad": (0.01, 1.2),
    "safety.steering_rate_max_radps": (0.01, 50.0),
    "safety.speed_max_mps": (0.01, 60.0),
    "safety.lateral_accel_max_mps2": (0.01, 15.0),
    "safety.lateral_jerk_max_mps3": (0.01, 500.0),
}


def range_of(path: tuple[str, ...]) -> tuple[float, float]:
    """The smallest size that is not 0, and the largest, of the number at a place: `("camera", "rate_hz")`."""
    place = ".".join(path)
    for key, limits in BY_KEY.items():
        if place == key or (key.startswith("camera.") and place == key.replace("camera.", "camera.right.", 1)):
            return limits
    end = max((unit for unit in BY_UNIT if path[-1].endswith(unit)), key=len)
    return BY_UNIT[end]


def out_of_range(path: tuple[str, ...], value: float) -> str | None:
    """What was expected of the number at a place, None where it is 0 or in its range."""
    least, most = range_of(path)
    size = abs(value)
    if size == 0 or least <= size <= most:
        return None
    return f"at most {most:g}" if size > most else f"at least {least:g}"

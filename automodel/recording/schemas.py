"""JSON schemas of the topics, so that Foxglove shows and plots them.

Foxglove reads a plain type per property: no unions (any value here may be null all the same), no arrays of arrays.
"""

from __future__ import annotations

import json
from typing import Any

_Schema = dict[str, Any]

_NUMBER: _Schema = {"type": "number"}
_INTEGER: _Schema = {"type": "integer"}
_BOOLEAN: _Schema = {"type": "boolean"}
_STRING: _Schema = {"type": "string"}
_NUMBERS: _Schema = {"type": "array", "items": _NUMBER}


def _object(**properties: _Schema) -> _Schema:
    return {"type": "object", "properties": properties}


_CURVE = _object(kind=_STRING, coefficients=_NUMBERS, points_x_m=_NUMBERS, points_y_m=_NUMBERS)
_LINE = _object(seen=_BOOLEAN, points_x_m=_NUMBERS, points_y_m=_NUMBERS, curve=_CURVE)
_POSE = _object(offset_m=_NUMBER, heading_rad=_NUMBER, width_m=_NUMBER, curvature_per_m=_NUMBER, covariance=_NUMBERS)

SCHEMAS: dict[str, tuple[str, _Schema]] = {
    "/motion": (
        "automodel.Motion",
        _object(t_ns=_INTEGER, speed_mps=_NUMBER, yaw_rate_radps=_NUMBER, source=_STRING),
    ),
    "/vehicle_state": (
        "automodel.VehicleState",
        _object(
            t_ns=_INTEGER,
            speed_mps=_NUMBER,
            yaw_rate_radps=_NUMBER,
            steering_rad=_NUMBER,
            ranges_m=_NUMBERS,
            battery_v=_NUMBER,
            armed=_BOOLEAN,
            faults={"type": "array", "items": _STRING},
            boot_id=_INTEGER,
        ),
    ),
    "/estimate": (
        "automodel.LaneEstimate",
        _object(
            t_ns=_INTEGER,
            status=_STRING,
            frame_age_ns=_INTEGER,
            pose=_POSE,
            crossing=_object(distance_m=_NUMBER, angle_rad=_NUMBER),
            left=_LINE,
            right=_LINE,
            centerline=_CURVE,
        ),
    ),
    "/command": (
        "automodel.Command",
        _object(t_ns=_INTEGER, steering_rad=_NUMBER, speed_mps=_NUMBER, valid_until_ns=_INTEGER),
    ),
    "/event": ("automodel.Event", _object(t_ns=_INTEGER, kind=_STRING, text=_STRING)),
}


def schema_text(topic: str) -> tuple[str, bytes]:
    """Name and JSON schema of a topic's messages."""
    name, schema = SCHEMAS[topic]
    return name, json.dumps({"title": name, **schema}).encode()

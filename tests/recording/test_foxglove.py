from __future__ import annotations

import json
import math
import re
from collections import defaultdict
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory

from automodel.cli.main import run as automodel
from automodel.config import CarConfig, parse_car
from automodel.curves import Curve, line
from automodel.geometry import GroundCamera
from automodel.recording import foxglove
from automodel.recording.codec import CAMERA, TOPICS, encode
from automodel.recording.foxglove import FoxgloveScene
from automodel.recording.reader import Recording
from automodel.signals import Event, LaneEstimate, LaneLine, LanePose, LaneStatus, Motion
from tests.support.recorded_values import CAR_TEXT

OFFSET_M, HEADING_RAD, WIDTH_M = 0.1, 0.2, 0.4


def straight_lane(car: CarConfig, bound_m: float = 0.03) -> LaneEstimate:
    """A straight lane that the car's reference point is 0.1 m left of, turned 0.2 rad to the left."""
    left_of_lane = np.array([math.sin(HEADING_RAD), math.cos(HEADING_RAD)])
    foot = np.array([car.vehicle.reference_x_m, 0.0]) - OFFSET_M * left_of_lane

    def at(d_m: float) -> Curve:
        x_m, y_m = foot + d_m * left_of_lane
        return line(x_m, y_m, -HEADING_RAD, 1.5)

    half, points = 0.5 * WIDTH_M, np.array([[0.8, 0.1], [0.9, 0.1]])
    pose = LanePose(
        offset_m=OFFSET_M, heading_rad=HEADING_RAD, width_m=WIDTH_M, curvature_per_m=0.0, covariance=np.eye(3),
        offset_bound_m=bound_m,
    )  # fmt: skip
    return LaneEstimate(
        t_ns=5,
        status=LaneStatus.ONE_LINE,
        left=LaneLine(curve=at(half), points_m=points, seen=True),
        right=LaneLine(curve=at(-half), points_m=np.empty((0, 2)), seen=False),
        centerline=at(0.0),
        pose=pose,
    )


def sent(messages: Any) -> dict[str, Any]:
    return dict(messages)


def test_the_lane_frame_lies_on_the_centerline_and_the_car_in_it() -> None:
    car = CarConfig()
    estimate = straight_lane(car)
    messages = sent(FoxgloveScene(car).estimate(estimate))
    tf, pose = messages[foxglove.BODY_LANE], messages[foxglove.POSE].pose
    assert (tf.parent_frame_id, tf.child_frame_id) == ("body", "lane")
    assert estimate.centerline is not None
    assert (tf.translation.x, tf.translation.y) == pytest.approx(tuple(estimate.centerline.position(0.0)), abs=1e-12)
    assert 2 * math.atan2(tf.rotation.z, tf.rotation.w) == pytest.approx(float(estimate.centerline.heading(0.0)))
    assert pose.position.y == OFFSET_M
    assert 2 * math.atan2(pose.orientation.z, pose.orientation.w) == pytest.approx(HEADING_RAD)


def test_annotations_are_the_curves_seen_by_the_camera_and_stay_near_the_image() -> None:
    car = CarConfig()
    estimate = straight_lane(car)
    message = sent(FoxgloveScene(car).estimate(estimate))[foxglove.ANNOTATIONS]
    camera = GroundCamera.from_config(car.camera)
    assert estimate.centerline is not None
    far = estimate.centerline.position(estimate.centerline.length_m)
    ends = [(a.points[-1].x, a.points[-1].y) for a in message.points]
    assert min(math.dist(end, camera.ground_to_px(far)) for end in ends) < 1e-6
    pixels = np.array([(p.x, p.y) for a in message.points for p in a.points])
    assert np.all(np.isfinite(pixels))
    assert camera.camera.inside(pixels, -float(car.camera.width_px)).all()
    assert "ONE_LINE" in message.texts[0].text


def test_the_band_from_above_is_as_wide_as_the_bound_and_none_without_one() -> None:
    car = CarConfig()
    (entity,) = sent(FoxgloveScene(car).estimate(straight_lane(car)))[foxglove.LANE].entities
    band = np.array([(p.x, p.y) for p in entity.triangles[0].points]).reshape(-1, 2, 2)
    assert np.linalg.norm(band[:, 0] - band[:, 1], axis=1) == pytest.approx(0.06)
    corners = set(entity.triangles[0].indices)
    assert corners == set(range(len(entity.triangles[0].points)))
    assert len(entity.lines) == 3
    (unbounded,) = sent(FoxgloveScene(car).estimate(straight_lane(car, math.inf)))[foxglove.LANE].entities
    assert not unbounded.triangles


def test_a_lost_lane_disappears() -> None:
    update = sent(FoxgloveScene(CarConfig()).estimate(LaneEstimate(t_ns=7, status=LaneStatus.LOST)))[foxglove.LANE]
    assert not update.entities
    assert update.deletions[0].id == "lane"


def test_a_quarter_circle_is_reckoned_in_the_world() -> None:
    scene = FoxgloveScene(CarConfig())
    for index in range(11):
        motion = Motion(t_ns=index * 10**8, speed_mps=0.5 * math.pi, yaw_rate_radps=0.5 * math.pi)
        transform = sent(scene.motion(motion))[foxglove.WORLD_BODY]
    assert (transform.translation.x, transform.translation.y) == pytest.approx((1.0, 1.0))
    assert 2 * math.atan2(transform.rotation.z, transform.rotation.w) == pytest.approx(0.5 * math.pi)


def test_the_camera_looks_where_the_car_toml_says() -> None:
    car = CarConfig()
    messages = sent(FoxgloveScene(car).start(0))
    (transform,) = messages[foxglove.BODY_CAMERA].transforms
    calibration = messages[foxglove.CALIBRATIONS[CAMERA]]
    from scipy.spatial.transform import Rotation

    q, t = transform.rotation, transform.translation
    body_from_cam = Rotation.from_quat([q.x, q.y, q.z, q.w]).as_matrix()
    in_cam = body_from_cam.T @ (np.array([1.0, 0.1, 0.0]) - [t.x, t.y, t.z])
    u, v, w = np.reshape(calibration.K, (3, 3)) @ in_cam
    assert (u / w, v / w) == pytest.approx(tuple(GroundCamera.from_config(car.camera).ground_to_px([1.0, 0.1])))


def test_events_have_levels() -> None:
    scene = FoxgloveScene(CarConfig())
    levels = [
        sent(scene.event(Event(t_ns=0, kind=kind, text="t")))[foxglove.LOG].level for kind in ("drive", "hold", "stop")
    ]
    assert levels == sorted(set(levels))


def test_the_export_validates_shows_everything_that_the_layout_wants_and_still_replays(
    recorded_run: Callable[[int], Path], tmp_path: Path
) -> None:
    run, out = recorded_run(3), tmp_path / "fox.mcap"
    assert automodel(["export", str(run), "--foxglove", str(out)]) == 0
    decoded: defaultdict[str, list[Any]] = defaultdict(list)
    with open(out, "rb") as file:
        reader = make_reader(file, validate_crcs=True, decoder_factories=[DecoderFactory()])
        for schema, channel, message in reader.iter_messages():
            assert schema is not None
            if channel.message_encoding == "protobuf":  # by the schema in the file, as Foxglove does
                decode = DecoderFactory().decoder_for("protobuf", schema)
                assert decode is not None
                decoded[channel.topic].append(decode(message.data))
            else:
                decoded[channel.topic].append(json.loads(message.data))
    wanted = {"/camera", "/camera/calibration", foxglove.ANNOTATIONS, foxglove.LANE, foxglove.CAR, foxglove.WORLD_BODY}
    assert wanted | {foxglove.BODY_CAMERA, foxglove.BODY_LANE, foxglove.POSE} <= decoded.keys()
    assert len(decoded[foxglove.ANNOTATIONS]) == len(decoded["/camera"]) == 3
    named = set(re.findall(r'"(/[a-z_/]+)', foxglove.layout_file().read_text()))
    assert named <= {*foxglove.TOPICS, *TOPICS.values(), CAMERA}
    assert (tmp_path / "fox.layout.json").read_text() == foxglove.layout_file().read_text()

    before, after = (
        [encode(step.estimate) for step in Recording(path).steps() if step.estimate is not None] for path in (run, out)
    )
    assert before == after
    assert Recording(out).car_text == CAR_TEXT == Recording(run).car_text
    again = tmp_path / "again.mcap"
    assert automodel(["export", str(out), "--foxglove", str(again)]) == 0  # of a copy: the same, nothing doubled
    assert topics(again) == topics(out)


def topics(path: Path) -> dict[str, int]:
    """The number of messages of each topic."""
    with open(path, "rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    assert summary.statistics is not None
    counts = summary.statistics.channel_message_counts
    assert len({channel.topic for channel in summary.channels.values()}) == len(summary.channels)
    return {channel.topic: counts.get(id, 0) for id, channel in summary.channels.items()}


def test_the_layout_may_not_overwrite_the_recording(recorded_run: Callable[[int], Path], tmp_path: Path) -> None:
    run = recorded_run(1)
    before = run.read_bytes()
    assert automodel(["export", str(run), "--foxglove", str(run)]) == 2
    assert run.read_bytes() == before


def test_a_stereo_pair_has_two_calibrations() -> None:
    car = parse_car("[camera.right.extrinsics]\ny_m = -0.1\n", "car.toml")
    messages = sent(FoxgloveScene(car).start(0))
    assert {foxglove.CALIBRATIONS["/camera/left"], foxglove.CALIBRATIONS["/camera/right"]} <= messages.keys()
    assert [t.translation.y for t in messages[foxglove.BODY_CAMERA].transforms] == [0.0, -0.1]

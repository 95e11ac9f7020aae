"""Pipelines on markings that are no brighter above the floor than the noise of a pixel."""

from __future__ import annotations

import pytest

from automodel.assembly.parts import make_pipeline
from automodel.sim.appearance import Appearance
from automodel.sim.track_files import load_track
from tests.support.rendered_drives import CAR, RenderedDrive


@pytest.mark.parametrize("name", ["windows", "contour"])
def test_faint_lines_are_found_and_followed(name: str) -> None:
    look = Appearance(floor_grey=40.0, marking_grey=50.0, read_noise=10.0, noise_seed=3)
    seen = RenderedDrive(track=load_track("oval"), pipeline=make_pipeline(name, CAR), look=look).run(0.5, 2.5)
    valid = [one for one in seen if one.estimate.valid]
    assert len(valid) > 0.95 * len(seen)
    assert max(abs(one.offset_error_m) for one in valid) < 0.03

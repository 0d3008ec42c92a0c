"""Round trip of every lens model over random lenses."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pipelines.geometry.cameras import Camera, distort, undistort

SMALL = st.floats(-0.05, 0.05)


@pytest.mark.parametrize("model", ["SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV", "OPENCV_FISHEYE"])
@settings(max_examples=30, deadline=None)
@given(data=st.data())
def test_distort_then_undistort_returns_the_ray(model: str, data: st.DataObject) -> None:
    count = {"SIMPLE_RADIAL": 1, "RADIAL": 2, "OPENCV": 4, "FULL_OPENCV": 8, "OPENCV_FISHEYE": 4}[model]
    lens = data.draw(st.lists(SMALL, min_size=count, max_size=count))
    head = [800.0, 500.0, 400.0] if "RADIAL" in model else [800.0, 820.0, 500.0, 400.0]
    if model.endswith("OPENCV"):
        lens[2:4] = [value / 20 for value in lens[2:4]]  # tangential terms of real lenses are this small
    camera = Camera(model, 1000, 800, np.array(head + lens))
    rays = np.array(data.draw(st.lists(st.tuples(*[st.floats(-0.7, 0.7)] * 2), min_size=1, max_size=8)))
    # With |k| ≤ 0.05 and r ≤ 1 every model is one to one, so the ray itself must come back.
    np.testing.assert_allclose(undistort(camera, distort(camera, rays)), rays, atol=1e-9)

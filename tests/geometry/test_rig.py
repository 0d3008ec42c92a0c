"""Camera centres and attitudes from the navigation of a rig whose truth is known."""

from __future__ import annotations

import numpy as np

from pipelines.geometry.rotations import exp_so3
from pipelines.geometry.trajectory import Rig, mount, with_rig

COUNT = 5
RNG = np.random.default_rng(0)
BODY = exp_so3(RNG.normal(size=(COUNT, 3)))
CENTER = RNG.normal(size=(COUNT, 3)) * 100.0
MOUNT = exp_so3(RNG.normal(size=(COUNT, 3)))
ARM = RNG.normal(size=(COUNT, 3))
BORESIGHT = exp_so3(np.radians([0.5, -1.0, 0.3]))
ANTENNA = CENTER + np.einsum("nij,nj->ni", BODY, ARM)


def test_centre_and_attitude_of_each_photograph() -> None:
    """A point ahead of the antenna by the arm, seen in axes that the mount and the boresight turn."""
    center, frame_from_cam = with_rig(ANTENNA, BODY, Rig(MOUNT, ARM, BORESIGHT))
    np.testing.assert_allclose(center, CENTER, rtol=0, atol=1e-12)
    # The nominal camera axes are those of the mount; the boresight brings the true ones to them.
    nominal = np.swapaxes(frame_from_cam @ BORESIGHT.T, 1, 2)
    np.testing.assert_allclose(nominal @ BODY, MOUNT, rtol=0, atol=1e-12)


def test_one_rig_holds_for_all() -> None:
    rig = Rig(mount([0.0, -35.0, 0.0]), np.array([0.1, -0.2, -0.3]), BORESIGHT)
    assert rig.cam_from_body is not None and rig.antenna_in_body is not None
    each = Rig(np.tile(rig.cam_from_body, (COUNT, 1, 1)), np.tile(rig.antenna_in_body, (COUNT, 1)), BORESIGHT)
    for one_rig, own_rigs in zip(with_rig(ANTENNA, BODY, rig), with_rig(ANTENNA, BODY, each), strict=True):
        np.testing.assert_array_equal(one_rig, own_rigs)


def test_what_is_not_known_of_a_rig() -> None:
    """An unknown arm leaves the antenna, an unknown attitude no centre that the arm moves, and no rotation."""
    bodies, arms = BODY.copy(), ARM.copy()
    bodies[[0, 1]], arms[[1, 2]] = np.nan, np.nan
    center, frame_from_cam = with_rig(ANTENNA, bodies, Rig(MOUNT, arms))
    assert np.isnan(center[0]).all()
    np.testing.assert_array_equal(center[1:3], ANTENNA[1:3])
    np.testing.assert_allclose(center[3:], CENTER[3:], rtol=0, atol=1e-12)
    assert np.isfinite(frame_from_cam).all(axis=(1, 2)).tolist() == [False, False, True, True, True]
    center, frame_from_cam = with_rig(ANTENNA, BODY, Rig())
    np.testing.assert_array_equal(center, ANTENNA)
    assert np.isnan(frame_from_cam).all()

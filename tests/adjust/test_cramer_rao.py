"""The bound, against the inverse of the full information matrix from numerical derivatives."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from pipelines.core.errors import DegenerateGeometryError
from pipelines.geometry.bundle import Network
from tests.bundle_scenes import SIGMA_PX, exact_network, jacobian
from tests.cramer_rao import Anchors, CameraInformation

IMAGES, MARK_PX = 5, 0.3
FIX = np.diag([0.02, 0.02, 0.03]) ** 2
SURVEY = np.diag([0.01, 0.01, 0.015]) ** 2
CONTROL = np.array([[-6.0, -5, 0], [5, -6, 2], [1, 7, -1]])
CHECK = np.array([[3.0, 2, 1], [-7, 6, 3]])


def seen_by_all(points: np.ndarray) -> Network:
    """The cameras of the exact network with other points, each marked in all images."""
    count = len(points)
    return replace(
        exact_network(images=IMAGES, points=30),
        point_in_world=points,
        obs_point=np.repeat(np.arange(count), IMAGES),
        obs_image=np.tile(np.arange(IMAGES), count),
        obs_xy_px=np.zeros((count * IMAGES, 2)),
    )


def full_bound(check: np.ndarray, control: np.ndarray, fixes: np.ndarray) -> np.ndarray:
    """The lower right block of the inverse of everything's information: ties, control points, one check point."""
    ties = exact_network(images=IMAGES, points=30)
    points = np.concatenate([ties.point_in_world, control, check[None]])
    design = jacobian(seen_by_all(points))
    sigma = np.repeat(np.r_[np.full(30, SIGMA_PX), np.full(len(control) + 1, MARK_PX)], 2 * IMAGES)
    information = (design / sigma[:, None] ** 2).T @ design
    for camera in fixes:
        place = slice(6 * camera + 3, 6 * camera + 6)
        information[place, place] += np.linalg.inv(FIX)
    for j in range(len(control)):
        place = slice(6 * IMAGES + 3 * (30 + j), 6 * IMAGES + 3 * (30 + j) + 3)
        information[place, place] += np.linalg.inv(SURVEY)
    unit = 1.0 / np.sqrt(np.diag(information))
    inverse = np.linalg.inv(information * unit[:, None] * unit) * unit[:, None] * unit
    place = slice(6 * IMAGES + 3 * (30 + len(control)), 6 * IMAGES + 3 * (30 + len(control)) + 3)
    return inverse[place, place]


@pytest.mark.parametrize(
    ("control", "fixes"),
    [
        (CONTROL[:0], np.arange(IMAGES)),
        (CONTROL, np.arange(IMAGES)),
        (CONTROL, np.arange(0)),
        (CONTROL, np.array([1])),
    ],
    ids=["fixes", "both", "control points", "one fix"],
)
def test_bound_is_the_inverse_of_all_information(control: np.ndarray, fixes: np.ndarray) -> None:
    marks = np.full(IMAGES * len(control), MARK_PX)
    anchors = Anchors(fixes, np.tile(FIX, (len(fixes), 1, 1)))
    if len(control):
        anchors = replace(
            anchors,
            control=seen_by_all(control),
            control_sigma_px=marks,
            cov_control=np.tile(SURVEY, (len(control), 1, 1)),
        )
    information = CameraInformation(exact_network(images=IMAGES, points=30), SIGMA_PX, anchors)
    found = information.bound(seen_by_all(CHECK), np.full(2 * IMAGES, MARK_PX))
    for j in range(2):
        np.testing.assert_allclose(found[j], full_bound(CHECK[j], control, fixes), rtol=2e-3, atol=1e-8)


def test_without_a_tie_to_the_earth_there_is_no_bound() -> None:
    with pytest.raises(DegenerateGeometryError, match="no bound"):
        CameraInformation(
            exact_network(images=IMAGES, points=30), SIGMA_PX, Anchors(np.arange(2), np.tile(FIX, (2, 1, 1)))
        )


def test_a_point_with_one_mark_has_none() -> None:
    anchors = Anchors(np.arange(IMAGES), np.tile(FIX, (IMAGES, 1, 1)))
    information = CameraInformation(exact_network(images=IMAGES, points=30), SIGMA_PX, anchors)
    marks = seen_by_all(CHECK)
    alone = replace(
        marks, obs_point=np.zeros(1, dtype=int), obs_image=np.zeros(1, dtype=int), obs_xy_px=np.zeros((1, 2))
    )
    assert np.isnan(information.bound(alone, np.ones(1))).all()

"""LiDAR against depth maps of a town of boxes, rendered exactly: shift and changes are known."""

from __future__ import annotations

import re

import numpy as np
import pytest

from pipelines.adjust.state import SystematicError, SystematicErrors
from pipelines.adjust.terms import At
from pipelines.core.errors import InputError
from pipelines.geometry.footprints import voxel_keys
from pipelines.geometry.similarity import Similarity
from pipelines.surface.lidar_cloud import planes_of
from pipelines.surface.registration import registration
from pipelines.train.lidar import plane_observations, registration_of
from pipelines.train.lidar_surface import TrustedLidar, _areas, verdict
from tests.refusals import refused
from tests.towns import EXTRA, PIXEL_M, SIGMA_M, TOWN, WITH_EXTRA, Town, scanned, surface_of, views_of


@pytest.mark.parametrize("shift", [(0.0, 0.0, 0.0), (0.06, -0.08, 0.10), (-0.3, 0.2, 0.4)])
def test_shift_is_found_to_a_centimetre_and_within_its_sigma(shift: tuple[float, float, float]) -> None:
    found = registration(scanned(TOWN, shift), views_of(TOWN), 0)
    error, sigma = found.shift_m - shift, np.sqrt(np.diag(found.covariance_m2))
    assert (np.abs(error) < 0.01).all()
    assert (np.abs(error) < 4 * sigma).all() and (sigma < 0.01).all()


def test_shift_is_found_beside_a_building_that_is_gone() -> None:
    found = registration(scanned(WITH_EXTRA, (0.1, 0.0, 0.0)), views_of(TOWN), 0)
    np.testing.assert_allclose(found.shift_m, (0.1, 0.0, 0.0), atol=0.01)


def test_planes_of_thinned_points_lie_on_the_surface() -> None:
    # Noise of 2 cm about a level 2 cm below a border of voxels: a sixth of the points is beyond the border. With
    # equal weights the planes would lie 6 mm too high; the points of a voxel are few, which leaves a millimetre.
    rng, level = np.random.default_rng(0), -0.02
    points = np.column_stack([rng.uniform(0, 10, (40_000, 2)), rng.normal(level, 0.02, 40_000)])
    _, first, count = np.unique(voxel_keys(points, 0.1), return_index=True, return_counts=True)
    planes = planes_of(points[first], np.ones(len(first), np.uint8), 0.1, count)
    assert abs(planes.position_in_model[:, 2].mean() - level) < 0.002
    assert planes.roughness_m.mean() == pytest.approx(0.02, abs=0.005)


def on(box: tuple[np.ndarray, np.ndarray], points: np.ndarray, *, above_m: float) -> np.ndarray:
    inside = ((points[:, :2] > box[0][:2] - 0.1) & (points[:, :2] < box[1][:2] + 0.1)).all(axis=1)
    return np.asarray(inside & (points[:, 2] > above_m))


@pytest.mark.parametrize(("then", "now", "kind"), [(WITH_EXTRA, TOWN, "removed"), (TOWN, WITH_EXTRA, "added")])
def test_what_has_changed_is_rejected_and_nothing_else(then: Town, now: Town, kind: str) -> None:
    cloud = scanned(then)
    judged = verdict(cloud, views_of(now), surface_of(now), sigma_m=SIGMA_M, pixel_m=PIXEL_M)
    # The lowest metre of a wall lies too near the ground that the photographs show.
    changed = on(EXTRA, cloud.position_in_model, above_m=1.0 if kind == "removed" else -1.0)
    assert changed.mean() > 0.03
    assert judged.rejected[changed].mean() >= 0.9
    away = ~on((EXTRA[0] - 2, EXTRA[1] + 2), cloud.position_in_model, above_m=-1.0)
    assert judged.rejected[away].mean() < 0.01
    assert (judged.confidence[judged.rejected] == 0).all() and np.median(judged.confidence[away]) > 0.5
    largest = judged.areas[0]
    assert largest.kind == kind and largest.area_m2 == pytest.approx(14 * 12, rel=0.2)
    np.testing.assert_allclose(largest.center_in_model[:2], (EXTRA[0] + EXTRA[1])[:2] / 2, atol=2)


def test_places_where_half_of_the_cloud_agrees_are_not_listed() -> None:
    # Ground with two patches of 6 m by 6 m: in one all points disagree, in the other every second one.
    east, north = (axis.ravel() for axis in np.meshgrid(np.arange(0, 40, 0.5), np.arange(0, 20, 0.5)))
    points = np.column_stack([east, north, np.zeros(len(east))])
    cloud = planes_of(points, np.ones(len(points), np.uint8), 0.5)
    inside = (north > 5) & (north < 11)
    whole, half = inside & (east > 5) & (east < 11), inside & (east > 25) & (east < 31)
    listed = _areas(cloud, whole | (half & ((2 * (east + north)) % 2 == 0)), "removed")
    assert len(listed) == 1
    np.testing.assert_allclose(listed[0].center_in_model[:2], (8, 8), atol=0.3)


def test_unchanged_town_is_confirmed() -> None:
    cloud = scanned(TOWN)
    judged = verdict(cloud, views_of(TOWN), surface_of(TOWN), sigma_m=SIGMA_M, pixel_m=PIXEL_M)
    assert judged.rejected.mean() < 0.01 and not judged.areas
    coarse = verdict(cloud, views_of(TOWN), surface_of(TOWN), sigma_m=1.0, pixel_m=PIXEL_M)
    # A cloud that is less accurate than stereo has little to say.
    assert np.median(coarse.confidence) < 0.1
    assert np.median(judged.confidence) > 0.5


@pytest.mark.parametrize("height_m", [52.3, -47.0])
def test_another_datum_is_refused_with_the_reason(height_m: float) -> None:
    cloud = scanned(TOWN, (0.0, 0.0, height_m))
    side = "above" if height_m > 0 else "below"
    with refused("lidar-height-offset", InputError) as error:
        registration_of(cloud, surface_of(TOWN), views_of(TOWN), 0)
    assert re.search(f"{abs(height_m):.1f}.* m {side}", str(error.value))


def test_another_place_is_refused() -> None:
    cloud = scanned(TOWN).moved(np.array([5000.0, 0.0, 0.0]))
    with refused("no-overlap", InputError):
        registration_of(cloud, surface_of(TOWN), views_of(TOWN), 0)


def test_planes_agree_with_the_shift_that_was_found() -> None:
    found = registration(scanned(TOWN, (0.06, -0.08, 0.10)), views_of(TOWN), 0)
    similarity = Similarity(translation=np.array([9.0, 5.0, 1.0]))
    planes = plane_observations(found, similarity)
    errors = SystematicErrors((SystematicError("lidar-shift", (1.0, 1.0, 1.0)),))
    turn = np.eye(3)[None]
    white = planes.whitened(At(turn, np.zeros((1, 3)), similarity, np.zeros(0), errors, found.shift_m, turn))
    assert len(planes) > 30
    # The medians of clusters, in units of their robust spread.
    assert abs(np.median(white)) < 0.5 and np.median(np.abs(white)) == pytest.approx(0.6745, rel=0.1)


def test_surface_takes_the_planes_of_trusted_lidar() -> None:
    cloud = scanned(TOWN)
    surface = TrustedLidar(cloud, np.full(len(cloud), 0.9), PIXEL_M)
    on_roof = np.column_stack([np.random.default_rng(0).uniform(-13, -3, (50, 2)) * [1, 0.8], np.full(50, 8.4)])
    far = on_roof + np.array([0.0, 0.0, 5.0])
    points, normal, confidence = surface.onto(np.concatenate([on_roof, far]))
    # 0.4 m above the roof: moved onto a plane through twelve points of 0.02 m.
    assert np.median(np.abs(points[:50, 2] - 8.0)) < 0.01
    assert (np.abs(normal[:50, 2]) > 0.95).mean() > 0.9 and (confidence[:50] == 0.9).mean() > 0.9
    np.testing.assert_array_equal(points[50:], far)
    assert (confidence[50:] == 0).all()

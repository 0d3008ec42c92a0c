"""Gaussians from SfM points: their size, colour and order, and clouds that are not as they should be."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from pipelines.core.errors import DegenerateGeometryError
from pipelines.splat.gaussians import rotation_matrices
from pipelines.splat.initialise import InitialisationOptions, gaussians_from_points, scene_extent
from pipelines.splat.sh import C0
from tests.refusals import numbers, refused


def grid(side: int = 6, spacing_m: float = 0.5) -> np.ndarray:
    axis = np.arange(side) * spacing_m
    return np.stack(np.meshgrid(axis, axis, axis), axis=-1).reshape(-1, 3)


def test_a_grid_gives_gaussians_of_its_spacing() -> None:
    points = grid()
    colours = np.random.default_rng(0).integers(0, 256, points.shape, dtype=np.uint8)
    gaussians = gaussians_from_points(points, colours)
    # On a grid the three nearest neighbours are all one spacing away.
    torch.testing.assert_close(gaussians.log_scales.exp(), torch.full((216, 3), 0.5))
    torch.testing.assert_close(torch.sigmoid(gaussians.logit_opacities), torch.full((216,), 0.1))
    assert gaussians.sh.shape == (216, 16, 3)
    assert (gaussians.sh[:, 1:] == 0).all()
    same = gaussians.means.numpy()[:, None] == points.astype(np.float32)
    rows = same.all(axis=2).argmax(axis=1)
    np.testing.assert_allclose((C0 * gaussians.sh[:, 0] + 0.5).numpy(), colours[rows] / 255, atol=1e-6)
    assert all(tensor.dtype == torch.float32 for tensor in gaussians.tensors().values())


def test_known_normals_make_discs() -> None:
    points, rng = grid(), np.random.default_rng(2)
    normals = rng.normal(size=points.shape)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    normals[0], normals[1], normals[2] = [0, 0, 1], [0, 0, -1], np.nan
    gaussians = gaussians_from_points(points, np.zeros_like(points), normals_in_model=normals)
    rows = (gaussians.means.numpy()[:, None] == points.astype(np.float32)).all(axis=2).argmax(axis=1)
    third = rotation_matrices(gaussians.quats_wxyz)[:, :, 2].numpy()
    known = rows != 2
    along = np.abs((third * normals[rows]).sum(axis=1))
    np.testing.assert_allclose(along[known], 1.0, atol=1e-6)
    scales = gaussians.log_scales.exp().numpy()
    np.testing.assert_allclose(scales[known], np.tile([0.5, 0.5, 0.05], (len(points) - 1, 1)), rtol=1e-5)
    np.testing.assert_allclose(scales[~known], [[0.5, 0.5, 0.5]], rtol=1e-5)
    opacity = torch.sigmoid(gaussians.logit_opacities).numpy()
    np.testing.assert_allclose(opacity, np.where(known, 0.5, 0.1), rtol=1e-5)


def test_float_colours_are_taken_as_they_are() -> None:
    gaussians = gaussians_from_points(grid(2), np.full((8, 3), 0.25), InitialisationOptions(sh_degree=0))
    torch.testing.assert_close(C0 * gaussians.sh[:, 0] + 0.5, torch.full((8, 3), 0.25))


def test_repeated_and_unusable_points_are_left_out() -> None:
    points = np.concatenate([grid(3), grid(3)[:5], [[np.nan, 0, 0], [np.inf, 0, 0], [1e6, 0, 0]]])
    gaussians = gaussians_from_points(points, np.zeros_like(points))
    assert len(gaussians) == 27
    assert torch.isfinite(gaussians.log_scales).all()


def test_a_lone_point_is_no_giant() -> None:
    points = np.concatenate([grid(), [[20.0, 0, 0]]])
    gaussians = gaussians_from_points(points, np.zeros_like(points))
    # Seventeen metres from its neighbours, but held at ten times the median spacing.
    assert gaussians.log_scales.exp().max() == pytest.approx(5.0, rel=1e-5)


def test_a_pair_of_points_at_almost_one_place_is_no_speck() -> None:
    points = np.concatenate([grid(), grid()[:1] + 1e-5, grid()[:1] - 1e-5, [[1e-5, 0, 0]]])
    gaussians = gaussians_from_points(points, np.zeros_like(points))
    assert gaussians.log_scales.exp().min() == pytest.approx(0.05, rel=1e-5)


def test_large_clouds_are_thinned_evenly() -> None:
    points = grid(10)
    options = InitialisationOptions(max_gaussians=125)
    gaussians = gaussians_from_points(points, np.zeros_like(points), options)
    assert len(gaussians) == 125
    # Every octant of the cube keeps its share, 125 / 8, to within a third.
    octant = (gaussians.means > 2.25).long() @ torch.tensor([4, 2, 1])
    assert ((torch.bincount(octant, minlength=8) - 125 / 8).abs() < 5).all()
    # Fewer points are farther apart, and larger.
    assert gaussians.log_scales.exp().median() > 0.5


def test_two_points_are_enough_and_one_is_not() -> None:
    gaussians = gaussians_from_points([[0, 0, 0], [3, 4, 0]], np.zeros((2, 3)))
    torch.testing.assert_close(gaussians.log_scales.exp(), torch.full((2, 3), 5.0))
    for points, usable in ((np.zeros((4, 3)), 1), (np.full((4, 3), np.nan), 0)):
        with refused("too-few-points", DegenerateGeometryError) as error:
            gaussians_from_points(points, np.zeros((4, 3)))
        assert numbers(str(error.value)) == [2, usable]


def test_shapes_must_agree() -> None:
    with pytest.raises(ValueError, match="colours"):
        gaussians_from_points(np.zeros((4, 3)), np.zeros((3, 3)))


def test_extent_is_that_of_3dgs() -> None:
    centers = np.array([[0.0, 0, 0], [10, 0, 0], [5, 5, 0], [5, -5, 0]])
    assert scene_extent(centers) == pytest.approx(1.1 * 5)
    with refused("cameras-at-one-place", DegenerateGeometryError):
        scene_extent(np.ones((3, 3)))

"""Spherical harmonics turn with the space that they are functions on."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from pipelines.geometry.rotations import exp_so3
from pipelines.splat import sh

angles = st.floats(-4, 4, allow_nan=False)
rotations = st.tuples(angles, angles, angles).map(lambda vector: exp_so3(np.array(vector)))


def directions(count: int = 50) -> Tensor:
    vectors = torch.randn(count, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    return vectors / vectors.norm(dim=1, keepdim=True)


def coefficients(degree: int, count: int = 3) -> Tensor:
    generator = torch.Generator().manual_seed(degree)
    return torch.randn(count, (degree + 1) ** 2, 3, generator=generator, dtype=torch.float64)


@given(rotation=rotations, degree=st.integers(0, 3))
@settings(max_examples=60, deadline=None)
def test_rotated_function_at_the_rotated_place_is_the_function(rotation: np.ndarray, degree: int) -> None:
    values, places = coefficients(degree), directions()
    turned = sh.rotate_sh(values, rotation)
    before = sh.evaluate_sh(values[:, None], places)
    after = sh.evaluate_sh(turned[:, None], places @ torch.from_numpy(rotation).T)
    torch.testing.assert_close(after, before, rtol=0, atol=1e-12)


@given(first=rotations, second=rotations)
@settings(max_examples=20, deadline=None)
def test_rotations_compose(first: np.ndarray, second: np.ndarray) -> None:
    values = coefficients(3)
    one_by_one = sh.rotate_sh(sh.rotate_sh(values, first), second)
    torch.testing.assert_close(one_by_one, sh.rotate_sh(values, second @ first), rtol=0, atol=1e-12)


def test_the_basis_is_orthonormal() -> None:
    # Gauss–Legendre in z times even steps in azimuth integrates polynomials of degree 6 exactly.
    z, weight = np.polynomial.legendre.leggauss(8)
    azimuth = np.arange(16) * 2 * np.pi / 16
    zz, aa = np.meshgrid(z, azimuth, indexing="ij")
    radius = np.sqrt(1 - zz**2)
    points = torch.from_numpy(np.stack([radius * np.cos(aa), radius * np.sin(aa), zz], axis=-1).reshape(-1, 3))
    weights = torch.from_numpy(np.repeat(weight * 2 * np.pi / 16, 16))
    values = sh.basis(points, 3)
    gram = values.T @ (weights[:, None] * values)
    torch.testing.assert_close(gram, torch.eye(16, dtype=torch.float64), rtol=0, atol=1e-12)


def test_signs_of_the_first_band_are_those_of_3dgs() -> None:
    axes = torch.eye(3, dtype=torch.float64)
    c1 = 0.4886025119029199
    expected = torch.tensor([[0, 0, -c1], [-c1, 0, 0], [0, c1, 0]], dtype=torch.float64)
    torch.testing.assert_close(sh.basis(axes, 1)[:, 1:], expected)


def test_single_precision_in_single_precision_out() -> None:
    values = coefficients(3).float()
    turned = sh.rotate_sh(values, exp_so3(np.array([0.3, -1.0, 2.0])))
    assert turned.dtype == torch.float32
    assert torch.equal(turned[:, 0], values[:, 0])


def test_bands_above_the_degree_are_ignored() -> None:
    values, place = coefficients(3), directions(1)
    torch.testing.assert_close(sh.evaluate_sh(values, place, degree=1), sh.evaluate_sh(values[:, :4], place))


def test_constant_is_the_colour() -> None:
    rgb = torch.rand(4, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    constant = sh.sh_from_rgb(rgb)
    torch.testing.assert_close(sh.C0 * constant + 0.5, rgb)
    torch.testing.assert_close(sh.evaluate_sh(constant[:, None], directions(4)) + 0.5, rgb)


def test_unknown_degrees_are_refused() -> None:
    with pytest.raises(ValueError, match="degree 0 to 3"):
        sh.coefficient_count(4)

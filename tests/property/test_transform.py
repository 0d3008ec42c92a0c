"""Gaussians in another frame are the same Gaussians: centres, covariances and colours move together."""

from __future__ import annotations

import numpy as np
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from pipelines.geometry.rotations import exp_so3
from pipelines.geometry.similarity import Similarity
from pipelines.splat import sh
from pipelines.splat.gaussians import Gaussians, rotation_matrices, transformed

angles = st.floats(-4, 4, allow_nan=False)
offsets = st.floats(-50, 50, allow_nan=False)
vectors = st.tuples(angles, angles, angles).map(np.array)
similarities = st.builds(
    Similarity,
    scale=st.floats(0.01, 100),
    rotation=vectors.map(exp_so3),
    translation=st.tuples(offsets, offsets, offsets).map(np.array),
)


def gaussians(count: int = 20, dtype: torch.dtype = torch.float64) -> Gaussians:
    generator = torch.Generator().manual_seed(0)

    def normal(*shape: int) -> Tensor:
        return torch.randn(count, *shape, generator=generator, dtype=dtype)

    return Gaussians(5 * normal(3), normal(4), normal(3), normal(), normal(16, 3))


def covariances(of: Gaussians) -> Tensor:
    axes = rotation_matrices(of.quats_wxyz) * of.log_scales.exp()[:, None]
    return axes @ axes.transpose(1, 2)


@given(similarity=similarities)
@settings(max_examples=50, deadline=None)
def test_centres_covariances_and_colours_move_together(similarity: Similarity) -> None:
    before = gaussians()
    after = transformed(before, similarity)
    turn = torch.from_numpy(similarity.rotation)
    np.testing.assert_allclose(after.means, similarity.apply(before.means.numpy()), rtol=1e-12, atol=1e-9)
    expected = similarity.scale**2 * turn @ covariances(before) @ turn.T
    torch.testing.assert_close(covariances(after), expected, rtol=1e-9, atol=1e-9 * similarity.scale**2)
    directions = gaussians().means
    colour = sh.evaluate_sh(before.sh, directions)
    torch.testing.assert_close(sh.evaluate_sh(after.sh, directions @ turn.T), colour, rtol=0, atol=1e-11)
    assert torch.equal(after.logit_opacities, before.logit_opacities)


@given(first=similarities, second=similarities)
@settings(max_examples=20, deadline=None)
def test_frames_compose_and_there_is_a_way_back(first: Similarity, second: Similarity) -> None:
    before = gaussians()
    stepwise, at_once = transformed(transformed(before, first), second), transformed(before, second @ first)
    back = transformed(stepwise, (second @ first).inverse())
    scale = max(first.scale * second.scale, 1.0)
    torch.testing.assert_close(stepwise.means, at_once.means, rtol=1e-9, atol=1e-7 * scale)
    torch.testing.assert_close(stepwise.sh, at_once.sh, rtol=0, atol=1e-11)
    torch.testing.assert_close(covariances(back), covariances(before), rtol=1e-8, atol=1e-8)


def test_single_precision_stays_single_and_is_rounded_once() -> None:
    similarity = Similarity(2.5, exp_so3(np.array([0.1, 2.0, -0.4])), np.array([30.0, -20.0, 5.0]))
    before = gaussians(dtype=torch.float32)
    after = transformed(before, similarity)
    assert all(tensor.dtype == torch.float32 for tensor in after.tensors().values())
    exact = similarity.apply(before.means.numpy())
    assert np.abs(after.means.numpy() - exact).max() <= np.spacing(np.float32(np.abs(exact).max())) / 2

"""Losses of the paper: L_abs and L_gcp as plain mean squares in metres (GeoRefGS section 2.4).

The residuals and their derivatives are those of the adjustment's terms, not weighted by their σ.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from pipelines.adjust.system import Problem
from pipelines.adjust.terms import At, ControlPoints, Fixes, Term
from pipelines.geometry.bundle import similarity_modes
from pipelines.train.georeference.unknowns import SolutionUnknowns

NAMES = {Fixes.kind: "absolute", ControlPoints.kind: "control"}


class _MeanSquares(torch.autograd.Function):
    """Mean squared residuals (T,) of T terms, of the corrections (n, 6) and the similarity (7,) of the whole."""

    @staticmethod
    def forward(ctx: Any, corrections: Tensor, whole: Tensor, at: At, terms: Sequence[Term]) -> Tensor:
        modes = similarity_modes(at.center)
        by_corrections = np.zeros((len(terms), *corrections.shape))
        values = np.zeros(len(terms))
        for row, term in enumerate(terms):
            slopes = term.slopes(at)
            values[row] = (slopes.residual**2).sum(axis=1).mean()
            scaled = 2.0 / len(term) * slopes.residual[slopes.row]
            np.add.at(by_corrections[row], slopes.camera, np.einsum("ed,edx->ex", scaled, slopes.by_pose))
        # A similarity of the whole moves the cameras by its modes.
        by_whole = np.einsum("tnx,nxs->ts", by_corrections, modes)
        ctx.save_for_backward(*(torch.from_numpy(by).to(corrections.device) for by in (by_corrections, by_whole)))
        return torch.from_numpy(values).to(corrections.device)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, Tensor, None, None]:
        (gradient,) = gradients
        by_corrections, by_whole = ctx.saved_tensors
        return (gradient[:, None, None] * by_corrections).sum(dim=0), gradient @ by_whole, None, None


class PaperLosses:
    """L_abs of the fixes and L_gcp of the control points of a problem, as functions of the unknowns."""

    def __init__(self, problem: Problem, *, control_points: bool) -> None:
        kinds = (Fixes.kind, ControlPoints.kind) if control_points else (Fixes.kind,)
        self._problem = problem
        self._terms = tuple(term for term in problem.measured if term.kind in kinds)

    def losses(self, at: SolutionUnknowns) -> dict[str, Tensor]:
        """Return the losses by their names."""
        if not self._terms:
            return {}
        squares = _MeanSquares.apply(  # type: ignore[no-untyped-call]
            at.corrections(), at.common_motion(), self._problem.at(at.state()), self._terms
        )
        return {NAMES[term.kind]: squares[row] for row, term in enumerate(self._terms)}

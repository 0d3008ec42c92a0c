"""The geographic half of the joint optimisation: similarity, cameras, constant errors, and their terms."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TypeVar

import torch
from torch import Tensor

from pipelines.geometry.cameras import Pinhole
from pipelines.georef.cameras import CameraCorrections
from pipelines.georef.control_by_depth import ControlByDepth, depth_residuals
from pipelines.georef.estimate import Estimate
from pipelines.georef.similarity import LearnableSimilarity
from pipelines.georef.systematic import SystematicErrors
from pipelines.georef.terms import ControlTerm, FixTerm, Term, Weighting, cauchy, moved_tensors
from pipelines.georef.weights import TermWeights
from pipelines.robust.statistics import outlier_gate
from pipelines.splat.depth import depth_at

TermT = TypeVar("TermT", bound=Term)


class GeoProblem(torch.nn.Module):
    """The geographic losses, and what bundle adjustment says against moving the cameras.

    Args:
        similarity: `geo_from_model`.
        cameras: poses in `model`.
        terms: the observations, at most one of a kind.
        weighting: "whitened" (maximum a posteriori) or "paper" (plain mean squares).
        hold_prior: keep what was known of the similarity beforehand as an observation. Only for layouts that the
            fixes do not determine; for a line only the attitude, since the rest came from the same fixes.
        errors: constant errors to estimate; None: none.
        learned_weights: learn a variance factor of each term.
        control_by_depth: given where training finds control points through the rendered depth; the term of the
            control points then has no part in the loss, only in the posterior.
    """

    def __init__(
        self,
        similarity: LearnableSimilarity,
        cameras: CameraCorrections,
        terms: Sequence[Term],
        *,
        weighting: Weighting = "whitened",
        hold_prior: bool = False,
        errors: SystematicErrors | None = None,
        learned_weights: bool = False,
        control_by_depth: ControlByDepth | None = None,
    ) -> None:
        super().__init__()
        self.similarity, self.cameras = similarity, cameras
        self.terms, self.control_by_depth = tuple(terms), control_by_depth
        self.weighting, self.hold_prior = weighting, hold_prior
        self.errors = SystematicErrors() if errors is None else errors
        self.weights = TermWeights({term.kind: term.dimension for term in terms}, weighting, learned_weights)

    @property
    def fixes(self) -> FixTerm | None:
        """Fixes of the training cameras."""
        return self.term(FixTerm)

    @property
    def control(self) -> ControlTerm | None:
        """Control points."""
        return self.term(ControlTerm)

    def term(self, kind: type[TermT]) -> TermT | None:
        """Return the term of a kind, or None."""
        return next((term for term in self.terms if isinstance(term, kind)), None)

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> GeoProblem:
        """Move the observations with the parameters, from device to device."""
        super()._apply(fn, recurse)  # type: ignore[no-untyped-call]
        self.terms = tuple(moved_tensors(term, fn) for term in self.terms)
        if self.control_by_depth is not None:
            self.control_by_depth = moved_tensors(self.control_by_depth, fn)
        return self

    def learned(self) -> dict[str, torch.nn.Parameter]:
        """Return all that is learned: similarity y, cameras z, errors x and weights u where there are any."""
        more = {"x": self.errors.x, "u": self.weights.u}
        return {"y": self.similarity.y, "z": self.cameras.z} | {k: p for k, p in more.items() if len(p)}

    def estimate(self) -> Estimate:
        """Return the present estimate, differentiable in all of `learned`."""
        cameras = self.cameras
        return self.estimate_at(self.similarity.y, cameras.corrections(), cameras.lens(), self.errors.vector())

    def estimate_at(self, y: Tensor, correction: Tensor, lens: Tensor, errors: Tensor) -> Estimate:
        """Return the estimate of other values: y (7,), camera corrections (n, 6), lens (L,), errors (p,)."""
        rotation, center = self.cameras.moved(correction)
        return Estimate(rotation, center, self.similarity.at(y), self.errors.split(errors), lens)

    def losses(self) -> dict[str, Tensor]:
        """Return the value of each term, a mean of ρ, by its kind; those of cameras and constant errors as well."""
        at = self.estimate()
        values = {term.kind: self._rho(term, self._squared_as(term, at)).mean() for term in self.terms}
        values["cameras"] = self._prior() / self._normaliser()
        if len(self.errors):
            values["errors"] = self.errors.prior(self.errors.vector()) / self._normaliser()
        return values

    def loss(self) -> Tensor:
        """Return L_abs + λ_gcp L_gcp + λ_rel L_rel + λ_att L_att + the terms of cameras and errors; scalar.

        Whitened: every χ² counts alike, so λ is the ratio of the observations of a term to the fixes, and for L_rel
        that of what its pairs are worth (`Term.share`). Paper: every λ = 1, and no term of the cameras'.
        Control points that are found by depth come with `depth_loss`.
        """
        values = self.losses()
        whitened = self.weighting == "whitened"
        total = values["cameras"] if whitened else 0.0 * values["cameras"]
        if whitened and "errors" in values:
            total = total + values["errors"]
        for term in self.terms:
            if self.control_by_depth is None or not isinstance(term, ControlTerm):
                total = total + self._factor(term) * self._priced(term, values[term.kind])
        return total + self.weights.prior() / self._normaliser() if self.weights.learned else total

    def sees_by_depth(self, camera: int) -> bool:
        """Return whether a view needs a rendered depth for `depth_loss`."""
        return self.control_by_depth is not None and camera in self.control_by_depth.rows

    def depth_loss(self, camera: int, depth_m: Tensor, alpha: Tensor, pinhole: Pinhole) -> Tensor | None:
        """Return λ_gcp L_gcp of one view, control points being found through the rendered depth; scalar.

        The gradient reaches similarity, camera and Gaussians. Each point counts as one, whatever the number of its
        marks, and each view for all of them, so that the mean over the views is the loss of the whole. None: the
        view has no marks. Marks where the render is nearly transparent do not count: there is no surface yet.

        Args:
            camera: index of the view.
            depth_m: (H, W) expected depth, differentiable.
            alpha: (H, W).
            pinhole: of these pixels, with the lens as it is now.
        """
        marks, control = self.control_by_depth, self.control
        if marks is None or control is None or not self.sees_by_depth(camera):
            return None
        rows = marks.rows[camera]
        xy = marks.rays(rows, self.cameras.lens())
        depth, seen = depth_at(depth_m, alpha, xy, pinhole)
        mapping, surveyed = self.similarity.at(self.similarity.y), marks.position_in_geo[rows]
        missed = depth_residuals(self.cameras.pose(camera), mapping, surveyed, xy, depth)
        if self.weighting == "whitened":
            missed = (marks.root_information[rows] @ missed[:, :, None])[:, :, 0]
        share = marks.share[rows] * seen
        rho = self._priced(control, self._rho(control, missed))
        return self._factor(control) * marks.views / len(control) * (share * rho).sum()

    def whitened(self, at: Estimate) -> dict[str, Tensor]:
        """Return the whitened residuals (M, d) of the terms that measure, by kind; learned variances count."""
        measuring = [term for term in self.terms if term.measures]
        if self.weighting == "paper":  # what is learned there are variances in m², not factors of the stated ones
            return {term.kind: term.whitened(at) for term in measuring}
        return {term.kind: self._scaled(term, term.whitened(at)) for term in measuring}

    @torch.no_grad()
    def contradicting(self, kind: type[Term]) -> list[int]:
        """Return the rows of a term's observations that contradict the whole at the 99.9 % level."""
        term = self.term(kind)
        if term is None:
            return []
        chi2 = self.whitened(self.estimate())[term.kind].square().sum(dim=1)
        return [int(row) for row in torch.nonzero(chi2 > outlier_gate(term.dimension))[:, 0]]

    def _prior(self) -> Tensor:
        prior = self.cameras.z.square().sum()
        return prior + self.similarity.prior() if self.hold_prior else prior

    def _normaliser(self) -> int:
        """N of the means: the fixes, or the cameras where there is none."""
        return len(self.cameras.center) if self.fixes is None else len(self.fixes)

    def _factor(self, term: Term) -> float:
        """λ of a term."""
        return 1.0 if self.weighting == "paper" else term.share * len(term) / self._normaliser()

    def _squared_as(self, term: Term, at: Estimate) -> Tensor:
        """Residuals (M, d) as they are squared: whitened, or in metres; those of angles always whitened."""
        in_metres = self.weighting == "paper" and term.in_metres
        return term.residuals(at) if in_metres else term.whitened(at)

    def _rho(self, term: Term, residual: Tensor) -> Tensor:
        """ρ (M,) of residuals (M, d)."""
        chi2 = self._scaled(term, residual).square().sum(dim=1)
        return chi2 if self.weighting == "paper" else cauchy(chi2, term.dimension)

    def _scaled(self, term: Term, white: Tensor) -> Tensor:
        """Residuals divided by the learned σ of their term."""
        s = self.weights.log_variance(term.kind)
        return white if s is None else torch.exp(-0.5 * s) * white

    def _priced(self, term: Term, value: Tensor) -> Tensor:
        """A term's ρ with the price of its learned variance."""
        s = self.weights.log_variance(term.kind)
        return value if s is None else value + self.weights.price(term.kind) * s

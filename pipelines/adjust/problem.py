"""Geographic half of the joint optimisation: similarity, cameras, constant errors, and their terms."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TypeVar

import torch
from torch import Tensor

from pipelines.adjust.cameras import CameraCorrections
from pipelines.adjust.control_by_depth import ControlByDepth, depth_residuals
from pipelines.adjust.estimate import Estimate
from pipelines.adjust.similarity import LearnableSimilarity
from pipelines.adjust.systematic import SystematicErrors
from pipelines.adjust.terms import ControlTerm, FixTerm, Term, Weighting, cauchy, moved_tensors
from pipelines.adjust.weights import TermWeights
from pipelines.geometry.bundle_information import BundleInformation
from pipelines.geometry.cameras import Pinhole
from pipelines.splat.depth import depth_at

TermT = TypeVar("TermT", bound=Term)


class GeoProblem(torch.nn.Module):
    """Geographic losses, with the prior of bundle adjustment on the corrections of the cameras.

    Args:
        similarity: `geo_from_model`.
        cameras: poses in `model`.
        terms: the observations, at most one term of a kind.
        weighting: "whitened" (maximum a posteriori) or "paper" (plain mean squares).
        hold_prior: treat the prior of the similarity as an observation. Only for layouts that the fixes do not
            determine. For a line, this prior is the attitude alone, since the rest of the initial estimate came
            from the same fixes.
        errors: constant errors to estimate; None: none.
        learned_weights: learn a variance factor of each term.
        control_by_depth: marks of the control points, if training projects them onto the rendered depth. Then
            `depth_loss` takes the place of the control points' term in the loss, while the term stays in the
            posterior. None: the term is in both.
        bundle: information of the image observations on the cameras. `adjust.posterior` then solves the cameras in
            sparse equations, and no parameter moves them. None: the basis of `cameras` corrects them.
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
        bundle: BundleInformation | None = None,
    ) -> None:
        super().__init__()
        self.similarity, self.cameras = similarity, cameras
        self.terms, self.control_by_depth = tuple(terms), control_by_depth
        self.weighting, self.hold_prior, self.bundle = weighting, hold_prior, bundle
        self.errors = SystematicErrors() if errors is None else errors
        self.weights = TermWeights({term.kind: term.dimension for term in terms}, weighting, learned_weights)

    @property
    def fixes(self) -> FixTerm | None:
        """Fixes of the training cameras; None without any."""
        return self.term(FixTerm)

    @property
    def control(self) -> ControlTerm | None:
        """Control points; None without any."""
        return self.term(ControlTerm)

    @property
    def corrects_cameras(self) -> bool:
        """Whether the cameras are unknowns; otherwise they are held."""
        return self.bundle is not None or len(self.cameras.z) > 0

    def term(self, kind: type[TermT]) -> TermT | None:
        """Return the term of a kind; None if there is none."""
        return next((term for term in self.terms if isinstance(term, kind)), None)

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> GeoProblem:
        """Move the observations between devices together with the parameters."""
        super()._apply(fn, recurse)  # type: ignore[no-untyped-call]
        self.terms = tuple(moved_tensors(term, fn) for term in self.terms)
        if self.control_by_depth is not None:
            self.control_by_depth = moved_tensors(self.control_by_depth, fn)
        return self

    def learned(self) -> dict[str, torch.nn.Parameter]:
        """Return the learned parameters by name: similarity y, cameras z, and, if any, errors x and weights u."""
        more = {"x": self.errors.x, "u": self.weights.u}
        return {"y": self.similarity.y, "z": self.cameras.z} | {k: p for k, p in more.items() if len(p)}

    def estimate(self) -> Estimate:
        """Return the present estimate, differentiable in all parameters of `learned`."""
        cameras = self.cameras
        return self.estimate_at(self.similarity.y, cameras.corrections(), cameras.lens(), self.errors.vector())

    def estimate_at(self, y: Tensor, correction: Tensor, lens: Tensor, errors: Tensor) -> Estimate:
        """Return the estimate at other values, differentiable in them.

        Args:
            y: (7,) coordinates of the similarity.
            correction: (n, 6) corrections (δω, δc) of the cameras.
            lens: (L,) change of the lens parameters.
            errors: (p,) constant errors.
        """
        rotation, center = self.cameras.moved(correction)
        return Estimate(rotation, center, self.similarity.at(y), self.errors.split(errors), lens)

    def losses(self) -> dict[str, Tensor]:
        """Return the losses by kind: of each term, a mean of ρ; of the cameras; and of the constant errors."""
        at = self.estimate()
        values = {term.kind: self._rho(term, self._squared_as(term, at)).mean() for term in self.terms}
        values["cameras"] = self._prior() / self._normaliser()
        if len(self.errors):
            values["errors"] = self.errors.prior(self.errors.vector()) / self._normaliser()
        return values

    def loss(self) -> Tensor:
        """Return L_abs + λ_gcp L_gcp + λ_rel L_rel + λ_att L_att + the losses of cameras and errors; scalar.

        - Whitened: every χ² has the same weight. λ is therefore the number of observations of a term over the
          number of fixes, times `Term.share`, which is below 1 for L_rel only.
        - Paper: every λ is 1, and the cameras have no loss.
        - Control points through the rendered depth are not included: see `depth_loss`.
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
        """Return whether a view has marks for `depth_loss`, and so needs a rendered depth."""
        return self.control_by_depth is not None and camera in self.control_by_depth.rows

    def depth_loss(self, camera: int, depth_m: Tensor, alpha: Tensor, pinhole: Pinhole) -> Tensor | None:
        """Return λ_gcp L_gcp of one view for control points through the rendered depth; scalar.

        - The gradient reaches similarity, camera and Gaussians.
        - Each point has weight 1, whatever the number of its marks.
        - The loss of a view is scaled by the number of views: its mean over the views is the loss of all marks.
        - Marks on a nearly transparent render have weight 0: there is no surface yet.

        Args:
            camera: index of the view.
            depth_m: (H, W) expected depth, metres, differentiable.
            alpha: (H, W) opacity of the render.
            pinhole: intrinsics of these pixels, with the present lens.

        Returns:
            None if the view has no marks.
        """
        marks, control = self.control_by_depth, self.control
        if marks is None or control is None or not self.sees_by_depth(camera):
            return None
        rows = marks.rows[camera]
        xy = marks.rays(rows, self.cameras.lens())
        depth, seen = depth_at(depth_m, alpha, xy, pinhole)
        mapping, surveyed = self.similarity.at(self.similarity.y), marks.position_in_geo[rows]
        residual = depth_residuals(self.cameras.pose(camera), mapping, surveyed, xy, depth)
        if self.weighting == "whitened":
            residual = (marks.root_information[rows] @ residual[:, :, None])[:, :, 0]
        share = marks.share[rows] * seen
        rho = self._priced(control, self._rho(control, residual))
        return self._factor(control) * marks.views / len(control) * (share * rho).sum()

    def whitened(self, at: Estimate) -> dict[str, Tensor]:
        """Return the whitened residuals (M, d) of the measuring terms by kind, scaled by learned variances."""
        measuring = [term for term in self.terms if term.measures]
        if self.weighting == "paper":  # learned are variances in m² then, not factors of the stated ones
            return {term.kind: term.whitened(at) for term in measuring}
        return {term.kind: self._scaled(term, term.whitened(at)) for term in measuring}

    def _prior(self) -> Tensor:
        prior = self.cameras.z.square().sum()
        return prior + self.similarity.prior() if self.hold_prior else prior

    def _normaliser(self) -> int:
        """Return N of the means: the number of fixes, or of cameras if there is no fix."""
        return len(self.cameras.center) if self.fixes is None else len(self.fixes)

    def _factor(self, term: Term) -> float:
        """Return λ of a term."""
        return 1.0 if self.weighting == "paper" else term.share * len(term) / self._normaliser()

    def _squared_as(self, term: Term, at: Estimate) -> Tensor:
        """Return the residuals (M, d) to be squared: whitened, or lengths in metres with "paper"."""
        in_metres = self.weighting == "paper" and term.in_metres
        return term.residuals(at) if in_metres else term.whitened(at)

    def _rho(self, term: Term, residual: Tensor) -> Tensor:
        """Return ρ (M,) of residuals (M, d)."""
        chi2 = self._scaled(term, residual).square().sum(dim=1)
        return chi2 if self.weighting == "paper" else cauchy(chi2, term.dimension)

    def _scaled(self, term: Term, white: Tensor) -> Tensor:
        """Return residuals divided by the learned σ of their term."""
        s = self.weights.log_variance(term.kind)
        return white if s is None else torch.exp(-0.5 * s) * white

    def _priced(self, term: Term, value: Tensor) -> Tensor:
        """Return a term's ρ plus the normalisation of its learned variance."""
        s = self.weights.log_variance(term.kind)
        return value if s is None else value + self.weights.price(term.kind) * s

"""The geographic half of the joint optimisation: similarity, cameras and what was measured on Earth."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields

import numpy as np
import torch
from torch import Tensor

from pipelines.core.types import FloatArray
from pipelines.geometry.cameras import Pinhole
from pipelines.georef.cameras import CameraCorrections
from pipelines.georef.linear import Linearised, linearise, posterior
from pipelines.georef.losses import (
    CAUCHY_SCALE2,
    CAUCHY_SCALE2_OF_ONE,
    Estimate,
    Weighting,
    attitude_residuals,
    cauchy,
    control_residuals,
    depth_residuals,
    fix_residuals,
    pair_residuals,
)
from pipelines.georef.measured import ControlMarks, Fixes, Measured
from pipelines.georef.similarity import LearnableSimilarity
from pipelines.georef.systematic import SystematicErrors
from pipelines.georef.weights import TermWeights
from pipelines.splat.depth import depth_at

# A measurement further out than this (99.9 % of χ² with 3 degrees of freedom) is called an outlier.
_OUTLIER_CHI2 = 16.27


@dataclass(frozen=True)
class GeoTerms:
    """Values of the geographic terms at one iteration; None where there is no such observation.

    Attributes:
        absolute, control, relative, attitude: means of ρ; `control` is by intersection, also where training uses
            the depth.
        cameras: what the corrections cost the image observations.
        errors: what the constant errors cost their priors.
    """

    absolute: Tensor | None
    control: Tensor | None
    relative: Tensor | None
    attitude: Tensor | None
    cameras: Tensor
    errors: Tensor | None

    def present(self) -> dict[str, Tensor]:
        """Those that there are, by name."""
        values = {field.name: getattr(self, field.name) for field in fields(self)}
        return {name: value for name, value in values.items() if value is not None}


class GeoProblem(torch.nn.Module):
    """L_abs, L_gcp, L_rel, L_att, and what bundle adjustment says against moving the cameras.

    Args:
        similarity: `geo_from_model`.
        cameras: poses in `model`.
        measured: the observations.
        weighting: "whitened" (maximum a posteriori) or "paper" (plain mean squares).
        hold_prior: keep what was known of the similarity beforehand as an observation. Only for layouts that the
            fixes do not determine; for a line only the attitude, since the rest came from the same fixes.
        errors: constant errors to estimate; None: none.
        learned_weights: learn a variance factor of each term.
    """

    def __init__(
        self,
        similarity: LearnableSimilarity,
        cameras: CameraCorrections,
        measured: Measured,
        *,
        weighting: Weighting = "whitened",
        hold_prior: bool = False,
        errors: SystematicErrors | None = None,
        learned_weights: bool = False,
    ) -> None:
        super().__init__()
        self.similarity, self.cameras = similarity, cameras
        self.measured = measured
        self.weighting, self.hold_prior = weighting, hold_prior
        self.errors = SystematicErrors() if errors is None else errors
        self.weights = TermWeights(weighting, learned_weights)

    @property
    def fixes(self) -> Fixes | None:
        """Of the training cameras."""
        return self.measured.fixes

    @property
    def marks(self) -> ControlMarks | None:
        """Of the control points."""
        return self.measured.marks

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> GeoProblem:
        """Move the observations with the parameters, from device to device."""
        super()._apply(fn, recurse)
        self.measured = self.measured.moved(fn)
        return self

    def learned(self) -> dict[str, torch.nn.Parameter]:
        """Everything that is learned here: similarity, cameras, and errors and weights where there are any."""
        more = {"x": self.errors.x, "u": self.weights.u}
        return {"y": self.similarity.y, "z": self.cameras.z} | {k: each for k, each in more.items() if len(each)}

    def estimate(self) -> Estimate:
        """The present estimate, differentiable in all of `learned`."""
        cameras = self.cameras
        return self._estimate(self.similarity.y, cameras.corrections(), cameras.lens(), self.errors.vector())

    def _estimate(self, y: Tensor, correction: Tensor, lens: Tensor, vector: Tensor) -> Estimate:
        rotation, center = self.cameras.moved(correction)
        return Estimate(rotation, center, self.similarity.at(y), self.errors.split(vector), lens)

    def terms(self) -> GeoTerms:
        """The losses, each a mean, as the method states them."""
        at, measured = self.estimate(), self.measured
        absolute = control = relative = attitude = None
        if (fixes := measured.fixes) is not None:
            absolute = self._mean("absolute", self._white(fix_residuals(at, fixes), fixes.root_information))
        if (marks := measured.marks) is not None:
            control = self._mean("control", self._white(control_residuals(at, marks), marks.root_information))
        if (pairs := measured.pairs) is not None:
            relative = self._mean("relative", self._white(pair_residuals(at, pairs), pairs.root_information))
        if (attitudes := measured.attitudes) is not None:
            turned = attitude_residuals(at, attitudes) * attitudes.root_information[:, None]
            attitude = self._mean("attitude", turned)
        errors = self.errors.prior(self.errors.vector()) / self._normaliser() if len(self.errors) else None
        return GeoTerms(absolute, control, relative, attitude, self._prior() / self._normaliser(), errors)

    def loss(self) -> Tensor:
        """L_abs + λ_gcp L_gcp + λ_rel L_rel + λ_att L_att + the terms of cameras and errors; scalar.

        Whitened: every χ² counts alike, so λ is the ratio of the observations of a term to the fixes, and for L_rel
        that of what its pairs are worth (`measured.scale_share`). Paper: every λ = 1, and no term of the cameras'.
        Control points that are found by depth come with `depth_loss`.
        """
        terms = self.terms()
        whitened = self.weighting == "whitened"
        total = terms.cameras if whitened else 0.0 * terms.cameras
        if whitened and terms.errors is not None:
            total = total + terms.errors
        for name in ("absolute", "control", "relative", "attitude"):
            value = getattr(terms, name)
            if value is not None and not (name == "control" and self.measured.depth_marks is not None):
                total = total + self._share(name) * self._priced(name, value)
        return total + self.weights.prior() / self._normaliser() if self.weights.learned else total

    def sees_by_depth(self, camera: int) -> bool:
        """Whether a view needs a rendered depth for `depth_loss`."""
        return self.measured.depth_marks is not None and camera in self.measured.depth_marks.rows

    def depth_loss(self, camera: int, depth_m: Tensor, alpha: Tensor, pinhole: Pinhole) -> Tensor | None:
        """λ_gcp L_gcp of one view, control points being found through the rendered depth at their marks; scalar.

        The gradient reaches similarity, camera and Gaussians. Each point counts as one, whatever the number of its
        marks, and each view for all of them, so that the mean over the views is the loss of the whole. None: the
        view has no marks. Marks where the render is nearly transparent do not count: there is no surface yet.

        Args:
            camera: index of the view.
            depth_m: (H, W) expected depth, differentiable.
            alpha: (H, W).
            pinhole: of these pixels, with the lens as it is now.
        """
        marks = self.measured.depth_marks
        if marks is None or not self.sees_by_depth(camera):
            return None
        rows = marks.rows[camera]
        xy = marks.rays(rows, self.cameras.lens())
        depth, seen = depth_at(depth_m, alpha, xy, pinhole)
        mapping, surveyed = self.similarity.at(self.similarity.y), marks.position_in_geo[rows]
        missed = depth_residuals(self.cameras.pose(camera), mapping, surveyed, xy, depth)
        rho = self._rho("control", self._white(missed, marks.root_information[rows]))
        points = 1 if self.marks is None else len(self.marks.position_in_geo)
        share = marks.share[rows] * seen
        return self._share("control") * marks.views / points * (share * self._priced("control", rho)).sum()

    def whitened(self, at: Estimate) -> Tensor:
        """Whitened residuals (F + J + A, 3) of the fixes, the control points, then the attitudes.

        The pairs of L_rel are none of these: they repeat what the fixes say. Learned variances count.
        """
        rows, measured = [], self.measured
        if (fixes := measured.fixes) is not None:
            rows.append(("absolute", _times(fixes.root_information, fix_residuals(at, fixes))))
        if (marks := measured.marks) is not None:
            rows.append(("control", _times(marks.root_information, control_residuals(at, marks))))
        if (attitudes := measured.attitudes) is not None:
            rows.append(("attitude", attitude_residuals(at, attitudes) * attitudes.root_information[:, None]))
        if not rows:
            return at.center.new_zeros((0, 3))
        if self.weighting == "paper":  # what is learned there are variances in m², not factors of the stated ones
            return torch.cat([white for _, white in rows])
        return torch.cat([self._scaled(name, white) for name, white in rows])

    def forward(self) -> Tensor:
        """`whitened` at the present estimate."""
        return self.whitened(self.estimate())

    def linearised(self) -> Linearised:
        """The problem about the present estimate."""
        cameras, turns = self.cameras, 6 * len(self.cameras.center)

        def residuals(y: Tensor, moved: Tensor, vector: Tensor) -> Tensor:
            return self.whitened(self._estimate(y, moved[:turns].view(-1, 6), moved[turns:], vector))

        held = float(self.hold_prior) * self.similarity.held
        precision = torch.cat([held, self.errors.sigma**-2])
        with torch.no_grad():
            moved = torch.cat([cameras.corrections().flatten(), cameras.lens()])
            at = (self.similarity.y, moved, self.errors.vector(), cameras.z)
        return linearise(residuals, at, torch.cat([cameras.basis.flatten(0, 1), cameras.lens_basis]), precision)

    def covariance(self) -> FloatArray:
        """Covariance (7, 7) of the similarity about its pivot, cameras and constant errors marginalised out.

        From the Gauss–Newton normal matrix of the whitened residuals at the present estimate, with the weights
        that the Cauchy kernel gave, in the form of `products.SimilarityRecord`.
        """
        return self.covariances()[0]

    def covariances(self) -> tuple[FloatArray, FloatArray]:
        """`covariance`, and that of the constant errors (p, p), all else marginalised out."""
        model = self.linearised()
        found = posterior(model, model.white).numpy()
        root = self.similarity.root.cpu().numpy()
        return np.asarray(root @ found[:7, :7] @ root.T), found[7:, 7:]

    def outliers(self) -> list[int]:
        """Cameras whose fix contradicts the whole at the 99.9 % level."""
        if self.fixes is None:
            return []
        return [int(self.fixes.camera[row]) for row in self._far(0, len(self.fixes.camera))]

    def control_outliers(self) -> list[int]:
        """Control points that contradict the whole at the 99.9 % level, as rows of `marks`."""
        if self.marks is None:
            return []
        return self._far(0 if self.fixes is None else len(self.fixes.camera), len(self.marks.position_in_geo))

    def _far(self, first: int, count: int) -> list[int]:
        with torch.no_grad():
            chi2 = self()[first : first + count].square().sum(dim=1)
        return [int(row) for row in torch.nonzero(chi2 > _OUTLIER_CHI2)[:, 0]]

    def _prior(self) -> Tensor:
        prior = self.cameras.z.square().sum()
        return prior + self.similarity.prior() if self.hold_prior else prior

    def _normaliser(self) -> int:
        """N of the means: the fixes, or the cameras where there is none."""
        return len(self.cameras.center) if self.fixes is None else len(self.fixes.camera)

    def _share(self, term: str) -> float:
        """λ of a term."""
        if self.weighting == "paper" or term == "absolute":
            return 1.0
        measured, count = self.measured, 0.0
        if term == "control" and measured.marks is not None:
            count = len(measured.marks.position_in_geo)
        elif term == "relative" and measured.pairs is not None:
            count = measured.pairs.share * len(measured.pairs.distance_in_geo)
        elif term == "attitude" and measured.attitudes is not None:
            count = len(measured.attitudes.camera)
        return count / self._normaliser()

    def _white(self, residual: Tensor, root_information: Tensor) -> Tensor:
        """Residuals (M, 3) or (M,) as they are squared: whitened, or in metres."""
        if self.weighting == "paper":
            return residual
        return residual * root_information if residual.dim() == 1 else _times(root_information, residual)

    def _rho(self, term: str, white: Tensor) -> Tensor:
        """ρ (M,) of residuals (M, 3) or (M,)."""
        white = self._scaled(term, white)
        squared = white.square() if white.dim() == 1 else white.square().sum(dim=1)
        if self.weighting == "paper":
            return squared
        return cauchy(squared, CAUCHY_SCALE2_OF_ONE if white.dim() == 1 else CAUCHY_SCALE2)

    def _mean(self, term: str, white: Tensor) -> Tensor:
        return self._rho(term, white).mean()

    def _scaled(self, term: str, white: Tensor) -> Tensor:
        """Residuals divided by the learned σ of their term."""
        s = self.weights.log_variance(term)
        return white if s is None else torch.exp(-0.5 * s) * white

    def _priced(self, term: str, value: Tensor) -> Tensor:
        """A term's ρ with the price of its learned variance."""
        s = self.weights.log_variance(term)
        return value if s is None else value + self.weights.price(term) * s


def _times(matrix: Tensor, vector: Tensor) -> Tensor:
    return (matrix @ vector[:, :, None])[:, :, 0]

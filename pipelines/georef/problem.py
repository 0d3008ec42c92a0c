"""The geographic half of the joint optimisation: similarity, cameras and what was measured on Earth."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from pipelines.georef.cameras import CameraCorrections
from pipelines.georef.losses import (
    CAUCHY_SCALE2,
    ControlMarks,
    Fixes,
    Weighting,
    absolute_loss,
    control_point_loss,
    intersect,
)
from pipelines.georef.similarity import LearnableSimilarity
from pipelines.products import FloatArray

# A fix further out than this (99.9 % of χ² with 3 degrees of freedom) is called an outlier.
_OUTLIER_CHI2 = 16.27
# Cauchy's weight also falls on what is only noise. Under Gaussian noise of the stated σ, weights divided by this
# give the covariance that the estimator has: E[w] E[w² χ²/3] / E[∂(w r)/∂r]² for χ² with 3 degrees of freedom.
WEIGHT_OF_NOISE = 0.7886


@dataclass(frozen=True)
class GeoTerms:
    """Values of the geographic terms at one iteration; None where there is no such observation."""

    absolute: Tensor | None
    control: Tensor | None
    cameras: Tensor


class GeoProblem(torch.nn.Module):
    """L_abs, L_gcp and what bundle adjustment says against moving the cameras.

    Args:
        similarity: `geo_from_model`.
        cameras: poses in `model`.
        fixes: of the training cameras, or None.
        marks: of the control points, or None.
        weighting: "whitened" (maximum a posteriori) or "paper" (plain mean squares).
        hold_prior: keep the initial similarity as an observation. Only for layouts that the fixes do not
            determine (a line), since it was estimated from the same fixes.
    """

    def __init__(
        self,
        similarity: LearnableSimilarity,
        cameras: CameraCorrections,
        fixes: Fixes | None,
        marks: ControlMarks | None,
        *,
        weighting: Weighting = "whitened",
        hold_prior: bool = False,
    ) -> None:
        super().__init__()
        self.similarity, self.cameras = similarity, cameras
        self.fixes, self.marks = fixes, marks
        self.weighting, self.hold_prior = weighting, hold_prior

    def terms(self) -> GeoTerms:
        """The losses, each a mean, as the method states them."""
        absolute = control = None
        if self.fixes is not None:
            absolute = absolute_loss(self.similarity, self.cameras, self.fixes, self.weighting)
        if self.marks is not None:
            control = control_point_loss(self.similarity, self.cameras, self.marks, self.weighting)
        return GeoTerms(absolute, control, self.prior() / self._normaliser())

    def loss(self) -> Tensor:
        """L_abs + λ_gcp L_gcp + the cameras' own term; scalar.

        Whitened: every χ² counts alike, so λ_gcp is the ratio of control points to fixes. Paper: λ_gcp = 1, and
        no term of the cameras'.
        """
        terms = self.terms()
        total = terms.cameras if self.weighting == "whitened" else 0.0 * terms.cameras
        if terms.absolute is not None:
            total = total + terms.absolute
        if terms.control is not None and self.marks is not None:
            count = len(self.marks.position_in_geo)
            weight = count / self._normaliser() if self.weighting == "whitened" else 1.0
            total = total + weight * terms.control
        return total

    def prior(self) -> Tensor:
        """What is known beforehand: a sum of squares of single parameters; scalar."""
        prior = self.cameras.z.square().sum()
        return prior + self.similarity.y.square().sum() if self.hold_prior else prior

    def _normaliser(self) -> int:
        """N of the means: the fixes, or the cameras where there is none."""
        return len(self.cameras.center) if self.fixes is None else len(self.fixes.camera)

    def forward(self) -> Tensor:
        """Whitened residuals (F + J, 3) of the fixes, then of the control points."""
        rows = []
        if self.fixes is not None:
            residual = self.similarity(self.cameras.centers()[self.fixes.camera]) - self.fixes.position_in_geo
            rows.append(self.fixes.root_information @ residual[:, :, None])
        if self.marks is not None:
            residual = self.similarity(intersect(self.cameras, self.marks)) - self.marks.position_in_geo
            rows.append(self.marks.root_information @ residual[:, :, None])
        return torch.cat(rows)[:, :, 0]

    def covariance(self) -> FloatArray:
        """Covariance (7, 7) of the similarity about its pivot, the cameras' uncertainty marginalised out.

        From the Gauss–Newton normal matrix of the whitened residuals at the present estimate, with the weights
        that the Cauchy kernel gave, in the form of `products.SimilarityRecord`.
        """
        y, z = self.similarity.y.detach(), self.cameras.z.detach()

        def residuals(y: Tensor, z: Tensor) -> Tensor:
            state = {"similarity.y": y, "cameras.z": z}
            return torch.func.functional_call(self, state, ())

        by_y, by_z = torch.func.jacrev(residuals, argnums=(0, 1), chunk_size=64)(y, z)
        with torch.no_grad():
            weight = 1.0 / (1.0 + self().square().sum(dim=1) / CAUCHY_SCALE2)
            root = (weight / WEIGHT_OF_NOISE).sqrt()[:, None, None]
        by_y = (root * by_y).flatten(0, 1).cpu().numpy()
        by_z = (root * by_z).flatten(0, 1).cpu().numpy()
        information = by_y.T @ by_y + (np.eye(len(y)) if self.hold_prior else 0.0)
        cross = by_y.T @ by_z
        information -= cross @ np.linalg.solve(by_z.T @ by_z + np.eye(len(z)), cross.T)
        basis = self.similarity.root.cpu().numpy()
        return np.asarray(basis @ np.linalg.solve(information, basis.T))

    def outliers(self) -> list[int]:
        """Cameras whose fix contradicts the whole at the 99.9 % level."""
        if self.fixes is None:
            return []
        with torch.no_grad():
            chi2 = self()[: len(self.fixes.camera)].square().sum(dim=1)
        return [int(camera) for camera in self.fixes.camera[chi2 > _OUTLIER_CHI2]]

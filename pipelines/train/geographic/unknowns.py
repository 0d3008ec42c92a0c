"""Unknowns of the geographic losses as tensors: similarity, cameras, lens and systematic errors; and rotations."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from pipelines.adjust.state import ErrorName, State, SystematicErrors
from pipelines.core.types import FloatArray
from pipelines.geometry.cameras import CameraPoses
from pipelines.geometry.similarity import Similarity, perturbation
from pipelines.geometry.statistics import CAUCHY_SCALE2


def exp_so3_tensor(rotation_vector: Tensor) -> Tensor:
    """Return the rotation matrices (…, 3, 3) of rotation vectors (…, 3), in radians.

    Rodrigues' formula is used, because `torch.linalg.matrix_exp` would wait for the device.
    """
    squared = rotation_vector.square().sum(dim=-1, keepdim=True)[..., None]
    angle = (squared + torch.finfo(squared.dtype).tiny).sqrt()  # the root has no derivative at zero
    x, y, z = rotation_vector.unbind(-1)
    zero = torch.zeros_like(x)
    cross = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], dim=-1).reshape(*rotation_vector.shape[:-1], 3, 3)
    identity = torch.eye(3, dtype=cross.dtype, device=cross.device)
    linear, quadratic = torch.sinc(angle / math.pi), 0.5 * torch.sinc(0.5 * angle / math.pi).square()
    return identity + linear * cross + quadratic * (cross @ cross)


def log_so3_tensor(rotation: Tensor) -> Tensor:
    """Return the rotation vectors (…, 3), in radians, of rotations (…, 3, 3) by less than π."""
    skewed = rotation - rotation.transpose(-1, -2)
    sine_axis = 0.5 * torch.stack([skewed[..., 2, 1], skewed[..., 0, 2], skewed[..., 1, 0]], dim=-1)
    # The root has no derivative at zero: a rotation by 0 counts as one by 1e-12 rad.
    sine = (sine_axis.square().sum(dim=-1, keepdim=True) + 1e-24).sqrt()
    cosine = 0.5 * (rotation.diagonal(dim1=-2, dim2=-1).sum(dim=-1, keepdim=True) - 1.0)
    return sine_axis * (torch.atan2(sine, cosine) / sine)


def cauchy(chi2: Tensor, dimension: int) -> Tensor:
    """Return Cauchy's ρ (N,) of squared whitened residuals (N,) of a dimension: c² ln(1 + χ²/c²)."""
    scale2 = CAUCHY_SCALE2[dimension]
    return scale2 * torch.log1p(chi2 / scale2)


@dataclass(frozen=True)
class TensorSimilarity:
    """Similarity in float64: p_geo = scale () · rotation (3, 3) p_model + translation (3,), metres."""

    scale: Tensor
    rotation: Tensor
    translation: Tensor

    def apply(self, points: Tensor) -> Tensor:
        """Return the mapped points (N, 3)."""
        return self.scale * points @ self.rotation.T + self.translation


@dataclass(frozen=True)
class Estimate:
    """Values of all unknowns that the measurements depend on."""

    rotation: Tensor  # (n, 3, 3) cam ← model
    center: Tensor  # (n, 3) projection centres in `model`, metres
    geo_from_model: TensorSimilarity
    errors: SystematicErrors
    vector: Tensor  # (p,) values of the systematic errors, m and rad
    lens: Tensor  # (L,) change of the lens parameters; L = 0: none

    def geo_from_cam(self, camera: Tensor) -> Tensor:
        """Return the rotations geo ← cam (K, 3, 3) of cameras with indices (K,)."""
        return self.geo_from_model.rotation @ self.rotation[camera].transpose(1, 2)

    def error(self, name: ErrorName) -> Tensor | None:
        """Return the components (3,) of an error without sessions; None if it is not among the unknowns."""
        columns = self.errors.columns(name)
        return None if columns is None else self.vector[columns]


class LearnableSimilarity(torch.nn.Module):
    """Similarity `geo_from_model` = perturbation(root · y) ∘ base, in float64.

    The perturbation is that of `geometry.similarity.SimilarityRecord`: (δ ln s, δω, δt) about `pivot` in the
    target frame. All seven coordinates y are of the same size, whatever the extent of the scene, so that one
    learning rate fits.

    Args:
        base: similarity at y = 0.
        covariance: (7, 7) of the base; its root is the unit of y.
        pivot: (3,) in the target frame, metres.
    """

    def __init__(self, base: Similarity, covariance: FloatArray, pivot: FloatArray) -> None:
        super().__init__()
        self.pivot_in_geo = np.asarray(pivot, dtype=np.float64)
        self.base = base
        self.y = torch.nn.Parameter(torch.zeros(7, dtype=torch.float64))
        value, vector = np.linalg.eigh((covariance + covariance.T) / 2)
        # A floor for directions without uncertainty.
        root = vector * np.sqrt(np.maximum(value, 1e-12 * max(value.max(), 1e-12)))
        self.root: Tensor
        self.base_rotation: Tensor
        self.base_shift: Tensor
        self.pivot: Tensor
        self.register_buffer("root", torch.from_numpy(root))
        self.register_buffer("base_rotation", torch.tensor(base.rotation, dtype=torch.float64))
        self.register_buffer("base_shift", torch.tensor(base.translation, dtype=torch.float64))
        self.register_buffer("pivot", torch.tensor(self.pivot_in_geo))

    def forward(self) -> TensorSimilarity:
        """Return the present similarity, differentiable in y."""
        delta = self.root @ self.y
        turn, grow = exp_so3_tensor(delta[1:4]), torch.exp(delta[0])
        return TensorSimilarity(
            grow * self.base.scale,
            turn @ self.base_rotation,
            self.pivot + delta[4:] + grow * (turn @ (self.base_shift - self.pivot)),
        )

    def current(self) -> Similarity:
        delta = (self.root @ self.y).detach().cpu().numpy()
        return perturbation(delta, self.pivot_in_geo) @ self.base


class CameraCorrections(torch.nn.Module):
    """Poses = base corrected by (δω, δc) = frozen + basis · z, lens = frozen + lens basis · z, in float64.

    The basis of `geometry.bundle.correction_basis` has these properties:

    - |z|² is the χ² that the correction costs the image observations.
    - No z moves all cameras by a similarity: the basis holds the gauge.
    - A test camera gives no gradient by its photograph. Its correction follows from its correlation with the other
      cameras, as in the bundle. The lens parameters correlate with the poses and follow likewise.

    Args:
        base: poses as SfM left them.
        basis: (n, 6, k) rows (δω, δc), rad and m; k = 0 freezes the cameras.
        lens_basis: (L, k) response of the lens parameters: `CorrectionBasis.lens_matrix`.
        start: corrections of cameras and lens to start from.
        z: (k,) coordinates of the start; what they do not give of it is frozen.
    """

    def __init__(
        self, base: CameraPoses, basis: FloatArray, lens_basis: FloatArray, start: State, z: FloatArray
    ) -> None:
        super().__init__()
        self.z = torch.nn.Parameter(torch.tensor(z, dtype=torch.float64))
        self.basis: Tensor
        self.lens_basis: Tensor
        self.rotation: Tensor
        self.center: Tensor
        self.frozen_poses: Tensor
        self.frozen_lens: Tensor
        for name, values in (
            ("basis", basis),
            ("lens_basis", lens_basis),
            ("rotation", base.cam_from_model),
            ("center", base.cam_center_in_model),
            ("frozen_poses", start.correction - basis @ z),
            ("frozen_lens", start.lens - lens_basis @ z),
        ):
            self.register_buffer(name, torch.from_numpy(np.ascontiguousarray(values)))

    @classmethod
    def frozen(cls, base: CameraPoses, start: State) -> CameraCorrections:
        """Return cameras and lens that nothing moves."""
        n, lenses = len(start.correction), len(start.lens)
        return cls(base, np.zeros((n, 6, 0)), np.zeros((lenses, 0)), start, np.zeros(0))

    def corrections(self) -> Tensor:
        """Return the corrections (δω, δc) of all cameras (n, 6), rad and m."""
        return self.frozen_poses + (self.basis.flatten(0, 1) @ self.z).view(-1, 6)

    def lens(self) -> Tensor:
        """Return the change (L,) of the lens parameters, in the order of `geometry.cameras.Lenses`; L = 0: none."""
        return self.frozen_lens + self.lens_basis @ self.z

    def moved(self) -> tuple[Tensor, Tensor]:
        """Return the corrected rotations cam ← model (n, 3, 3) and centres (n, 3) in `model`, metres."""
        correction = self.corrections()
        return self.rotation @ exp_so3_tensor(-correction[:, :3]), self.center + correction[:, 3:]

    def pose(self, index: int) -> tuple[Tensor, Tensor]:
        """Return the corrected rotation cam ← model (3, 3) and centre (3,) of one camera."""
        correction = self.frozen_poses[index] + self.basis[index] @ self.z
        return self.rotation[index] @ exp_so3_tensor(-correction[:3]), self.center[index] + correction[3:]

    def cam_from_model(self, index: int) -> Tensor:
        """Return the corrected pose of one camera, (4, 4) float32, differentiable in z."""
        rotation, center = self.pose(index)
        translation = -rotation @ center
        bottom = torch.eye(4, dtype=torch.float64, device=rotation.device)[3:]
        return torch.cat([torch.cat([rotation, translation[:, None]], dim=1), bottom]).float()


class LearnableErrors(torch.nn.Module):
    """Systematic errors v = start + unit · x, in metres and radians.

    The prior is that of the adjustment: Cauchy's kernel sets it aside for an error far larger than its σ.

    Args:
        errors: which, with the σ of their prior.
        start: (p,) values at x = 0.
        unit: (p,) scale of x, so that one learning rate fits.
    """

    def __init__(self, errors: SystematicErrors, start: FloatArray, unit: FloatArray) -> None:
        super().__init__()
        self.errors = errors
        self.x = torch.nn.Parameter(torch.zeros(len(errors), dtype=torch.float64))
        self.start: Tensor
        self.unit: Tensor
        self.sigma: Tensor
        sigma = np.array([block.sigma for block in errors.blocks], dtype=np.float64).reshape(-1)
        for name, values in (("start", start), ("unit", unit), ("sigma", sigma)):
            self.register_buffer(name, torch.tensor(values, dtype=torch.float64))

    def vector(self) -> Tensor:
        """Return the present values (p,)."""
        return self.start + self.unit * self.x

    def prior(self) -> Tensor:
        """Return −2 ln of the prior density, up to a constant; scalar."""
        return cauchy((self.vector() / self.sigma).view(-1, 3).square().sum(dim=1), 3).sum()

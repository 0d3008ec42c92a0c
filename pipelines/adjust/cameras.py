"""Cameras and lens that training corrects, in the whitened coordinates of bundle adjustment."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from pipelines.adjust.so3 import exp_so3
from pipelines.core.types import FloatArray
from pipelines.geometry.cameras import CameraPoses


@dataclass(frozen=True)
class HeldCorrections:
    """Corrections of cameras and lens that no parameter moves.

    Attributes:
        poses: (n, 6) corrections (δω, δc), rad and m.
        lens: (L,) change of the lens parameters, in the order of `geometry.lens.Lenses`; L = 0: the lens stays.
    """

    poses: FloatArray
    lens: FloatArray


class CameraCorrections(torch.nn.Module):
    """Poses = base corrected by (δω, δc) = held + basis · z, in float64.

    The basis of `geometry.correction_basis.correction_basis` has these properties:

    - |z|² is the χ² that the correction costs the image observations.
    - No z moves all cameras by a similarity: the basis holds the gauge.
    - A test camera gives no gradient. Its correction follows from its correlation with the other cameras, as in
      the bundle. The lens parameters correlate with the poses and follow likewise.

    Args:
        base: poses before training.
        basis: (n, 6, k) rows (δω, δc), rad and m; k = 0 holds the cameras fixed.
        lens_basis: (L, k) response of the lens parameters: `CorrectionBasis.lens_matrix`. None: the lens stays.
    """

    def __init__(self, base: CameraPoses, basis: FloatArray, lens_basis: FloatArray | None = None) -> None:
        super().__init__()
        follows = np.zeros((0, basis.shape[2])) if lens_basis is None else lens_basis
        self.z = torch.nn.Parameter(torch.zeros(basis.shape[2], dtype=torch.float64))
        self.basis: Tensor
        self.lens_basis: Tensor
        self.rotation: Tensor
        self.center: Tensor
        self.register_buffer("basis", torch.from_numpy(np.ascontiguousarray(basis)))
        self.register_buffer("lens_basis", torch.from_numpy(np.ascontiguousarray(follows)))
        self.register_buffer("rotation", torch.from_numpy(np.ascontiguousarray(base.cam_from_model)))
        self.register_buffer("center", torch.from_numpy(np.ascontiguousarray(base.cam_center_in_model)))
        self.held_poses: Tensor
        self.held_lens: Tensor
        self.hold(HeldCorrections(np.zeros((len(basis), 6)), np.zeros(len(follows))))

    @classmethod
    def held(cls, base: CameraPoses, corrections: HeldCorrections) -> CameraCorrections:
        """Return cameras and lens that only `hold` moves."""
        lens_count = len(corrections.lens)
        cameras = cls(base, np.zeros((len(base.cam_center_in_model), 6, 0)), np.zeros((lens_count, 0)))
        cameras.hold(corrections)
        return cameras

    def hold(self, corrections: HeldCorrections) -> None:
        """Set the part of the corrections that no parameter moves."""
        device = self.center.device
        self.register_buffer("held_poses", torch.from_numpy(np.ascontiguousarray(corrections.poses)).to(device))
        self.register_buffer("held_lens", torch.from_numpy(np.ascontiguousarray(corrections.lens)).to(device))

    def corrections(self) -> Tensor:
        """Return the corrections (δω, δc) of all cameras (n, 6), rad and m."""
        return self.held_poses + (self.basis.flatten(0, 1) @ self.z).view(-1, 6)

    def lens(self) -> Tensor:
        """Return the change (L,) of the lens parameters, in the order of `geometry.lens.Lenses`; L = 0: none."""
        return self.held_lens + self.lens_basis @ self.z

    def centers(self) -> Tensor:
        """Return the corrected projection centres (n, 3) in `model`, metres."""
        return self.moved(self.corrections())[1]

    def rotations(self) -> Tensor:
        """Return the corrected rotations cam ← model (n, 3, 3)."""
        return self.moved(self.corrections())[0]

    def moved(self, correction: Tensor) -> tuple[Tensor, Tensor]:
        """Return the poses under other corrections (n, 6), differentiable in them.

        Returns:
            Rotations cam ← model (n, 3, 3) and centres (n, 3) in `model`.
        """
        return self.rotation @ exp_so3(-correction[:, :3]), self.center + correction[:, 3:]

    def pose(self, index: int) -> tuple[Tensor, Tensor]:
        """Return the corrected rotation cam ← model (3, 3) and centre (3,) of one camera."""
        correction = self.held_poses[index] + self.basis[index] @ self.z
        return self.rotation[index] @ exp_so3(-correction[:3]), self.center[index] + correction[3:]

    def cam_from_model(self, index: int) -> Tensor:
        """Return the corrected pose of one camera, (4, 4) float32, differentiable in z."""
        rotation, center = self.pose(index)
        translation = -rotation @ center
        bottom = torch.eye(4, dtype=torch.float64, device=rotation.device)[3:]
        return torch.cat([torch.cat([rotation, translation[:, None]], dim=1), bottom]).float()

    def current(self) -> CameraPoses:
        """Return the present poses."""
        with torch.no_grad():
            return CameraPoses(self.rotations().cpu().numpy(), self.centers().cpu().numpy())

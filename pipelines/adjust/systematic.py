"""Constant errors of the measurements that training may estimate, common to all fixes or attitudes of a flight.

- bias: fix minus true position of the antenna, one for each flight. Only control points make it observable.
- lever-arm: l, the antenna seen from the camera, in the camera's axes: antenna = centre + geo_from_cam · l.
- lidar-shift: the LiDAR minus its true place. Only its planes make it observable.
- boresight: B = nominal_from_true. The attitudes are recorded of the nominal axes: geo_from_true = recorded · B.

With the boresight, training estimates a rotation in the axes of geo that all attitudes share (compass, tilt of the
gimbal). Its prior has the σ of one attitude: hundreds of attitudes therefore have no more information on the
rotation than one.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from pipelines.core.types import FloatArray
from pipelines.scene.estimated_error import EstimatedError

# Weak priors: wider than the errors of any flight, and finite, so that unobservable errors show by their σ.
SIGMA_BIAS_M = (5.0, 5.0, 10.0)
SIGMA_ARM_M = 1.0
SIGMA_LIDAR_M = 1.0
SIGMA_BORESIGHT_RAD = math.radians(5.0)
# A component counts as observed if its σ is at most this part of the prior's.
OBSERVED_PART = 0.5


@dataclass(frozen=True)
class SystematicErrorValues:
    """Values of the errors; None for errors that are not estimated.

    Attributes:
        bias_m: (G, 3) metres of the fixes of each flight, axes of geo, fix minus truth.
        arm_m: (3,) metres, antenna seen from the camera beyond the arm that the survey has applied, camera axes.
        boresight_rad: (3,) rotation vector from the true to the nominal camera axes.
        common_rad: (3,) rotation vector common to all recorded attitudes, axes of geo.
        lidar_m: (3,) metres, LiDAR minus its true place, axes of geo.
    """

    bias_m: Tensor | None = None
    arm_m: Tensor | None = None
    boresight_rad: Tensor | None = None
    common_rad: Tensor | None = None
    lidar_m: Tensor | None = None


@dataclass(frozen=True)
class ErrorBlock:
    """Three components of the vector of all errors.

    Attributes:
        name: as in `TrainOptions.estimate`, or "common", or "lidar-shift".
        flight: of a bias, counted from 0; None: of all flights.
        sigma: (3) of the prior, in metres or radians.
    """

    name: Literal["bias", "lever-arm", "boresight", "common", "lidar-shift"]
    flight: int | None
    sigma: tuple[float, float, float]


class SystematicErrors(torch.nn.Module):
    """Vector v = start + unit · x of all errors (p,), in metres and radians, with v ~ N(0, diag σ²) a priori.

    `start` and `unit` scale the learned x to size one. The unit is the root of v's covariance, see
    `adjust.start.begin`.

    Args:
        flights: number of flights whose biases to estimate; 0: no bias.
        arm: estimate the lever arm.
        attitude_sigma_rad: σ of one attitude, to estimate the boresight; None: no boresight.
        lidar: estimate the shift of the LiDAR.
    """

    def __init__(
        self, flights: int = 0, *, arm: bool = False, attitude_sigma_rad: float | None = None, lidar: bool = False
    ) -> None:
        super().__init__()
        blocks = [ErrorBlock("bias", flight, SIGMA_BIAS_M) for flight in range(flights)]
        if arm:
            blocks.append(ErrorBlock("lever-arm", None, (SIGMA_ARM_M,) * 3))
        if attitude_sigma_rad is not None:
            blocks.append(ErrorBlock("boresight", None, (SIGMA_BORESIGHT_RAD,) * 3))
            blocks.append(ErrorBlock("common", None, (attitude_sigma_rad,) * 3))
        if lidar:
            blocks.append(ErrorBlock("lidar-shift", None, (SIGMA_LIDAR_M,) * 3))
        self.blocks = tuple(blocks)
        self.flights = flights
        prior = np.array([block.sigma for block in self.blocks]).reshape(-1)
        self.x = torch.nn.Parameter(torch.zeros(len(prior), dtype=torch.float64))
        self.sigma: Tensor
        self.start: Tensor
        self.unit: Tensor
        self.register_buffer("sigma", torch.from_numpy(prior))
        self.register_buffer("start", torch.zeros(len(prior), dtype=torch.float64))
        self.register_buffer("unit", torch.from_numpy(np.diag(prior)))

    def __len__(self) -> int:
        return len(self.sigma)

    def begin(self, start: FloatArray, unit: FloatArray) -> None:
        """Set the values (p,) to start from, and the unit (p, p) of x; x becomes zero."""
        with torch.no_grad():
            self.start.copy_(torch.from_numpy(start))
            self.unit.copy_(torch.from_numpy(unit))
            self.x.zero_()

    def set_vector(self, vector: Tensor) -> None:
        """Set the present values (p,)."""
        with torch.no_grad():
            self.x.copy_(torch.linalg.solve(self.unit, vector - self.start))

    def vector(self) -> Tensor:
        """Return the present values v (p,)."""
        return self.start + self.unit @ self.x

    def prior(self, vector: Tensor) -> Tensor:
        """Return Σ (v/σ)² of a vector (p,); scalar."""
        return (vector / self.sigma).square().sum()

    def split(self, vector: Tensor) -> SystematicErrorValues:
        """Return the errors of a vector (p,) by their kind."""
        rows = vector.view(-1, 3)
        common = {block.name: row for block, row in zip(self.blocks, rows, strict=True) if block.flight is None}
        return SystematicErrorValues(
            rows[: self.flights] if self.flights else None,
            common.get("lever-arm"),
            common.get("boresight"),
            common.get("common"),
            common.get("lidar-shift"),
        )

    def estimates(self, covariance: FloatArray) -> tuple[EstimatedError, ...]:
        """Return the present values with the σ of their covariance (p, p), in metres and degrees.

        The rotation that all attitudes share is not included.
        """
        value, prior = self.vector().detach().cpu().numpy(), self.sigma.cpu().numpy()
        sigma = np.sqrt(np.diag(covariance))
        estimates = []
        for index, block in enumerate(self.blocks):
            if block.name == "common":
                continue
            axes, is_angle = slice(3 * index, 3 * index + 3), block.name == "boresight"
            unit = math.degrees(1.0) if is_angle else 1.0
            estimates.append(
                EstimatedError(
                    name=block.name,
                    flight=block.flight,
                    unit="deg" if is_angle else "m",
                    value=tuple(unit * value[axes]),
                    sigma=tuple(unit * sigma[axes]),
                    observed=tuple(sigma[axes] <= OBSERVED_PART * prior[axes]),
                )
            )
        return tuple(estimates)

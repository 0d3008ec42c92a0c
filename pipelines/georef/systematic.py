"""Constant errors of the measurements that training may estimate: what a whole flight's fixes or attitudes share.

    bias       a fix lies at the true antenna place + b, one b for each flight; control points alone show it
    lever-arm  the antenna seen from the camera, in the camera's axes: it lies at the centre + geo_from_cam · l
    boresight  nominal_from_true: recorded are the rotations of nominal axes, from which the true ones are turned

With a boresight comes what all attitudes of a flight share in the axes of geo (compass, tilt of the gimbal): it has
the σ of one attitude as its prior, so that hundreds of attitudes claim no more of the rotation than one.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from pipelines.core.types import FloatArray
from pipelines.georef.estimated_error import EstimatedError

# Weak priors: wide enough for whatever a flight brings, finite so that what is not observable is recognised.
SIGMA_BIAS_M = (5.0, 5.0, 10.0)
SIGMA_ARM_M = 1.0
SIGMA_BORESIGHT_RAD = math.radians(5.0)
# With a σ above this part of its prior's, a component has not been observed.
OBSERVED_PART = 0.5


@dataclass(frozen=True)
class SystematicErrorValues:
    """Values of the errors; None where one is not estimated.

    Attributes:
        bias_m: (G, 3) of the fixes of each flight, axes of geo, fix minus truth.
        arm_m: (3,) antenna seen from the camera beyond what the survey has applied, axes of the camera.
        boresight_rad: (3,) rotation vector from the true to the nominal camera axes.
        common_rad: (3,) rotation vector, axes of geo, of all recorded attitudes.
    """

    bias_m: Tensor | None = None
    arm_m: Tensor | None = None
    boresight_rad: Tensor | None = None
    common_rad: Tensor | None = None


@dataclass(frozen=True)
class ErrorBlock:
    """One error in the vector of all: `name` as in `TrainOptions.estimate` or "common", flight counted from 0."""

    name: Literal["bias", "lever-arm", "boresight", "common"]
    flight: int | None
    sigma: tuple[float, float, float]


class SystematicErrors(torch.nn.Module):
    """The vector v = start + unit · x of all errors (p,), in metres and radians, with v ~ N(0, diag σ²) a priori.

    `start` and `unit` (the root of v's covariance once the data are known, see `georef.start.begin`) only make the
    learned x of size one.

    Args:
        flights: whose biases to estimate; 0: none.
        arm: estimate the lever arm.
        attitude_sigma_rad: σ of one attitude; given: estimate the boresight.
    """

    def __init__(self, flights: int = 0, *, arm: bool = False, attitude_sigma_rad: float | None = None) -> None:
        super().__init__()
        blocks = [ErrorBlock("bias", flight, SIGMA_BIAS_M) for flight in range(flights)]
        if arm:
            blocks.append(ErrorBlock("lever-arm", None, (SIGMA_ARM_M,) * 3))
        if attitude_sigma_rad is not None:
            blocks.append(ErrorBlock("boresight", None, (SIGMA_BORESIGHT_RAD,) * 3))
            blocks.append(ErrorBlock("common", None, (attitude_sigma_rad,) * 3))
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
        """Set the values (p,) at which to start, and the unit (p, p) of x; x becomes zero."""
        with torch.no_grad():
            self.start.copy_(torch.from_numpy(start))
            self.unit.copy_(torch.from_numpy(unit))
            self.x.zero_()

    def set_vector(self, vector: Tensor) -> None:
        """Set the present values (p,)."""
        with torch.no_grad():
            self.x.copy_(torch.linalg.solve(self.unit, vector - self.start))

    def vector(self) -> Tensor:
        """Present values v (p,)."""
        return self.start + self.unit @ self.x

    def prior(self, vector: Tensor) -> Tensor:
        """Σ (v/σ)²; scalar."""
        return (vector / self.sigma).square().sum()

    def split(self, vector: Tensor) -> SystematicErrorValues:
        """The errors of a vector (p,)."""
        rows = vector.view(-1, 3)
        common = {block.name: row for block, row in zip(self.blocks, rows, strict=True) if block.flight is None}
        return SystematicErrorValues(
            rows[: self.flights] if self.flights else None,
            common.get("lever-arm"),
            common.get("boresight"),
            common.get("common"),
        )

    def estimates(self, covariance: FloatArray) -> tuple[EstimatedError, ...]:
        """The present values with the σ of their covariance (p, p); what all attitudes share is not among them."""
        value, prior = self.vector().detach().cpu().numpy(), self.sigma.cpu().numpy()
        sigma = np.sqrt(np.diag(covariance))
        estimates = []
        for index, block in enumerate(self.blocks):
            if block.name == "common":
                continue
            here, turned = slice(3 * index, 3 * index + 3), block.name == "boresight"
            unit = math.degrees(1.0) if turned else 1.0
            estimates.append(
                EstimatedError(
                    name=block.name,
                    flight=block.flight,
                    unit="deg" if turned else "m",
                    value=tuple(unit * value[here]),
                    sigma=tuple(unit * sigma[here]),
                    observed=tuple(sigma[here] <= OBSERVED_PART * prior[here]),
                )
            )
        return tuple(estimates)

"""Unknowns of the adjustment: similarity, corrections of cameras and lens, systematic errors."""

from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from pipelines.core.types import BoolArray, FloatArray
from pipelines.geometry.cameras import CameraPoses
from pipelines.geometry.rotations import exp_so3
from pipelines.geometry.similarity import Similarity
from pipelines.survey.measurement_errors import EstimatedError

# Priors of lever arm and boresight, in the adjustment and in the search for its start: wider than any error of a
# mounting, and finite, so that what a flight leaves open shows by its σ. Wider ones would change no observed value
# by more than 1 %, and would only enlarge the σ of heights that a downward lever arm takes up.
SIGMA_ARM_M, SIGMA_BORESIGHT_RAD = 1.0, float(np.radians(5.0))
SIGMA_LIDAR_M = 1.0
# A component counts as observed if its σ is at most this part of the prior's. The prior of a mount only keeps the σ
# finite: at a tenth of it, 0.1 m or 0.5°, it moves an estimate by 1 % of the way to its start. The other priors are
# what is known of the error.
_OBSERVED_PART, _OBSERVED_PART_OF_MOUNT = 0.5, 0.1

ErrorName = Literal["bias", "drift", "lever-arm", "boresight", "common", "lidar-shift", "earlier-date"]


def is_observed(name: ErrorName, sigma: FloatArray, prior: FloatArray | float) -> BoolArray:
    """Return the mask (3,) of the components that the measurements determine, by their σ and that of the prior."""
    part = _OBSERVED_PART_OF_MOUNT if name in ("lever-arm", "boresight") else _OBSERVED_PART
    return np.asarray(sigma <= part * np.asarray(prior))


@dataclass(frozen=True)
class SystematicError:
    """Three components that many measurements share, with a prior N(0, σ²) per axis, metres or radians.

    - bias: fix minus true position of the antenna, axes of geo, common to a session.
    - drift: what the error of a session's fixes does beside its mean, as a factor of one shape in time (`mode`),
      axes of geo (`adjust.drift`).
    - lever-arm: the antenna seen from the camera beyond the arm that the survey has applied, camera axes.
    - boresight: rotation vector from the true to the nominal camera axes, to which attitudes refer.
    - common: rotation vector that all recorded attitudes share, axes of geo (compass, tilt of a gimbal). Its prior
      has the σ of one attitude: hundreds of attitudes have no more information on the rotation than one.
    - lidar-shift: LiDAR minus its true place, axes of geo.
    - earlier-date: true place minus that in the solution of the earlier date, which the later one takes over.
    """

    name: ErrorName
    sigma: tuple[float, float, float]
    session: int | None = None
    mode: int | None = None

    @property
    def label(self) -> str:
        """Name in products, one for each error."""
        name = self.name if self.mode is None else f"{self.name} {self.mode + 1}"
        return name if self.session is None else f"{name} of session {self.session + 1}"


@dataclass(frozen=True)
class SystematicErrors:
    """All systematic errors of an adjustment; their components form one vector v (p,)."""

    blocks: tuple[SystematicError, ...] = ()

    def __len__(self) -> int:
        return 3 * len(self.blocks)

    def columns(self, name: ErrorName, session: int | None = None, mode: int | None = None) -> slice | None:
        """Return the place of an error in v; None if it is not among them."""
        wanted = (name, session, mode)
        places = (i for i, block in enumerate(self.blocks) if (block.name, block.session, block.mode) == wanted)
        rank = next(places, None)
        return None if rank is None else slice(3 * rank, 3 * rank + 3)

    def value(self, vector: FloatArray, name: ErrorName) -> FloatArray | None:
        """Return the components (3,) of an error without sessions in v (p,); None if it is not among them."""
        columns = self.columns(name)
        return None if columns is None else vector[columns]

    def estimates(self, vector: FloatArray, covariance: FloatArray) -> tuple[EstimatedError, ...]:
        """Return the values (p,) with the σ of their covariance (p, p), in metres and degrees.

        The rotation that all attitudes share and the drift of the fixes are not included.
        """
        values, sigmas = vector.reshape(-1, 3), np.sqrt(np.diag(covariance)).reshape(-1, 3)
        estimates = []
        for block, value, sigma in zip(self.blocks, values, sigmas, strict=True):
            if block.name in ("common", "drift"):
                continue
            is_angle, prior = block.name == "boresight", np.array(block.sigma)
            factor = float(np.degrees(1.0)) if is_angle else 1.0
            estimates.append(
                EstimatedError(
                    name=block.name,
                    session=block.session,
                    unit="deg" if is_angle else "m",
                    value=tuple((factor * value).tolist()),
                    sigma=tuple((factor * sigma).tolist()),
                    prior=tuple((factor * prior).tolist()),
                    observed=tuple(is_observed(block.name, sigma, prior).tolist()),
                )
            )
        return tuple(estimates)


@dataclass(frozen=True)
class State:
    """Values of all unknowns."""

    geo_from_model: Similarity
    # (n, 6) corrections (δω, δc) of the cameras in `model`, rad and m: R' = R Exp(−δω), c' = c + δc
    correction: FloatArray
    lens: FloatArray  # (L,) change of the lens parameters; L = 0: the lens stays
    errors: FloatArray = field(default_factory=lambda: np.zeros(0))  # (p,) systematic errors, m and rad

    def poses(self, base: CameraPoses) -> CameraPoses:
        turned = base.cam_from_model @ exp_so3(-self.correction[:, :3])
        return CameraPoses(turned, base.cam_center_in_model + self.correction[:, 3:])

"""Points of the surface in the CRS of the file."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipelines.adjust.accuracy_grid import AccuracyGrid
from pipelines.core.types import FloatArray
from pipelines.formats.cloud_points import CloudPoints
from pipelines.scene.surface_cloud.fusion import SurfaceCloud
from pipelines.scene.target_crs import TargetCrs

_STEP_M = 10.0  # of the differences that tell the axes of a CRS


@dataclass(frozen=True)
class CloudFrame:
    """CRS of the cloud.

    Attributes:
        target: the CRS.
        middle: (3,) middle of the scene in the CRS.
        crs_from_geo: (3, 3) rotation of directions: grid north is not true north. Identity where coordinates are
            angles, which have no directions of their own: normals are East-North-Up then.
    """

    target: TargetCrs
    middle: FloatArray
    crs_from_geo: FloatArray

    def points(self, cloud: SurfaceCloud, grid: AccuracyGrid | None) -> CloudPoints:
        """Return points in the CRS, with the covariance of the georeference and of the surface together.

        Args:
            cloud: in `geo`.
            grid: predicted covariance of the georeference; None: unknown, and so is the sum.
        """
        georeference = np.full((len(cloud), 3, 3), np.nan) if grid is None else grid.cov_at(cloud.position)
        # The surface is uncertain along its normal. Along itself, a surface has no place.
        across = cloud.sigma_m[:, None] * cloud.normal
        return CloudPoints(
            self.target.xyz_from_geo(cloud.position),
            (cloud.normal @ self.crs_from_geo.T).astype(np.float32),
            cloud.rgb,
            (georeference + across[:, :, None] * across[:, None, :]).astype(np.float32),
        )


def cloud_frame(target: TargetCrs, scene_in_geo: FloatArray) -> CloudFrame:
    """Return the frame of a cloud in a CRS.

    Args:
        target: the CRS.
        scene_in_geo: (M, 3) places that span the scene.
    """
    middle = scene_in_geo.mean(axis=0)
    at = target.xyz_from_geo(middle + _STEP_M * np.concatenate([np.zeros((1, 3)), np.eye(3), -np.eye(3)]))
    if target.crs.is_geographic:
        return CloudFrame(target, at[0], np.eye(3))
    left, _, right = np.linalg.svd((at[1:4] - at[4:7]).T)
    return CloudFrame(target, at[0], left @ right)

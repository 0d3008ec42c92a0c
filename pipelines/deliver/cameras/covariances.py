"""Full covariances of cameras and tie points, for who weights them in a solution of his own.

Both files are in the frame of `splat.ply`, as the COLMAP model beside them: metres, along east, north and up.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pipelines.adjust.posterior import Posterior
from pipelines.core.products import save_npz
from pipelines.core.types import FloatArray, IntArray
from pipelines.formats.csv_writer import write_table
from pipelines.geometry.similarity import Similarity
from pipelines.geometry.sparse_model import SparseModel

# Components of a camera: rotation about its centre by the axes, rad, then position of the centre, m.
_COMPONENTS = ("rotation_e", "rotation_n", "rotation_u", "e", "n", "u")
_MOST_POINTS = 100_000


@dataclass(frozen=True)
class Covariances:
    """Covariances of n cameras and N tie points; NaN: not known.

    Attributes:
        camera_name: n names.
        camera_cov: (n, 6, 6) of (δθ [rad], δc [m]): R_file_from_cam' = Exp(δθ) R_file_from_cam.
        point_id: (N,) ids of the SfM model.
        position: (N, 3) metres.
        point_cov_m2: (N, 3, 3), errors of the points' own image observations included.
    """

    camera_name: tuple[str, ...]
    camera_cov: FloatArray
    point_id: IntArray
    position: FloatArray
    point_cov_m2: FloatArray


def covariances_in_file(model: SparseModel, posterior: Posterior | None, file_from_geo: Similarity) -> Covariances:
    """Return the covariances of the cameras, and of at most 100 000 tie points that lie evenly among all.

    Args:
        model: cameras and points in the frame of the file.
        posterior: of the cameras; None: no covariance is known.
        file_from_geo: rigid.
    """
    rays = np.bincount(model.obs_point, minlength=len(model.point_id))
    known = np.flatnonzero((rays >= 2) & np.isfinite(model.point_in_local).all(axis=1))
    chosen = known[:: max(1, -(-len(known) // _MOST_POINTS))]
    position = model.point_in_local[chosen]
    of_cameras, of_points = np.full((len(model.image_name), 6, 6), np.nan), np.full((len(chosen), 3, 3), np.nan)
    if posterior is not None:
        turn, both = file_from_geo.rotation, np.kron(np.eye(2), file_from_geo.rotation)
        place = np.full(len(rays), -1)
        place[chosen] = np.arange(len(chosen))
        seen = np.flatnonzero(place[model.obs_point] >= 0)
        in_geo = file_from_geo.inverse().apply(position)
        of_points = posterior.of_tie_points(in_geo, place[model.obs_point[seen]], model.obs_image[seen])
        of_cameras, of_points = both @ posterior.camera_cov @ both.T, turn @ of_points @ turn.T
    return Covariances(model.image_name, of_cameras, model.point_id[chosen], position, of_points)


def write_covariances(found: Covariances, npz: Path, table: Path) -> None:
    """Write all covariances as NPZ, and those of the cameras as a table of their upper triangles.

    Args:
        found: the covariances.
        npz: path of the arrays.
        table: path of the CSV file.
    """
    save_npz(npz, vars(found))
    rows, columns = np.triu_indices(6)
    header = [f"cov_{_COMPONENTS[row]}_{_COMPONENTS[column]}" for row, column in zip(rows, columns, strict=True)]
    cells = (
        (name, *(f"{value:.9e}" if np.isfinite(value) else "" for value in values))
        for name, values in zip(found.camera_name, found.camera_cov[:, rows, columns].tolist(), strict=True)
    )
    write_table(table, (("name", *header), *cells))

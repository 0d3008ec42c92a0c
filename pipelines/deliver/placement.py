"""The one placement of a trained model, which all deliverables of a survey share, and their common words.

Frame-based files (PLY, SPZ, tiles) are East-North-Up at their own origin in the middle of the scene. There, float32
coordinates stay small, and "up" is the vertical at the splat, not at the start of the survey. The similarity maps
the model to Earth (GeoRefGS section 2.4). A survey without a place on Earth keeps its local frame.
"""

import shutil
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from pipelines.core.errors import InputError
from pipelines.core.figures import Headline
from pipelines.core.products import Remark, is_checked
from pipelines.core.types import FloatArray, Quaternion, Row7, vector3
from pipelines.formats.georef_sidecar import GeoreferenceSigma, GeorefSidecar, SceneSigma, georeference_sigma
from pipelines.geodesy import enu
from pipelines.geodesy.crs import ECEF, parse_crs
from pipelines.geodesy.vertical import VerticalDatum
from pipelines.geometry.rotations import quat_xyzw_from_matrix
from pipelines.geometry.similarity import Similarity, moved_pivot
from pipelines.survey.solution import Solution
from pipelines.survey.survey import Survey

# Columns: x, y and z of a file with y up, along east, north and up: x is east, z south.
ENU_FROM_Y_UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
_ORIGIN_DECIMALS_DEG = 6  # 0.1 m: short numbers can be copied without loss
_ORIGIN_DECIMALS_M = 1


@dataclass(frozen=True)
class Placement:
    """Place of a model on Earth, through the East-North-Up frame `file` in the middle of the scene.

    In a local metric frame, there is no place on Earth, and `file` is that frame.

    Attributes:
        origin_lla: (3,) latitude, longitude in degrees and ellipsoidal height of the origin of `file`, rounded:
            these numbers define the frame exactly. None: the frame is local.
        ecef_from_file: rigid, to the Earth-centred frame EPSG:4978; None: the frame is local.
        file_from_geo: rigid.
        geo_from_model: the trained similarity.
        covariance: (7, 7) of the similarity about the origin of `file`, along its axes; None if unknown.
        vertical: what the survey's input heights referred to.
        accuracy: headline of the result, which every file states; None: nothing states it.
    """

    origin_lla: FloatArray | None
    ecef_from_file: Similarity | None
    file_from_geo: Similarity
    geo_from_model: Similarity
    covariance: FloatArray | None
    vertical: VerticalDatum
    cautions: tuple[Remark, ...]
    accuracy: Headline | None

    @property
    def file_from_model(self) -> Similarity:
        return self.file_from_geo @ self.geo_from_model

    @property
    def georeference_sigma(self) -> GeoreferenceSigma | None:
        """Predicted σ of the georeference alone, at the origin of `file`; None: not known, unchecked, or local."""
        if self.covariance is None or self.origin_lla is None or not is_checked(self.cautions):
            return None
        return georeference_sigma(self.covariance, np.zeros(3))

    def sidecar(self, file_from_axes: FloatArray | None = None) -> GeorefSidecar:
        """Return the sidecar of a file in the frame `file`.

        Args:
            file_from_axes: (3, 3) rotation from the axes of the file, for one whose axes are not East-North-Up. The
                sidecar's rotation and covariance are those of its axes, σ remain those of east, north and up.
        """
        axes = np.eye(3) if file_from_axes is None else file_from_axes
        world_from_file = Similarity() if self.ecef_from_file is None else self.ecef_from_file
        x, y, z, w = quat_xyzw_from_matrix(world_from_file.rotation @ axes).tolist()
        quaternion: Quaternion = (x, y, z, w)
        covariance = None if self.covariance is None else _turned(self.covariance, axes.T)
        return GeorefSidecar(
            crs_id=None if self.ecef_from_file is None else "EPSG:4978",
            origin=vector3(world_from_file.translation),
            rotation=quaternion,
            scale=1.0,
            origin_lla=None if self.origin_lla is None else vector3(self.origin_lla),
            vertical_datum=self.vertical,
            crs_wkt="" if self.ecef_from_file is None else parse_crs(ECEF).wkt,
            covariance=None if covariance is None else tuple(map(_row, covariance)),
            accuracy=self.accuracy,
            georeference_sigma=self.georeference_sigma,
            cautions=self.cautions,
        )


def solved_placement(
    model: Solution, survey: Survey, points_in_model: ArrayLike, accuracy: Headline | None
) -> Placement:
    """Return the placement of a solved model, on Earth unless its frame is local.

    Args:
        points_in_model: (N, 3) centres of all its Gaussians, or without any its SfM points, N ≥ 1; their median is
            the middle of the scene.
    """
    geo_from_model = Similarity.from_record(model.geo_from_model)
    origin_lla, ecef_from_file, file_from_geo = None, None, Similarity()
    if survey.origin is not None:
        scene_in_geo = np.median(geo_from_model.apply(points_in_model), axis=0)
        lla = enu.lla_from_enu(scene_in_geo, survey.origin)
        origin_lla = np.array([*np.round(lla[:2], _ORIGIN_DECIMALS_DEG), np.round(lla[2], _ORIGIN_DECIMALS_M)])
        ecef_from_file, ecef_from_geo = (
            Similarity(1.0, enu.ecef_from_enu_rotation(origin), enu.ecef_from_lla(origin))
            for origin in (origin_lla, enu.lla_of(survey.origin))
        )
        file_from_geo = ecef_from_file.inverse() @ ecef_from_geo
    covariance, pivot = np.array(model.geo_from_model.covariance), model.geo_from_model.pivot
    about_origin = moved_pivot(covariance, pivot, file_from_geo.inverse().translation)
    return Placement(
        origin_lla=origin_lla,
        ecef_from_file=ecef_from_file,
        file_from_geo=file_from_geo,
        geo_from_model=geo_from_model,
        covariance=_turned(about_origin, file_from_geo.rotation) if about_origin.any() else None,
        vertical=survey.vertical,
        cautions=model.cautions,
        accuracy=accuracy,
    )


def _turned(covariance: FloatArray, to_from_from: FloatArray) -> FloatArray:
    """Return a similarity's covariance (7, 7) along other axes, about the same origin."""
    turn = np.eye(7)
    turn[1:4, 1:4] = turn[4:, 4:] = to_from_from
    return np.asarray(turn @ covariance @ turn.T)


def _row(values: FloatArray) -> Row7:
    s, rx, ry, rz, x, y, z = values.tolist()
    return s, rx, ry, rz, x, y, z


def scene_sigma(counts: str, horizontal_m: FloatArray, vertical_m: FloatArray) -> SceneSigma:
    """Return medians and largest of predicted σ (K,), for a sidecar that says which errors they count."""
    return SceneSigma(
        counts=counts,
        median_sigma_h_m=float(np.median(horizontal_m)),
        median_sigma_v_m=float(np.median(vertical_m)),
        largest_sigma_h_m=float(horizontal_m.max()),
        largest_sigma_v_m=float(vertical_m.max()),
    )


def median_values(sigma: SceneSigma | None, of: str) -> dict[str, float | None]:
    """Return the median σ of points or cells for `--json`; None where they are not known."""
    return {
        f"median_{of}_sigma_h_m": None if sigma is None else sigma.median_sigma_h_m,
        f"median_{of}_sigma_v_m": None if sigma is None else sigma.median_sigma_v_m,
    }


def require_space(folder: Path, needed_bytes: int, files: str, advice: str) -> None:
    """Refuse files that the disk would not hold: an InputError names them, and what makes them smaller."""
    free_bytes = shutil.disk_usage(folder).free
    if needed_bytes > free_bytes:
        needed, free = f"{needed_bytes / 2**30:.1f} GiB", f"{free_bytes / 2**30:.1f} GiB"
        advice = f"{advice[0].upper()}{advice[1:]}, or free space on this disk"
        raise InputError("disk-space", f"{files} may need {needed}; {free} are free. {advice}.", path=folder)

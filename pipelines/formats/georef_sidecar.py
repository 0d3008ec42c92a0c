"""Sidecar of an exported artefact: its place on Earth, with the uncertainty of that place.

The sidecar is JSON beside the file (`splat.ply.georef.json`), because popular tools lose PLY comments. Its content
mirrors SPZ_NIANTIC_georeference: p_ecef = scale · R(rotation) · p_file + origin, in float64. The same similarity
stands there as a 4×4 matrix. docs/formats.md has every field and a worked example.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import ArrayLike
from pydantic import ConfigDict, Field, field_validator, model_validator
from pydantic.alias_generators import to_camel

from pipelines.core.figures import Headline
from pipelines.core.files import replace_text
from pipelines.core.products import Product, Remark
from pipelines.core.types import Matrix4, Quaternion, Row7, Vector3, vector3
from pipelines.geodesy.vertical import VerticalDatum
from pipelines.geometry.rotations import matrix_from_quat_xyzw
from pipelines.geometry.similarity import Similarity, covariance_at

SUFFIX = ".georef.json"
# Between the matrix and the similarity, for sidecars whose numbers somebody has rounded: 1 mm at 1 km.
_MATRIX_TOLERANCE, _MATRIX_TOLERANCE_M = 1e-6, 1e-3

Covariance7 = Annotated[tuple[Row7, ...], Field(min_length=7, max_length=7)]


class _CamelCase(Product):
    model_config = ConfigDict(alias_generator=to_camel, populate_by_name=True)


class GeoreferenceSigma(Product):
    """σ of the georeference alone in metres, which the covariance predicts at `at`, a point of the file's frame.

    The model's shape is not counted, so that these are no accuracy of what the file shows.
    """

    at: Vector3
    sigma_e_m: float
    sigma_n_m: float
    sigma_u_m: float
    sigma_h_m: float
    sigma_v_m: float
    sigma_3d_m: float


def _matrix_of(fields: dict[str, Any]) -> Matrix4:
    """Return the matrix of a sidecar's similarity, row by row."""
    similarity = Similarity(fields["scale"], matrix_from_quat_xyzw(fields["rotation"]), np.array(fields["origin"]))
    first, second, third, last = map(tuple, similarity.matrix().tolist())
    return first, second, third, last


class GeorefSidecar(_CamelCase):
    """Content of the sidecar; names in the file are in camelCase.

    `matrix` (`ecefFromFile` in the file) is the similarity of `origin`, `rotation` and `scale` as a 4×4 matrix, row
    by row, for columns of homogeneous coordinates. `accuracy` is the headline of the result; None: nothing stated
    it when the file was written. `georeference_sigma` is a part of it; None: not known, or nothing checks it.
    """

    format: Literal["georefgs"] = "georefgs"
    version: Literal[2] = 2
    crs_id: Literal["EPSG:4978"] = "EPSG:4978"
    origin: Vector3
    rotation: Quaternion
    scale: float = Field(gt=0)
    matrix: Matrix4 = Field(default_factory=_matrix_of, alias="ecefFromFile")
    epoch: float | None = None
    origin_lla: Vector3
    vertical_datum: VerticalDatum
    crs_wkt: str
    covariance: Covariance7 | None
    accuracy: Headline | None
    georeference_sigma: GeoreferenceSigma | None
    cautions: tuple[Remark, ...] = ()

    @field_validator("rotation")
    @classmethod
    def _unit(cls, rotation: Quaternion) -> Quaternion:
        if abs(float(np.linalg.norm(rotation)) - 1) > 1e-6:
            raise ValueError("not a unit quaternion")
        return rotation

    @model_validator(mode="after")
    def _agrees(self) -> GeorefSidecar:
        off = np.abs(np.array(self.matrix) - self.ecef_from_file().matrix())
        if off[:, :3].max() > _MATRIX_TOLERANCE or off[:, 3].max() > _MATRIX_TOLERANCE_M:
            raise ValueError("ecefFromFile: is not the matrix of origin, rotation and scale")
        return self

    def ecef_from_file(self) -> Similarity:
        """Return the similarity p_ecef = s R p_file + origin."""
        return Similarity(self.scale, matrix_from_quat_xyzw(self.rotation), np.array(self.origin))


class SceneSigma(Product):
    """Predicted standard deviations in metres over a file's points or cells: medians, and the largest.

    `counts` says which errors they hold, and of what.
    """

    counts: str
    median_sigma_h_m: float
    median_sigma_v_m: float
    largest_sigma_h_m: float
    largest_sigma_v_m: float


def median_sigma(sigma: SceneSigma | None, of: str) -> str:
    """Return the end of a line that states the median σ, and of what; empty for None."""
    if sigma is None:
        return ""
    return f", median σ of the {of} {sigma.median_sigma_h_m:.3f} m H, {sigma.median_sigma_v_m:.3f} m V"


class CrsSidecar(_CamelCase):
    """Sidecar of a file whose coordinates are in a CRS; names in the file are in camelCase.

    Without a vertical part in `crs_wkt`, `vertical_datum` says what the heights count from. None: not stated, not
    known when the file was written, or, of σ, checked by nothing.
    """

    format: Literal["georefgs"] = "georefgs"
    version: Literal[2] = 2
    crs: str
    crs_wkt: str
    vertical_datum: VerticalDatum
    units: tuple[str, str, str]
    epoch: float | None = None
    operation: str
    operation_accuracy_m: float | None
    bounds: tuple[Vector3, Vector3]
    accuracy: Headline | None
    sigma: SceneSigma | None
    assumed: tuple[str, ...] = ()
    cautions: tuple[Remark, ...] = ()


def georeference_sigma(covariance: ArrayLike, point_in_file: ArrayLike) -> GeoreferenceSigma:
    """Return σ of the georeference by the sidecar's covariance (7, 7), at a point (3,) of the file's frame."""
    at = np.asarray(point_in_file, dtype=np.float64)
    east, north, up = np.diagonal(covariance_at(at[None], covariance, np.zeros(3))[0]).tolist()
    return GeoreferenceSigma(
        at=vector3(at),
        sigma_e_m=math.sqrt(east),
        sigma_n_m=math.sqrt(north),
        sigma_u_m=math.sqrt(up),
        sigma_h_m=math.sqrt(east + north),
        sigma_v_m=math.sqrt(up),
        sigma_3d_m=math.sqrt(east + north + up),
    )


def sidecar_path(artefact: Path) -> Path:
    """Return the path of a file's sidecar: the file's name with `.georef.json` added."""
    return artefact.with_name(artefact.name + SUFFIX)


def write_sidecar(sidecar: GeorefSidecar | CrsSidecar, artefact: Path) -> None:
    """Write the sidecar beside its file; the sidecar appears whole or not at all."""
    replace_text(sidecar_path(artefact), sidecar.model_dump_json(by_alias=True, indent=1) + "\n")

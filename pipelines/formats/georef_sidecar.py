"""Sidecar of an exported artefact: its place on Earth, with the uncertainty of that place.

The sidecar is JSON beside the file (`splat.ply.georef.json`), because popular tools lose PLY comments. Its content
mirrors SPZ_NIANTIC_georeference: p_ecef = scale · R(rotation) · p_file + origin, in float64. The same similarity
stands there as a 4×4 matrix. docs/formats.md has every field and a worked example. `splat.ply.iso.xml` beside it
says the same to GIS catalogues.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from numpy.typing import ArrayLike
from pydantic import ConfigDict, Field, field_validator, model_validator
from pydantic.alias_generators import to_camel

from pipelines.core.errors import InputError
from pipelines.core.figures import Headline
from pipelines.core.files import replace_text
from pipelines.core.json_values import JsonValue
from pipelines.core.products import Product, Remark
from pipelines.core.sentences import without_folders
from pipelines.core.types import Matrix4, Quaternion, Row7, Vector3, vector3
from pipelines.formats.iso_metadata import (
    PLAN_SIGMA,
    STANDARD_ERROR,
    IsoMetadata,
    QualityElement,
    headline_quality,
    iso_xml,
)
from pipelines.geodesy.crs import LOCAL_FRAME, parse_crs
from pipelines.geodesy.vertical import VerticalDatum
from pipelines.geometry.rotations import matrix_from_quat_xyzw
from pipelines.geometry.similarity import Similarity, covariance_at

SUFFIX, ISO_SUFFIX = ".georef.json", ".iso.xml"
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


def _matrix_of(fields: Mapping[str, JsonValue]) -> Matrix4 | None:
    if fields["crs_id"] is None:
        return None
    similarity = Similarity(fields["scale"], matrix_from_quat_xyzw(fields["rotation"]), np.array(fields["origin"]))
    first, second, third, last = map(tuple, similarity.matrix().tolist())
    return first, second, third, last


class GeorefSidecar(_CamelCase):
    """Content of the sidecar; names in the file are in camelCase.

    Without `crs_id`, the survey has no place on Earth: origin, rotation and scale lead to its local metric frame,
    and there is neither `matrix` nor `origin_lla`.

    `matrix` (`ecefFromFile` in the file) is the similarity of `origin`, `rotation` and `scale` as a 4×4 matrix, row
    by row, for columns of homogeneous coordinates. `accuracy` is the headline of the result; None: nothing stated
    it when the file was written. `georeference_sigma` is a part of it; None: not known, or nothing checks it.
    """

    format: Literal["georefgs"] = "georefgs"
    version: Literal[2] = 2
    crs_id: Literal["EPSG:4978"] | None = "EPSG:4978"
    origin: Vector3
    rotation: Quaternion
    scale: float = Field(gt=0)
    matrix: Matrix4 | None = Field(default_factory=_matrix_of, alias="ecefFromFile")
    epoch: float | None = None
    origin_lla: Vector3 | None
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
        if self.crs_id is None:
            if self.matrix is not None or self.origin_lla is not None:
                raise ValueError("crsId: there is none, but a place on Earth")
            return self
        if self.matrix is None or self.origin_lla is None:
            raise ValueError("ecefFromFile, originLla: missing")
        off = np.abs(np.array(self.matrix) - self.ecef_from_file().matrix())
        if off[:, :3].max() > _MATRIX_TOLERANCE or off[:, 3].max() > _MATRIX_TOLERANCE_M:
            raise ValueError("ecefFromFile: is not the matrix of origin, rotation and scale")
        return self

    def ecef_from_file(self) -> Similarity:
        """Return the similarity p_ecef = s R p_file + origin; an InputError: the file has no place on Earth."""
        if self.crs_id is None:
            raise InputError("not-on-earth", "The file is in a local metric frame, without a place on Earth.")
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


class MeshHole(_CamelCase):
    """Hole inside a mesh: middle, in the file's frame, and longest side of the box around its rim."""

    at: Vector3
    width_m: float


class MeshFigures(_CamelCase):
    """Figures of a mesh: its grid, faces, what its simplification has moved, and where it is open, in metres.

    The errors are distances of vertices before the simplification from the simplified mesh: RMS, and the largest.
    Gaps between measured points up to `closed_gap_m` are closed. The widest of the holes that are left are listed.
    """

    voxel_m: float
    texel_m: float
    faces_before_simplification: int
    faces: int
    rms_simplification_error_m: float
    largest_simplification_error_m: float
    closed_gap_m: float
    open_edges: float  # share of all edges
    holes: int
    widest_holes: tuple[MeshHole, ...]
    watertight: bool


class MeshSidecar(GeorefSidecar):
    """Sidecar of a mesh in a frame of its own."""

    mesh: MeshFigures


class MeshCrsSidecar(CrsSidecar):
    """Sidecar of a mesh in a CRS."""

    mesh: MeshFigures


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
    """Write the sidecar and the ISO metadata beside their file; each appears whole or not at all."""
    replace_text(sidecar_path(artefact), sidecar.model_dump_json(by_alias=True, indent=1) + "\n")
    name = artefact.name
    metadata = _of_frame(sidecar, name) if isinstance(sidecar, GeorefSidecar) else _of_crs(sidecar, name)
    replace_text(artefact.with_name(name + ISO_SUFFIX), iso_xml(metadata))


def _of_frame(sidecar: GeorefSidecar, name: str) -> IsoMetadata:
    """Return the metadata of a file in a frame, whose extent is not recorded: its place is that of the origin."""
    place, box = "without a place on Earth", None
    if sidecar.origin_lla is not None:
        lat, lon, _ = sidecar.origin_lla
        place = f"whose origin is at latitude {lat:.8f}°, longitude {lon:.8f}°"
        place += f". {name}{SUFFIX} places the frame on Earth"
        box = lon, lat
    sigma, of = sidecar.georeference_sigma, "the georeference alone; the model's shape is not counted"
    lengths = () if sigma is None else ((PLAN_SIGMA, sigma.sigma_h_m), (STANDARD_ERROR, sigma.sigma_v_m))
    return IsoMetadata(
        title=name,
        abstract=f"Model from photographs in a metric frame of its own, {place}. "
        f"{_accuracy_sentence(sidecar.accuracy)}",
        crs=sidecar.crs_id or LOCAL_FRAME,
        heights=_heights(sidecar.vertical_datum, sidecar.crs_wkt),
        west_south=box,
        east_north=box,
        height_range=None,
        lineage=("The place comes from an adjustment of all measurements.", *_sentences(sidecar.cautions)),
        quality=(
            *headline_quality(sidecar.accuracy),
            *(QualityElement(measure, of, value_m) for measure, value_m in lengths),
        ),
    )


def _of_crs(sidecar: CrsSidecar, name: str) -> IsoMetadata:
    bounds, west_south, east_north, has_heights = np.array(sidecar.bounds), None, None, True
    if sidecar.crs_wkt:  # else a local frame
        crs = parse_crs(sidecar.crs_wkt)
        corners = np.stack(np.meshgrid(*bounds.T, indexing="ij"), axis=-1).reshape(-1, 3)
        lla = crs.lla_from_xyz(corners)
        (south, west, _), (north, east, _) = lla.min(axis=0).tolist(), lla.max(axis=0).tolist()
        west_south, east_north, has_heights = (west, south), (east, north), not crs.is_geocentric
    sigma, known = sidecar.sigma, sidecar.operation_accuracy_m
    lengths = () if sigma is None else (
        (PLAN_SIGMA, "median", sigma.median_sigma_h_m),
        (STANDARD_ERROR, "median", sigma.median_sigma_v_m),
        (PLAN_SIGMA, "largest", sigma.largest_sigma_h_m),
        (STANDARD_ERROR, "largest", sigma.largest_sigma_v_m),
    )  # fmt: skip
    return IsoMetadata(
        title=name,
        abstract=f"Product of a survey with photographs, in {sidecar.crs}. {_accuracy_sentence(sidecar.accuracy)}",
        crs=sidecar.crs,
        heights=_heights(sidecar.vertical_datum, sidecar.crs_wkt),
        west_south=west_south,
        east_north=east_north,
        height_range=(float(bounds[0, 2]), float(bounds[1, 2])) if has_heights else None,
        lineage=(
            f"Coordinates by the operation {sidecar.operation}"
            + ("." if known is None else f", whose published accuracy is {known} m."),
            *(f"Assumed: {without_folders(text)}." for text in sidecar.assumed),
            *_sentences(sidecar.cautions),
        ),
        quality=(
            *headline_quality(sidecar.accuracy),
            *(QualityElement(kind, f"{which} of {sigma.counts}", value) for kind, which, value in lengths if sigma),
        ),
    )


def _accuracy_sentence(headline: Headline | None) -> str:
    return "Its accuracy is not stated." if headline is None else f"Accuracy: {headline.text}."


def _heights(datum: VerticalDatum, crs_wkt: str) -> str:
    """Return what heights count from, and whether nobody stated it; a local frame needs no word."""
    return f"{datum.name} ({datum.source})" if crs_wkt and not datum.stated else datum.name


def _sentences(cautions: tuple[Remark, ...]) -> list[str]:
    return [without_folders(caution.sentence) for caution in cautions]

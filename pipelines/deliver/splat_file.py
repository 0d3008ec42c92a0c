"""`georef inspect` of a file of a splat: what it holds, and where on Earth the file and its sidecar place it.

A place that the file holds itself (SPZ) and that of the sidecar are two sources of one quantity. Neither outranks
the other: both are told, and their distance where they differ.
"""

import math
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from pipelines.core.errors import InputError
from pipelines.core.files import file_size
from pipelines.core.products import Remark, load_json
from pipelines.core.types import FloatArray, Vector3, vector3
from pipelines.formats.georef_sidecar import GeorefSidecar, sidecar_path
from pipelines.formats.splat_ply import SplatArrays, read_splat_ply
from pipelines.formats.spz import decode_spz, spz_georeference
from pipelines.geodesy.crs import parse_crs
from pipelines.geodesy.enu import ecef_from_lla
from pipelines.geometry.rotations import matrix_from_quat_xyzw
from pipelines.geometry.similarity import Similarity

_SHARES = (1.0, 99.0)  # percentiles of the bounds, as of `georef info`
_SAME_M = 1e-3


@dataclass(frozen=True)
class StatedPlace:
    """Place on Earth of the middle of a splat, as a source states it.

    Attributes:
        source: name of the file that states it.
        crs: to which it leads; epoch: decimal year at which its coordinates are valid, None: not stated.
        middle_lla: degrees, and metres above the ellipsoid; None: the CRS is of another body, or of angles.
    """

    source: str
    crs: str
    epoch: float | None
    middle_lla: Vector3 | None


@dataclass(frozen=True)
class SplatReport:
    """File of a splat.

    Attributes:
        low, high: bounds in the file's own axes, in its metres, of 98 % of the Gaussians along each axis.
    """

    path: str
    format: str
    gaussians: int
    sh_degree: int
    low: Vector3
    high: Vector3
    places: tuple[StatedPlace, ...]
    remarks: tuple[Remark, ...]

    def document(self) -> dict[str, Any]:
        return {**asdict(self), "remarks": [remark.model_dump() for remark in self.remarks]}


@dataclass(frozen=True)
class _Source:
    """Similarity from the axes of a file to a CRS, and the file that states it."""

    name: str
    crs: str
    epoch: float | None
    crs_from_file: Similarity


def inspect_splat(path: Path) -> SplatReport:
    """Return what an SPZ or a 3DGS PLY holds, and its places on Earth; an InputError: a file is damaged."""
    file_size(path)
    data = path.read_bytes() if path.suffix.lower() == ".spz" else None
    splat = read_splat_ply(path) if data is None else decode_spz(data, path)
    sources = list(_sources(path, data))
    low, high = np.percentile(splat.means, _SHARES, axis=0)
    middle = np.median(splat.means, axis=0)
    shown_at = [_lla_of_points(source, np.stack([middle, low, high]), path) for source in sources]
    places = tuple(
        StatedPlace(source.name, source.crs, source.epoch, None if lla is None else vector3(lla[0]))
        for source, lla in zip(sources, shown_at, strict=True)
    )
    return SplatReport(
        path=str(path),
        format="3DGS PLY" if data is None else "SPZ",
        gaussians=len(splat),
        sh_degree=_degree(splat),
        low=vector3(low),
        high=vector3(high),
        places=places,
        remarks=tuple(_remarks(path, places, shown_at)),
    )


def _sources(path: Path, data: bytes | None) -> Iterator[_Source]:
    """Yield what states a place of a file, given the bytes of an SPZ."""
    embedded = None if data is None else spz_georeference(data, path)
    if embedded is not None:
        rotation = matrix_from_quat_xyzw(embedded.quat_xyzw)
        placed = Similarity(embedded.scale, rotation, np.array(embedded.origin))
        yield _Source(path.name, embedded.crs, embedded.epoch, placed)
    beside = sidecar_path(path)
    if beside.is_file():
        sidecar = load_json(GeorefSidecar, beside)
        if sidecar.crs_id is not None:
            yield _Source(beside.name, sidecar.crs_id, sidecar.epoch, sidecar.ecef_from_file())


def _lla_of_points(source: _Source, points: FloatArray, path: Path) -> FloatArray | None:
    """Return latitude, longitude and height (n, 3) of points in the file's axes; None: not known.

    No similarity leads to angles.
    """
    try:
        crs = parse_crs(source.crs, path=path)
        if crs.is_geographic:
            return None
        return crs.lla_from_xyz(source.crs_from_file.apply(points), path=path)
    except InputError:
        return None


def _remarks(path: Path, places: tuple[StatedPlace, ...], shown_at: list[FloatArray | None]) -> Iterator[Remark]:
    if not places:
        beside = sidecar_path(path).name
        sentence = f"Nothing states a place on Earth: neither {path.name} itself nor a {beside} beside it."
        yield Remark(code="no-place", sentence=sentence)
    for place in places:
        if place.middle_lla is None:
            sentence = f"{place.source} leads to {place.crs[:60]}, which is no place on Earth that is known here."
            yield Remark(code="place-not-on-earth", sentence=sentence)
        elif not parse_crs(place.crs, path=path).vertical.stated:
            sentence = f"{place.source} leads to {place.crs[:60]}, and its heights were taken as ellipsoidal."
            yield Remark(code="place-heights", sentence=sentence)
    known = [lla for lla in shown_at if lla is not None]
    if len(known) == 2:
        apart_m = float(np.linalg.norm(ecef_from_lla(known[0]) - ecef_from_lla(known[1]), axis=1).max())
        if apart_m > _SAME_M:
            sentence = (
                f"{places[0].source} and {places[1].source} place the splat up to {apart_m:.3f} m apart. One was "
                "moved or replaced without the other: ask who wrote them, or export again."
            )
            yield Remark(code="place-inconsistent", sentence=sentence)


def _degree(splat: SplatArrays) -> int:
    return math.isqrt(splat.sh.shape[1]) - 1

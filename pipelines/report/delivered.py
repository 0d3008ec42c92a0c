"""Delivered files: each with its CRS, cell size, share measured and interpolated, σ, size and hash."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pipelines.core.descriptions import DESCRIPTIONS
from pipelines.core.errors import GeorefError
from pipelines.core.figures import length_text
from pipelines.core.manifest import hash_file
from pipelines.core.products import load_json
from pipelines.core.stages import BY_NAME, DELIVERABLES
from pipelines.core.workspace import Workspace
from pipelines.formats.georef_sidecar import (
    CrsSidecar,
    GeorefSidecar,
    MeshCrsSidecar,
    MeshSidecar,
    sidecar_path,
)
from pipelines.formats.geotiff import raster_frame
from pipelines.report.page import number_text, share

_STAGES = ("export-ply", *(spec.name for spec in DELIVERABLES if spec.name != "report"))
_DRAWN_OF = {"contours.gpkg": "dsm.tif", "contours.dxf": "dsm.tif"}  # in the CRS of that raster
_SIDECARS: tuple[type[GeorefSidecar | CrsSidecar], ...] = (MeshCrsSidecar, CrsSidecar, MeshSidecar, GeorefSidecar)


@dataclass(frozen=True)
class DeliveredFile:
    """File or folder of the result; texts are empty for what it does not have."""

    path: str
    description: str
    crs: str  # of its coordinates, with their units
    heights: str
    cell: str
    shares: str  # measured and interpolated, of its area
    sigma: str  # median over its points or cells, or of the placement of the whole
    bytes: int
    files: int  # 1, or the number in a folder
    sha256: str  # of a file


@dataclass(frozen=True)
class DeliveredFacts:
    """Files that the workspace holds for its user, in the order of the work."""

    files: tuple[DeliveredFile, ...]


def delivered_facts(workspace: Workspace) -> DeliveredFacts:
    """Return the delivered files that there are, hashed as they lie on the disk."""
    folders = {BY_NAME[name].folder: name for name in _STAGES}
    found = []
    for path, description in DESCRIPTIONS.items():
        stage = folders.get(path.partition("/")[0])
        if stage is not None and (workspace.root / path).exists():
            values = _values(workspace, stage)
            found.append(_file(workspace.root / path, path, description, values))
    return DeliveredFacts(tuple(found))


def measured_share(workspace: Workspace) -> tuple[float, float] | None:
    """Return which share of the delivered rasters is measured, and their hectares; None: there are none."""
    values = _values(workspace, "export-raster")
    measured, area_ha = values.get("measured"), values.get("delivered_ha")
    return (measured, area_ha) if isinstance(measured, float) and isinstance(area_ha, float) else None


def _values(workspace: Workspace, stage: str) -> dict[str, Any]:
    try:
        manifest = workspace.manifest(BY_NAME[stage])
    except GeorefError:  # damaged: the section on processing says so
        return {}
    return {} if manifest is None else manifest.values


def _file(file: Path, path: str, description: str, values: dict[str, Any]) -> DeliveredFile:
    crs, heights, sigma = _place(file)
    shares = _shares(values) if crs and path != "export/splat.ply" else ""
    if file.name in _DRAWN_OF:  # it has no sidecar of its own
        crs, heights, _ = _place(file.with_name(_DRAWN_OF[file.name]))
    elif file.suffix == ".geojson":
        crs = "longitude, latitude (WGS84)"
    inside = [each for each in file.rglob("*") if each.is_file()] if file.is_dir() else [file]
    return DeliveredFile(
        path=path,
        description=description,
        crs=crs,
        heights=heights,
        cell=_cell(file, values) if file.suffix == ".tif" else "",
        shares=shares,
        sigma=sigma,
        bytes=sum(each.stat().st_size for each in inside),
        files=len(inside),
        sha256="" if file.is_dir() else hash_file(file, {}),
    )


def _place(file: Path) -> tuple[str, str, str]:
    """Return CRS, heights and σ as the sidecar of a file states them; empty without one."""
    sidecar = _sidecar(file)
    if sidecar is None:
        return "", "", ""
    if isinstance(sidecar, CrsSidecar):
        of = sidecar.sigma
        sigma = "" if of is None else _sigma(of.median_sigma_h_m, of.median_sigma_v_m)
        return sidecar.crs, sidecar.vertical_datum.described, sigma
    whole = sidecar.georeference_sigma
    sigma = "" if whole is None else f"{_sigma(whole.sigma_h_m, whole.sigma_v_m)} (placement)"
    crs = "local metric frame" if sidecar.crs_id is None else f"metres, placed in {sidecar.crs_id} by its sidecar"
    return crs, sidecar.vertical_datum.described, sigma


def _sidecar(file: Path) -> GeorefSidecar | CrsSidecar | None:
    path = sidecar_path(file)
    for kind in _SIDECARS if path.is_file() else ():
        try:
            return load_json(kind, path)
        except GeorefError:
            continue
    return None


def _sigma(horizontal_m: float, vertical_m: float) -> str:
    return f"H {length_text(horizontal_m)}, V {length_text(vertical_m)}"


def _cell(file: Path, values: dict[str, Any]) -> str:
    try:
        step = raster_frame(file).step_x
    except GeorefError:
        return ""
    unit = next(iter(values.get("units") or ("metre",)))
    return f"{step:g} {unit}"


def _shares(values: dict[str, Any]) -> str:
    measured, interpolated = values.get("measured"), values.get("interpolated")
    if not isinstance(measured, float | int):
        return ""
    text = f"{share(measured)} measured"
    if isinstance(interpolated, float | int):
        text += f", {share(interpolated)} interpolated"
    area_ha = values.get("delivered_ha")
    return text if not isinstance(area_ha, float | int) else f"{text}, of {number_text(area_ha, 2)} ha"

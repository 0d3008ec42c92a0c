"""Record of the processing: stages with options, inputs, versions and times; remarks; and the delivered files.

A file has its CRS, cell size, share measured and interpolated, σ, size and hash. Other stages have left for the
page: LiDAR that the training has used, the comparison with a reference, and the change since an earlier survey.
"""

from __future__ import annotations

import contextlib
from collections.abc import Mapping
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from typing import Any

from pipelines.core.errors import GeorefError, InputError
from pipelines.core.figures import DEPTH_ERRORS, length_text
from pipelines.core.json_values import JsonValue
from pipelines.core.manifest import hash_file
from pipelines.core.options import flag_name, notation
from pipelines.core.products import Remark, load_json
from pipelines.core.stages import (
    BY_NAME,
    CHANGE,
    CHANGE_FIGURES,
    DELIVERABLES,
    DESCRIPTIONS,
    LIDAR,
    LIDAR_MAP,
    REFERENCE_HISTOGRAM,
    REFERENCE_MAP,
    StageSpec,
)
from pipelines.core.staleness import Flags, cautions_by_stage, status
from pipelines.core.workspace import Workspace
from pipelines.formats.georef_sidecar import (
    CrsSidecar,
    GeorefSidecar,
    MeshCrsSidecar,
    MeshSidecar,
    sidecar_path,
)
from pipelines.formats.geotiff import raster_frame
from pipelines.report.page import Picture, number_text, png_file, preview, share
from pipelines.survey.change_report import Change, ChangedRegion
from pipelines.survey.lidar_report import LidarReport
from pipelines.survey.survey import Survey

_REPORT = "report"


@dataclass(frozen=True)
class StageRecord:
    """Stage as it was run; None: not recorded."""

    name: str
    state: str  # as in `georef status`, when the report was made
    reason: str  # likewise
    made: datetime | None = None
    duration_s: float | None = None
    key_figure: str = ""
    options: dict[str, str] = field(default_factory=dict)  # by flag, all of them
    inputs: dict[str, str] = field(default_factory=dict)  # SHA-256 by product or flag
    warnings: tuple[Remark, ...] = ()


@dataclass(frozen=True)
class RecordFacts:
    """Processing of a survey: its stages in the order of the work, assumptions of `ingest`, cautions by stage."""

    stages: tuple[StageRecord, ...]
    total_s: float  # sum of the recorded durations
    versions: dict[str, str]  # by name, with the stages that ran with them if not all did
    assumptions: tuple[Remark, ...]
    cautions: dict[str, tuple[Remark, ...]]
    by_hand: tuple[str, ...]  # stages whose product was put there by hand

    @property
    def remarks(self) -> list[tuple[str, tuple[Remark, ...]]]:
        """Warnings and cautions, each with its stage."""
        return [*((stage.name, stage.warnings) for stage in self.stages), *self.cautions.items()]


def record_facts(workspace: Workspace, survey: Survey) -> RecordFacts:
    """Return what the appendix shows of all stages but `report`: state, options, inputs, warnings and versions."""
    stages: list[StageRecord] = []
    versions: dict[str, dict[str, list[str]]] = {}
    for row in status(workspace):
        if row.stage == _REPORT:
            continue
        manifest, spec = None, BY_NAME[row.stage]
        with contextlib.suppress(InputError):  # `state` tells
            manifest = workspace.manifest(spec)
        if manifest is None:
            stages.append(StageRecord(spec.name, row.state, row.reason))
            continue
        stages.append(
            StageRecord(
                name=spec.name,
                state=row.state,
                reason=row.reason,
                made=manifest.finished,
                duration_s=manifest.duration_s,
                key_figure=manifest.key_figure,
                options=_options(spec, manifest.config),
                inputs=manifest.inputs,
                warnings=manifest.warnings,
            )
        )
        for name, version in manifest.versions.items():
            versions.setdefault(name, {}).setdefault(version, []).append(row.stage)
    return RecordFacts(
        stages=tuple(stages),
        total_s=sum(stage.duration_s or 0.0 for stage in stages),
        versions={
            name: "; ".join(
                version if len(by_version) == 1 else f"{version} ({', '.join(ran)})"
                for version, ran in by_version.items()
            )
            for name, by_version in versions.items()
        },
        assumptions=survey.assumptions,
        cautions=cautions_by_stage(workspace),
        by_hand=tuple(stage.name for stage in stages if stage.made is None and stage.state == "current"),
    )


def _options(spec: StageSpec, config: Flags) -> dict[str, str]:
    """Return the recorded options of a stage by flag, as users write their values."""
    try:
        options = spec.options.model_validate(config)
    except ValueError:  # of a version with other options
        return {name: _notation(value) for name, value in config.items()}
    fields = type(options).model_fields
    return {flag_name(spec.options, name): _notation(getattr(options, name)) for name in fields}


def _notation(value: object) -> str:
    """Return a value as users write it; a path without its folders, which are nobody's business."""
    if isinstance(value, Path) or (isinstance(value, str) and Path(value).is_absolute()):
        return Path(value).name
    if value is None:
        return "not given"
    if isinstance(value, bool):
        return "yes" if value else "no"
    return notation(value) or "none"


_MAP_PX = 1400
_LISTED = 12


@dataclass(frozen=True)
class LidarFacts:
    """LiDAR of a training: axis, shift and σ in metres; number of areas in the table; their map if it was kept.

    `errors`: field, head and form of each column of the errors at points that were held out.
    """

    report: LidarReport
    shift: tuple[tuple[str, float, float], ...]
    listed: int
    map: Picture | None
    errors: tuple[tuple[str, str, str], ...] = tuple(
        (name, figure.label, "whole" if not figure.unit else "signed" if name == "bias_m" else "metres")
        for name, figure in DEPTH_ERRORS.items()
    )


def lidar_facts(workspace: Workspace) -> LidarFacts | None:
    """Return the LiDAR of a training; None: it has used none."""
    if not (workspace.root / LIDAR).is_file():
        return None
    report = load_json(LidarReport, workspace.root / LIDAR)
    registration = report.registration
    return LidarFacts(
        report,
        tuple(zip(("east", "north", "up"), registration.shift_m, registration.sigma_m, strict=True)),
        min(len(report.areas), _LISTED),
        preview(workspace.root / LIDAR_MAP, _MAP_PX),
    )


@dataclass(frozen=True)
class ChangeFacts:
    """Change since an earlier survey, and the largest regions that changed; `change` None: it is out of date.

    `listed` holds the user's polygons first; `earlier` is the name of the earlier workspace.
    """

    change: Change | None
    earlier: str
    listed: tuple[ChangedRegion, ...]


def change_facts(workspace: Workspace, record: RecordFacts) -> ChangeFacts | None:
    """Return the change since an earlier survey; None: there is none."""
    made = next((one for one in record.stages if one.name == CHANGE.name), None)
    if made is None or not (workspace.root / CHANGE_FIGURES).is_file():
        return None
    earlier = Path(made.options.get("--before", "")).name
    if made.state != "current":
        return ChangeFacts(None, earlier, ())
    change = load_json(Change, workspace.root / CHANGE_FIGURES)
    return ChangeFacts(change, earlier, change.regions[:_LISTED])


def reference_facts(workspace: Workspace) -> dict[str, Picture | None]:
    """Return the pictures of a comparison; None: nothing was measured."""
    products = {"map": REFERENCE_MAP, "histogram": REFERENCE_HISTOGRAM}
    return {name: png_file(workspace.root / product) for name, product in products.items()}


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
    files = []
    for path, description in DESCRIPTIONS.items():
        stage = folders.get(path.partition("/")[0])
        if stage is not None and (workspace.root / path).exists():
            values = _values(workspace, stage)
            files.append(_file(workspace.root / path, path, description, values))
    return DeliveredFacts(tuple(files))


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


def _file(file: Path, path: str, description: str, values: Mapping[str, JsonValue]) -> DeliveredFile:
    crs, heights, sigma = _stated_place(file)
    shares = _shares(values) if crs and path != "export/splat.ply" else ""
    if file.name in _DRAWN_OF:  # it has no sidecar of its own
        crs, heights, _ = _stated_place(file.with_name(_DRAWN_OF[file.name]))
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


def _stated_place(file: Path) -> tuple[str, str, str]:
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


def _cell(file: Path, values: Mapping[str, JsonValue]) -> str:
    try:
        step = raster_frame(file).step_x
    except GeorefError:
        return ""
    unit = next(iter(values.get("units") or ("metre",)))
    return f"{step:g} {unit}"


def _shares(values: Mapping[str, JsonValue]) -> str:
    measured, interpolated = values.get("measured"), values.get("interpolated")
    if not isinstance(measured, float | int):
        return ""
    text = f"{share(measured)} measured"
    if isinstance(interpolated, float | int):
        text += f", {share(interpolated)} interpolated"
    area_ha = values.get("delivered_ha")
    return text if not isinstance(area_ha, float | int) else f"{text}, of {number_text(area_ha, 2)} ha"

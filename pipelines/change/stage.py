"""Stage `change`: what differs between the rasters of two epochs, by how much, and whether it is real.

Reads the rasters, surveys and adjustments of both workspaces. Writes `change/` in the later one: `difference.tif`,
`sigma.tif`, `lod.tif`, `significant.tif`, `regions.geojson`, `regions.gpkg`, `regions.csv`, `change.json` and the
page `change.html`; on request `along_normals.laz`.
"""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from pipelines.change.along_normals import Datum, change_along_normals, require_clouds
from pipelines.change.datum import load_epoch, shared_by
from pipelines.change.detection import (
    QUANTILE_95,
    Cells,
    Noise,
    level_of_detection,
    significant_change,
    unchanged_ground,
)
from pipelines.change.grid import CommonGrid, EpochRasters, Window, epoch_rasters
from pipelines.change.options import ChangeOptions
from pipelines.change.page import Compared, change_page
from pipelines.change.regions import Parts, find_regions, reach_of
from pipelines.change.tied import Tied, contradicted, tied_by
from pipelines.core.errors import InputError
from pipelines.core.files import remove, replace_text
from pipelines.core.products import Remark, save_json, union
from pipelines.core.sentences import listed
from pipelines.core.stages import CHANGE_PAGE
from pipelines.core.staleness import status
from pipelines.core.types import vector3
from pipelines.core.workspace import StageRun, Summary, Workspace
from pipelines.formats.geotiff import Band, RasterKind, write_mosaic
from pipelines.formats.tables import table_text
from pipelines.formats.vector_files import feature, features_text, write_polygons_gpkg
from pipelines.geodesy.crs import parse_crs
from pipelines.report.page import render_page
from pipelines.survey.boundaries import Outlines, read_outlines
from pipelines.survey.change_report import Change, ChangedRegion, Registration

_PLACES = 20  # along each side of the rasters, which stand for the survey
_ROOM = __name__.rpartition(".")[0]
_MOST_LEVELS = 1_000_000  # of detection, whose median is stated
LOWERED, UNCHANGED, RAISED = 2, 1, 3  # in significant.tif; 0: not measured in both
_KINDS = {
    "difference": RasterKind("float32", (Band("later minus earlier height", "metre"),)),
    "sigma": RasterKind("float32", (Band("standard deviation of the difference", "metre"),)),
    "lod": RasterKind("float32", (Band("level of detection at 95 %", "metre"),)),
    "significant": RasterKind(
        "uint8", (Band("1 no significant change, 2 lowered, 3 raised; 0 not measured in both"),)
    ),
}


def run(stage: StageRun, options: ChangeOptions) -> Summary:
    """Write the change and return its figures.

    Raises:
        InputError: the σ of the datum is not known, and no registration was asked for.
        DegenerateGeometryError: both epochs have too little unchanged ground in common.
    """
    workspaces = Workspace(options.before), stage.workspace
    before, after = (epoch_rasters(one, options.of) for one in workspaces)
    epochs = load_epoch(workspaces[0]), load_epoch(workspaces[1])
    if options.along_normals:
        require_clouds(workspaces)
    registered = options.stable is not None or options.stable_auto
    tied, solved_again = tied_by(epochs, workspaces)
    for one, workspace in zip(epochs, workspaces, strict=True):
        if one.grid is None and not registered and tied is None:
            message = f"has no σ of its datum: {one.reason}. Register with --stable FILE or --stable-auto."
            raise InputError("datum-not-known", message, path=workspace.root)
    shared = shared_by(epochs[0].survey, epochs[1].survey, same_base=options.same_base)
    area = _polygons(options.boundary, "--boundary", after, options)
    grid = CommonGrid((before, after), epochs, shared, None if area is None else shapely.union_all(area), tied)
    stable = _polygons(options.stable, "--stable", after, options)
    ground = None if stable is None else shapely.union_all(stable)
    noise = unchanged_ground(
        grid.samples(ground, stage.progress), grid.cell_m, grid.datum_h_m, with_tilt=options.tilt
    )
    registration = _registration_of(noise, applied=registered, datum_v_m=grid.datum_v_m)
    parts = Parts(stage.out / "parts", grid)
    sign, median_lod_m = _write_rasters(stage, parts, noise, registered=registered)
    given = _polygons(options.regions, "--regions", after, options) or ()
    found = find_regions(parts, sign, noise, given, options.min_area)
    _write_significant(stage.out, parts, found.sign)
    moved = None
    if options.along_normals:
        datum = Datum(grid, noise, registered)
        moved = change_along_normals(workspaces, datum, options.reach, stage.out, stage.progress)
    change = Change(
        of=options.of,
        crs=after.sidecar.crs,
        cell_m=grid.cell_m,
        registration=registration,
        shared_control_points=shared.control,
        shared_sigma_v_m=float(np.sqrt(shared.by_control_m2[2] + shared.by_base_m2[2])),
        median_lod_m=median_lod_m,
        significant_share=float((found.sign != 0).mean()),
        lowered=found.lowered,
        raised=found.raised,
        found=found.every,
        regions=found.regions,
        along_normals=moved,
        common=None if tied is None else tied.common,
    )
    save_json(change, stage.out / "change.json")
    _write_vectors(stage.out, change, found.polygons, grid)
    if tied is not None:
        _write_common(stage.out, tied)
    remove(parts.folder)
    cautions = tuple(one.cautions for one in epochs)
    stale = tuple(remark for one in workspaces for remark in _stale_rasters(one))
    doubted = () if tied is None else _doubted(contradicted(tied, found.regions, found.polygons, grid.crs))
    summary = _summary(change, (*stale, *solved_again, *doubted), union(*cautions))
    compared = Compared(stage.out, change, found.polygons, grid, workspaces, tied)
    page = change_page(compared, summary.warnings, cautions, stage.progress)
    replace_text(stage.out / Path(CHANGE_PAGE).name, render_page(page, _ROOM))
    return summary


def _registration_of(noise: Noise, *, applied: bool, datum_v_m: float) -> Registration:
    """Return the record of a registration; `datum_v_m` is the σ of a vertical shift by both adjustments."""
    sigma = np.sqrt(np.diag(noise.shift_cov_m2))
    limit = QUANTILE_95 * float(np.hypot(datum_v_m, np.hypot(sigma[2], noise.long_range_m)))
    return Registration(
        applied=applied,
        shift_m=vector3(noise.shift_m),
        sigma_shift_m=vector3(sigma),
        tilt=(float(noise.tilt[0]), float(noise.tilt[1])),
        sigma_tilt=(float(noise.tilt_sigma[0]), float(noise.tilt_sigma[1])),
        datum_sigma_v_m=datum_v_m,
        long_range_sigma_m=noise.long_range_m,
        correlated_m2=noise.correlated_m2,
        correlation_length_m=noise.length_m,
        noise_factor=noise.scatter,
        stable_share=noise.share,
        contradicts=not applied and abs(float(noise.shift_m[2])) > limit,
    )


def _stale_rasters(workspace: Workspace) -> Iterator[Remark]:
    """Yield a warning if the rasters of an epoch are older than the survey and the adjustment beside them."""
    for row in status(workspace):
        if row.stage == "export-raster" and row.state in ("stale", "damaged"):
            sentence = f"The rasters of {workspace.root.name} are {row.state} ({row.reason}). "
            sentence += f"`georef export-raster {workspace.root}` makes them again."
            yield Remark(code="epoch-stale", sentence=sentence)


def _summary(change: Change, warnings: tuple[Remark, ...], cautions: tuple[Remark, ...]) -> Summary:
    found = change.regions
    cut, fill = sum(one.cut_m3 for one in found), sum(one.fill_m3 for one in found)
    registration = change.registration
    if registration.contradicts:
        sentence = (
            f"Unchanged ground lies {registration.shift_m[2]:+.3f} m apart in the epochs, more than the datum's σ "
            f"of {registration.datum_sigma_v_m:.3f} m explains. Register with --stable FILE or --stable-auto"
            f"{'' if change.common is not None else ', or tie the later epoch to the earlier (sfm --earlier)'}."
        )
        warnings = (*warnings, Remark(code="epochs-shifted", sentence=sentence))
    figure = f"{len(found)} regions, {cut:.1f} m³ cut, {fill:.1f} m³ fill, "
    figure += f"shift {registration.shift_m[2]:+.3f} ± {registration.sigma_shift_m[2]:.3f} m "
    figure += "applied" if registration.applied else "seen on unchanged ground, not applied"
    if change.common is not None:
        figure += f", {change.common.used} points in common, σ of the difference {change.common.sigma_v_m:.3f} m"
    values = {
        "regions": len(found),
        "cut_m3": cut,
        "fill_m3": fill,
        "shift_m": registration.shift_m,
        "sigma_shift_m": registration.sigma_shift_m,
        "registered": registration.applied,
        "datum_sigma_v_m": registration.datum_sigma_v_m,
        "long_range_sigma_m": registration.long_range_sigma_m,
        "correlated_m2": registration.correlated_m2,
        "common": None if change.common is None else change.common.model_dump(),
        "significant_share": change.significant_share,
    }
    return Summary(figure, values, warnings, cautions)


def _polygons(path: Path | None, field: str, after: EpochRasters, options: ChangeOptions) -> tuple[Any, ...] | None:
    """Return the polygons of a file in the plan of the rasters; None: no file."""
    if path is None:
        return None
    crs = parse_crs(after.sidecar.crs_wkt)
    west, south, east, north = after.frame.bounds
    across, up = np.meshgrid(np.linspace(west, east, _PLACES), np.linspace(south, north, _PLACES))
    places = crs.lla_from_xyz(np.column_stack([across.ravel(), up.ravel(), np.zeros(across.size)]))
    found = read_outlines(
        path,
        places,
        field=field,
        crs=options.polygons_crs,
        crs_field="--polygons-crs",
        one_site=field == "--boundary",
    )

    def moved(one: Outlines) -> list[Any]:
        def to_rasters(plan: NDArray[Any]) -> NDArray[Any]:
            return crs.xyz_from_lla(one.lla(plan, path))[:, :2]

        return [shapely.transform(part, to_rasters) for part in one.polygons]

    return tuple(part for one in found for part in moved(one))


def _registered(cells: Cells, grid: CommonGrid, window: Window, noise: Noise, *, registered: bool) -> Cells:
    """Return cells after the registration, with the σ that their neighbours share."""
    if not registered:
        return replace(cells, datum_m=np.maximum(cells.datum_m, noise.long_range_m))
    moved = noise.moved_by(cells.slope, grid.place_m(window))
    datum = np.hypot(np.sqrt(noise.shift_cov_m2[2, 2]), noise.long_range_m)
    return replace(cells, difference_m=cells.difference_m - moved, datum_m=np.full(cells.difference_m.shape, datum))


def _write_rasters(
    stage: StageRun, parts: Parts, noise: Noise, *, registered: bool
) -> tuple[NDArray[np.int8], float]:
    """Write the rasters, keep their parts, and return the sign of all changes and the median level of detection."""
    grid, reach = parts.grid, reach_of(parts.grid, noise)
    parts.folder.mkdir(exist_ok=True)
    sign = np.zeros((grid.frame.rows, grid.frame.columns), dtype=np.int8)
    windows, levels = list(grid.windows()), []
    with stage.progress.task("windows", len(windows)) as task:
        for window in windows:
            wide, own = grid.around(window, reach)
            cells = _registered(grid.cells(wide), grid, wide, noise, registered=registered)
            lod = level_of_detection(cells, noise.factor)
            sign[window.slices] = significant_change(cells, noise.factor, reach)[own]
            known = np.isfinite(cells.difference_m[own])
            bands = {
                "difference": cells.difference_m[own],
                "sigma": np.where(known, lod[own] / QUANTILE_95, np.nan),
                "lod": np.where(known, lod[own], np.nan),
                "datum": np.where(known, cells.datum_m[own], np.nan),
                "variance": np.where(known, cells.variance_m2[own], np.nan),
                "step": cells.step_m2[own],
                "measured": (known & cells.is_measured[own]).astype(np.uint8),
            }
            for name, values in bands.items():
                parts.write(name, window, values)
            certain = lod[own][cells.is_certain[own]]
            levels.append(certain[:: max(len(certain) * len(windows) // _MOST_LEVELS, 1)])
            task.advance()
    for name in ("difference", "sigma", "lod"):
        _write_mosaic(stage.out, parts, name)
    return sign, float(np.median(np.concatenate(levels)))


def _write_significant(folder: Path, parts: Parts, sign: NDArray[np.int8]) -> None:
    for window in parts.grid.windows():
        change = sign[window.slices]
        classes = np.select([~parts.measured(window), change < 0, change > 0], [0, LOWERED, RAISED], UNCHANGED)
        parts.write("significant", window, classes.astype(np.uint8))
    _write_mosaic(folder, parts, "significant")


def _write_mosaic(folder: Path, parts: Parts, name: str) -> None:
    places = [(parts.path(name, window), window.column, window.row) for window in parts.grid.windows()]
    write_mosaic(folder / f"{name}.tif", places, parts.grid.frame, _KINDS[name], {})


def _doubted(names: list[str]) -> tuple[Remark, ...]:
    """Return the warning of regions that their own points in common contradict; none without."""
    if not names:
        return ()
    sentence = (
        f"In {listed(names)}, points in common lie where they lay at the other date, although the surfaces differ: "
        "one of both is wrong there. Compare the photographs before you count the volume."
    )
    return (Remark(code="region-contradicted", sentence=sentence),)


def _write_common(folder: Path, tied: Tied) -> None:
    """Write the points in common with their later minus earlier place."""
    rows = zip(tied.lla(), tied.used.tolist(), np.round(tied.missed_m, 4).tolist(), strict=True)
    features = [
        feature(
            {"type": "Point", "coordinates": np.round(lla[[1, 0]], 8).tolist()},
            {"used": used, "east_m": missed[0], "north_m": missed[1], "up_m": missed[2]},
        )
        for lla, used, missed in rows
    ]
    replace_text(folder / "common_points.geojson", features_text(features))


def _write_vectors(folder: Path, change: Change, polygons: list[Any], grid: CommonGrid) -> None:
    def in_wgs84(plan: NDArray[Any]) -> NDArray[Any]:
        lla = grid.crs.lla_from_xyz(np.column_stack([plan, np.zeros(len(plan))]))
        return np.round(lla[:, [1, 0]], 8)

    rows = [region.model_dump() for region in change.regions]
    features = [
        feature(shapely.geometry.mapping(shapely.orient_polygons(shapely.transform(one, in_wgs84))), row)
        for one, row in zip(polygons, rows, strict=True)
    ]
    replace_text(folder / "regions.geojson", features_text(features))
    write_polygons_gpkg(folder / "regions.gpkg", "regions", polygons, rows, grid.frame.wkt)
    heads = list(ChangedRegion.model_fields)
    replace_text(folder / "regions.csv", table_text([heads, *([row[name] for name in heads] for row in rows)]))

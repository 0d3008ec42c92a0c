"""Stage `change`: what differs between the rasters of two epochs, by how much, and whether it is real.

Reads the rasters, surveys and adjustments of both workspaces. Writes `change/` in the later one: `difference.tif`,
`sigma.tif`, `lod.tif`, `significant.tif`, `regions.geojson`, `regions.gpkg`, `regions.csv`, `change.json` and the
page `change.html`; on request `along_normals.laz`.
"""

from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from pipelines.change.along_normals import Datum, change_along_normals, require_clouds
from pipelines.change.datum import Epoch, load_epoch, same_photographs, shared_by
from pipelines.change.detection import (
    QUANTILE_95,
    Noise,
    level_of_detection,
    significant_change,
)
from pipelines.change.grid import (
    DOUBTFUL,
    LOWERED,
    RAISED,
    UNCHANGED,
    CommonGrid,
    EpochRasters,
    epoch_rasters,
)
from pipelines.change.options import ChangeOptions
from pipelines.change.own_points import contradicted_by_own_points, noise_of
from pipelines.change.page import Compared, change_page
from pipelines.change.regions import (
    DoubtfulRegions,
    FoundRegions,
    RasterParts,
    find_regions,
    reach_of,
    without_doubtful,
)
from pipelines.change.tied import Contradicted, Surfaces, Tied, contradicted, tied_by
from pipelines.change.volumes_by_date import Ground, volumes_by_date
from pipelines.core.errors import InputError
from pipelines.core.files import remove, replace_text
from pipelines.core.products import Remark, save_json, union
from pipelines.core.sentences import listed
from pipelines.core.stages import CHANGE_PAGE
from pipelines.core.staleness import status
from pipelines.core.types import BoolArray, FloatArray, vector3
from pipelines.core.workspace import StageRun, Summary, Workspace
from pipelines.formats.geotiff import Band, RasterKind, sampled_raster, write_mosaic
from pipelines.formats.tables import table_text
from pipelines.formats.vector_files import feature, features_text, write_polygons_gpkg
from pipelines.geodesy.crs import parse_crs
from pipelines.report.page import render_page
from pipelines.survey.boundaries import Outlines, read_outlines
from pipelines.survey.change_report import Change, ChangedRegion, EpochShift, RegionAtDate

_MOSTLY_KNOWN = 0.95  # share of a given polygon with heights of both dates, below which a warning says so
_PLACES = 20  # along each side of the rasters, which stand for the survey
_ROOM = __name__.rpartition(".")[0]
_MOST_LEVELS = 1_000_000  # of detection, whose median is stated
_MOST_TWICE = 0.5  # of the photographs of an epoch: more are one flight
# Reasons of doubtful regions, and codes of their warnings: by points in common, and by a date's own tie points.
DOUBTED, OFF_POINTS = "region-contradicted", "surface-contradicted"
_WHY = {
    DOUBTED: "points in common lie where they lay at the other date, although the surfaces differ there",
    OFF_POINTS: "a surface lies beside the tie points of its own photographs there",
}
_KINDS = {
    "difference": RasterKind("float32", (Band("later minus earlier height", "metre"),)),
    "sigma": RasterKind("float32", (Band("standard deviation of the difference", "metre"),)),
    "lod": RasterKind("float32", (Band("level of detection at 95 %", "metre"),)),
    "significant": RasterKind(
        "uint8", (Band("1 no significant change, 2 lowered, 3 raised, 4 doubtful; 0 not measured in both"),)
    ),
}


def run(stage: StageRun, options: ChangeOptions) -> Summary:
    """Write the change and return its figures.

    Raises:
        InputError: the σ of the datum is not known, and no registration was asked for; or both epochs are one
            flight.
        DegenerateGeometryError: both epochs have too little unchanged ground in common.
    """
    workspaces = Workspace(options.before), stage.workspace
    before, after = (epoch_rasters(one, options.of) for one in workspaces)
    epochs = load_epoch(workspaces[0]), load_epoch(workspaces[1])
    if options.along_normals:
        require_clouds(workspaces)
    twice = tuple(_twice(epochs, workspaces[0]))
    registered = options.is_registered
    tied, solved_again = tied_by(epochs, workspaces)
    for one, workspace in zip(epochs, workspaces, strict=True):
        if one.grid is None and not registered and tied is None:
            message = f"has no σ of its datum: {one.reason}. Register with --stable FILE or --stable-auto."
            raise InputError("datum-not-known", message, path=workspace.root)
    shared = shared_by(epochs[0].survey, epochs[1].survey, same_base=options.same_base)
    area = _polygons(options.boundary, "--boundary", after, options)
    inside = None if area is None else shapely.union_all(area)
    grid = CommonGrid((before, after), epochs, shared, inside, tied)
    stable = _polygons(options.stable, "--stable", after, options)
    ground = None if stable is None else shapely.union_all(stable)
    noise = noise_of(grid, ground, stage.progress, with_tilt=options.tilt)
    registration = _registration_of(noise, applied=registered, datum_v_m=grid.datum_v_m)
    parts = RasterParts(stage.out / "parts", grid)
    sign, median_lod_m = _write_rasters(stage, parts, noise, registered=registered)
    given = _polygons(options.regions, "--regions", after, options) or ()
    found = find_regions(parts, sign, noise, given, options.min_area)
    found, doubtful, partly = _counted(found, tied, noise, parts)
    _write_significant(stage.out, parts, found.sign, doubtful.inside)
    moved = None
    if options.along_normals:
        datum = Datum(grid, noise, registered)
        moved = change_along_normals(workspaces, datum, options.reach, stage.out, stage.progress)
    where = Ground(grid.crs, inside, ground)
    by_date, left_out = ((), ()) if tied is None else volumes_by_date(tied, found, where, options, stage.progress)
    significant, doubted = int((found.sign != 0).sum()), int(doubtful.inside.sum())
    change = Change(
        of=options.of,
        crs=after.sidecar.crs,
        cell_m=grid.cell_m,
        registration=registration,
        shared_control_points=shared.control,
        shared_sigma_v_m=float(np.sqrt(shared.by_control_m2[2] + shared.by_base_m2[2])),
        median_lod_m=median_lod_m,
        significant_share=significant / found.sign.size,
        doubtful_share=doubted / max(significant + doubted, 1),
        lowered=found.lowered,
        raised=found.raised,
        found=found.every,
        regions=found.regions,
        doubtful=doubtful.regions,
        unmeasured=dict(found.unmeasured),
        along_normals=moved,
        common=None if tied is None else tied.common,
        by_date=by_date,
    )
    save_json(change, stage.out / "change.json")
    _write_vectors(stage.out, change, found.polygons, doubtful.polygons, grid)
    if tied is not None:
        _write_common(stage.out, tied)
    remove(parts.folder)
    cautions = tuple(one.cautions for one in epochs)
    stale = tuple(remark for one in workspaces for remark in _stale_rasters(one))
    of_regions = (*_doubted(found, doubtful, partly), *_partly_known(found))
    warnings = (*stale, *twice, *solved_again, *left_out, *of_regions)
    summary = _summary(change, warnings, union(*cautions))
    compared = Compared(stage.out, change, found.polygons, grid, workspaces, tied, doubtful.polygons)
    page = change_page(compared, summary.warnings, cautions, stage.progress)
    replace_text(stage.out / Path(CHANGE_PAGE).name, render_page(page, _ROOM))
    return summary


def _registration_of(noise: Noise, *, applied: bool, datum_v_m: float) -> EpochShift:
    """Return the record of a registration; `datum_v_m` is the σ of a vertical shift by both adjustments."""
    sigma = np.sqrt(np.diag(noise.shift_cov_m2))
    limit = QUANTILE_95 * float(np.hypot(datum_v_m, np.hypot(sigma[2], noise.long_range_m)))
    return EpochShift(
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


def _twice(epochs: tuple[Epoch, Epoch], before: Workspace) -> Iterator[Remark]:
    """Yield a warning if some photographs are in both epochs: ground that they show has not changed between them.

    Raises:
        InputError: most of an epoch's photographs are the other's; the surfaces then differ by training alone.
    """
    surveys = [epoch.survey for epoch in epochs]
    names = same_photographs(*surveys)
    if len(names) > _MOST_TWICE * min(len(survey.images) for survey in surveys):
        message = (
            f"has {len(names)} of its {len(surveys[0].images)} photographs in common with the later survey: both "
            "are of one flight, and their surfaces differ by the errors of two solutions alone."
        )
        raise InputError("same-photographs", message, path=before.root)
    if names:
        sentence = (
            f"{len(names)} photographs of the later survey are in the earlier one, too: {listed(names)}. They show "
            "no change between the epochs."
        )
        yield Remark(code="photographs-in-both", sentence=sentence, remedy="Remove them from one of the surveys.")


def _stale_rasters(workspace: Workspace) -> Iterator[Remark]:
    """Yield a warning if the rasters of an epoch are older than the survey and the adjustment beside them."""
    for row in status(workspace):
        if row.stage == "export-raster" and row.state in ("stale", "damaged"):
            sentence = f"The rasters of {workspace.root.name} are {row.state} ({row.reason})."
            remedy = f"`georef export-raster {workspace.root}` makes them again."
            yield Remark(code="epoch-stale", sentence=sentence, remedy=remedy)


def _summary(change: Change, warnings: tuple[Remark, ...], cautions: tuple[Remark, ...]) -> Summary:
    regions = change.regions
    cut, fill = sum(one.cut_m3 for one in regions), sum(one.fill_m3 for one in regions)
    registration = change.registration
    if registration.contradicts:
        sentence = (
            f"Unchanged ground lies {registration.shift_m[2]:+.3f} m apart in the epochs, more than the datum's σ "
            f"of {registration.datum_sigma_v_m:.3f} m explains."
        )
        remedy = (
            "Register with --stable FILE or --stable-auto"
            f"{'' if change.common is not None else ', or tie the later epoch to the earlier (sfm --earlier)'}."
        )
        warnings = (*warnings, Remark(code="epochs-shifted", sentence=sentence, remedy=remedy))
    figure = f"{len(regions)} regions, {cut:.1f} m³ cut, {fill:.1f} m³ fill, "
    if change.doubtful:
        figure += f"{len(change.doubtful)} doubtful, "
    figure += f"shift {registration.shift_m[2]:+.3f} ± {registration.sigma_shift_m[2]:.3f} m "
    figure += "applied" if registration.applied else "seen on unchanged ground, not applied"
    if change.common is not None:
        figure += f", {change.common.used} points in common, σ of the difference {change.common.sigma_v_m:.3f} m"
    values = {
        "regions": len(regions),
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
        "doubtful_regions": len(change.doubtful),
        "doubtful_share": change.doubtful_share,
        "by_date": [one.model_dump() for one in change.by_date],
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
    outlines = read_outlines(
        path,
        places,
        field=field,
        crs=options.polygons_crs,
        crs_field="--polygons-crs",
        one_site=field == "--boundary",
    )

    def moved(one: Outlines) -> list[Any]:
        def to_rasters(plan: FloatArray) -> NDArray[Any]:
            return crs.xyz_from_lla(one.lla(plan, path))[:, :2]

        return [shapely.transform(part, to_rasters) for part in one.polygons]

    return tuple(part for one in outlines for part in moved(one))


def _write_rasters(
    stage: StageRun, parts: RasterParts, noise: Noise, *, registered: bool
) -> tuple[NDArray[np.int8], float]:
    """Write the rasters, keep their parts, and return the sign of all changes and the median level of detection."""
    grid, reach = parts.grid, reach_of(parts.grid, noise)
    parts.folder.mkdir(exist_ok=True)
    sign = np.zeros((grid.frame.rows, grid.frame.columns), dtype=np.int8)
    windows, levels = list(grid.windows()), []
    with stage.progress.task("windows", len(windows)) as task:
        for window in windows:
            wide, core = grid.around(window, reach)
            cells = grid.registered(wide, noise, applied=registered)
            lod = level_of_detection(cells, noise.factor)
            sign[window.slices] = significant_change(cells, noise.factor, reach)[core]
            known = np.isfinite(cells.difference_m[core])
            bands = {
                "difference": cells.difference_m[core],
                "sigma": np.where(known, lod[core] / QUANTILE_95, np.nan),
                "lod": np.where(known, lod[core], np.nan),
                "datum": np.where(known, cells.datum_m[core], np.nan),
                "variance": np.where(known, cells.variance_m2[core], np.nan),
                "step": cells.step_m2[core],
                "measured": (known & cells.is_measured[core]).astype(np.uint8),
            }
            for name, values in bands.items():
                parts.write(name, window, values)
            certain = lod[core][cells.is_certain[core]]
            levels.append(certain[:: max(len(certain) * len(windows) // _MOST_LEVELS, 1)])
            task.advance()
    for name in ("difference", "sigma", "lod"):
        _write_mosaic(stage.out, parts, name)
    return sign, float(np.median(np.concatenate(levels)))


def _write_significant(folder: Path, parts: RasterParts, sign: NDArray[np.int8], doubtful: BoolArray) -> None:
    for window in parts.grid.windows():
        change = sign[window.slices]
        cases = [~parts.measured(window), doubtful[window.slices], change < 0, change > 0]
        classes = np.select(cases, [0, DOUBTFUL, LOWERED, RAISED], UNCHANGED)
        parts.write("significant", window, classes.astype(np.uint8))
    _write_mosaic(folder, parts, "significant")


def _write_mosaic(folder: Path, parts: RasterParts, name: str) -> None:
    places = [(parts.path(name, window), window.column, window.row) for window in parts.grid.windows()]
    write_mosaic(folder / f"{name}.tif", places, parts.grid.frame, _KINDS[name], {})


def _counted(
    found: FoundRegions, tied: Tied | None, noise: Noise, parts: RasterParts
) -> tuple[FoundRegions, DoubtfulRegions, list[str]]:
    """Return the regions that count, those that points contradict, and the names of those in a part."""
    contradicts, grid = Contradicted(), parts.grid
    surfaces = Surfaces(grid.crs, partial(sampled_raster, parts.folder.parent / "difference.tif"), noise.length_m)
    by_own: tuple[int, ...] = ()
    if grid.rasters[0].of == "surface":
        by_own = contradicted_by_own_points(grid, found.regions, found.polygons, surfaces)
    if tied is not None:
        contradicts = contradicted(tied, found.regions, found.polygons, surfaces)
    reasons = dict.fromkeys(by_own, OFF_POINTS) | dict.fromkeys(contradicts.whole, DOUBTED)
    kept = [index for index in range(len(found.regions)) if index not in reasons]
    remaining, doubtful = without_doubtful(found, reasons, noise, grid.cell_m2)
    partly = [one.name for one, index in zip(remaining.regions, kept, strict=True) if index in contradicts.part]
    return remaining, doubtful, partly


def _doubted(found: FoundRegions, doubtful: DoubtfulRegions, partly: list[str]) -> Iterator[Remark]:
    """Yield the warnings of regions that points contradict as a whole, or in a part."""
    for reason, why in _WHY.items():
        of_reason = [index for index, region in enumerate(doubtful.regions) if region.reason == reason]
        if not of_reason:
            continue
        names = [doubtful.regions[index].name for index in of_reason]
        net_m3 = sum(doubtful.regions[index].net_m3 for index in of_reason)
        area = shapely.union_all([doubtful.polygons[index] for index in of_reason])
        given = [
            region.name
            for region, polygon in zip(found.regions, found.polygons, strict=True)
            if region.name.startswith("P") and area.intersects(polygon)
        ]
        sentence = (
            f"{listed(names)} of {net_m3:+.1f} m³ {'is' if len(names) == 1 else 'are'} doubtful and counted as no "
            f"change: {why}. One of both surfaces is wrong. Compare the photographs."
        )
        if given:
            sentence += f" The volumes of {listed(given)} count a part of it."
        yield Remark(code=reason, sentence=sentence)
    if partly:
        sentence = (
            f"In a part of {listed(partly)}, points in common lie where they lay at the other date, although the "
            "surfaces differ. Compare the photographs before you count the volume."
        )
        yield Remark(code="region-partly-contradicted", sentence=sentence)


def _partly_known(found: FoundRegions) -> Iterator[Remark]:
    """Yield the warnings of given regions of which much, or nearly all, has no height of one of the dates."""
    none = [f"{name} ({share:.0%})" for name, share in found.unmeasured.items()]
    if none:
        sentence = (
            f"{listed(none)} {'has' if len(none) == 1 else 'have'} no volume: hardly any of the polygon has a "
            "height of both dates, and that part lies along walls that one of them does not show whole."
        )
        yield Remark(code="region-not-measured", sentence=sentence)
    few = [f"{one.name} ({one.known_share:.0%})" for one in found.regions if one.known_share < _MOSTLY_KNOWN]
    if few:
        sentence = (
            f"The volumes of {listed(few)} are those of the part of the polygon that has a height of both dates. "
            "The rest was not measured at one of them, and is counted as nothing."
        )
        yield Remark(code="region-partly-known", sentence=sentence)


def _rows_by_date(change: Change) -> list[list[Any]]:
    """Return the head and the lines of the table of volumes by date."""
    of_region = [name if name != "name" else "region" for name in RegionAtDate.model_fields]
    rows: list[list[Any]] = [["date", "taken_on", "sigma_v_m", *of_region]]
    for date in change.by_date:
        rows += [[date.name, date.taken_on, date.sigma_v_m, *one.model_dump().values()] for one in date.regions]
    return rows


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


def _write_vectors(
    folder: Path,
    change: Change,
    polygons: list[shapely.Geometry],
    doubtful: list[shapely.Geometry],
    grid: CommonGrid,
) -> None:
    """Write the regions and the doubtful ones with their polygons, and the table of volumes by date."""
    _write_geojson(folder / "regions.geojson", change.regions, polygons, grid)
    if doubtful:
        _write_geojson(folder / "doubtful.geojson", change.doubtful, doubtful, grid)
    if change.by_date:
        replace_text(folder / "by_date.csv", table_text(_rows_by_date(change)))
    rows, doubted = ([region.model_dump() for region in each] for each in (change.regions, change.doubtful))
    layers = {"regions": (polygons, rows), **({"doubtful": (doubtful, doubted)} if doubtful else {})}
    write_polygons_gpkg(folder / "regions.gpkg", layers, grid.frame.wkt)
    heads = list(ChangedRegion.model_fields)
    replace_text(folder / "regions.csv", table_text([heads, *([row[name] for name in heads] for row in rows)]))


def _write_geojson(
    path: Path, regions: Sequence[ChangedRegion], polygons: list[shapely.Geometry], grid: CommonGrid
) -> None:
    """Write regions with their polygons, which are in the CRS of the grid, in WGS84."""

    def in_wgs84(plan: FloatArray) -> NDArray[Any]:
        lla = grid.crs.lla_from_xyz(np.column_stack([plan, np.zeros(len(plan))]))
        return np.round(lla[:, [1, 0]], 8)

    features = [
        feature(
            shapely.geometry.mapping(shapely.orient_polygons(shapely.transform(one, in_wgs84))), region.model_dump()
        )
        for one, region in zip(polygons, regions, strict=True)
    ]
    replace_text(path, features_text(features))

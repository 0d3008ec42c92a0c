"""Stage `export-raster`: orthophoto, surface model (DSM) and σ rasters in a CRS, contours, hillshade and preview.

Reads the survey, the trained model and the initial similarity. Writes `raster/orthophoto.tif`, `dsm.tif`, their σ,
`measured.tif` and, of the ground, `dtm.tif` as Cloud Optimized GeoTIFF, each with its sidecar, and pictures; with
`--contours` also `contours.gpkg` and `contours.dxf`, with `--bands` also `bands.tif`. The Gaussians are
rendered orthographically, and the photographs projected onto that surface, window by window: finished windows
survive an interruption.
"""

import json
import math
from pathlib import Path

import contourpy
import cv2
import numpy as np
from scipy.ndimage import gaussian_filter

from pipelines.core.errors import DegenerateGeometryError, InputError
from pipelines.core.files import remove, replace_text
from pipelines.core.products import Remark, union
from pipelines.core.types import BoolArray, FloatArray
from pipelines.core.workspace import StageRun, Summary
from pipelines.deliver.bands import BandPictures, band_pictures
from pipelines.deliver.options import ExportRasterOptions
from pipelines.deliver.photo_colours import ColourPictures, PhotoColours
from pipelines.deliver.placement import median_values, require_space, scene_sigma
from pipelines.deliver.raster_mosaic import Mosaic
from pipelines.deliver.raster_window import RasterSource, make_frame, raster_source
from pipelines.deliver.surface import without_sigma
from pipelines.formats.georef_sidecar import CrsSidecar, median_sigma, write_sidecar
from pipelines.formats.geotiff import RasterFrame, read_reduced
from pipelines.formats.vector_files import ContourLine, features_text, write_contours_dxf, write_contours_gpkg
from pipelines.geometry.relief import pale, sunlight
from pipelines.surface.measured_area import area_of
from pipelines.surface.surface_views import ModelRenderer, model_renderer
from pipelines.survey.area import corners, ground_sampling_m, scene_points
from pipelines.survey.headline import headline_of
from pipelines.survey.navigation import load_survey
from pipelines.survey.scene import photographs
from pipelines.survey.solution import TrainedModel, read_sfm, read_trained
from pipelines.survey.survey import Survey
from pipelines.survey.target_crs import TargetCrs, target_crs

_DETAIL = 1.5  # training pixels over cells, beyond which a raster shows less than its cells promise
# Bytes of a cell on the disk at most: colours, height, mask and two σ, as measured, whole and final rasters.
_BYTES_PER_CELL = 74
_BYTES_PER_BAND = 10  # of a cell, whole and final, with overviews
_PICTURE_PX = 2000
_COLOURED = 0.01, 0.99  # quantiles of the heights at the ends of the colours
# Of the contour lines.
_EVERY_MAJOR = 5
_LEAST_CELLS, _LEAST_INTERVALS = 12.0, 10.0  # length of the shortest line; a ring has twice as much
_SMOOTHED = 1.5  # cells: σ of the smoothing, without which every stone has its own line
_SMOOTHED_WITHIN = 5.0  # cells: σ of the smoothing where it moves the height by no more than its own σ
_MOST_LEVELS = 2_000
_CONTOUR_PX = 6000  # of the surface that lines are drawn of


def run(stage: StageRun, options: ExportRasterOptions) -> Summary:
    """Write rasters, pictures and contours, return their figures; a DegenerateGeometryError: no cell was seen."""
    model = read_trained(stage.workspace)
    sfm, survey = read_sfm(stage.workspace, model), model.weighted(load_survey(stage.workspace))
    points, gsd_m = scene_points(model, sfm), ground_sampling_m(model, sfm)
    assert gsd_m is not None  # a training has points
    target = target_crs(options, survey.origin, corners(points), survey.vertical)
    area = area_of(options, stage.workspace, model, sfm, survey, progress=stage.progress)
    polygon = area.in_crs(target)
    frame = make_frame(polygon.bounds, target, gsd_m, options)
    size = f"{frame.columns} × {frame.rows} cells"
    bands = options.bands * (len({each.camera_id for each in survey.companions}) + 2)
    needed_bytes = (_BYTES_PER_CELL + _BYTES_PER_BAND * bands) * frame.columns * frame.rows
    require_space(stage.out, needed_bytes, f"rasters of {size}", "give a larger --gsd")
    pictures: BandPictures | None = None
    remarks: tuple[Remark, ...] = ()
    if options.bands:
        pictures, remarks = band_pictures(stage.workspace, model, sfm, survey, stage.progress)
    renderer = model_renderer(stage.workspace, model, sfm, survey, progress=stage.progress)
    source, reason, warnings = raster_source(stage, renderer, target, frame, area, options=options)
    fill = options.fill if area.is_outline or options.fill == 0 else "all"
    mosaic = Mosaic(
        stage.out / "parts", frame, target, polygon,
        has_terrain=source.terrain is not None, fill=fill, photo_m=gsd_m,
    )  # fmt: skip
    mosaic.render(source, stage.progress)
    _colour(stage, mosaic, renderer, survey, source, bands=pictures, options=options)
    height = mosaic.sample("dsm")
    if not len(height):
        message = f"No cell is seen by {options.min_views} training views or more."
        remedy = "Train longer, or lower --min-views."
        raise DegenerateGeometryError("no-raster-cells", message, remedy=remedy)
    sidecar = _sidecar(stage, model, mosaic, source, height, options=options, no_sigma=reason)
    terrain = sidecar if source.terrain is None else _sidecar_of_terrain(sidecar, mosaic)
    sidecars = {"dtm": terrain, "sigma_dtm": terrain}
    for path, file_sidecar in mosaic.write(stage.out, lambda name: sidecars.get(name, sidecar), stage.progress):
        write_sidecar(file_sidecar, path)
    holes = mosaic.interpolated_parts(stage.out / "measured.tif")
    replace_text(stage.out / "interpolated.geojson", features_text(holes))
    height_colours = None
    if options.hillshade:
        height_colours = _write_pictures(stage.out, target.horizontal_unit_m / target.crs.height_unit_m)
    of_ground = options.contours_of == "terrain" and source.terrain is not None
    names = ("dtm.tif", "sigma_dtm.tif") if of_ground else ("dsm.tif", "sigma_v.tif")
    lines = _write_contours(stage.out, names, frame, target, options.contours)
    measured, interpolated, delivered_ha = mosaic.shares()
    values = {
        "columns": frame.columns,
        "rows": frame.rows,
        "gsd": frame.step_x,
        "gsd_photographs_m": gsd_m,
        "gsd_training_m": source.training_gsd_m,
        "crs": target.crs.name,
        "heights": target.crs.vertical.name,
        "units": target.crs.units,
        "bounds": sidecar.bounds,
        "map": height_colours
        and {
            "names": target.axes,
            "unit": target.crs.short_units[0],
            "unit_m": target.horizontal_unit_m,
            "height_unit": target.crs.short_units[2],
            "height_colours": height_colours,
        },
        "area_ha": area.hectares,
        "delivered_ha": delivered_ha,
        "measured": measured,
        "interpolated": interpolated,
        "photographed": mosaic.photographed(),
        **median_values(sidecar.sigma, "cell"),
        "bands": [] if pictures is None else [band.description for band in pictures.bands.described()],
        "contour_lines": lines,
        "assumed": "; ".join(target.assumed),
    }
    source.views.close()
    remove(mosaic.folder)
    figure = (
        f"{size} of {frame.step_x:g} {target.crs.units[0]} in {target.crs.name}, {measured:.0%} of "
        f"{delivered_ha:.3g} ha measured, {interpolated:.0%} interpolated"
    )
    return Summary(figure + median_sigma(sidecar.sigma, "cells"), values, (*warnings, *remarks), sidecar.cautions)


def _colour(
    stage: StageRun,
    mosaic: Mosaic,
    renderer: ModelRenderer,
    survey: Survey,
    source: RasterSource,
    *,
    bands: BandPictures | None,
    options: ExportRasterOptions,
) -> None:
    """Colour the orthophoto by the photographs, and on request its bands; keep on request what cells are from."""
    model, sfm = renderer.model, renderer.sfm
    longest_px = max(max(camera.width, camera.height) for camera in sfm.cameras.values())
    images = photographs(model.with_lenses(sfm), survey, stage.workspace, longest_px)
    if options.colours == "photographs":
        colours = PhotoColours(source, images, ColourPictures(model, sfm, source, images))
        mosaic.colour(colours, stage.progress)
        if options.source:
            mosaic.add_source()
            replace_text(stage.out / "source.json", json.dumps(["", *sfm.image_name], indent=1))
    if bands is not None:
        mosaic.add_bands(PhotoColours(source, images, bands), bands.bands, stage.progress)


def _sidecar(
    stage: StageRun,
    model: TrainedModel,
    mosaic: Mosaic,
    source: RasterSource,
    height: FloatArray,
    *,
    options: ExportRasterOptions,
    no_sigma: str,
) -> CrsSidecar:
    """Return the sidecar of the rasters of the surface, with heights (K,) of their cells.

    `no_sigma` says why σ is not known.
    """
    sigma = None
    if not no_sigma:
        counts = "georeference, cameras and lens; the surface's own noise between training views; interpolation"
        sigma = scene_sigma(counts, mosaic.sample("sigma_h"), mosaic.sample("sigma_v"))
    west, south, east, north = mosaic.frame.bounds
    bounds = [[west, south, height.min()], [east, north, height.max()]]
    what = "Heights show" if options.colours == "photographs" else "Heights and colours show"
    pixels = f"the training's pixels of {source.training_gsd_m:.3f} m"
    detail = f"{what} no finer detail than {pixels}, whatever the cell size."
    coarse = (Remark(code="detail-of-training", sentence=detail),) if source.training_px > _DETAIL else ()
    empty = "The rasters state no σ, and sigma_h.tif and sigma_v.tif are empty"
    cautions = union(model.cautions, (*coarse, *without_sigma(empty, no_sigma)))
    return source.target.sidecar(bounds, headline_of(stage.workspace), sigma, cautions)


def _sidecar_of_terrain(sidecar: CrsSidecar, mosaic: Mosaic) -> CrsSidecar:
    """Return the sidecar of the ground below the surface: its own heights, and the σ of where it is bridged."""
    height, vertical_m = mosaic.sample("dtm"), mosaic.sample("sigma_dtm")
    (west, south, _), (east, north, _) = bounds = sidecar.bounds
    if len(height):
        bounds = ((west, south, float(height.min())), (east, north, float(height.max())))
    sigma = None
    if sidecar.sigma is not None and len(vertical_m):
        counts = f"{sidecar.sigma.counts}; the ground below houses and trees"
        sigma = scene_sigma(counts, mosaic.sample("sigma_h"), vertical_m)
    return sidecar.model_copy(update={"bounds": bounds, "sigma": sigma})


def _write_contours(
    folder: Path, names: tuple[str, str], frame: RasterFrame, target: TargetCrs, interval: float | None
) -> int:
    """Write the contour lines of a raster of the folder with its σ, and return their number."""
    if not interval:
        return 0
    height, sigma_m = (read_reduced(folder / name, _CONTOUR_PX)[0][0].astype(np.float64) for name in names)
    within = np.nan_to_num(sigma_m) / target.crs.height_unit_m
    least = _LEAST_INTERVALS * interval * target.crs.height_unit_m / target.horizontal_unit_m
    lines = contour_lines(height, within, frame, interval, least)
    write_contours_gpkg(folder / "contours.gpkg", lines, frame.wkt)
    write_contours_dxf(folder / "contours.dxf", lines)
    return len(lines)


def _write_pictures(folder: Path, heights_by_plan: float) -> tuple[float, float]:
    """Write `preview.png` and `hillshade.png` of the rasters in a folder, transparent where there is no surface.

    Return the heights at the ends of the hillshade's colours.

    Args:
        folder: has `orthophoto.tif` and `dsm.tif`.
        heights_by_plan: horizontal unit over the unit of the heights.
    """
    rgba, _ = read_reduced(folder / "orthophoto.tif", _PICTURE_PX)
    cv2.imwrite(str(folder / "preview.png"), np.ascontiguousarray(np.moveaxis(rgba, 0, 2)[..., [2, 1, 0, 3]]))
    bands, cell = read_reduced(folder / "dsm.tif", _PICTURE_PX)
    height, known = bands[0], np.isfinite(bands[0])
    alpha = np.where(known, 255, 0).astype(np.uint8)
    light = sunlight(np.where(known, height, np.nanmedian(height)), cell * heights_by_plan)
    grey = np.round(255 * np.clip(light, 0.0, 1.0))
    low, high = np.nanquantile(height, _COLOURED)
    level = np.clip((np.nan_to_num(height, nan=low) - low) / max(high - low, 1e-6), 0.0, 1.0)
    colours = cv2.applyColorMap(np.asarray(255 * level, dtype=np.uint8), cv2.COLORMAP_TURBO)
    shaded = pale(np.asarray(colours / 255.0, dtype=np.float64)) * grey[..., None]
    cv2.imwrite(str(folder / "hillshade.png"), np.dstack([shaded.astype(np.uint8), alpha]))
    return float(low), float(high)


def contour_lines(
    height: FloatArray, within: FloatArray, frame: RasterFrame, interval: float, least: float
) -> list[ContourLine]:
    """Return contour lines of a surface, lowest first, no scraps and no small rings.

    An InputError: the interval is too small.

    Args:
        height: (H, W) rows from the north, over the whole frame; NaN: no surface.
        within: (H, W) by which smoothing may move a height: its σ; 0: not known.
        frame: of the raster, whose cells may be smaller.
        interval: between two lines, in the unit of the heights.
        least: length of the shortest line in the unit of the plan; a ring has twice as much.
    """
    known = np.isfinite(height)
    if known.sum() < 4:
        return []
    low, high = np.nanquantile(height, [0.0005, 0.9995])
    levels = interval * np.arange(math.ceil(low / interval), math.floor(high / interval) + 1)
    if len(levels) > _MOST_LEVELS:
        message = f"The interval makes {len(levels)} contour heights, more than {_MOST_LEVELS}."
        remedy = "Give a larger interval."
        raise InputError("contour-interval", message, field="--contours", remedy=remedy)
    west, south, east, north = frame.bounds
    step = (east - west) / height.shape[1], (north - south) / height.shape[0]
    x = west + (np.arange(height.shape[1]) + 0.5) * step[0]
    y = north - (np.arange(height.shape[0]) + 0.5) * step[1]
    fine, broad = (_smoothed(height, known, cells) for cells in (_SMOOTHED, _SMOOTHED_WITHIN))
    smooth = np.ma.masked_where(~known, np.clip(broad, fine - within, fine + within))
    least = max(least, _LEAST_CELLS * step[0])
    generator = contourpy.contour_generator(x, y, smooth)
    lines = []
    for level in levels:
        for xy in generator.lines(float(level)):
            points = np.asarray(xy)
            length = float(np.linalg.norm(np.diff(points, axis=0), axis=1).sum())
            is_ring = bool(np.array_equal(points[0], points[-1]))
            if length >= least * (2 if is_ring else 1):
                lines.append(ContourLine(float(level), points, round(level / interval) % _EVERY_MAJOR == 0))
    return lines


def _smoothed(height: FloatArray, known: BoolArray, cells: float) -> FloatArray:
    """Return heights (H, W) smoothed by a Gaussian of so many cells, in which unknown cells take no part."""
    weight = gaussian_filter(known.astype(np.float64), cells, mode="constant")
    return np.asarray(
        gaussian_filter(np.where(known, height, 0.0), cells, mode="constant") / np.maximum(weight, 1e-9)
    )

"""Plan of the rasters, and the cells of one window: colour, height and σ.

The frame has cells on whole multiples of their size, over the area; it is checked before the work begins. Every
Gaussian goes through ENU → ECEF → CRS by itself: its centre exactly, its covariance by the derivative of that way,
which varies so slowly that it is taken from a few nodes over the scene. A window is rendered from above, and
checked by what the training views show.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from scipy.interpolate import RegularGridInterpolator
from scipy.ndimage import binary_closing, binary_opening, uniform_filter
from scipy.spatial import cKDTree

from pipelines.adjust.accuracy_grid import AccuracyGrid
from pipelines.core.errors import DegenerateGeometryError, InputError
from pipelines.core.products import Remark
from pipelines.core.types import BoolArray, ByteArray, FloatArray
from pipelines.core.workspace import StageRun
from pipelines.deliver.options import ExportRasterOptions
from pipelines.deliver.surface import ground_below, predicted_sigma, surface_views
from pipelines.formats.geotiff import RasterFrame
from pipelines.geometry.similarity import Similarity
from pipelines.geometry.sparse_model import SparseModel
from pipelines.splat.gaussians import Gaussians, rotation_matrices
from pipelines.splat.rasterizer.orthographic import PlanSplats, PlanView, render_orthographic
from pipelines.splat.sh import basis
from pipelines.surface.ground import GroundModel
from pipelines.surface.surface_views import ModelRenderer, SurfaceViews
from pipelines.survey.area import Area, depths_of_observations, scene_points
from pipelines.survey.solution import Solution, TrainedModel
from pipelines.survey.target_crs import TargetCrs

_CHUNK = 1 << 17
_NODES = 5  # along each axis of the scene
_STEP_M = 1.0
_ABOVE = 1.0  # unit of the heights, between the level from which depths count and the highest centre
_MOST_REACH = 3.34  # standard deviations at which an opaque Gaussian falls below 1/255
_VIEWS_OF_COLOUR = 4
_DILATION_PX2 = 0.3  # of the training, in its pixels
_LARGEST_DEG = 0.01  # about a kilometre


def training_pixel_m(model: TrainedModel, sfm: SparseModel) -> float:
    """Return the median size at the SfM points of a pixel of the photographs as the model was trained with them."""
    depth_m, focal_px = depths_of_observations(model, sfm)
    cameras = [sfm.camera_of(index) for index in range(len(sfm.image_name))]
    longest_px = np.array([max(camera.width, camera.height) for camera in cameras])
    reduced = np.maximum(longest_px / model.max_image_size, 1.0)[sfm.obs_image]
    return float(np.median(depth_m / focal_px * reduced))


def make_frame(
    bounds: Sequence[float], target: TargetCrs, default_gsd_m: float, options: ExportRasterOptions
) -> RasterFrame:
    """Return the frame of the rasters.

    Args:
        bounds: west, south, east, north of the area in the CRS.
        target: the CRS.
        default_gsd_m: size of a cell in metres without `--gsd`.

    Raises:
        InputError: a geocentric CRS, a geographic CRS without a size in degrees, or too many cells.
    """
    crs = target.crs
    if crs.is_geocentric:
        message = f"{crs.name} is geocentric and has no map plane."
        remedy = "Give a projected CRS, such as EPSG:32632."
        raise InputError("crs-geocentric", message, field="--crs", remedy=remedy)
    if crs.is_geographic and options.gsd is None:
        message = f"{crs.name} has coordinates in {crs.units[0]}s."
        remedy = "Give the cell size in that unit, such as --gsd 0.000001, or a projected CRS."
        raise InputError("gsd-in-degrees", message, field="--gsd", remedy=remedy)
    if crs.is_geographic and options.gsd is not None and options.gsd > _LARGEST_DEG:
        message = (
            f"The unit of {crs.name} is the {crs.units[0]}, not the metre, and {options.gsd:g} "
            f"{crs.units[0]}s are more than a kilometre."
        )
        remedy = "Give the cell size in that unit, such as --gsd 0.000001."
        raise InputError("gsd-too-large", message, field="--gsd", remedy=remedy)
    step = _readable(default_gsd_m / crs.horizontal_unit) if options.gsd is None else options.gsd
    west, south, east, north = bounds
    west, south = np.floor(west / step), np.floor(south / step)
    east, north = np.ceil(east / step), np.ceil(north / step)
    columns, rows = int(east - west), int(north - south)
    if columns * rows > options.max_pixels:
        enough = step * math.sqrt(columns * rows / options.max_pixels)
        message = (
            f"A cell size of {step:g} {crs.units[0]} makes {columns} × {rows} = {columns * rows:.3g} "
            f"cells, more than --max-pixels {options.max_pixels:.3g}."
        )
        remedy = f"Give --gsd {enough:.2g} or larger, or a larger --max-pixels."
        raise InputError("too-many-cells", message, field="--gsd", remedy=remedy)
    return RasterFrame(crs.wkt1, west * step, north * step, step, step, columns, rows)


def _readable(gsd: float) -> float:
    """Return a size rounded up to two digits, which people can copy."""
    digit = 10.0 ** (math.floor(math.log10(gsd)) - 1)
    return round(math.ceil(gsd / digit - 1e-9) * digit, 12)


def samples_per_cell(training_px: float) -> int:
    """Return the number of samples along a side of a cell: odd, so that one lies in the middle."""
    return max(round(1.0 / training_px) | 1, 1)


def dilation_cells2(training_px: float, dilation_px2: float = _DILATION_PX2) -> float:
    """Return the variance that rendering adds on the screen, in squared cells: that of the training, or another.

    What the training saw was blurred by its own pixels. A finer raster must not let holes show between Gaussians.
    """
    return dilation_px2 * max(training_px, 1.0 / samples_per_cell(training_px)) ** 2


def plan_splats(
    gaussians: Gaussians, model: TrainedModel, target: TargetCrs, frame: RasterFrame, training_px: float
) -> tuple[PlanSplats, float]:
    """Return Gaussians in columns and rows of a raster's cells and depths, and the level that depths count from.

    The level is a height in the CRS's unit, above all Gaussians.

    Args:
        gaussians: those of the trained model that count, in `model`.
        target: the CRS.
        training_px: size of a training pixel on the ground, in cells.
    """
    geo_from_model = model.similarity
    mean_in_geo = geo_from_model.apply(gaussians.means.numpy())
    xyz = np.concatenate(
        [target.xyz_from_geo(mean_in_geo[i : i + _CHUNK]) for i in range(0, len(mean_in_geo), _CHUNK)]
    )
    derivative_at = _derivative(mean_in_geo, target, frame)
    cov = np.empty((len(xyz), 3, 3))
    for start in range(0, len(xyz), _CHUNK):
        part = slice(start, start + _CHUNK)
        # Principal axes in columns, one standard deviation long.
        rotation = rotation_matrices(gaussians.quats_wxyz[part].double())
        axes = np.asarray((rotation * gaussians.log_scales[part].double().exp()[:, None]).numpy())
        axes = geo_from_model.scale * geo_from_model.rotation @ axes
        axes = np.asarray(derivative_at(mean_in_geo[part])).reshape(-1, 3, 3) @ axes
        cov[part] = axes @ np.swapaxes(axes, 1, 2)
    metric = np.array([1.0, 1.0, target.crs.height_unit_m / (frame.step_x * target.horizontal_unit_m)])
    reach = _MOST_REACH * np.sqrt(cov[:, 2, 2])
    level = float((xyz[:, 2] + reach).max()) + _ABOVE
    column = (xyz[:, 0] - frame.west) / frame.step_x
    row = (frame.north - xyz[:, 1]) / frame.step_y
    splats = PlanSplats(
        np.column_stack([column, row, level - xyz[:, 2]]),
        cov,
        torch.sigmoid(gaussians.logit_opacities.double()).numpy()
        * _faintness(cov * np.outer(metric, metric), dilation_cells2(training_px), mip_filter=model.mip_filter),
        _colours_from_above(gaussians, model),
    )
    return splats, level


def _derivative(points: FloatArray, target: TargetCrs, frame: RasterFrame) -> RegularGridInterpolator:
    """Return the derivative (9,) of column, row and depth by a place in `geo`, interpolated between nodes."""
    low, high = points.min(axis=0), points.max(axis=0)
    high = np.maximum(high, low + _STEP_M)
    axes = [np.linspace(a, b, _NODES) for a, b in zip(low, high, strict=True)]
    nodes = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    ends = [target.xyz_from_geo(nodes + _STEP_M / 2 * sign * axis) for axis in np.eye(3) for sign in (1, -1)]
    by_geo = np.stack([ends[0] - ends[1], ends[2] - ends[3], ends[4] - ends[5]], axis=-1) / _STEP_M
    by_geo = by_geo / np.array([frame.step_x, -frame.step_y, -1.0])[:, None]
    if not np.isfinite(by_geo).all():
        message = f"{target.crs.name} does not cover the scene: its coordinates there are not finite."
        remedy = "Give another --crs."
        raise DegenerateGeometryError("crs-not-finite", message, remedy=remedy)
    return RegularGridInterpolator(tuple(axes), by_geo.reshape(*3 * (_NODES,), 9))


def _faintness(cov: FloatArray, dilation: float, *, mip_filter: bool) -> FloatArray:
    """Return factors (N,) of the opacity that take from discs seen edge-on the area that dilation gives them.

    A wall is a stack of discs. Each would be widened to a pixel without getting fainter, and a hundred of them
    would paint the wall pixels wide beside its roof. A disc seen face-on keeps the opacity of the training. With
    the mip filter, the factors take from all discs what dilation gives them, as they did in the training.

    Args:
        cov: (N, 3, 3) of columns, rows and depth, all in cells.
        dilation: variance that rendering adds on the screen, in squared cells.
    """
    seen = cov[:, :2, :2]
    squared = np.linalg.eigvalsh(cov)[:, 1:]
    face = np.prod(squared / (squared + dilation), axis=1)
    dilated = (seen[:, 0, 0] + dilation) * (seen[:, 1, 1] + dilation) - seen[:, 0, 1] ** 2
    area = np.maximum(np.linalg.det(seen), 0.0) / dilated
    if mip_filter:
        return np.asarray(np.sqrt(area))
    return np.asarray(np.sqrt(np.clip(area / np.maximum(face, 1e-300), 0.0, 1.0)))


def _colours_from_above(gaussians: Gaussians, solution: Solution) -> FloatArray:
    """Return colours (N, 3) as the training cameras nearest in plan see the Gaussians, averaged over these cameras.

    Straight down would be a direction from which an oblique flight has never looked: harmonics say nothing there.
    """
    geo_from_model = solution.similarity
    centers_in_model = solution.poses.cam_center_in_model[solution.indices("train")]
    tree = cKDTree(geo_from_model.apply(centers_in_model)[:, :2])
    nearest = min(_VIEWS_OF_COLOUR, len(centers_in_model))
    centers = torch.from_numpy(np.ascontiguousarray(centers_in_model))
    colours = np.empty((len(gaussians), 3))
    for start in range(0, len(gaussians), _CHUNK):
        part = gaussians.select(torch.arange(start, min(start + _CHUNK, len(gaussians))))
        means = part.means.double()
        _, camera = tree.query(geo_from_model.apply(means.numpy())[:, :2], k=[*range(1, nearest + 1)])
        total = torch.zeros(len(part), 3, dtype=torch.float64)
        for rank in range(nearest):
            direction = torch.nn.functional.normalize(means - centers[camera[:, rank]], dim=1)
            values = torch.einsum("nk,nkc->nc", basis(direction, part.sh_degree), part.sh.double())
            total += (0.5 + values).clamp_min(0.0)
        colours[start : start + len(part)] = (total / nearest).numpy()
    return colours


PAINTED = 128  # alpha of a cell whose colour is known and whose height is not measured
_SOLID = 0.5  # least opacity of a surface
_ONE_SURFACE_GSD = 4.0  # training pixels: largest spread of the heights of the Gaussians of one surface
_AVERAGED = 5  # checked cells on a side over which the surface's own noise is averaged
# Gaussians at the edge of a roof reach over it, and the dilation widens them. Heights are those of Gaussians with
# less of both, where these hide what lies below: on a simulated flight, roofs are 1.4 training pixels too wide
# otherwise, and 0.7 with them.
_SHRINK, _EDGE_DILATION_PX2 = 0.7, 0.05
# Through the gaps between those, deeper ones count, and level ground lies a fifth of a training pixel too low.
# Heights are those of whole Gaussians where both differ by less than this, in training pixels: no edge is near.
_NO_EDGE_GSD = 1.0
_MOST_THROUGH = 0.5  # largest number of views that look through a surface, as a part of those that agree
# Checked cells: half the width of slivers that are dropped, and of gaps that are closed.
_OPENED, _CLOSED = 2, 3
_SIGMA_PX = 0.15  # of a ray through a photograph, in training pixels: by simulated flights
_NODE_PX = 64  # cells between two nodes at which the georeference's σ is taken
_FIT_NODES = 4  # nodes along each side, at which the way from the CRS to `geo` is fitted
_LEAST_OPACITY = 1 / 255
_AROUND = 0.1  # of the area's extent: Gaussians further outside it, in plan, reach into no cell
_HAZE_VIEWS = 2  # training views that look through a Gaussian, and none that shows a surface there


@dataclass(frozen=True)
class RasterSource:
    """Sources of the windows of the rasters.

    Attributes:
        splats, level: Gaussians over the plane, and the height above them that their depths count from.
        sigma: predicted σ of the georeference over the scene; None: not known.
        terrain: the ground; None: not known.
        training_px: size of a training pixel on the ground, in cells.
        training_gsd_m: size of a training pixel on the ground.
        min_views: least number of training views that show a cell's surface.
    """

    splats: PlanSplats
    level: float
    views: SurfaceViews
    geo_from_model: Similarity
    target: TargetCrs
    sigma: AccuracyGrid | None
    terrain: GroundModel | None
    training_px: float
    training_gsd_m: float
    min_views: int

    @cached_property
    def terrain_level(self) -> FloatArray:
        """Heights (R, C) of the terrain's cells in the CRS's unit."""
        assert self.terrain is not None
        return self.target.xyz_from_geo(self.terrain.nodes())[:, 2].reshape(self.terrain.height.shape)


def raster_source(
    stage: StageRun,
    renderer: ModelRenderer,
    target: TargetCrs,
    frame: RasterFrame,
    area: Area,
    *,
    options: ExportRasterOptions,
) -> tuple[RasterSource, str, tuple[Remark, ...]]:
    """Return what the windows are made from, the reason why σ is not known, or an empty text, and any warnings.

    Raises:
        InputError: a photograph cannot be read, or the depth maps do not fit on the disk.
        DegenerateGeometryError: no Gaussian lies within the scene.
    """
    model, sfm, views = renderer.model, renderer.sfm, surface_views(stage, renderer)
    terrain, warnings = ground_below(views, model.similarity, area, options, stage.progress)
    training_gsd_m = training_pixel_m(model, sfm)
    training_px = training_gsd_m / (frame.step_x * target.horizontal_unit_m)
    splats, level = plan_splats(_seen_gaussians(renderer, views, area), model, target, frame, training_px)
    sigma, no_sigma = predicted_sigma(stage.workspace, model, sfm)
    source = RasterSource(
        splats=splats,
        level=level,
        views=views,
        geo_from_model=model.similarity,
        target=target,
        sigma=sigma,
        terrain=terrain,
        training_px=training_px,
        training_gsd_m=training_gsd_m,
        min_views=options.min_views,
    )
    return source, no_sigma, warnings


def _seen_gaussians(renderer: ModelRenderer, views: SurfaceViews, area: Area) -> Gaussians:
    """Return the Gaussians that reach into the area; far ones may lie outside the domain of the CRS.

    Left out are those in the air, through which the training views look at the surface.
    """
    points, gaussians = scene_points(renderer.model, renderer.sfm), renderer.gaussians
    west, south, east, north = area.polygon.bounds
    low, high = np.array([west, south, points[:, 2].min()]), np.array([east, north, points[:, 2].max()])
    around = float(np.linalg.norm(high - low)) * np.array([_AROUND, _AROUND, 1.0])  # masts stand above all points
    in_geo = renderer.geo_from_model.apply(gaussians.means.numpy())
    inside = ((in_geo >= low - around) & (in_geo <= high + around)).all(axis=1)
    solid = torch.sigmoid(gaussians.logit_opacities) >= _LEAST_OPACITY
    chosen = gaussians.select(solid & torch.from_numpy(inside))
    if len(chosen) == 0:
        message = "No opaque Gaussian lies in the area of interest."
        remedy = "Check --boundary, or train again with `georef train --force`."
        raise DegenerateGeometryError("no-gaussians-in-scene", message, remedy=remedy)
    support = views.support(chosen.means.double().numpy())
    haze = (support.views == 0) & (support.seen_through >= _HAZE_VIEWS)
    return chosen.select(torch.from_numpy(~haze))


@dataclass(frozen=True)
class WindowCells:
    """Cells of a window of H × W.

    Attributes:
        rgba: (4, H, W); alpha is 255 where the surface is measured, `PAINTED` where only a colour is known, or 0.
        height: (H, W) in the CRS's unit; NaN: not measured.
        modelled: (H, W) height of the model where it is not measured; NaN: none, or measured.
        sigma_h_m, sigma_v_m: (H, W) metres; NaN: not measured, or not known.
    """

    rgba: ByteArray
    height: FloatArray
    modelled: FloatArray
    sigma_h_m: FloatArray
    sigma_v_m: FloatArray


def render_window(source: RasterSource, frame: RasterFrame, column: int, row: int) -> WindowCells:
    """Return the cells of a window, whose first cell in the raster is at `column` and `row`.

    1. Heights are the depths at which the view from above is half opaque, or their mean if the Gaussians of a cell
       lie on one surface. Near edges shrunken Gaussians count first, so that roofs end where they do.
    2. A cell counts if enough training views show the surface there, and more than look through it. Nothing else
       tells the seen ground from what training left where nobody looked.
    3. σ is that of the georeference and of the surface. The surface's own is the RMS difference of the training
       views from it: their errors correlate, and more views do not make them smaller.
    """
    inner = samples_per_cell(source.training_px)
    splats = source.splats.scaled(float(inner)) if inner > 1 else source.splats
    size, corner = (frame.columns * inner, frame.rows * inner), (float(column * inner), float(row * inner))
    view = render_orthographic(
        splats, *size, corner=corner, dilation_px2=dilation_cells2(source.training_px) * inner**2
    )
    sharp = render_orthographic(
        splats,
        *size,
        corner=corner,
        dilation_px2=dilation_cells2(source.training_px, _EDGE_DILATION_PX2) * inner**2,
        shrink=_SHRINK,
    )
    middle = inner // 2
    whole, height = (_heights(source, each)[middle::inner, middle::inner] for each in (view, sharp))
    no_edge = np.abs(height - whole) < _NO_EDGE_GSD * source.training_gsd_m / source.target.crs.height_unit_m
    height = np.where(no_edge | np.isnan(height), whole, height)
    colour, alpha = _reduced(view.colour, inner), _reduced(view.alpha, inner)
    seen, noise_up_m, noise_h_m = _support(source, frame, height)
    modelled, height = np.where(seen, np.nan, height), np.where(seen, height, np.nan)
    solid = np.isfinite(height)
    rgba = np.zeros((4, frame.rows, frame.columns), dtype=np.uint8)
    # Over black, as in the training, which may have learned dark places as holes: they would be whitened otherwise.
    rgb = np.clip(colour, 0.0, 1.0)
    painted = solid | (alpha > _SOLID)
    rgba[:3] = np.where(painted, np.moveaxis(np.round(255 * rgb), 2, 0), 0)
    rgba[3] = np.where(solid, 255, np.where(painted, PAINTED, 0))
    sigma_h, sigma_v = georeference_sigma_maps(source, frame, height)
    sigma_h, sigma_v = np.hypot(sigma_h, noise_h_m), np.hypot(sigma_v, noise_up_m)
    return WindowCells(rgba, height, modelled, np.where(solid, sigma_h, np.nan), np.where(solid, sigma_v, np.nan))


def _heights(source: RasterSource, view: PlanView) -> FloatArray:
    """Return the heights (H, W) of a view from above in the CRS's unit; NaN: no surface."""
    # The mean of one surface is less noisy than the median.
    limit = _ONE_SURFACE_GSD * source.training_gsd_m / source.target.crs.height_unit_m
    one_surface = (view.depth_variance < limit**2) & (view.median_depth > 0)
    depth = np.where(one_surface, view.expected_depth, view.median_depth)
    return np.where(view.alpha > _SOLID, source.level - depth, np.nan)


def _reduced(values: FloatArray, inner: int) -> FloatArray:
    """Return the mean over `inner` × `inner` samples."""
    rows, columns = values.shape[0] // inner, values.shape[1] // inner
    blocks = values.reshape(rows, inner, columns, inner, *values.shape[2:])
    return np.asarray(blocks.mean(axis=(1, 3)))


def _support(
    source: RasterSource, frame: RasterFrame, height: FloatArray
) -> tuple[BoolArray, FloatArray, FloatArray]:
    """Return which cells are seen (H, W), and the surface's own noise (H, W), up and horizontal, in metres.

    Training pixels that are larger than the cells are checked once.
    """
    stride = max(int(source.training_px), 1)
    rows, columns = (
        np.minimum(np.arange(stride // 2, size + stride // 2, stride), size - 1) for size in height.shape
    )
    checked = height[np.ix_(rows, columns)]
    at_row, at_column = np.nonzero(np.isfinite(checked))
    up, horizontal = np.zeros(checked.shape), np.zeros(checked.shape)
    seen = np.zeros(checked.shape, dtype=bool)
    if len(at_row):
        cell = np.column_stack([columns[at_column], rows[at_row]]) + 0.5
        in_geo = places_in_geo(source, frame, cell, checked[at_row, at_column])
        support = source.views.support(source.geo_from_model.inverse().apply(in_geo))
        # All views may agree on a wrong surface where their rays meet at small angles.
        lateral_m = _SIGMA_PX * source.training_gsd_m / np.sqrt(np.maximum(support.views, 1))
        with np.errstate(invalid="ignore", divide="ignore"):
            square = np.nan_to_num(support.rms_up_m**2 + (lateral_m / support.spread_rad) ** 2, nan=np.inf)
        enough = (support.views >= source.min_views) & (support.seen_through <= _MOST_THROUGH * support.views)
        shown = enough & (square < source.training_gsd_m**2)
        seen[at_row, at_column] = shown
        up[at_row, at_column] = np.where(shown, square, 0.0)
        horizontal[at_row, at_column] = 2 * up[at_row, at_column] * np.nan_to_num(support.spread_rad) ** 2
    weight = uniform_filter(seen.astype(np.float64), _AVERAGED, mode="constant")
    noise_up_m, noise_h_m = (
        np.sqrt(
            np.maximum(uniform_filter(square, _AVERAGED, mode="constant"), 0.0)
            / np.maximum(weight, 0.5 / _AVERAGED**2)
        )
        for square in (up, horizontal)
    )
    seen = _tidied(seen)
    row_of = np.minimum(np.arange(height.shape[0]) // stride, len(rows) - 1)
    column_of = np.minimum(np.arange(height.shape[1]) // stride, len(columns) - 1)
    whole = np.ix_(row_of, column_of)
    return seen[whole], noise_up_m[whole], noise_h_m[whole]


def _tidied(seen: BoolArray) -> BoolArray:
    """Return seen cells (H, W) without slivers and narrow gaps.

    Slivers are agreements by chance. At the edge of a roof no view agrees with the mixed height of a cell, and
    cells between seen ones were seen too.
    """
    margin = _OPENED + _CLOSED
    wider = binary_opening(np.pad(seen, margin, mode="edge"), iterations=_OPENED)
    wider = binary_closing(wider, iterations=_CLOSED)
    return np.asarray(wider[margin:-margin, margin:-margin])


def places_in_geo(source: RasterSource, frame: RasterFrame, cell: FloatArray, height: FloatArray) -> FloatArray:
    """Return places (K, 3) in `geo` of cells (K, 2) and heights (K,), to a fraction of a millimetre.

    Within a window the way from the CRS to `geo` is a quadratic: it is fitted to exactly transformed nodes.
    """
    low = np.array([0.0, 0.0, height.min()])
    size = np.array([frame.columns, frame.rows, max(height.max() - height.min(), 1.0)])
    nodes = np.stack(np.meshgrid(*3 * (np.linspace(0, 1, _FIT_NODES),), indexing="ij"), axis=-1).reshape(-1, 3)
    pixel = low + nodes * size
    xyz = np.column_stack(
        [frame.west + pixel[:, 0] * frame.step_x, frame.north - pixel[:, 1] * frame.step_y, pixel[:, 2]]
    )
    coefficients = np.linalg.lstsq(_quadratic(nodes), source.target.geo_from_xyz(xyz), rcond=None)[0]
    return np.asarray(_quadratic((np.column_stack([cell, height]) - low) / size) @ coefficients)


def _quadratic(x: FloatArray) -> FloatArray:
    products = [x[:, i] * x[:, j] for i in range(3) for j in range(i, 3)]
    return np.column_stack([np.ones(len(x)), x, *products])


def georeference_sigma_maps(
    source: RasterSource, frame: RasterFrame, height: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return σ_H and σ_V (H, W) of the georeference in metres; NaN: not known."""
    if source.sigma is None or not np.isfinite(height).any():
        return np.full(height.shape, np.nan), np.full(height.shape, np.nan)
    rows, columns = (np.linspace(0, size, size // _NODE_PX + 2) for size in height.shape)
    cell = np.stack(np.meshgrid(columns, rows), axis=-1).reshape(-1, 2)
    in_geo = places_in_geo(source, frame, cell, np.full(len(cell), np.nanmedian(height)))
    sigma = np.sqrt(np.diagonal(source.sigma.cov_at(in_geo), axis1=1, axis2=2))
    horizontal, vertical = (
        between_nodes(values.reshape(len(rows), len(columns)), (rows, columns), height.shape)
        for values in (np.hypot(sigma[:, 0], sigma[:, 1]), sigma[:, 2])
    )
    return horizontal, vertical


def between_nodes(values: FloatArray, nodes: tuple[FloatArray, ...], shape: tuple[int, ...]) -> FloatArray:
    """Return values in the middles of cells, linearly between those (R, C) of nodes at rows (R,), columns (C,)."""
    for axis, (node, size) in enumerate(zip(nodes, shape, strict=True)):
        at = np.interp(np.arange(size) + 0.5, node, np.arange(len(node)))
        low = np.minimum(at.astype(np.int64), len(node) - 2)
        share = (at - low)[:, None] if axis == 0 else at - low
        values = (1 - share) * values.take(low, axis) + share * values.take(low + 1, axis)
    return values

"""Cells of one window: colour, height and σ, from the view from above and from what the training views show."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from scipy.ndimage import binary_closing, binary_opening, uniform_filter

from pipelines.adjust.accuracy_grid import AccuracyGrid
from pipelines.core.errors import DegenerateGeometryError
from pipelines.core.products import Remark
from pipelines.core.types import BoolArray, ByteArray, FloatArray
from pipelines.core.workspace import StageRun
from pipelines.deliver.options import ExportRasterOptions
from pipelines.deliver.raster_plan import dilation_cells2, plan_splats, samples_per_cell, training_pixel_m
from pipelines.deliver.surface import ground_below, predicted_sigma, surface_views
from pipelines.formats.geotiff import RasterFrame
from pipelines.geometry.similarity import Similarity
from pipelines.splat.gaussians import Gaussians
from pipelines.splat.rasterizer.orthographic import PlanSplats, PlanView, render_orthographic
from pipelines.surface.ground import GroundModel
from pipelines.surface.surface_views import ModelRenderer, SurfaceViews
from pipelines.survey.area import Area, scene_points
from pipelines.survey.target_crs import TargetCrs

PAINTED = 128  # alpha of a cell whose colour is known and whose height is not measured
_SOLID = 0.5  # least opacity of a surface
_ONE_SURFACE_GSD = 4.0  # training pixels: largest spread of the heights of the Gaussians of one surface
_AVERAGED = 5  # checked cells on a side over which the surface's own noise is averaged
# Gaussians at the edge of a roof reach over it, and the dilation widens them. Heights are those of Gaussians with
# less of both, where these hide what lies below: on a simulated flight, roofs are 1.4 training pixels too wide
# otherwise, and 0.7 with them.
_SHRINK, _EDGE_DILATION_PX2 = 0.7, 0.05
_MOST_THROUGH = 0.5  # largest number of views that look through a surface, as a part of those that agree
# Checked cells: half the width of slivers that are dropped, and of gaps that are closed.
_OPENED, _CLOSED = 2, 3
_SIGMA_PX = 0.15  # of a ray through a photograph, in training pixels: by simulated flights
_NODE_PX = 64  # cells between two nodes at which the georeference's σ is taken
_NODES = 4  # nodes along each side, at which the way from the CRS to `geo` is fitted
_LEAST_OPACITY = 1 / 255
_AROUND = 0.1  # of the area's extent: Gaussians further outside it, in plan, reach into no cell
_HAZE_VIEWS = 2  # training views that look through a Gaussian, and none that shows a surface there


@dataclass(frozen=True)
class RasterSource:
    """What the windows of the rasters are made from.

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
       lie on one surface. Shrunken Gaussians count first, so that roofs end at their edges.
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
    broad_height, height = (_heights(source, each)[middle::inner, middle::inner] for each in (view, sharp))
    height = np.where(np.isnan(height), broad_height, height)
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
    nodes = np.stack(np.meshgrid(*3 * (np.linspace(0, 1, _NODES),), indexing="ij"), axis=-1).reshape(-1, 3)
    place = low + nodes * size
    xyz = np.column_stack(
        [frame.west + place[:, 0] * frame.step_x, frame.north - place[:, 1] * frame.step_y, place[:, 2]]
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
    for axis, (place, size) in enumerate(zip(nodes, shape, strict=True)):
        at = np.interp(np.arange(size) + 0.5, place, np.arange(len(place)))
        low = np.minimum(at.astype(np.int64), len(place) - 2)
        share = (at - low)[:, None] if axis == 0 else at - low
        values = (1 - share) * values.take(low, axis) + share * values.take(low + 1, axis)
    return values

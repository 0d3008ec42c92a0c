"""Plan of the rasters: their frame of cells, and the Gaussians over the map plane.

The frame has cells on whole multiples of their size, over the area; it is checked before the work begins. Every
Gaussian goes through ENU → ECEF → CRS by itself: its centre exactly, its covariance by the derivative of that way,
which varies so slowly that it is taken from a few nodes over the scene.
"""

import math
from collections.abc import Sequence

import numpy as np
import torch
from scipy.interpolate import RegularGridInterpolator
from scipy.spatial import cKDTree

from pipelines.core.errors import DegenerateGeometryError, InputError
from pipelines.core.types import FloatArray
from pipelines.deliver.options import ExportRasterOptions
from pipelines.formats.geotiff import RasterFrame
from pipelines.geometry.sparse_model import SparseModel
from pipelines.splat.gaussians import Gaussians, rotation_matrices
from pipelines.splat.rasterizer.orthographic import PlanSplats
from pipelines.splat.sh import basis
from pipelines.survey.area import depths_of_observations
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

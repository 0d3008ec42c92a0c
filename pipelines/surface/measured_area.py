"""Area of interest: the user's boundary, or the surface that three views measure; and the crop of a splat to it.

One area ends every product: rasters, cloud, mesh, crop of the splat, viewer, and the area that the report states.
It is a function of the trained model and of two options. What is measured is found once from small depth maps, and
kept in the cache of the workspace, under a key of the model.
"""

import hashlib
import logging
from dataclasses import dataclass, replace

import cv2
import numpy as np

from pipelines.core.errors import InputError
from pipelines.core.progress import SILENT, Progress
from pipelines.core.stages import GAUSSIANS, MODEL
from pipelines.core.types import BoolArray, Float32Array, FloatArray, IntArray
from pipelines.core.workspace import Workspace
from pipelines.geometry.cameras import Pinhole, ViewPose
from pipelines.geometry.similarity import Similarity
from pipelines.geometry.sparse_model import SparseModel
from pipelines.splat.surface import measured_depth
from pipelines.surface.surface_views import SAME_SURFACE, ModelRenderer, model_renderer, photo_consistent
from pipelines.surface.visibility import DepthViews, Viewpoints, support
from pipelines.survey.area import Area, boundary_area, depths_of_observations, scene_in_geo, seen_area
from pipelines.survey.measured_ground import MeasuredGround
from pipelines.survey.navigation import load_survey
from pipelines.survey.options import LEAST_PHOTOGRAPHS, CropOptions, FilledAreaOptions
from pipelines.survey.solution import Solution, TrainedModel, read_sfm, read_solution, read_trained
from pipelines.survey.survey import Survey

_LONGEST_PX = 320  # of the depth maps
_MOST_PIXELS = 1 << 27  # of all depth maps: half a gibibyte
_CELL_PX = 2.0  # of the depth maps, for a side of a cell
_MOST_CELLS = 2000  # along the longer side
_HEIGHTS = 8  # of a cell, the latest ones, of which the median is looked at
_COARSEST = (
    2.0  # largest width of a pixel over the median: far ground of oblique photographs is no part of the area
)
_MOST_THROUGH = 0.5  # largest number of views that look through a cell, over the number of those that agree
_SCRAP = 0.01  # of the ground that three photographs see
_SIGMA_PX = 0.25  # of a ray, in pixels of the depth maps
_RESOLVED_PX = 1.0  # of the training: largest σ of a measured height, as of the cells of rasters
_LAYOUT = b"measured ground 3"
log = logging.getLogger(__name__)


def area_of(
    options: FilledAreaOptions,
    workspace: Workspace,
    solution: Solution,
    sfm: SparseModel,
    survey: Survey,
    *,
    progress: Progress = SILENT,
) -> Area:
    """Return the area of interest, at which every product ends.

    1. A boundary is taken whole, as is, with `--fill all`, the ground that three photographs see. So is that ground
       before there is a trained model.
    2. Otherwise the area is what is measured of it: without spikes and islands, with holes filled up to a width.
       Where that is hardly anything, it is all that is seen: a scrap of a hundredth tells nothing of a survey.

    Raises:
        InputError: the boundary cannot be read, states no CRS, or lies elsewhere; or a photograph cannot be read.
        DegenerateGeometryError: no ground is seen by enough photographs.
    """
    scene = scene_in_geo(solution, sfm)
    stated = boundary_area(options, scene, survey.origin)
    whole = seen_area(solution, sfm, scene) if stated is None else stated
    if not workspace.has(MODEL):
        return whole
    ground = measured_ground(workspace, solution, sfm, survey, progress)
    fill = "all" if options.fill is None and stated is not None else options.fill
    if fill != "all":
        outline = ground.outline(whole.polygon, fill)
        if outline is None or (stated is None and outline.area < _SCRAP * whole.polygon.area):
            log.warning(
                "Hardly any ground is measured by %d training views (%.0f of %.0f m²): the area is all that is "
                "seen, and what was not measured is interpolated. Train longer.",
                LEAST_PHOTOGRAPHS, 0.0 if outline is None else outline.area, whole.polygon.area,
                extra={"code": "hardly-measured"},
            )  # fmt: skip
        else:
            source = f"ground that {LEAST_PHOTOGRAPHS} training views measure"
            source = source if stated is None else f"{source} in {whole.source}"
            whole = replace(whole, polygon=outline, source=source, is_outline=True)
    return replace(whole, measured=ground.share(whole.polygon))


def measured_ground(
    workspace: Workspace, solution: Solution, sfm: SparseModel, survey: Survey, progress: Progress = SILENT
) -> MeasuredGround:
    """Return the ground that the training views of the trained model measure, from the cache if it is there.

    Raises:
        InputError: a photograph or a product cannot be read.
    """
    path = workspace.cache / "area" / f"{_key(solution, workspace)}.npz"
    if path.exists():
        try:
            return MeasuredGround.load(path)
        except InputError as error:
            log.warning("%s; it is made again", error)
    model = solution if isinstance(solution, TrainedModel) else read_trained(workspace)
    measured = measured_by(model_renderer(workspace, model, sfm, survey, progress=progress), progress)
    try:
        measured.save(path)
    except OSError as error:  # found again next time
        log.warning("%s cannot be written: %s", path, error.strerror)
    return measured


def _key(solution: Solution, workspace: Workspace) -> str:
    """Return a hash of all that decides what is measured."""
    digest = hashlib.sha256(_LAYOUT)
    digest.update(repr(solution.similarity).encode())
    for product in (MODEL, GAUSSIANS):
        with workspace.path(product).open("rb") as handle:
            digest.update(hashlib.file_digest(handle, "sha256").digest())
    return digest.hexdigest()[:32]


def measured_by(renderer: ModelRenderer, progress: Progress = SILENT) -> MeasuredGround:
    """Return the ground that the training views of a renderer measure; an InputError: a photograph is unusable.

    1. Depth maps are rendered small; depths count where the photograph confirms the render.
    2. A cell of the plan has the median height of the views that show it.
    3. It is measured if three views agree on that height, more than look through it, to a training pixel.
    """
    cameras = renderer.model.indices("train")
    depth_m, focal_px = depths_of_observations(renderer.model, renderer.sfm)
    photo_m = float(np.median(depth_m / focal_px)) if len(depth_m) else 1.0
    longest_px = min(_LONGEST_PX, int((_MOST_PIXELS / max(len(cameras), 1)) ** 0.5))
    pinholes = tuple(renderer.images.pinhole(index).limited(longest_px) for index in cameras)
    maps = []
    with progress.task("measured ground", len(cameras)) as task:
        for index, pinhole in zip(cameras, pinholes, strict=True):
            maps.append(_depth(renderer, index, pinhole))
            task.advance()
    poses, geo_from_model = renderer.poses, renderer.geo_from_model
    rotation, center = poses.cam_from_model[cameras], poses.cam_center_in_model[cameras]
    widths = [
        geo_from_model.scale * float(np.median(depth[depth > 0])) / pinhole.fx
        for depth, pinhole in zip(maps, pinholes, strict=True)
        if (depth > 0).any()
    ]
    if not widths:
        return MeasuredGround(np.zeros((1, 1), dtype=bool), np.zeros(2), np.array([photo_m, photo_m]))
    pixel_m = float(np.median(widths))
    reduced = [
        small.width / renderer.images.pinhole(index).width for index, small in zip(cameras, pinholes, strict=True)
    ]
    training_m = pixel_m * float(np.median(reduced))
    points = []
    for depth, pinhole, turned, place in zip(maps, pinholes, rotation, center, strict=True):
        near = (depth > 0) & (geo_from_model.scale * depth / pinhole.fx < _COARSEST * pixel_m)
        row, column = np.nonzero(near)
        ray = pinhole.rays(np.stack([column, row], axis=-1) + 0.5)
        in_model = (depth[row, column].astype(np.float64)[:, None] * ray) @ turned + place
        points.append(geo_from_model.apply(in_model))
    cells = _Cells.around(points, _CELL_PX * pixel_m)
    for seen in points:
        cells.add(seen)
    places = cells.places()
    views = DepthViews.of(Viewpoints(rotation, center, pinholes), np.concatenate([depth.ravel() for depth in maps]))
    up_in_model = geo_from_model.rotation.T @ [0.0, 0.0, 1.0]
    agreement = support(geo_from_model.inverse().apply(places), views, up_in_model, SAME_SURFACE)
    agreement = agreement.scaled(geo_from_model.scale)
    enough = (agreement.views >= LEAST_PHOTOGRAPHS) & (agreement.seen_through <= _MOST_THROUGH * agreement.views)
    with np.errstate(invalid="ignore", divide="ignore"):
        lateral_m = _SIGMA_PX * pixel_m / (agreement.spread_rad * np.sqrt(agreement.views))
        close = agreement.rms_up_m**2 + lateral_m**2 < (_RESOLVED_PX * training_m) ** 2
    return MeasuredGround(cells.grid(enough & close), cells.corner, np.array([cells.cell_m, photo_m]))


def _depth(renderer: ModelRenderer, index: int, pinhole: Pinhole) -> Float32Array:
    """Return the depth (H, W) of a training camera at a small size, 0 where masked or not confirmed."""
    pose = renderer.pose(index)
    view = renderer.render(ViewPose(pinhole, pose.cam_from_model, pose.center_in_model), depth=True)
    depth = measured_depth(view).cpu().numpy().astype(np.float32)
    rgb = (255 * view.colour.clamp(0, 1)).round().byte().cpu().numpy()
    size = (pinhole.width, pinhole.height)
    small = cv2.resize(np.array(renderer.images.image(index)), size, interpolation=cv2.INTER_AREA)
    depth[~photo_consistent(rgb, np.asarray(small, dtype=np.uint8))] = 0
    if renderer.images.is_masked(index):
        mask = np.array(renderer.images.mask(index)).astype(np.uint8)
        depth[cv2.resize(mask, size, interpolation=cv2.INTER_NEAREST) == 0] = 0
    return depth


class _Cells:
    """Cells of the plan, with the heights that views show in each: the latest `_HEIGHTS`, one a view."""

    def __init__(self, corner: FloatArray, cell_m: float, shape: tuple[int, int]) -> None:
        self.corner, self.cell_m, self._shape = corner, cell_m, shape
        self._height = np.full((shape[0] * shape[1], _HEIGHTS), np.nan, dtype=np.float32)
        self._views = np.zeros(len(self._height), dtype=np.int64)

    @classmethod
    def around(cls, points: list[FloatArray], cell_m: float) -> "_Cells":
        """Return empty cells over points (N, 3) of views, of a side of `cell_m` or more."""
        bounds = np.array([(seen[:, :2].min(axis=0), seen[:, :2].max(axis=0)) for seen in points if len(seen)])
        low, high = bounds[:, 0].min(axis=0), bounds[:, 1].max(axis=0)
        cell_m = max(cell_m, float((high - low).max()) / _MOST_CELLS)
        columns, rows = (np.floor((high - low) / cell_m).astype(int) + 1).tolist()
        return cls(low, cell_m, (rows, columns))

    def add(self, points: FloatArray) -> None:
        """Add the points (N, 3) that a view shows."""
        if not len(points):
            return
        column, row = np.floor((points[:, :2] - self.corner) / self.cell_m).astype(np.int64).T
        cell, first = np.unique(row * self._shape[1] + column, return_index=True)
        self._height[cell, self._views[cell] % _HEIGHTS] = points[first, 2]
        self._views[cell] += 1

    def places(self) -> FloatArray:
        """Return the middles (K, 3) of the cells that enough views show, at the median height."""
        shown = self._rows_in_views()
        row, column = np.divmod(shown, self._shape[1])
        plan = self.corner + (np.stack([column, row], axis=1) + 0.5) * self.cell_m
        return np.column_stack([plan, np.nanmedian(self._height[shown], axis=1)])

    def grid(self, chosen: np.ndarray) -> np.ndarray:
        """Return all cells (R, C), true where the place is chosen."""
        cells = np.zeros(len(self._height), dtype=bool)
        cells[self._rows_in_views()[chosen]] = True
        return cells.reshape(self._shape)

    def _rows_in_views(self) -> IntArray:
        return np.flatnonzero(self._views >= LEAST_PHOTOGRAPHS)


@dataclass(frozen=True)
class Crop:
    """Area outside which Gaussians are left out; those higher than `sky_m` in `geo` stay."""

    area: Area
    geo_from_model: Similarity
    sky_m: float

    def keeps(self, center_in_model: FloatArray | Float32Array) -> BoolArray:
        """Return which of Gaussians' centres (N, 3) stay."""
        center = self.geo_from_model.apply(center_in_model)
        return self.area.contains(center) | (center[:, 2] > self.sky_m)


def crop_of(workspace: Workspace, options: CropOptions) -> Crop | None:
    """Return the crop that the options ask for; None: none. Errors as of `read_solution` and `area_of`.

    The sky is what lies higher than all cameras.
    """
    if not options.crop and options.boundary is None:
        return None
    solution = read_solution(workspace)
    sfm, survey, cameras = read_sfm(workspace, solution), load_survey(workspace), solution.center_in_geo
    sky_m = float(cameras[:, 2].max()) if options.keep_sky else np.inf
    return Crop(area_of(options, workspace, solution, sfm, survey), solution.similarity, sky_m)

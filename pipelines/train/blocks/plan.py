"""Division of a survey into blocks: cells of equal load, the photographs of each, predicted memory.

Reads the survey, the SfM model and the initial similarity; no photographs. Writes `plan.json`. The plane is divided
into cells by a kd-tree (doi 10.1145/361002.361007) that halves the load. The load is predicted from the SfM points:
the Gaussians that a surface needs grow with the pixels in which photographs show it, and a block's memory and time
with the Gaussians that its views show (doi 10.48550/arXiv.2510.01767).

1. Each photograph is divided into a grid. The points observed in one of its cells share the pixels of the cell, so
   that a richly textured wall weighs no more than the meadow before it.
2. A point's surface is the mean of its pixels over the photographs that observe it: the size of the surface that it
   stands for, in pixels.
3. The Gaussians of the whole are shared out among the points by their surface.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from pipelines.core.errors import DegenerateGeometryError, ResourceError
from pipelines.core.machine import free_main_memory_bytes
from pipelines.core.products import save_json
from pipelines.core.progress import SILENT, Progress
from pipelines.core.types import BoolArray, FloatArray, IntArray
from pipelines.core.workspace import StageRun, Summary
from pipelines.geometry.cameras import project
from pipelines.splat.memory import USABLE, TrainingSize, predicted_peak_bytes
from pipelines.survey.block_plan import BlockCell, BlockPlan, PlannedBlock, scaffold_gaussians
from pipelines.survey.photographs import pinhole_of
from pipelines.survey.scene import SparseScene, load_adjusted_scene
from pipelines.train.options import PlanOptions

_COLUMNS, _ROWS = 16, 12  # of a photograph's grid
# More observations need gigabytes and do not improve the shares of a block: points are left out evenly.
_MOST_OBSERVATIONS = 6_000_000


@dataclass(frozen=True)
class ObservedSurface:
    """P points of the surface, and their M observations in n training images."""

    point_in_model: FloatArray  # (P, 3) metres
    surface: FloatArray  # (P,) share of the survey's surface that each point stands for; sum 1
    obs_point: IntArray  # (M,) indices
    obs_image: IntArray  # (M,) indices
    obs_share: FloatArray  # (M,) share of the image that it stands for; sum 1 in each image with any

    def share_in_views(self, inside: BoolArray, images: int) -> FloatArray:
        """Return the share (n,) of each image that shows the points of a mask (P,), 0 … 1."""
        rows = inside[self.obs_point]
        return np.bincount(self.obs_image[rows], self.obs_share[rows], minlength=images).astype(np.float64)


def observed_surface(scene: SparseScene, most_observations: int = _MOST_OBSERVATIONS) -> ObservedSurface:
    """Return the surface that the training images of a scene observe; too many observations are thinned evenly."""
    sparse = scene.sparse
    step = -(-len(sparse.obs_point) // most_observations)
    is_train = np.zeros(len(sparse.image_name), dtype=bool)
    is_train[scene.train] = True
    rows = np.flatnonzero((sparse.obs_point % step == 0) & is_train[sparse.obs_image])
    image, xy = sparse.obs_image[rows], sparse.obs_xy_px[rows]
    sizes = np.array([(camera.width, camera.height) for camera in sparse.cameras.values()], dtype=np.float64)
    keys = {key: place for place, key in enumerate(sparse.cameras)}
    size = sizes[np.array([keys[int(key)] for key in sparse.image_camera_id])][image]
    column = np.clip((xy[:, 0] / size[:, 0] * _COLUMNS).astype(np.int64), 0, _COLUMNS - 1)
    row = np.clip((xy[:, 1] / size[:, 1] * _ROWS).astype(np.int64), 0, _ROWS - 1)
    grid_cell = (image * _ROWS + row) * _COLUMNS + column
    in_cell = np.bincount(grid_cell, minlength=len(sparse.image_name) * _ROWS * _COLUMNS)
    occupied = (in_cell.reshape(len(sparse.image_name), -1) > 0).sum(axis=1)
    pixels = 1.0 / in_cell[grid_cell]  # in cells of the grid
    kept, place = np.unique(sparse.obs_point[rows], return_inverse=True)
    surface = np.bincount(place, pixels) / np.bincount(place)
    return ObservedSurface(
        point_in_model=scene.point_in_model[kept],
        surface=surface / surface.sum(),
        obs_point=place,
        obs_image=image,
        obs_share=pixels / occupied[image],
    )


_OUTER = 0.01  # share of the load beyond either end of a cell's extent, so that a stray point does not extend it
MOST_BLOCKS = 4096


def cells_of_number(
    points: FloatArray,
    load: FloatArray,
    count: int,
    cell: BlockCell = BlockCell(),  # noqa: B008
) -> list[BlockCell]:
    """Return cells that divide the plane, or `cell`, with loads as equal as the points allow.

    The points (P, 2 or more) are east and north in metres, their loads (P,) are ≥ 0. A DegenerateGeometryError:
    they lie at fewer places than cells are wanted.
    """
    if count == 1:
        return [cell]
    inside, first = cell.contains(points), count // 2
    below, above = _halves(cell, points[inside], load[inside], first / count)
    return [*cells_of_number(points, load, first, below), *cells_of_number(points, load, count - first, above)]


def cells_that_fit(
    points: FloatArray, load: FloatArray, fits: Callable[[BlockCell, FloatArray], bool]
) -> list[BlockCell]:
    """Return cells, at most 4096, that divide the plane, halved until each fits; a DegenerateGeometryError: none.

    Points and loads are as of `cells_of_number`; `fits` tells of a cell, with its extent (2,) in metres.
    """
    waiting, done = [BlockCell()], list[BlockCell]()
    while waiting:
        cell = waiting.pop()
        inside = cell.contains(points)
        if fits(cell, extent_of(points[inside], load[inside])):
            done.append(cell)
        else:
            waiting += reversed(_halves(cell, points[inside], load[inside], 0.5))
        if len(waiting) + len(done) > MOST_BLOCKS:
            raise DegenerateGeometryError(
                "too-many-blocks",
                f"More than {MOST_BLOCKS} blocks would be needed to fit into memory.",
                remedy=(
                    "Reduce --max-gaussians or --max-image-size, or use workers with more memory (--block-memory)."
                ),
            )
    return done


def extent_of(points: FloatArray, load: FloatArray) -> FloatArray:
    """Return the extent (2,) in metres, east and north, in which most of the load lies."""
    if not len(points):
        return np.zeros(2)
    ends = [[_quantile(points[:, axis], load, share) for share in (_OUTER, 1 - _OUTER)] for axis in (0, 1)]
    return np.array([high - low for low, high in ends])


def _halves(cell: BlockCell, points: FloatArray, load: FloatArray, share: float) -> tuple[BlockCell, BlockCell]:
    """Return the cell cut across its longer axis, with a share of the load in its first part."""
    for axis in np.argsort(-extent_of(points, load), kind="stable"):
        values = points[:, axis]
        if len(values) and values.max() > values.min():
            # No part may be empty: a cut at the lowest value has nothing below it.
            place = max(_quantile(values, load, share), float(np.nextafter(values.min(), np.inf)))
            return cell.cut(int(axis), min(place, float(values.max())))
    raise DegenerateGeometryError(
        "too-few-points", "The survey has too few points for this number of blocks: reduce --blocks."
    )


def _quantile(values: FloatArray, load: FloatArray, share: float) -> float:
    """Return the value below which a share of the load lies."""
    order = np.argsort(values, kind="stable")
    summed = np.cumsum(load[order])
    place = int(np.searchsorted(summed, share * summed[-1]))
    return float(values[order[min(place, len(order) - 1)]])


_LEAST_SHARE = 0.1  # of a photograph that must show the block, so that the photograph trains it
_LEAST_CAMERAS = 8
_PROCESS_BYTES = 400 * 2**20  # of a process with its libraries, before it reads the survey
_OBSERVATION_BYTES = 240  # of the SfM model, which each block reads whole
_SAMPLED_CAMERAS = 24  # of a block, in which its Gaussians are counted


def run(stage: StageRun, options: PlanOptions) -> Summary:
    """Write the plan, and return its key figures; raises a `GeorefError` if a product cannot be read."""
    workspace = stage.workspace
    *_, scene = load_adjusted_scene(workspace)
    plan = plan_blocks(scene, options, stage.progress)
    save_json(plan, stage.out / "plan.json")
    shares = [block.share for block in plan.blocks]
    values = {
        "blocks": len(plan.blocks),
        "photographs": plan.photographs,
        "photographs_of_blocks": [len(block.cameras) for block in plan.blocks],
        "gaussians_of_blocks": [block.gaussians for block in plan.blocks],
        "largest_share": round(max(shares), 4),
        "peak_bytes": max(block.peak_bytes for block in plan.blocks),
    }
    return Summary(f"{len(plan.blocks)} blocks of {plan.photographs} photographs", values)


def plan_blocks(scene: SparseScene, options: PlanOptions, progress: Progress = SILENT) -> BlockPlan:
    """Return the division of a scene into blocks.

    Raises:
        ResourceError: no number of blocks fits into the memory.
        DegenerateGeometryError: the survey cannot be cut into so many blocks.
    """
    planner, memory = _Planner(scene, observed_surface(scene), options), None
    if not options.blocks and options.block_memory is not None:
        memory = int(options.block_memory * 2**30)
    elif not options.blocks:
        memory = free_main_memory_bytes()
    cells = planner.cells(memory)
    with progress.task("blocks", len(cells)) as task:
        blocks = []
        for number, cell in enumerate(cells):
            blocks.append(planner.block(number, cell))
            task.advance()
    return BlockPlan(
        blocks=tuple(blocks),
        gaussians=options.max_gaussians,
        scaffold_gaussians=scaffold_gaussians(options.max_gaussians),
        photographs=len(scene.train),
        memory_bytes=memory,
    )


@dataclass(frozen=True)
class _Planner:
    """Sparse scene with its observed surface and the options of the plan."""

    scene: SparseScene
    surface: ObservedSurface
    options: PlanOptions

    def cells(self, memory_bytes: int | None) -> list[BlockCell]:
        """Return the cells: of the number in the options, or such that each block fits into the memory if known."""
        points, load = self.surface.point_in_model, self.surface.surface
        if self.options.blocks:
            return cells_of_number(points, load, self.options.blocks)
        if memory_bytes is None:
            return [BlockCell()]
        usable = USABLE * memory_bytes
        if self._peak_bytes(1) > usable:
            raise ResourceError(
                "not-enough-memory",
                (
                    f"A block needs at least {self._peak_bytes(1) / 2**30:.1f} GiB of memory, and a worker may "
                    f"use {usable / 2**30:.1f} GiB."
                ),
                remedy="Reduce --max-image-size or --crop-size, or raise --block-memory.",
            )

        def fits(cell: BlockCell, extent_m: FloatArray) -> bool:
            region = cell.widened(self.options.block_overlap * extent_m)
            return self._peak_bytes(self._gaussians(region.contains(points))) <= usable

        return cells_that_fit(points, load, fits)

    def block(self, number: int, cell: BlockCell) -> PlannedBlock:
        points = self.surface.point_in_model
        inside = cell.contains(points)
        margin = self.options.block_overlap * extent_of(points[inside], self.surface.surface[inside])
        in_region = cell.widened(margin).contains(points)
        share = self.surface.share_in_views(in_region, len(self.scene.sparse.image_name))
        cameras = self._cameras(share)
        pinholes = [
            pinhole_of(self.scene.sparse.camera_of(i), self.options.max_image_size) for i in cameras.tolist()
        ]
        pixels = np.array([camera.width * camera.height for camera in pinholes])
        gaussians = self._gaussians(in_region)
        return PlannedBlock(
            id=number,
            cell=cell,
            margin_m=(float(margin[0]), float(margin[1])),
            cameras=tuple(self.scene.sparse.image_name[index] for index in cameras),
            share=min(float(self.surface.surface[inside].sum()), 1.0),
            gaussians=gaussians,
            visible=self._visible(in_region, cameras),
            view_px=float((share[cameras] * pixels).mean()) if len(cameras) else 0.0,
            peak_bytes=self._peak_bytes(gaussians),
        )

    def _cameras(self, share: FloatArray) -> IntArray:
        """Return the training images that show enough of a block, or the few that show most of it."""
        train = np.sort(self.scene.train)
        enough = train[share[train] >= _LEAST_SHARE]
        if len(enough) >= _LEAST_CAMERAS:
            return np.asarray(enough)
        most = train[np.argsort(-share[train], kind="stable")[:_LEAST_CAMERAS]]
        return np.sort(most[share[most] > 0])

    def _visible(self, inside: BoolArray, cameras: IntArray) -> float:
        """Return the mean number of Gaussians of a region in its views; hidden Gaussians count."""
        points, surface = self.surface.point_in_model[inside], self.surface.surface[inside]
        poses, sparse = self.scene.poses, self.scene.sparse
        seen = []
        for index in cameras[:: max(1, len(cameras) // _SAMPLED_CAMERAS)].tolist():
            in_cam = (points - poses.cam_center_in_model[index]) @ poses.cam_from_model[index].T
            ahead = np.flatnonzero(in_cam[:, 2] > 0)
            camera = sparse.camera_of(index)
            # Far outside the image the lens polynomial folds back into it.
            slope = np.abs(in_cam[ahead, :2] / in_cam[ahead, 2:])
            pinhole = pinhole_of(camera, max(camera.width, camera.height))
            reach = 1.2 * np.array([pinhole.width / pinhole.fx, pinhole.height / pinhole.fy])
            ahead = ahead[(slope < reach).all(axis=1)]
            xy = project(camera, in_cam[ahead])
            in_image = ((xy >= 0) & (xy < [camera.width, camera.height])).all(axis=1)
            seen.append(float(surface[ahead[in_image]].sum()))
        return self.options.max_gaussians * float(np.mean(seen)) if seen else 0.0

    def _gaussians(self, inside: BoolArray) -> int:
        """Return the limit of the Gaussians at the points of a mask (P,)."""
        share = float(self.surface.surface[inside].sum())
        return max(round(self.options.max_gaussians * share), 1)

    def _peak_bytes(self, gaussians: int) -> int:
        """Return the predicted peak of the memory of a block's process, with the scaffold around the block."""
        sparse, options = self.scene.sparse, self.options
        scene = _PROCESS_BYTES + _OBSERVATION_BYTES * len(sparse.obs_point)
        count = gaussians + scaffold_gaussians(options.max_gaussians)
        _, one_of_each = np.unique(sparse.image_camera_id, return_index=True)
        cameras = [pinhole_of(sparse.camera_of(int(index)), options.max_image_size) for index in one_of_each]
        largest = max(cameras, key=lambda camera: camera.width * camera.height)
        return scene + predicted_peak_bytes(TrainingSize(count, largest, options.sh_degree, cameras=0))

"""Division of a survey into blocks: cells of equal load, the photographs of each, predicted memory.

Reads the survey, the SfM model and the initial similarity; no photographs. Writes `plan.json`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pipelines.blocks.load import ObservedSurface, observed_surface
from pipelines.blocks.options import PlanOptions
from pipelines.blocks.partition import cells_of_number, cells_that_fit, extent_of
from pipelines.core.errors import ResourceError
from pipelines.core.free_memory import free_main_memory_bytes
from pipelines.core.products import save_json
from pipelines.core.progress import SILENT, Progress
from pipelines.core.types import BoolArray, FloatArray, IntArray
from pipelines.core.workspace import StageRun, Summary
from pipelines.geometry.cameras import Pinhole, project
from pipelines.scene.block_plan import BlockCell, BlockPlan, PlannedBlock
from pipelines.scene.photographs import pinhole_of
from pipelines.scene.scaffold import scaffold_gaussians
from pipelines.scene.scene import Scene, load_adjusted_scene
from pipelines.splat.memory import USABLE, TrainingSize, predicted_peak_bytes

_LEAST_SHARE = 0.1  # of a photograph that shows a block which it is to train
_LEAST_CAMERAS = 8
_PROCESS_BYTES = 400 * 2**20  # of a process with its libraries, before it reads the survey
_OBSERVATION_BYTES = 240  # of the SfM model, which each block reads whole
_SAMPLED_CAMERAS = 24  # of a block, in which its Gaussians are counted


def run(stage: StageRun, options: PlanOptions) -> Summary:
    """Write the plan, and return its key figures.

    Raises:
        ResourceError: no number of blocks fits into the memory.
        DegenerateGeometryError: the survey cannot be cut into so many blocks.
        GeorefError: a product cannot be read.
    """
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


def plan_blocks(scene: Scene, options: PlanOptions, progress: Progress = SILENT) -> BlockPlan:
    """Return the division of a scene into blocks.

    Args:
        scene: cameras and SfM points.
        options: of the plan.
        progress: counts the blocks.

    Raises:
        ResourceError: no number of blocks fits into the memory.
        DegenerateGeometryError: the survey cannot be cut into so many blocks.
    """
    planner = _Planner(scene, observed_surface(scene), options)
    memory = None if options.blocks else planner.worker_bytes()
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
    """Scene with its observed surface and the options of the plan."""

    scene: Scene
    surface: ObservedSurface
    options: PlanOptions

    def worker_bytes(self) -> int | None:
        """Return the memory that a worker may use; None: unknown."""
        if self.options.block_memory is not None:
            return int(self.options.block_memory * 2**30)
        return free_main_memory_bytes()

    def cells(self, memory_bytes: int | None) -> list[BlockCell]:
        """Return the cells: of the number in the options, or such that each block fits into the memory.

        Raises:
            ResourceError: not even a block without Gaussians would fit.
            DegenerateGeometryError: the survey cannot be cut into so many blocks.
        """
        points, load = self.surface.point_in_model, self.surface.surface
        if self.options.blocks:
            return cells_of_number(points, load, self.options.blocks)
        if memory_bytes is None:
            return [BlockCell()]
        usable = USABLE * memory_bytes
        if self._peak_bytes(1) > usable:
            raise ResourceError(
                f"a block needs at least {self._peak_bytes(1) / 2**30:.1f} GiB, and a worker may use "
                f"{usable / 2**30:.1f}: give a smaller --max-image-size, or a larger --block-memory"
            )

        def fits(cell: BlockCell, extent_m: FloatArray) -> bool:
            return self._peak_bytes(self._gaussians(self._widened(cell, extent_m))) <= usable

        return cells_that_fit(points, load, fits)

    def block(self, number: int, cell: BlockCell) -> PlannedBlock:
        """Return the block of a cell."""
        points = self.surface.point_in_model
        inside = cell.contains(points)
        margin = self._margin(extent_of(points[inside], self.surface.surface[inside]))
        region = cell.widened(margin)
        in_region = region.contains(points)
        share = self.surface.share_in_views(in_region, len(self.scene.sparse.image_name))
        cameras = self._cameras(share)
        pixels = np.array([camera.width * camera.height for camera in map(self._pinhole, cameras.tolist())])
        gaussians = self._gaussians(region)
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
        """Return the mean number of Gaussians of a region in its views, without regard to what hides them."""
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
            shown = ((xy >= 0) & (xy < [camera.width, camera.height])).all(axis=1)
            seen.append(float(surface[ahead[shown]].sum()))
        return self.options.max_gaussians * float(np.mean(seen)) if seen else 0.0

    def _margin(self, extent_m: FloatArray) -> FloatArray:
        return np.asarray(self.options.block_overlap * extent_m)

    def _widened(self, cell: BlockCell, extent_m: FloatArray) -> BlockCell:
        return cell.widened(self._margin(extent_m))

    def _gaussians(self, region: BlockCell) -> int:
        """Return the limit of the Gaussians in a region."""
        return max(round(self.options.max_gaussians * self.surface.share_of(region)), 1)

    def _peak_bytes(self, gaussians: int) -> int:
        """Return the predicted peak of the memory of a block's process, with the scaffold around the block."""
        observations = len(self.scene.sparse.obs_point)
        scene = _PROCESS_BYTES + _OBSERVATION_BYTES * observations
        count = gaussians + scaffold_gaussians(self.options.max_gaussians)
        cameras = [self._pinhole(index) for index in self._one_of_each_camera()]
        largest = max(cameras, key=lambda camera: camera.width * camera.height)
        return scene + predicted_peak_bytes(TrainingSize(count, largest, self.options.sh_degree, cameras=0))

    def _one_of_each_camera(self) -> Sequence[int]:
        _, first = np.unique(self.scene.sparse.image_camera_id, return_index=True)
        return [int(index) for index in first]

    def _pinhole(self, index: int) -> Pinhole:
        return pinhole_of(self.scene.sparse.camera_of(index), self.options.max_image_size)

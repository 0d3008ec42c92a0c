"""Parts of a training in blocks: stages in variants of the workspace, each with lock, manifest and log of its own.

`blocks/` holds plan, solution and scaffold, and `blocks/<number>/` one block each.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pipelines.core import stages
from pipelines.core.errors import InputError, MissingProductError
from pipelines.core.products import load_json
from pipelines.core.progress import SILENT, Progress
from pipelines.core.runner import Outcome, run_stage
from pipelines.core.staleness import request, why_damaged, why_stale
from pipelines.core.workspace import Workspace
from pipelines.splat.rasterizer.backends import chosen_backend
from pipelines.survey.block_plan import SCAFFOLD_IMAGE_PX, BlockPlan, BlockRecord, BlockTraining
from pipelines.survey.options import NOT_IN_BLOCKS
from pipelines.train.options import TrainOptions

FOLDER = "blocks"
UPSTREAM = stages.stage_slice(None, "init-sim3")
# The plan applies these, and a block is stale with the plan.
_OF_PLAN = ("preset", "blocks", "block_overlap", "block_memory")


@dataclass(frozen=True)
class Parts:
    """Parts of the training of one workspace with given options; an InputError: the training is to use LiDAR."""

    workspace: Workspace
    options: TrainOptions

    def __post_init__(self) -> None:
        if self.options.lidar is not None:
            raise InputError("lidar-in-blocks", NOT_IN_BLOCKS, field="--lidar")

    def variant(self, number: int | None = None) -> Workspace:
        """Return the variant of a block, or the one that holds plan, solution, scaffold and seams."""
        lent = {spec.folder: self.workspace.root / spec.folder for spec in UPSTREAM}
        whole = Workspace(self.workspace.root / FOLDER, self.workspace, lent, FOLDER)
        if number is None:
            return whole
        of_block = {
            spec.folder: whole.root / spec.folder
            for spec in (stages.PLAN_BLOCKS, stages.SOLVE, stages.TRAIN_SCAFFOLD)
        }
        return Workspace(whole.root / str(number), self.workspace, lent | of_block, FOLDER)

    def on_gpu(self) -> bool:
        """Return whether a block takes a GPU; a backend that is not available here is an error."""
        return chosen_backend(self.options.backend) == "cuda"

    def plan(self) -> BlockPlan:
        """Return the plan; a MissingProductError: there is none; an InputError: it cannot be read."""
        path = self.variant().root / stages.BLOCK_PLAN
        if not path.is_file():
            raise MissingProductError(
                f"{FOLDER}/{stages.BLOCK_PLAN}", f"georef train {self.workspace.root} --part plan"
            )
        return load_json(BlockPlan, path)

    def trainings(self, plan: BlockPlan) -> list[BlockTraining]:
        return [
            load_json(BlockTraining, self.variant(block.id).path(stages.BLOCK_TRAINING)) for block in plan.blocks
        ]

    def flags(self, spec: stages.StageSpec, number: int | None = None) -> dict[str, Any]:
        """Return all options of a part; `number` is that of the block, for `TRAIN_BLOCK`."""
        effort = self.options.effort
        given = self.options.model_dump(mode="json") | {
            "iterations": effort.iterations,
            "max_image_size": effort.max_image_size,
            "max_gaussians": effort.max_gaussians,
            "id": number,
        }
        if spec is stages.TRAIN_SEAMS:
            given["trained"] = list(self._hashes())
        if spec is stages.SOLVE:
            given["max_image_size"] = min(effort.max_image_size, SCAFFOLD_IMAGE_PX)
        left_out = () if spec is stages.PLAN_BLOCKS else _OF_PLAN
        return {name: given[name] for name in spec.options.model_fields if name in given and name not in left_out}

    def _hashes(self) -> Iterator[str]:
        """Yield the hash of each block's Gaussians; a block that is not trained is an error."""
        for block in self.plan().blocks:
            manifest = self.variant(block.id).manifest(stages.TRAIN_BLOCK)
            if manifest is None:
                command = f"georef train {self.workspace.root} --part {block.id}"
                raise MissingProductError(f"{FOLDER}/{block.id}/{stages.BLOCK_GAUSSIANS}", command)
            yield manifest.files[Path(stages.BLOCK_GAUSSIANS).name].sha256

    def run(
        self, spec: stages.StageSpec, number: int | None = None, *, force: bool = False, progress: Progress = SILENT
    ) -> Outcome:
        """Run a part, unless it is current and not forced, and return its outcome; a GeorefError: it fails."""
        variant = self.variant(number)
        variant.root.mkdir(parents=True, exist_ok=True)
        flags = self.flags(spec, number)
        return run_stage(variant, spec, flags, force=force, resume="if-same", progress=progress)

    def why_missing(self, spec: stages.StageSpec, number: int | None = None) -> str:
        """Return why a part must run: it never has, or is stale or damaged; empty if it is current."""
        variant = self.variant(number)
        try:
            manifest = variant.manifest(spec)
            if manifest is None:
                return "not trained"
            requested = request(variant, spec, self.flags(spec, number), {})
        except (MissingProductError, InputError) as error:
            return str(error)
        return why_damaged(variant.damaged(spec, manifest, {}, by_content=False)) or why_stale(
            variant, requested, manifest
        )

    def is_outdated(self) -> bool:
        """Return whether a block was trained again after the merged model was made."""
        record = self.workspace.root / stages.BLOCK_RECORD
        if not record.is_file():
            return False
        try:
            merged = load_json(BlockRecord, record).blocks
            return [part.training for part in merged] != self.trainings(self.plan())
        except (MissingProductError, InputError):
            return False

    def states(self, plan: BlockPlan) -> dict[int, str]:
        """Return by number of a block `trained`, or why it must be trained."""
        return {block.id: self.why_missing(stages.TRAIN_BLOCK, block.id) or "trained" for block in plan.blocks}

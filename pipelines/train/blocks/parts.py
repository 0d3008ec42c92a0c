"""Parts of a training in blocks: stages in variants of the workspace, each with lock, manifest and log of its own.

`blocks/` holds plan, solution and scaffold, and `blocks/<number>/` one block each.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, Protocol

from pipelines.core.errors import InputError, MissingProductError
from pipelines.core.products import load_json
from pipelines.core.progress import SILENT, Progress
from pipelines.core.runner import Outcome, run_stage
from pipelines.core.stages import (
    BLOCK_GAUSSIANS,
    BLOCK_PLAN,
    BLOCK_RECORD,
    BLOCK_TRAINING,
    PLAN_BLOCKS,
    SOLVE,
    TRAIN_BLOCK,
    TRAIN_SCAFFOLD,
    TRAIN_SEAMS,
    StageSpec,
    stage_slice,
)
from pipelines.core.staleness import request, why_damaged, why_stale
from pipelines.core.workspace import Workspace
from pipelines.splat.rasterizer.backends import chosen_backend
from pipelines.survey.block_plan import SCAFFOLD_IMAGE_PX, BlockPlan, BlockRecord, BlockTraining, PlannedBlock
from pipelines.survey.options import NOT_IN_BLOCKS

FOLDER = "blocks"
_COMMAND = "blocks"
UPSTREAM = stage_slice(None, "init-sim3")
# The plan applies these, and a block is stale with the plan.
_OF_PLAN = ("preset", "blocks", "block_overlap", "block_memory")


class Effort(Protocol):
    """Effort of a training, with the values of its preset."""

    @property
    def iterations(self) -> int:
        """Iterations of each block."""

    @property
    def max_image_size(self) -> int:
        """Longest side of a photograph in pixels."""

    @property
    def max_gaussians(self) -> int:
        """Limit of the Gaussians of the whole."""


class TrainingRequest(Protocol):
    """Options of `train`, as far as its parts need to know them."""

    @property
    def effort(self) -> Effort:
        """Effort of the training."""

    @property
    def backend(self) -> Literal["auto", "cpu", "cuda"]:
        """Rasteriser of the training."""

    @property
    def lidar(self) -> Path | None:
        """LiDAR to hold the surface to."""

    def model_dump(self, *, mode: str) -> dict[str, Any]:
        """Return all options by field."""


@dataclass(frozen=True)
class Parts:
    """Parts of the training of one workspace with given options.

    Attributes:
        workspace: of the survey.
        options: of its training.

    Raises:
        InputError: the training is to use LiDAR.
    """

    workspace: Workspace
    options: TrainingRequest

    def __post_init__(self) -> None:
        """Refuse LiDAR."""
        if self.options.lidar is not None:
            raise InputError(NOT_IN_BLOCKS, field="--lidar")

    @property
    def whole(self) -> Workspace:
        """Variant that holds plan, solution and scaffold."""
        return self.workspace.variant(FOLDER, self._lent(), _COMMAND)

    def of_block(self, number: int) -> Workspace:
        """Return the variant that holds a block."""
        own = {spec.folder: self.whole.root / spec.folder for spec in (PLAN_BLOCKS, SOLVE, TRAIN_SCAFFOLD)}
        return self.workspace.variant(f"{FOLDER}/{number}", self._lent() | own, _COMMAND)

    def on_gpu(self) -> bool:
        """Return whether a block takes a GPU.

        Raises:
            BackendUnavailableError: the backend is not available here.
        """
        return chosen_backend(self.options.backend) == "cuda"

    def plan(self) -> BlockPlan:
        """Return the plan.

        Raises:
            MissingProductError: there is none.
            InputError: the plan cannot be read.
        """
        path = self.whole.root / BLOCK_PLAN
        if not path.is_file():
            raise MissingProductError(f"{FOLDER}/{BLOCK_PLAN}", f"georef blocks plan {self.workspace.root}")
        return load_json(BlockPlan, path)

    def training(self, block: PlannedBlock) -> BlockTraining:
        """Return the record of a trained block.

        Raises:
            InputError: the record cannot be read.
        """
        return load_json(BlockTraining, self.of_block(block.id).path(BLOCK_TRAINING))

    def flags(self, spec: StageSpec, number: int | None = None) -> dict[str, Any]:
        """Return all options of a part.

        Args:
            spec: of the part.
            number: of the block, for `TRAIN_BLOCK`.
        """
        effort = self.options.effort
        given = self.options.model_dump(mode="json") | {
            "iterations": effort.iterations,
            "max_image_size": effort.max_image_size,
            "max_gaussians": effort.max_gaussians,
            "id": number,
        }
        if spec is TRAIN_SEAMS:
            given["trained"] = [self._hash_of(block.id) for block in self.plan().blocks]
        if spec is SOLVE:
            given["max_image_size"] = min(effort.max_image_size, SCAFFOLD_IMAGE_PX)
        left_out = () if spec is PLAN_BLOCKS else _OF_PLAN
        return {name: given[name] for name in spec.options.model_fields if name in given and name not in left_out}

    def _hash_of(self, number: int) -> str:
        """Return the hash of a block's Gaussians.

        Raises:
            MissingProductError: the block is not trained.
        """
        manifest = self.of_block(number).manifest(TRAIN_BLOCK)
        if manifest is None:
            command = f"georef blocks train {self.workspace.root} --id {number}"
            raise MissingProductError(f"{FOLDER}/{number}/{BLOCK_GAUSSIANS}", command)
        return manifest.files[Path(BLOCK_GAUSSIANS).name].sha256

    def run(
        self, spec: StageSpec, number: int | None = None, *, force: bool = False, progress: Progress = SILENT
    ) -> Outcome:
        """Run a part, unless it is current, and return its outcome.

        Args:
            spec: of the part.
            number: of the block, for `TRAIN_BLOCK`.
            force: run even if it is current, and start afresh.
            progress: shows the tasks.

        Raises:
            GeorefError: the part fails.
        """
        variant = self.place(spec, number)
        variant.root.mkdir(parents=True, exist_ok=True)
        flags = self.flags(spec, number)
        return run_stage(variant, spec, flags, force=force, resume="if-same", progress=progress)

    def place(self, spec: StageSpec, number: int | None = None) -> Workspace:
        """Return the variant in which a part runs."""
        return self.whole if number is None else self.of_block(number)

    def why_missing(self, spec: StageSpec, number: int | None = None) -> str:
        """Return why a part must run: it never has, or is stale or damaged; empty if it is current."""
        variant = self.place(spec, number)
        try:
            manifest = variant.manifest(spec)
            if manifest is None:
                return "not trained"
            asked = request(variant, spec, self.flags(spec, number), {})
        except (MissingProductError, InputError) as error:
            return str(error)
        return why_damaged(variant.damaged(spec, manifest, {}, by_content=False)) or why_stale(
            variant, asked, manifest
        )

    def waiting(self, plan: BlockPlan) -> Iterator[PlannedBlock]:
        """Yield the blocks of a plan that are not current."""
        return (block for block in plan.blocks if self.why_missing(TRAIN_BLOCK, block.id))

    def is_merged(self) -> bool:
        """Return whether the merged model holds the blocks as they were last trained."""
        record = self.workspace.root / BLOCK_RECORD
        if not record.is_file():
            return False
        try:
            merged = load_json(BlockRecord, record).blocks
            return [part.training for part in merged] == [self.training(block) for block in self.plan().blocks]
        except (MissingProductError, InputError):
            return False

    def states(self, plan: BlockPlan) -> dict[int, str]:
        """Return by number of a block `trained`, or why it must be trained."""
        return {block.id: self.why_missing(TRAIN_BLOCK, block.id) or "trained" for block in plan.blocks}

    def _lent(self) -> dict[str, Any]:
        return {spec.folder: self.workspace.root / spec.folder for spec in UPSTREAM}

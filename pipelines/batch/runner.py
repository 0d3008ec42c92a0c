"""Run of a batch: each mission is `georef run` in a process of its own, and the table follows their ends."""

from __future__ import annotations

import contextlib
import json
import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pipelines.batch.files import write_batch
from pipelines.batch.missions import Mission, MissionList
from pipelines.batch.table import BatchTable, mission_row, state_of
from pipelines.core.errors import StorageError, storage_failures
from pipelines.core.plan import Action
from pipelines.core.progress import Progress
from pipelines.engine.job import Engine, Job, JobEnd

log = logging.getLogger(__name__)

# Interpreter, libraries, COLMAP's features of large photographs: on top of what is predicted for the training.
BASE_BYTES = 1 << 30


@dataclass(frozen=True)
class PlannedMission:
    """Mission with the forecast of its run.

    Attributes:
        mission: the mission.
        actions: what its run would do with each stage; none where the run will be refused.
        inputs: files and folders that its options name.
        refusal: reason why the run will be refused, else empty.
        training_bytes: predicted peak of its training in main memory; 0 without one, or if unknown.
        uses_gpu: whether it trains on a GPU.
    """

    mission: Mission
    actions: Mapping[str, Action]
    training_bytes: int = 0
    uses_gpu: bool = False
    inputs: tuple[Path, ...] = ()
    refusal: str = ""

    @property
    def is_current(self) -> bool:
        """Whether there is nothing to do."""
        return bool(self.actions) and all(action == "keep" for action in self.actions.values())

    @property
    def peak_bytes(self) -> int:
        """Predicted peak of the memory of its run."""
        return BASE_BYTES + self.training_bytes

    def job(self, folder: Path) -> Job:
        """Return the command that completes the mission of a list in a folder."""
        workspace = self.mission.workspace.root
        return Job(
            self.mission.name,
            run_arguments(self.mission),
            self.peak_bytes,
            self.uses_gpu,
            folder,
            writes=workspace,
            reads=tuple(path for path in self.inputs if not path.is_relative_to(workspace)),
        )


def run_batch(
    listed: MissionList, planned: Sequence[PlannedMission], engine: Engine, progress: Progress
) -> BatchTable:
    """Run the missions that are not current, and return the table of all; one that fails stops no other.

    The table is written beside the missions at the beginning and at the end of each mission, as JSON and as a page.

    Args:
        listed: the missions.
        planned: the same with their forecasts, in the same order.
        engine: runs them.
        progress: shows all missions, and one line for each that runs.

    Raises:
        KeyboardInterrupt: the user stopped the batch; the missions that ran have saved their work.
        StorageError: the table cannot be written.
    """
    rows = {
        plan.mission.name: mission_row(plan.mission, "current" if plan.is_current else "waiting")
        for plan in planned
    }

    def table() -> BatchTable:
        return BatchTable(batch=listed.name, missions=tuple(rows.values()))

    def ended(end: JobEnd) -> None:
        rows[end.job.name] = mission_row(by_name[end.job.name], state_of(end), end)
        with contextlib.suppress(OSError):  # It stops no mission; the last writing tells.
            write_batch(listed.folder, table())

    by_name = {plan.mission.name: plan.mission for plan in planned}
    with storage_failures(listed.folder):
        write_batch(listed.folder, table())
    jobs = [plan.job(listed.folder) for plan in planned if not plan.is_current]
    if jobs:
        engine.run("missions", jobs, ended, progress)
        _write_last(listed, table())
    return table()


def _write_last(listed: MissionList, table: BatchTable) -> None:
    """Write the table; where missions have failed, which tell why, a table that cannot be written is a warning.

    Raises:
        StorageError: all missions are complete, and the table cannot be written.
    """
    try:
        with storage_failures(listed.folder):
            write_batch(listed.folder, table)
    except StorageError as error:
        if table.is_complete:
            raise
        log.warning("the table of the batch is not that of now: %s", error)


def run_arguments(mission: Mission) -> tuple[str, ...]:
    """Return the arguments of `georef` that run a mission; paths in them are absolute."""
    running = {spec.name for spec in mission.stages}
    settings = [
        f"{stage}.{option}={_literal(value)}"
        for stage, flags in mission.flags.items()
        if stage in running
        for option, value in flags.items()
    ]
    return (
        *("run", str(mission.workspace.root.absolute())),
        *(("--to", mission.last) if mission.last else ()),
        *(("--deliver", mission.deliver) if mission.deliver else ()),
        *(word for setting in settings for word in ("--set", setting)),
    )


def _literal(value: Any) -> str:
    """Return a value as TOML writes it, for which JSON's form of texts, numbers and lists will do."""
    return json.dumps(str(value) if isinstance(value, Path) else value, ensure_ascii=False)

"""Batch of missions: each is `georef run` in a process of its own, and a table beside them follows their ends."""

import contextlib
import json
import logging
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Literal
from urllib.parse import quote

from pipelines import __version__
from pipelines.core.errors import GeorefError, StorageError, storage_failures
from pipelines.core.figures import Headline
from pipelines.core.files import replace_text
from pipelines.core.manifest import Manifest
from pipelines.core.plan import Action
from pipelines.core.products import Product, Remark, union
from pipelines.core.progress import Progress
from pipelines.core.stages import REPORT, REPORT_PAGE
from pipelines.core.staleness import cautions_by_stage
from pipelines.jobs.engine import Engine, Job, JobEnd
from pipelines.jobs.missions import Mission, MissionList
from pipelines.report.page import Page, Section, moment, render_page
from pipelines.survey.headline import headline_of
from pipelines.survey.report import read_report

log = logging.getLogger(__name__)

MissionState = Literal["waiting", "current", "done", "interrupted", "failed"]


class MissionRow(Product):
    """Row of the table.

    Attributes:
        workspace: path of its workspace, relative to the folder of the batch.
        state: `waiting`: not run by this batch yet; `current`: there was nothing to do.
        failure, log: reason of the failure, with the stage; log of that stage, relative to the folder of the batch.
        seconds: of this run; None: it did not run.
        processing_s: of all stages, whenever they ran.
        images, registered: number of photographs, and of those in the SfM model.
        test_psnr: mean over the test views, dB.
        report: page of `georef report`, relative to the folder of the batch.
    """

    mission: str
    workspace: str
    state: MissionState
    failure: str | None = None
    log: str | None = None
    seconds: float | None = None
    processing_s: float | None = None
    images: int | None = None
    registered: int | None = None
    accuracy: Headline | None = None
    test_psnr: float | None = None
    report: str | None = None
    warnings: tuple[Remark, ...] = ()
    cautions: tuple[Remark, ...] = ()


class BatchTable(Product):
    """Table of the missions of a batch."""

    format_version: Literal[1] = 1
    batch: str
    missions: tuple[MissionRow, ...]

    @property
    def states(self) -> str:
        """Number of missions by state, such as `3 done, 1 failed`."""
        counts = Counter(row.state for row in self.missions)
        return ", ".join(f"{count} {state}" for state, count in counts.items())

    @property
    def is_complete(self) -> bool:
        return all(row.state in ("done", "current") for row in self.missions)


def mission_row(mission: Mission, state: MissionState, end: JobEnd | None = None) -> MissionRow:
    """Return the row of a mission; it has figures if the mission has its result. Without an end, it did not run."""
    seconds = None if end is None else round(end.seconds, 3)
    row = MissionRow(mission=mission.name, workspace=mission.relative_path, state=state, seconds=seconds)
    if state == "failed" and end is not None:
        log = mission.workspace.root / "logs" / f"{end.step}.log"
        return row.model_copy(
            update={
                "failure": f"{end.step}: {end.error}" if end.step else end.error,
                "log": f"{mission.relative_path}/logs/{end.step}.log" if end.step and log.is_file() else None,
            }
        )
    return row.model_copy(update=_figures(mission)) if state in ("done", "current") else row


def _figures(mission: Mission) -> dict[str, object]:
    workspace = mission.workspace
    manifests: dict[str, Manifest] = {}
    for spec in mission.stages:
        with contextlib.suppress(GeorefError):  # put there by hand, or damaged since
            manifest = workspace.manifest(spec)
            if manifest is not None:
                manifests[spec.name] = manifest
    figures: dict[str, object] = {
        "processing_s": round(sum(manifest.duration_s for manifest in manifests.values()), 3),
        "images": _count(manifests, "ingest", "images"),
        "registered": _count(manifests, "sfm", "registered"),
        "warnings": union(*(manifest.warnings for manifest in manifests.values())),
        "cautions": union(*cautions_by_stage(workspace).values()),
        "accuracy": headline_of(workspace),
        "report": f"{mission.relative_path}/{REPORT_PAGE}" if (workspace.root / REPORT_PAGE).is_file() else None,
    }
    with contextlib.suppress(GeorefError):  # a mission may end before `evaluate`
        test = read_report(workspace.path(REPORT)).test_views
        figures["test_psnr"] = None if test is None else test.psnr
    return figures


def _count(manifests: dict[str, Manifest], stage: str, name: str) -> int | None:
    """Return a whole number among the values of a stage; None without it: users edit manifests."""
    value = manifests[stage].values.get(name) if stage in manifests else None
    return value if isinstance(value, int) else None


def page_file(folder: Path, batch: str) -> Path:
    """Return the path of a batch's page, beside its list."""
    return folder / f"{batch}.batch.html"


def write_batch(folder: Path, table: BatchTable) -> None:
    """Write the table as JSON and as a page; existing files are replaced when the new ones are complete."""
    replace_text(page_file(folder, table.batch), render_page(batch_page(table), __package__))
    replace_text(folder / f"{table.batch}.batch.json", table.model_dump_json(indent=1) + "\n")


def batch_page(table: BatchTable) -> Page:
    """Return the page of a batch: its table with links to the reports, failures, and remarks by mission."""
    links = {row.mission: quote(row.report) for row in table.missions if row.report is not None}
    remarks = [row for row in table.missions if row.warnings or row.cautions]
    failed = [row for row in table.missions if row.failure is not None]
    facts = {"table": table, "links": links, "remarks": remarks, "failed": failed}
    return Page(
        title=f"Batch: {table.batch}",
        subtitle=f"{len(table.missions)} missions: {table.states}",
        about={"Program": f"GeoRefGS {__version__}", "Made": moment(datetime.now(UTC))},
        sections=(
            Section("missions", "Missions", "missions.html", facts),
            *([Section("failures", "Failures", "failures.html", facts)] if failed else []),
            *([Section("remarks", "Warnings and cautions", "remarks.html", facts)] if remarks else []),
        ),
        document=table.model_dump(mode="json"),
    )


# Interpreter, libraries, COLMAP's features of large photographs: on top of what is predicted for the training.
BASE_BYTES = 1 << 30


@dataclass(frozen=True)
class PlannedMission:
    """Mission with the estimate of its run."""

    mission: Mission
    actions: Mapping[str, Action]  # by stage; none where the run will be refused
    training_bytes: int = 0  # predicted peak in main memory; 0 without training, or if unknown
    uses_gpu: bool = False
    inputs: tuple[Path, ...] = ()  # files and folders that its options name
    refusal: str = ""  # reason why the run will be refused

    @property
    def is_current(self) -> bool:
        return bool(self.actions) and all(action == "keep" for action in self.actions.values())

    @property
    def peak_bytes(self) -> int:
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
    `planned` are the missions of the list with their estimates, in the same order.

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
        state: MissionState = "done" if end.is_done else "interrupted" if end.is_interrupted else "failed"
        rows[end.job.name] = mission_row(by_name[end.job.name], state, end)
        with contextlib.suppress(OSError):  # It stops no mission; the last writing tells.
            write_batch(listed.folder, table())

    by_name = {plan.mission.name: plan.mission for plan in planned}
    with storage_failures(listed.folder):
        write_batch(listed.folder, table())
    jobs = [plan.job(listed.folder) for plan in planned if not plan.is_current]
    if jobs:
        engine.run("missions", jobs, ended, progress)
        try:
            with storage_failures(listed.folder):
                write_batch(listed.folder, table())
        except StorageError as error:
            if table().is_complete:
                raise
            log.warning("The table of the batch was not updated. %s", error)  # The failed missions tell more.
    return table()


def run_arguments(mission: Mission) -> tuple[str, ...]:
    """Return the arguments of `georef` that run a mission; paths in them are absolute."""
    running = {spec.name for spec in mission.stages}
    # TOML's form of a value, for which JSON's form of texts, numbers and lists will do.
    settings = [
        f"{stage}.{option}={json.dumps(str(value) if isinstance(value, Path) else value, ensure_ascii=False)}"
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

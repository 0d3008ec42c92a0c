"""Table of a batch: state, accuracy, time and warnings of each mission."""

from __future__ import annotations

import contextlib
from collections import Counter
from collections.abc import Iterable
from typing import Literal

from pipelines.batch.missions import Mission
from pipelines.core.cautions import Caution, union
from pipelines.core.errors import GeorefError
from pipelines.core.figures import Headline
from pipelines.core.manifest import Manifest
from pipelines.core.products import Product
from pipelines.core.stages import REPORT, REPORT_PAGE
from pipelines.core.staleness import cautions_by_stage
from pipelines.engine.job import JobEnd
from pipelines.scene.headline import headline_of
from pipelines.scene.report import read_report

MissionState = Literal["waiting", "current", "done", "interrupted", "failed"]


class MissionRow(Product):
    """Row of the table.

    Attributes:
        mission: its name.
        workspace: path of its workspace, relative to the folder of the batch.
        state: `waiting`: not run by this batch yet; `current`: there was nothing to do.
        failure: reason of the failure, with the stage.
        log: log of the stage that failed, relative to the folder of the batch.
        seconds: of this run; None: it did not run.
        processing_s: of all stages, whenever they ran.
        images, registered: number of photographs, and of those in the SfM model.
        accuracy: headline of its result.
        test_psnr: mean over the test views, dB.
        report: page of `georef report`, relative to the folder of the batch.
        warnings: of the stages.
        cautions: limits of the result.
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
    warnings: tuple[str, ...] = ()
    cautions: tuple[Caution, ...] = ()


class BatchTable(Product):
    """Table of the missions.

    Attributes:
        format_version: version of the format.
        batch: name of the batch.
        missions: one row for each mission.
    """

    format_version: Literal[1] = 1
    batch: str
    missions: tuple[MissionRow, ...]

    @property
    def counts(self) -> Counter[str]:
        """Number of missions by state."""
        return Counter(row.state for row in self.missions)

    @property
    def is_complete(self) -> bool:
        """Whether every mission has its result."""
        return all(row.state in ("done", "current") for row in self.missions)


def mission_row(mission: Mission, state: MissionState, end: JobEnd | None = None) -> MissionRow:
    """Return the row of a mission; it has figures if the mission has its result.

    Args:
        mission: the mission.
        state: of the mission.
        end: of its run; None: it did not run.
    """
    seconds = None if end is None else round(end.seconds, 3)
    row = MissionRow(mission=mission.name, workspace=mission.place, state=state, seconds=seconds)
    if state == "failed" and end is not None:
        log = mission.workspace.root / "logs" / f"{end.place}.log"
        return row.model_copy(
            update={
                "failure": f"{end.place}: {end.error}" if end.place else end.error,
                "log": f"{mission.place}/logs/{end.place}.log" if end.place and log.is_file() else None,
            }
        )
    return row.model_copy(update=_figures(mission)) if state in ("done", "current") else row


def state_of(end: JobEnd) -> MissionState:
    """Return the state of a mission whose run has ended."""
    return "done" if end.is_done else "interrupted" if end.is_interrupted else "failed"


def _figures(mission: Mission) -> dict[str, object]:
    """Return the figures of a mission's products, by field of the row."""
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
        "warnings": _unique(text for manifest in manifests.values() for text in manifest.warnings),
        "cautions": union(*cautions_by_stage(workspace).values()),
        "accuracy": headline_of(workspace),
        "report": f"{mission.place}/{REPORT_PAGE}" if (workspace.root / REPORT_PAGE).is_file() else None,
    }
    with contextlib.suppress(GeorefError):  # a mission may end before `evaluate`
        test = read_report(workspace.path(REPORT)).test_views
        figures["test_psnr"] = None if test is None else test.psnr
    return figures


def _count(manifests: dict[str, Manifest], stage: str, name: str) -> int | None:
    """Return a whole number among the values of a stage; None without it: users edit manifests."""
    value = manifests[stage].values.get(name) if stage in manifests else None
    return value if isinstance(value, int) else None


def _unique(texts: Iterable[str]) -> tuple[str, ...]:
    return tuple(dict.fromkeys(texts))

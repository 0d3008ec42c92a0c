"""Record of the processing: stages with options, inputs, versions and times; assumptions, warnings, cautions.

Also what other stages have left for the page: LiDAR that the training has used, the comparison with a reference,
and the change since an earlier survey.
"""

import contextlib
from collections.abc import Mapping
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from typing import Any

from pipelines.core.errors import InputError
from pipelines.core.figures import DEPTH_ERRORS
from pipelines.core.options import flag_name, notation
from pipelines.core.products import Remark, load_json
from pipelines.core.stages import (
    BY_NAME,
    CHANGE,
    CHANGE_FIGURES,
    LIDAR,
    LIDAR_MAP,
    REFERENCE_HISTOGRAM,
    REFERENCE_MAP,
    StageSpec,
)
from pipelines.core.staleness import cautions_by_stage, status
from pipelines.core.workspace import Workspace
from pipelines.report.page import Picture, png_file, preview
from pipelines.survey.change_report import Change, ChangedRegion
from pipelines.survey.report_parts import LidarReport
from pipelines.survey.survey import Survey

_REPORT = "report"


@dataclass(frozen=True)
class StageRecord:
    """Stage as it was run; None: not recorded."""

    name: str
    state: str  # as in `georef status`, when the report was made
    reason: str  # likewise
    made: datetime | None = None
    duration_s: float | None = None
    key_figure: str = ""
    options: dict[str, str] = field(default_factory=dict)  # by flag, all of them
    inputs: dict[str, str] = field(default_factory=dict)  # SHA-256 by product or flag
    warnings: tuple[Remark, ...] = ()


@dataclass(frozen=True)
class RecordFacts:
    """Processing of a survey: its stages in the order of the work, assumptions of `ingest`, cautions by stage."""

    stages: tuple[StageRecord, ...]
    total_s: float  # sum of the recorded durations
    versions: dict[str, str]  # by name, with the stages that ran with them if not all did
    assumptions: tuple[Remark, ...]
    cautions: dict[str, tuple[Remark, ...]]
    by_hand: tuple[str, ...]  # stages whose product was put there by hand

    @property
    def remarks(self) -> list[tuple[str, tuple[Remark, ...]]]:
        """Warnings and cautions, each with its stage."""
        return [*((stage.name, stage.warnings) for stage in self.stages), *self.cautions.items()]


def record_facts(workspace: Workspace, survey: Survey) -> RecordFacts:
    """Return what the appendix shows of all stages but `report`: state, options, inputs, warnings and versions."""
    stages: list[StageRecord] = []
    versions: dict[str, dict[str, list[str]]] = {}
    for row in status(workspace):
        if row.stage == _REPORT:
            continue
        manifest, spec = None, BY_NAME[row.stage]
        with contextlib.suppress(InputError):  # `state` tells
            manifest = workspace.manifest(spec)
        if manifest is None:
            stages.append(StageRecord(spec.name, row.state, row.reason))
            continue
        stages.append(
            StageRecord(
                name=spec.name,
                state=row.state,
                reason=row.reason,
                made=manifest.finished,
                duration_s=manifest.duration_s,
                key_figure=manifest.key_figure,
                options=_options(spec, manifest.config),
                inputs=manifest.inputs,
                warnings=manifest.warnings,
            )
        )
        for name, version in manifest.versions.items():
            versions.setdefault(name, {}).setdefault(version, []).append(row.stage)
    return RecordFacts(
        stages=tuple(stages),
        total_s=sum(stage.duration_s or 0.0 for stage in stages),
        versions={
            name: "; ".join(
                version if len(by_version) == 1 else f"{version} ({', '.join(ran)})"
                for version, ran in by_version.items()
            )
            for name, by_version in versions.items()
        },
        assumptions=survey.assumptions,
        cautions=cautions_by_stage(workspace),
        by_hand=tuple(stage.name for stage in stages if stage.made is None and stage.state == "current"),
    )


def _options(spec: StageSpec, config: Mapping[str, Any]) -> dict[str, str]:
    """Return the recorded options of a stage by flag, as users write their values."""
    try:
        options = spec.options.model_validate(config)
    except ValueError:  # of a version with other options
        return {name: _notation(value) for name, value in config.items()}
    fields = type(options).model_fields
    return {flag_name(spec.options, name): _notation(getattr(options, name)) for name in fields}


def _notation(value: object) -> str:
    """Return a value as users write it; a path without its folders, which are nobody's business."""
    if isinstance(value, Path) or (isinstance(value, str) and Path(value).is_absolute()):
        return Path(value).name
    if value is None:
        return "not given"
    if isinstance(value, bool):
        return "yes" if value else "no"
    return notation(value) or "none"


_MAP_PX = 1400
_LISTED = 12


@dataclass(frozen=True)
class LidarFacts:
    """LiDAR of a training: axis, shift and σ in metres; number of areas in the table; their map if it was kept.

    `errors`: field, head and form of each column of the errors at points that were held out.
    """

    report: LidarReport
    shift: tuple[tuple[str, float, float], ...]
    listed: int
    map: Picture | None
    errors: tuple[tuple[str, str, str], ...] = tuple(
        (name, figure.label, "whole" if not figure.unit else "signed" if name == "bias_m" else "metres")
        for name, figure in DEPTH_ERRORS.items()
    )


def lidar_facts(workspace: Workspace) -> LidarFacts | None:
    """Return the LiDAR of a training; None: it has used none."""
    if not (workspace.root / LIDAR).is_file():
        return None
    report = load_json(LidarReport, workspace.root / LIDAR)
    registration = report.registration
    return LidarFacts(
        report,
        tuple(zip(("east", "north", "up"), registration.shift_m, registration.sigma_m, strict=True)),
        min(len(report.areas), _LISTED),
        preview(workspace.root / LIDAR_MAP, _MAP_PX),
    )


@dataclass(frozen=True)
class ChangeFacts:
    """Change since an earlier survey, and the largest regions that changed; `change` None: it is out of date.

    `listed` holds the user's polygons first; `earlier` is the name of the earlier workspace.
    """

    change: Change | None
    earlier: str
    listed: tuple[ChangedRegion, ...]


def change_facts(workspace: Workspace, record: RecordFacts) -> ChangeFacts | None:
    """Return the change since an earlier survey; None: there is none."""
    made = next((one for one in record.stages if one.name == CHANGE.name), None)
    if made is None or not (workspace.root / CHANGE_FIGURES).is_file():
        return None
    earlier = Path(made.options.get("--before", "")).name
    if made.state != "current":
        return ChangeFacts(None, earlier, ())
    change = load_json(Change, workspace.root / CHANGE_FIGURES)
    return ChangeFacts(change, earlier, change.regions[:_LISTED])


def reference_facts(workspace: Workspace) -> dict[str, Picture | None]:
    """Return the pictures of a comparison; None: nothing was measured."""
    products = {"map": REFERENCE_MAP, "histogram": REFERENCE_HISTOGRAM}
    return {name: png_file(workspace.root / product) for name, product in products.items()}

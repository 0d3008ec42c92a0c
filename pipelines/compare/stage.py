"""Ablation: one survey trained and measured in several configurations, compared in one table.

Each configuration is a variant of the workspace at `compare/<name>/`. The variant runs the stages in which it
differs, and reads the folders of all other stages. As in `georef run`, current stages are skipped and interrupted
ones are resumed.
"""

import logging
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field

from pipelines.compare.configurations import BY_CONFIGURATION, COMMON_TRAIN_OPTIONS, Configuration
from pipelines.compare.table import ComparedRow, Comparison, PointAccuracy, compared_surface, write_comparison
from pipelines.core.errors import ConvergenceError, DegenerateGeometryError, GeorefError, InputError
from pipelines.core.options import read_requests, remember
from pipelines.core.products import union
from pipelines.core.progress import SILENT, Progress
from pipelines.core.runner import Outcome, run_pipeline, run_stage
from pipelines.core.stages import ADJUST, BY_NAME, REPORT, StageSpec, stage_slice
from pipelines.core.staleness import Flags, must_exist, stage_config
from pipelines.core.workspace import Workspace
from pipelines.survey.report import read_report

log = logging.getLogger(__name__)

FOLDER = "compare"
_SHARED = stage_slice(None, "geolocate")
_INIT, _TRAIN, _EVALUATE = BY_NAME["init-sim3"], BY_NAME["train"], BY_NAME["evaluate"]

_RESULTS = (DegenerateGeometryError, ConvergenceError)  # errors that are the result of a configuration

StageContext = Callable[[Workspace, StageSpec], AbstractContextManager[None]]


@dataclass(frozen=True)
class VariantStage:
    """Stage to run in a variant, with its options."""

    variant: Workspace
    spec: StageSpec
    flags: Flags


@dataclass(frozen=True)
class ComparedStage:
    """Outcome of a stage, with the configuration that requested it; None: all share it."""

    configuration: str | None
    outcome: Outcome


def compare(
    workspace: Workspace,
    configurations: Sequence[Configuration],
    flags: Flags,
    *,
    force: bool = False,
    progress: Progress = SILENT,
    around: StageContext = lambda _workspace, _spec: nullcontext(),
) -> tuple[Comparison, list[ComparedStage]]:
    """Bring the configurations up to date, write the table of their figures, and return it and the stages run.

    The stages up to geolocate are shared, and run first if they are not current. A configuration whose geometry or
    training fails has a row with the reason, and the others continue.

    Args:
        flags: options of `train` for all configurations (`seed` also for the similarity). They override those of
            the last comparison, which override those of the last request for `train`. They are remembered.
        force: run the stages of the configurations even if they are current.
        around: returns the context in which a stage runs, such as its log file.

    Raises:
        GeorefError: the first other failure.
    """
    must_exist(workspace)
    if flags.get("georeference") == "frozen":
        message = "'frozen' would make C, D and E one with A: choose joint or paper."
        raise InputError("georeference-frozen", message, field="--georeference")
    with workspace.lock(FOLDER):
        requests = read_requests(workspace.root)
        requested = {**requests.get("train", {}), **requests.get(FOLDER, {}), **flags}
        requested = {name: value for name, value in requested.items() if name in COMMON_TRAIN_OPTIONS}
        if requested.get("georeference") == "frozen":  # of a training: the configurations decide what moves
            del requested["georeference"]
        plans = [
            (configuration, tuple(_plan(workspace, configuration, requested))) for configuration in configurations
        ]
        for _, plan in plans:
            for planned in plan:
                stage_config(planned.variant, planned.spec, planned.flags)  # a bad option costs no hours
        remember(workspace.root, {FOLDER: requested})
    shared = run_pipeline(workspace, _SHARED, {}, progress=progress, around=lambda spec: around(workspace, spec))
    with workspace.lock(FOLDER):
        runner = _PlanRunner([ComparedStage(None, outcome) for outcome in shared], force, progress, around)
        rows = tuple(_row(configuration, plan, runner) for configuration, plan in plans)
        scalars = {
            name: value if isinstance(value, bool | int | float) else str(value)
            for name, value in requested.items()
        }
        table = Comparison(options=scalars, rows=rows)
        write_comparison(workspace.root / FOLDER, table, workspace.root.name)
    return table, runner.finished


def _plan(workspace: Workspace, configuration: Configuration, requested: Flags) -> Iterator[VariantStage]:
    """Yield the stages of a configuration in order, after those of the configuration whose training it uses."""
    variant_folder, root = f"{FOLDER}/{configuration.name}", workspace.root
    shared = {spec.folder: root / spec.folder for spec in _SHARED}
    seed = {"seed": requested["seed"]} if "seed" in requested else {}
    lent = dict(shared)  # folders that the variant reads and does not write
    if configuration.sim3 is None:
        yield VariantStage(Workspace(root / variant_folder, workspace, shared, FOLDER), ADJUST, seed)
        lent |= dict.fromkeys(("sfm", _INIT.folder), root / variant_folder / ADJUST.folder)
    if configuration.trained_by is not None:
        trainer = BY_CONFIGURATION[configuration.trained_by]
        plan = _plan(workspace, trainer, requested)
        yield from (planned for planned in plan if planned.spec is not _EVALUATE)
        lent[_TRAIN.folder] = root / FOLDER / trainer.name / _TRAIN.folder
    variant = Workspace(root / variant_folder, workspace, lent, FOLDER)
    if configuration.sim3 is not None:
        yield VariantStage(variant, _INIT, {**configuration.sim3, "max_residual": None, **seed})
    if configuration.trained_by is None:
        yield VariantStage(variant, _TRAIN, {"georeference": "joint", **requested, **configuration.train})
    similarity = "trained" if configuration.trained_by is None else "initial"
    backend = {"backend": requested["backend"]} if "backend" in requested else {}
    evaluated = read_requests(workspace.root).get(_EVALUATE.name, {})
    yield VariantStage(variant, _EVALUATE, {**evaluated, **backend, "similarity": similarity})


@dataclass
class _PlanRunner:
    """Runner that runs each planned stage once, even if several configurations plan it."""

    finished: list[ComparedStage]
    force: bool
    progress: Progress
    around: StageContext
    _by_place: dict[tuple[str, str], Outcome | GeorefError] = field(default_factory=dict)

    def run(self, configuration: Configuration, planned: VariantStage) -> Outcome:
        """Return the outcome of a stage, run now or before; a GeorefError: it fails, or has failed before."""
        key = (str(planned.variant.root), planned.spec.name)
        if key not in self._by_place:
            planned.variant.root.mkdir(parents=True, exist_ok=True)
            try:
                with self.around(planned.variant, planned.spec):
                    self._by_place[key] = run_stage(
                        planned.variant,
                        planned.spec,
                        planned.flags,
                        force=self.force,
                        resume="if-same",
                        progress=self.progress,
                    )
            except _RESULTS as error:
                self._by_place[key] = error
        outcome = self._by_place[key]
        if isinstance(outcome, GeorefError):
            raise outcome
        if all(stage.outcome is not outcome for stage in self.finished):
            self.finished.append(ComparedStage(configuration.name, outcome))
        return outcome


def _row(configuration: Configuration, plan: Sequence[VariantStage], runner: _PlanRunner) -> ComparedRow:
    """Run a configuration and return the row of its figures."""
    log.info("configuration %s: %s", configuration.name, configuration.title)
    identity = {"configuration": configuration.name, "title": configuration.title, "note": configuration.note}
    try:
        # Of two runs of init-sim3 the later is the configuration's own.
        manifests = {planned.spec.name: runner.run(configuration, planned).manifest for planned in plan}
    except _RESULTS as error:
        log.warning("configuration %s failed: %s", configuration.name, error)
        return ComparedRow(**identity, failure=str(error))
    del manifests[_EVALUATE.name]  # Its warnings concern the survey, which all rows share.
    training = manifests[_TRAIN.name].values
    report = read_report(plan[-1].variant.path(REPORT))
    test = report.test_views
    assert test is not None and report.checkpoints.surface is not None  # every configuration trains
    return ComparedRow(
        **identity,
        test_psnr=test.psnr,
        test_psnr_covered=test.psnr_covered,
        test_covered_share=test.covered_share,
        test_ssim=test.ssim,
        triangulated=PointAccuracy.model_validate(report.checkpoints.triangulated, from_attributes=True),
        surface=PointAccuracy.model_validate(report.checkpoints.surface, from_attributes=True),
        reference=compared_surface(report.reference),
        iterations=training.get("iterations"),
        gaussians=training.get("gaussians"),
        training_s=training.get("seconds") if configuration.trained_by is None else None,
        warnings=union(*(manifest.warnings for manifest in manifests.values())),
        cautions=union(*(manifest.cautions for manifest in manifests.values())),
    )

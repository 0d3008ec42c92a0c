"""The ablation: one survey trained and measured in several configurations (method, section 4), in one table.

Each configuration is a variant of the workspace at `compare/<name>/`: it runs the stages in which it differs, and
reads the folders of the others where they are. What is current is skipped, what was interrupted goes on, as in
`georef run`.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field
from typing import Any

from pipelines.compare.table import ComparedRow, Comparison, figures_of, write_comparison
from pipelines.core.errors import ConvergenceError, DegenerateGeometryError, GeorefError, InputError
from pipelines.core.progress import SILENT, Progress
from pipelines.core.runner import Outcome, run_pipeline, run_stage
from pipelines.core.stages import ADJUST, BY_NAME, REPORT, StageSpec, stage_slice
from pipelines.core.staleness import Flags, must_exist, stage_config
from pipelines.core.workspace import Workspace

log = logging.getLogger(__name__)

FOLDER = "compare"
_SHARED = stage_slice(None, "geolocate")
_INIT, _TRAIN, _EVALUATE = BY_NAME["init-sim3"], BY_NAME["train"], BY_NAME["evaluate"]
_FIXED = {
    "optimize_cameras": False,
    "geo_loss": False,
    "gcp_loss": False,
    "rel_loss": False,
    "geo_schedule": "constant",
}
_JOINT = {**_FIXED, "optimize_cameras": True, "geo_loss": True}

_RESULTS = (DegenerateGeometryError, ConvergenceError)  # errors that say something of a configuration

Around = Callable[[Workspace, StageSpec], AbstractContextManager[None]]


@dataclass(frozen=True)
class Configuration:
    """One row of the ablation.

    Attributes:
        name: as in `--configs`.
        title: what it is.
        note: what sets it apart, in a line.
        sim3: options of `init-sim3` that make it; None: a bundle adjustment with the fixes places the model.
        train: options of `train` that make it; those of A where `trained_by` says A.
        trained_by: the configuration whose training it takes, itself if None.
    """

    name: str
    title: str
    note: str
    sim3: Mapping[str, Any] | None
    train: Mapping[str, Any] = field(default_factory=dict)
    trained_by: str | None = None


CONFIGURATIONS: tuple[Configuration, ...] = (
    Configuration(
        "baseline", "SfM-BBA + 3DGS",
        "bundle adjustment with the fixes as priors, then cameras fixed and no geographic loss; no control points",
        None, _FIXED,
    ),
    Configuration(
        "A", "3DGS, aligned afterwards",
        "SfM's cameras fixed, no geographic loss; similarity robustly from camera centres and fixes",
        {"method": "robust", "control_points": False}, _FIXED,
    ),
    Configuration(
        "B", "geolocation + initial similarity",
        "the Gaussians of A, placed by the paper's similarity of the geolocated points",
        {"method": "paper", "control_points": False}, trained_by="A",
    ),
    Configuration(
        "C", "B + joint T and cameras, L_abs",
        "similarity and cameras trained with L_abs alone, from a robust start; no control points",
        {"method": "robust", "control_points": False}, _JOINT,
    ),
    Configuration(
        "D", "C + L_gcp + L_rel",
        "control points and relative distances too, at constant weight",
        {"method": "robust", "control_points": True}, {**_JOINT, "gcp_loss": True, "rel_loss": True},
    ),
    Configuration(
        "E", "D + adaptive weight, the full method",
        "the weight of the geographic losses rises while training",
        {"method": "robust", "control_points": True},
        {**_JOINT, "gcp_loss": True, "rel_loss": True, "geo_schedule": "rising"},
    ),
)  # fmt: skip
NAMES = tuple(configuration.name for configuration in CONFIGURATIONS)
# What makes the configurations is not for the user to set; all other options of `train` are, for all alike.
TRAIN_OPTIONS = tuple(name for name in _TRAIN.options.model_fields if name not in _FIXED)


@dataclass(frozen=True)
class Step:
    """A stage to run in a variant, with its options."""

    variant: Workspace
    spec: StageSpec
    flags: Flags


@dataclass(frozen=True)
class Ran:
    """The outcome of a stage, and the configuration that asked for it (or for none in particular)."""

    configuration: str | None
    outcome: Outcome


def chosen(text: str) -> tuple[Configuration, ...]:
    """Configurations by their names, with commas, each once.

    Raises:
        InputError: a name that is none.
    """
    by_name = {configuration.name: configuration for configuration in CONFIGURATIONS}
    names = [name.strip() for name in text.split(",") if name.strip()]
    unknown = [name for name in names if name not in by_name]
    if unknown or not names:
        message = f"{unknown[0]!r} is none of {', '.join(NAMES)}" if unknown else f"choose from {', '.join(NAMES)}"
        raise InputError(message, field="--configs")
    return tuple(by_name[name] for name in dict.fromkeys(names))


def compare(
    workspace: Workspace,
    configurations: Sequence[Configuration],
    flags: Flags,
    *,
    force: bool = False,
    progress: Progress = SILENT,
    around: Around = lambda _workspace, _spec: nullcontext(),
) -> tuple[Comparison, list[Ran]]:
    """Bring the configurations up to date and write the table of their figures.

    Stages up to geolocate are shared, and run first where they are not current. A configuration whose geometry or
    training fails has a row that says why; the others go on.

    Args:
        flags: options of `train` for all configurations (`seed` also for the similarity). They come on top of those
            of the last comparison, these on top of what `train` was last asked for with, and are remembered.
        force: run the stages of the configurations even if they are current.
        around: a context to run each stage in.

    Raises:
        GeorefError: the first other failure.
    """
    must_exist(workspace)
    with workspace.lock(FOLDER):
        requests = workspace.requests()
        asked = {**requests.get("train", {}), **requests.get(FOLDER, {}), **flags}
        asked = {name: value for name, value in asked.items() if name in TRAIN_OPTIONS}
        plans = [(each, list(_plan(workspace, each, asked))) for each in configurations]
        for _, steps in plans:
            for step in steps:
                stage_config(step.variant, step.spec, step.flags)  # a bad option costs no hours
        workspace.remember({FOLDER: asked})
    shared = run_pipeline(workspace, _SHARED, {}, progress=progress, around=lambda spec: around(workspace, spec))
    with workspace.lock(FOLDER):
        runner = _Runner([Ran(None, outcome) for outcome in shared], force, progress, around)
        rows = tuple(_row(configuration, steps, runner) for configuration, steps in plans)
        table = Comparison(options=stated(asked), rows=rows)
        write_comparison(workspace.root / FOLDER, table)
    return table, runner.ran


def stated(options: Flags) -> dict[str, Any]:
    """Options as JSON holds them."""
    return {name: value if isinstance(value, bool | int | float) else str(value) for name, value in options.items()}


def _plan(workspace: Workspace, configuration: Configuration, asked: Flags) -> Iterator[Step]:
    """The stages of a configuration, in order, those of the training that it takes from another included."""
    place, root = f"{FOLDER}/{configuration.name}", workspace.root
    shared = {spec.folder: root / spec.folder for spec in _SHARED}
    seed = {"seed": asked["seed"]} if "seed" in asked else {}
    lent = dict(shared)
    if configuration.sim3 is None:
        yield Step(workspace.variant(place, shared), ADJUST, seed)
        lent |= dict.fromkeys(("sfm", _INIT.folder), root / place / ADJUST.folder)
    if configuration.trained_by is not None:
        other = next(each for each in CONFIGURATIONS if each.name == configuration.trained_by)
        yield from (step for step in _plan(workspace, other, asked) if step.spec is not _EVALUATE)
        lent[_TRAIN.folder] = root / FOLDER / other.name / _TRAIN.folder
    variant = workspace.variant(place, lent)
    if configuration.sim3 is not None:
        yield Step(variant, _INIT, {**configuration.sim3, "max_residual": None, **seed})
    if configuration.trained_by is None:
        yield Step(variant, _TRAIN, {**asked, **configuration.train})
    placed = "trained" if configuration.trained_by is None else "initial"
    backend = {"backend": asked["backend"]} if "backend" in asked else {}
    evaluated = workspace.requests().get(_EVALUATE.name, {})
    yield Step(variant, _EVALUATE, {**evaluated, **backend, "similarity": placed})


@dataclass
class _Runner:
    """Runs each step once, whoever asks for it."""

    ran: list[Ran]
    force: bool
    progress: Progress
    around: Around
    _done: dict[tuple[str, str], Outcome | GeorefError] = field(default_factory=dict)

    def run(self, configuration: Configuration, step: Step) -> Outcome:
        """The outcome of a step.

        Raises:
            GeorefError: it fails, or has failed before.
        """
        key = (str(step.variant.root), step.spec.name)
        if key not in self._done:
            try:
                self._done[key] = self._run(step)
            except _RESULTS as error:
                self._done[key] = error
        outcome = self._done[key]
        if isinstance(outcome, GeorefError):
            raise outcome
        if all(each.outcome is not outcome for each in self.ran):
            self.ran.append(Ran(configuration.name, outcome))
        return outcome

    def _run(self, step: Step) -> Outcome:
        variant, spec = step.variant, step.spec
        variant.root.mkdir(parents=True, exist_ok=True)
        with self.around(variant, spec):
            return run_stage(variant, spec, step.flags, force=self.force, resume="if-same", progress=self.progress)


def _row(configuration: Configuration, steps: Sequence[Step], runner: _Runner) -> ComparedRow:
    """Run a configuration and read its figures."""
    log.info("configuration %s: %s", configuration.name, configuration.title)
    row = ComparedRow(configuration=configuration.name, title=configuration.title, note=configuration.note)
    try:
        # Of two runs of init-sim3 the later is the configuration's own.
        manifests = {step.spec.name: runner.run(configuration, step).manifest for step in steps}
    except _RESULTS as error:
        log.warning("configuration %s failed: %s", configuration.name, error)
        return row.model_copy(update={"failure": str(error)})
    del manifests[_EVALUATE.name]  # it warns of the survey, which is that of all rows
    trained = manifests[_TRAIN.name].values
    figures = {
        **figures_of(steps[-1].variant.path(REPORT)),
        "iterations": trained.get("iterations"),
        "gaussians": trained.get("gaussians"),
        "training_s": trained.get("seconds") if configuration.trained_by is None else None,
        "warnings": tuple(text for manifest in manifests.values() for text in manifest.warnings),
    }
    return row.model_copy(update=figures)

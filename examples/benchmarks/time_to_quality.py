"""Quality of a splat against the time since the start of `georef run`.

The first run compiles all kernels into an empty cache (cold), the others find them there (warm). While a run goes
on, each checkpoint of its training is kept, with its age. Afterwards the checkpoints are measured: PSNR of the test
and training views, and errors of the check points on the rendered surface. The time includes writing them, but not
measuring them.

    python examples/benchmarks/time_to_quality.py OUT --runs 2 -- --images photos --preset fast …
"""

from __future__ import annotations

import argparse
import itertools
import json
import os
import subprocess
import sys
import threading
import time
from contextlib import suppress
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from pathlib import Path

# As the command line does, and for the same reason: see georef_cli/main.py.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

from training import ViewQuality

from pipelines.adjust.solution import posterior_of
from pipelines.core.progress import SILENT
from pipelines.core.stages import PIPELINE, POINTS
from pipelines.core.workspace import Workspace
from pipelines.evaluate.check_points import check_points_on_surface
from pipelines.evaluate.photometric import compare_test_views
from pipelines.jobs.machine import inspect_machine
from pipelines.splat.rasterizer.backends import rasterizer
from pipelines.surface.surface_views import ModelRenderer
from pipelines.survey.scene import load_adjusted_scene, photographs
from pipelines.survey.solution import GeolocatedPoints
from pipelines.train.georeference.problem import frozen_problem, refining_problem
from pipelines.train.initial_gaussians import TrainingScene
from pipelines.train.options import TrainOptions
from pipelines.train.solution_state import measured_problem, solved_at
from pipelines.train.stage import trained_model
from pipelines.train.trainer import load_checkpoint, make_trainer

_POLL_S = 0.1
_GEOREF = (sys.executable, "-c", "from georef_cli.main import main; main()")


@dataclass(frozen=True)
class Row:
    """Figures of one checkpoint.

    Attributes:
        seconds: from the start of the command until the checkpoint was written.
        iteration: of the training.
        gaussians: their number.
        psnr: mean over the test views, of the renders as they are, dB.
        train_psnr: mean over the training views, of the renders with the exposures of their photographs, dB.
        surface_mean_h_m: mean horizontal error of the check points on the rendered surface; None: no check points.
        surface_median_h_m: likewise the median.
        surface_rmse_v_m: likewise the RMSE of the heights.
    """

    seconds: float
    iteration: int
    gaussians: int
    psnr: float | None
    train_psnr: float
    surface_mean_h_m: float | None
    surface_median_h_m: float | None
    surface_rmse_v_m: float | None


class CheckpointWatch:
    """Keeps each checkpoint of a running training: a second name for the file, which the training then replaces."""

    def __init__(self, workspace: Workspace, kept: Path) -> None:
        self._source, self._kept = workspace.root / "train.partial" / "checkpoint.npz", kept
        self._began, self._ended = time.monotonic(), threading.Event()
        self.age_s: dict[Path, float] = {}
        self._seen: set[int] = set()
        kept.mkdir(parents=True)
        self._thread = threading.Thread(target=self._watch, daemon=True)
        self._thread.start()

    def end(self, last: Path) -> None:
        """Stop to watch; the `last` checkpoint is kept, too, if it was moved away before it was seen."""
        self._ended.set()
        self._thread.join()
        self._keep(last)

    def _watch(self) -> None:
        while not self._ended.wait(_POLL_S):
            with suppress(FileNotFoundError):
                self._keep(self._source)

    def _keep(self, checkpoint: Path) -> None:
        if checkpoint.stat().st_ino not in self._seen:
            copy = self._kept / f"{len(self.age_s):04d}.npz"
            copy.hardlink_to(checkpoint)
            self._seen.add(copy.stat().st_ino)  # no other file has it as long as the copy exists
            self.age_s[copy] = time.monotonic() - self._began


def timed_run(workspace: Workspace, arguments: list[str], every: int, cache: Path) -> dict[str, object]:
    """Run `georef run`, and return the seconds of the whole and of each stage, the memory, and all rows."""
    workspace.root.parent.mkdir(parents=True, exist_ok=True)
    command = [*_GEOREF, "run", str(workspace.root), *arguments, "--set", f"train.checkpoint_every={every}"]
    watch = CheckpointWatch(workspace, workspace.root.with_name(f"{workspace.root.name}-checkpoints"))
    began = time.monotonic()
    log = workspace.root.with_name(f"{workspace.root.name}.log")
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(cache)}
    with log.open("wb") as output:
        process = subprocess.Popen(command, env=environment, stdout=output, stderr=output)
        _, status, usage = os.wait4(process.pid, 0)  # with those of the processes that it has waited for
        process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode != 0:
        sys.exit(f"{' '.join(command)} failed: see {log}")
    seconds = time.monotonic() - began
    watch.end(workspace.root / "train" / "checkpoint.npz")
    manifests = ((spec.name, workspace.manifest(spec)) for spec in PIPELINE)
    stages = {name: round(manifest.duration_s, 1) for name, manifest in manifests if manifest is not None}
    rows = [asdict(row) for row in measured(workspace, watch.age_s)]
    peak_mib = usage.ru_maxrss // 1024  # of the largest process, Linux counts in KiB
    return {"seconds": round(seconds, 1), "peak_mib": peak_mib, "stages_s": stages, "rows": rows}


def measured(workspace: Workspace, age_s: dict[Path, float]) -> list[Row]:
    """Return the figures of checkpoints, given their ages."""
    manifest = workspace.manifest(next(spec for spec in PIPELINE if spec.name == "train"))
    assert manifest is not None
    # Gaussians come from the checkpoints: the stereo that only places the first ones is not repeated.
    options = TrainOptions.model_validate({**manifest.config, "dense": False})
    (started, survey, scene), backend = load_adjusted_scene(workspace), rasterizer(options.backend)
    solved = scene.at(started)
    images = photographs(solved.sparse, survey, workspace, options.effort.max_image_size)
    observed = measured_problem(started, survey, scene, control_points=options.gcp_loss)
    refines, points = options.refined_cameras(len(images)) > 0, GeolocatedPoints.load(workspace.path(POINTS))
    problem = frozen_problem(started, scene)
    if refines:
        posterior = posterior_of(workspace, started, scene.sparse)
        problem = refining_problem(posterior, survey, scene, observed, options, points=points, seed=options.seed)
    trainer = make_trainer(TrainingScene(solved, images), problem, backend, options)
    rows: list[Row] = []
    for path, seconds in age_s.items():
        trainer.restore(load_checkpoint(path))
        if trainer.iteration == 0 or (rows and rows[-1].iteration == trainer.iteration):
            continue  # the last one is written twice
        solution = started
        if refines:
            solution = solved_at(started, survey, scene, observed, problem.unknowns.state()).solution
        model = trained_model(trainer, solution)
        gaussians = trainer.optimizer.gaussians.detached()
        renderer = ModelRenderer(model, scene.sparse, gaussians, images, backend)
        views = compare_test_views(renderer, None, lambda _name, _picture: None, SILENT, saved=0)
        errors = check_points_on_surface(survey.check_points, renderer, SILENT)
        train_psnr = ViewQuality(trainer, images).psnr(scene.train)
        rows.append(
            Row(
                round(seconds, 1), trainer.iteration, model.gaussians, views.psnr, train_psnr,
                errors.mean_h_m, errors.median_h_m, errors.rmse_v_m,
            )
        )  # fmt: skip
    return rows


def time_to(rows: list[dict[str, float]], psnr: float) -> float | None:
    """Return the seconds after which a PSNR was reached, linear between checkpoints; None: never."""
    for before, after in itertools.pairwise(rows):
        if before["psnr"] < psnr <= after["psnr"]:
            share = (psnr - before["psnr"]) / (after["psnr"] - before["psnr"])
            return round(before["seconds"] + share * (after["seconds"] - before["seconds"]), 1)
    return rows[0]["seconds"] if rows and rows[0]["psnr"] >= psnr else None


def print_run(name: str, run: dict[str, object]) -> None:
    """Print the stages and the rows of a run."""
    stages = ", ".join(f"{stage} {seconds} s" for stage, seconds in run["stages_s"].items())  # type: ignore[attr-defined]
    print(f"\n{name}: {run['seconds']} s ({stages}), {run['peak_mib']} MiB\n")
    print(
        "| time | iteration | Gaussians | test PSNR | train PSNR | on the surface: mean H | median H | RMSE V |\n|"
        + "---|" * 8
    )
    for row in run["rows"]:  # type: ignore[attr-defined]
        errors = [row["surface_mean_h_m"], row["surface_median_h_m"], row["surface_rmse_v_m"]]
        cells = " | ".join("" if value is None else f"{value:.3f} m" for value in errors)
        quality = f"{row['psnr']:.2f} dB | {row['train_psnr']:.2f} dB"
        print(f"| {row['seconds']:.0f} s | {row['iteration']} | {row['gaussians']} | {quality} | {cells} |")
    for target in (25, 27, 29, 31):
        print(f"{target} dB after {time_to(run['rows'], target)} s")  # type: ignore[arg-type]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path, help="empty folder for workspaces, caches and time_to_quality.json")
    parser.add_argument(
        "--runs", type=int, default=2, help="number of runs: the first is cold, the others are warm"
    )
    parser.add_argument("--cache", type=Path, help="folder of compiled kernels (default: an empty one)")
    parser.add_argument("--every", type=int, default=250, help="iterations between two checkpoints")
    parser.add_argument("arguments", nargs="+", help="arguments of `georef run` without the workspace, after --")
    arguments = parser.parse_args()
    cache = arguments.cache or arguments.out / "kernels"
    runs = {}
    for number in range(arguments.runs):
        name = "cold" if number == 0 and arguments.cache is None else f"warm-{number}"
        runs[name] = timed_run(
            Workspace(arguments.out / name), arguments.arguments, arguments.every, cache.resolve()
        )
        print_run(name, runs[name])
        document = {
            "command": ["georef", "run", "WORKSPACE", *arguments.arguments],
            "date": datetime.now(UTC).isoformat(timespec="seconds"),
            "machine": asdict(inspect_machine()),
            "runs": runs,
        }
        (arguments.out / "time_to_quality.json").write_text(json.dumps(document, indent=1), encoding="utf-8")


if __name__ == "__main__":
    main()

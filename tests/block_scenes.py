"""A survey of a wide field in strips, whose photographs are renders of known Gaussians: to be trained in blocks."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from georef_cli import boundary
from georef_cli.main import cli
from pipelines.core.progress import Progress
from pipelines.core.workspace import Workspace
from pipelines.jobs.engine import Job, JobEnd
from pipelines.jobs.local import chosen_engine
from pipelines.splat.gaussians import Gaussians
from pipelines.splat.sh import sh_from_rgb
from tests.scenes import Measured, TrueScene, looking_at, sparse_model, survey_of
from tests.splat_scenes import (
    CAMERA,
    NOISE,
    Rendered,
    write_photographs,
    write_rendered,
)
from tests.threads import single_thread

HEIGHT_M = 40.0


def field_height(east: np.ndarray, north: np.ndarray) -> np.ndarray:
    """Return the height of rolling ground, in metres."""
    return 2.5 * np.sin(east / 11.0) * np.cos(north / 9.0)


def make_field(
    columns: int = 6, rows: int = 4, *, step_m: float = 12.0, points: int = 900, test_views: tuple[int, ...] = (9,)
) -> Rendered:
    """Return a field under strips of cameras that look down, nearly straight.

    Args:
        columns, rows: of the cameras.
        step_m: between cameras; a photograph shows 43 × 32 m.
        points: of the SfM model.
        test_views: indices of photographs that are not trained on.
    """
    rng = np.random.default_rng(0)
    half = 0.5 * step_m * np.array([columns - 1, rows - 1])
    reach = half + np.array([26.0, 22.0])
    axes = [np.arange(-end, end + 0.1, 1.2) for end in reach]
    east, north = (axis.ravel() for axis in np.meshgrid(*axes))
    count = len(east)
    patch = rng.uniform(0.1, 0.9, (60, 60, 3))
    cell = ((np.column_stack([east, north]) + reach) // 5).astype(int)
    colour = np.clip(patch[cell[:, 0], cell[:, 1]] + rng.normal(0, 0.08, (count, 3)), 0, 1)
    gaussians = Gaussians(
        means=torch.from_numpy(np.column_stack([east, north, field_height(east, north)])).float(),
        quats_wxyz=torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(count, 1),
        log_scales=torch.tensor([0.7, 0.7, 0.1]).log().repeat(count, 1),
        logit_opacities=torch.full((count,), 4.0),
        sh=sh_from_rgb(torch.from_numpy(colour)).float()[:, None],
    )
    places = np.meshgrid(np.linspace(-half[0], half[0], columns), np.linspace(-half[1], half[1], rows))
    center = np.column_stack([place.ravel() for place in places] + [np.full(columns * rows, HEIGHT_M)])
    center += rng.normal(0, 0.5, center.shape)
    edge = half + np.array([20.0, 15.0])
    ground = rng.uniform(-edge, edge, (points, 2))
    scene = TrueScene(
        center,
        looking_at(center, center * [1, 1, 0] + rng.normal(0, 2, center.shape) * [1, 1, 0] + [0, 3, 0]),
        np.column_stack([ground, field_height(*ground.T)]),
        np.zeros((0, 3)),
        camera=CAMERA,
    )
    survey = survey_of(scene, NOISE, Measured(), rng)
    images = tuple(
        image.model_copy(update={"split": "test"}) if index in test_views else image
        for index, image in enumerate(survey.images)
    )
    sparse = sparse_model(scene, NOISE, rng)
    nearest = [int(np.argmin(np.abs(east - x) + np.abs(north - y))) for x, y in scene.point_in_geo[:, :2].tolist()]
    rgb = (0.5 + 0.28209479 * gaussians.sh[nearest, 0].numpy()).clip(0, 1)
    sparse = replace(sparse, point_rgb=(255 * rgb).astype(np.uint8))
    return Rendered(scene, gaussians, survey.model_copy(update={"images": images, "image_dir": "photos"}), sparse)


def write_field(root: Path, rendered: Rendered) -> Workspace:
    """Return a workspace of the field as the stages before training leave it, with its photographs."""
    write_photographs(rendered, root / "photos")
    return write_rendered(root, rendered)


class OneByOne:
    """Engine that runs each job in this process."""

    def __init__(self) -> None:
        self.ran: list[str] = []

    def together(self, jobs: Sequence[Job]) -> int:
        return 1

    def run(self, title: str, jobs: Sequence[Job], ended: Callable[[JobEnd], None], progress: Progress) -> None:
        for job in jobs:
            self.ran.append(job.name)
            code = boundary.guarded(cli, [*job.arguments, "--quiet"])
            ended(JobEnd(job, code, 0.0, "", "failed" if code else ""))


def georef(*arguments: object) -> tuple[int, list[str]]:
    """Exit code of a command, and the names of its jobs, which run in this process."""
    engine = OneByOne()
    with single_thread(), chosen_engine(engine):
        return boundary.guarded(cli, [*map(str, arguments), "--quiet"]), engine.ran

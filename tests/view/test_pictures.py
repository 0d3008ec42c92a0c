"""Pictures of the viewer: those that move, false colours, and what lies far outside the scene."""

from __future__ import annotations

import itertools
import threading

import numpy as np
import pytest
import torch

from pipelines.adjust.accuracy_grid import AccuracyGrid
from pipelines.core.stages import GAUSSIANS
from pipelines.core.workspace import Workspace
from pipelines.splat.gaussians import Gaussians, read_gaussians
from pipelines.surface.surface_views import ModelRenderer
from pipelines.survey.navigation import load_survey
from pipelines.survey.solution import read_sfm, read_solution
from pipelines.view import motion
from pipelines.view.pictures import Painter, Photographs, ViewerCamera, ViewFrame, Wanted, frame_of
from tests.view_scenes import renderer_of

pytestmark = pytest.mark.usefixtures("one_thread")

FEW = 4000


def painter_of(
    workspace: Workspace,
    monkeypatch: pytest.MonkeyPatch,
    grid: AccuracyGrid | None = None,
    gaussians: Gaussians | None = None,
) -> tuple[Painter, list[int]]:
    """Return the painter of a workspace, and the numbers of Gaussians that it has made models of."""
    renderer, made, showing = renderer_of(workspace), list[int](), ModelRenderer.showing
    renderer = renderer if gaussians is None else renderer.showing(gaussians)

    def counted(self: ModelRenderer, shown: Gaussians) -> ModelRenderer:
        made.append(len(shown))
        return showing(self, shown)

    monkeypatch.setattr(ModelRenderer, "showing", counted)
    photographs = Photographs(workspace, load_survey(workspace), renderer.sparse)
    return Painter(renderer, photographs, frame_of(renderer.model, renderer.sfm), grid), made


def _frame(workspace: Workspace) -> ViewFrame:
    solution = read_solution(workspace)
    return frame_of(solution, read_sfm(workspace, solution))


def from_above(half_m: float, at: tuple[float, float] = (0.0, 0.0), width: int = 160) -> ViewerCamera:
    rotation = np.array([[1.0, 0, 0], [0, -1, 0], [0, 0, -1]])
    return ViewerCamera(rotation, np.array([*at, half_m / np.tan(0.45)]), 0.9, width, width)


def test_a_picture_that_moves_shows_the_scene_with_fewer_gaussians(
    viewed: Workspace, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(motion, "MOST_GAUSSIANS", FEW)
    painter, made = painter_of(viewed, monkeypatch)
    painter.prepare_motion(threading.Event())
    assert made[0] == len(read_gaussians(viewed.path(GAUSSIANS))) > 3 * FEW
    assert all(later <= 0.5 * earlier for earlier, later in itertools.pairwise(made)) and made[-1] <= FEW
    # The whole hill: 40 pixels over 36 m, so that a cell of the coarse model is about two of them, and so is a
    # patch of one random colour: most of the pattern stays. Merged discs let a few percent of the black through.
    whole = from_above(18.0, width=40)
    still, moving = painter.paint(whole, Wanted()), painter.paint(whole, Wanted(moving=True))
    assert abs(still.rgb.mean() - moving.rgb.mean()) < 0.05 * 255
    assert 0.85 < np.corrcoef(still.rgb.ravel(), moving.rgb.ravel())[0, 1] < 0.999
    seen = (still.depth > 0) & (moving.depth > 0)
    assert seen.mean() > 0.95
    assert np.median(np.abs(still.depth - moving.depth)[seen]) < 0.02 * np.median(still.depth)
    # From near, few of the trained Gaussians are in the picture, and they are what is shown.
    near = from_above(2.0)
    still, moving = painter.paint(near, Wanted()), painter.paint(near, Wanted(moving=True))
    np.testing.assert_array_equal(still.rgb, moving.rgb)


@pytest.mark.parametrize("ended_before", [False, True])
def test_small_models_and_viewers_that_ended_make_none(
    viewed: Workspace, monkeypatch: pytest.MonkeyPatch, ended_before: bool
) -> None:
    ended = threading.Event()
    if ended_before:
        monkeypatch.setattr(motion, "MOST_GAUSSIANS", 100)
        ended.set()
    painter, made = painter_of(viewed, monkeypatch)
    painter.prepare_motion(ended)
    assert len(made) == 1
    camera = from_above(18.0, width=40)
    np.testing.assert_array_equal(
        painter.paint(camera, Wanted()).rgb, painter.paint(camera, Wanted(moving=True)).rgb
    )


def test_unknown_sigma_is_grey_beyond_the_scene(viewed: Workspace, monkeypatch: pytest.MonkeyPatch) -> None:
    """σ is known west of the middle only: the east must not have the colour of the rim, of a good σ."""
    to_middle, all_along = np.arange(-30.0, 0.5, 2.0), np.arange(-30.0, 30.5, 2.0)
    east, north = (axis.ravel() for axis in np.meshgrid(to_middle, all_along))
    middle = _frame(viewed).middle_in_geo
    position = middle + np.column_stack([east, north, np.zeros_like(east)])
    sigma_m = 0.02 + 0.001 * np.arange(len(east))
    cell = np.stack([(east + 30) // 2, (north + 30) // 2], axis=1).astype(np.int64)
    cov = sigma_m[:, None, None] ** 2 * np.eye(3) / 3
    grid = AccuracyGrid(position, cov, cell, 2.0, middle[:2] - 31.0, (16, 31))
    painter, _ = painter_of(viewed, monkeypatch, grid)
    view = painter.paint(from_above(10.0), Wanted(colouring="sigma"))
    spread = view.rgb.max(axis=2).astype(int) - view.rgb.min(axis=2)
    assert (spread[:, :72] > 30).mean() > 0.95  # coloured
    assert spread[:, 120:].max() <= 1  # grey: 5 m and more beyond the last cell of 2 m
    assert view.scale is not None and sigma_m.min() <= view.scale[0] < view.scale[1] <= sigma_m.max()
    beyond = painter.paint(from_above(2.0, at=(12.0, 0.0)), Wanted(colouring="sigma"))
    assert beyond.scale is None  # no legend of values that nobody knows
    assert (beyond.rgb.max(axis=2).astype(int) - beyond.rgb.min(axis=2)).max() <= 1
    for colouring in ("height", "views"):
        other = painter.paint(from_above(10.0), Wanted(colouring=colouring))  # type: ignore[arg-type]
        assert ((other.rgb.max(axis=2).astype(int) - other.rgb.min(axis=2)) > 30).mean() > 0.95


def test_far_gaussians_fade_but_for_photographs_and_clipping_boxes(
    viewed: Workspace, monkeypatch: pytest.MonkeyPatch
) -> None:
    frame, own = _frame(viewed), read_gaussians(viewed.path(GAUSSIANS))
    model_from_view = frame.view_from_model.inverse()

    def blob(radii: float) -> Gaussians:
        """Return a large red Gaussian so many radii of the scene east of its middle."""
        at = model_from_view.apply(np.array([[radii * frame.radius_m, 0.0, 0.0]]))
        sh = torch.zeros(1, own.sh.shape[1], 3)
        sh[0, 0] = torch.tensor([1.7, -1.7, -1.7])
        return Gaussians(
            means=torch.from_numpy(at).float(),
            quats_wxyz=torch.tensor([[1.0, 0, 0, 0]]),
            log_scales=torch.full((1, 3), float(np.log(0.05 * frame.radius_m * model_from_view.scale))),
            logit_opacities=torch.tensor([5.0]),
            sh=sh,
        )

    gaussians = Gaussians.concatenate([own, *(blob(radii) for radii in (1.9, 2.5, 3.5))])
    painter, _ = painter_of(viewed, monkeypatch, gaussians=gaussians)

    def redness(radii: float, wanted: Wanted) -> float:
        camera = from_above(0.02 * frame.radius_m, at=(radii * frame.radius_m, 0.0), width=16)
        rgb = painter.paint(camera, wanted).rgb.astype(float).mean(axis=(0, 1)) / 255
        return float(rgb[0] - rgb[1])

    near, half, far = (redness(radii, Wanted()) for radii in (1.9, 2.5, 3.5))
    assert near > 0.9 and far < 0.01
    assert 0.35 < half < 0.65  # of the way from two to three radii
    reach = 10 * frame.radius_m
    for wanted in (Wanted(photograph=0, share=0.0), Wanted(box=(-reach, -reach, -reach, reach, reach, reach))):
        assert redness(3.5, wanted) > 0.9

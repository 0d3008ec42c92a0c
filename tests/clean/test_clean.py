"""`georef clean`: floaters at known places go, hardly anything else does, and the wished number is obeyed."""

from __future__ import annotations

import logging
import shutil
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
import torch

from pipelines.clean.stage import (
    BEFORE_SURFACE,
    CONSOLIDATED,
    ISOLATED,
    KEPT,
    REASON_FILE,
    TRANSPARENT,
    Cleaning,
)
from pipelines.core.errors import DegenerateGeometryError
from pipelines.core.products import load_json, save_json
from pipelines.core.runner import run_stage
from pipelines.core.stages import ADJUSTMENT, BY_NAME, CLEANED, CLEANING, GAUSSIANS, MODEL, REMOVED, SPLAT, SPZ
from pipelines.core.workspace import Workspace
from pipelines.formats.georef_sidecar import GeorefSidecar, sidecar_path
from pipelines.splat.gaussians import Gaussians, read_gaussians, transformed, write_gaussians
from pipelines.splat.sh import sh_from_rgb
from pipelines.survey.solution import Solution, TrainedModel
from tests.refusals import logged_codes, refused
from tests.splat_scenes import (
    TEST_VIEWS,
    Rendered,
    ground_height,
    make_rendered,
    write_photographs,
    write_rendered,
)
from tests.threads import single_thread

TRANSPARENT_ONES = 25


def balls(place: np.ndarray, sigma_m: float, opacity: float, rgb: np.ndarray) -> Gaussians:
    """Return round Gaussians at places (N, 3) in `geo` with colours (N, 3)."""
    count = len(place)
    return Gaussians(
        torch.from_numpy(place).float(),
        torch.tensor([1.0, 0, 0, 0]).repeat(count, 1),
        torch.full((count, 3), float(np.log(sigma_m))),
        torch.full((count,), float(np.log(opacity / (1 - opacity)))),
        sh_from_rgb(torch.from_numpy(rgb)).float()[:, None],
    )


def in_the_air(rng: np.random.Generator, count: int, low_m: float, high_m: float) -> np.ndarray:
    """Return places over the middle of the hill, which most cameras see, above its ground."""
    plan = rng.uniform(-10, 10, (count, 2))
    return np.column_stack([plan, ground_height(*plan.T) + rng.uniform(low_m, high_m, count)])


@dataclass(frozen=True)
class Littered:
    """Workspace whose trained model is the truth, and behind its rows floaters by kind: their numbers of rows."""

    workspace: Workspace
    rows: dict[str, slice]
    truth: int


def write_littered(root: Path, rendered: Rendered, floaters: dict[str, Gaussians]) -> Littered:
    """Write the true Gaussians as a trained model, with floaters, given in `geo`, behind them."""
    write_photographs(rendered, root / "photos")
    workspace = write_rendered(root, rendered)
    solved = load_json(Solution, workspace.path(ADJUSTMENT))
    parts, rows, first = [rendered.gaussians], {}, len(rendered.gaussians)
    for name, some in floaters.items():
        parts.append(some)
        rows[name] = slice(first, first := first + len(some))
    model_from_geo = solved.similarity.inverse()
    gaussians = transformed(Gaussians.concatenate(parts), model_from_geo)
    settings = {
        "max_image_size": 96, "background": (0.0, 0.0, 0.0), "sh_degree": 0, "iterations": 1, "gaussians": first,
        "backend": "cpu",
    }  # fmt: skip
    save_json(TrainedModel(**solved.model_dump(), **settings), root / MODEL)
    write_gaussians(root / GAUSSIANS, gaussians)
    return Littered(workspace, rows, len(rendered.gaussians))


@pytest.fixture(scope="module")
def littered(tmp_path_factory: pytest.TempPathFactory) -> Littered:
    """The hill with opaque balls, thin veils, a clump, far specks and transparent Gaussians."""
    rendered, rng = make_rendered(0), np.random.default_rng(5)
    clump = np.array([3.0, -4.0, 17.0]) + rng.normal(0, 0.4, (12, 3))
    far = np.column_stack([rng.uniform(70, 90, 6), rng.uniform(-8, 8, 6), rng.uniform(0, 40, 6)])
    floaters = {
        "opaque": balls(in_the_air(rng, 20, 6, 16), 0.3, 0.95, rng.uniform(0, 1, (20, 3))),
        "veil": balls(in_the_air(rng, 20, 6, 16), 0.8, 0.06, rng.uniform(0, 1, (20, 3))),
        "dark clump": balls(clump, 0.3, 0.8, np.zeros((12, 3))),
        "far": balls(far, 0.2, 0.05, rng.uniform(0, 1, (6, 3))),
        "transparent": balls(in_the_air(rng, TRANSPARENT_ONES, 0, 3), 0.3, 0.002, rng.uniform(0, 1, (25, 3))),
    }
    with single_thread():
        return write_littered(tmp_path_factory.mktemp("littered") / "ws", rendered, floaters)


@pytest.fixture
def again(littered: Littered, tmp_path: Path) -> Littered:
    """The same, to be changed."""
    shutil.copytree(littered.workspace.root, tmp_path / "ws", ignore=shutil.ignore_patterns("clean"))
    return Littered(Workspace(tmp_path / "ws"), littered.rows, littered.truth)


def cleaned(littered: Littered, **options: object) -> tuple[Cleaning, np.ndarray]:
    """Run the stage; returns its record and the reason (N,) for which each Gaussian went."""
    with single_thread():
        run_stage(littered.workspace, BY_NAME["clean"], options)
    reason = np.load(littered.workspace.path(f"clean/{REASON_FILE}"), allow_pickle=False)
    return load_json(Cleaning, littered.workspace.path(CLEANING)), reason


def test_floaters_go_and_the_rest_stays(littered: Littered) -> None:
    record, reason = cleaned(littered)
    shares = {name: float((reason[rows] != KEPT).mean()) for name, rows in littered.rows.items()}
    assert shares == {"opaque": 1, "veil": 1, "dark clump": 1, "far": 1, "transparent": 1}
    assert set(reason[littered.rows["transparent"]].tolist()) == {TRANSPARENT}
    # Of the hill, at most one in two hundred: its rim is seen by few views.
    assert (reason[: littered.truth] != KEPT).mean() <= 0.005
    made, trained = (read_gaussians(littered.workspace.path(name)) for name in (CLEANED, GAUSSIANS))
    assert record.trained == len(trained) == len(reason)
    assert record.cleaned == len(made) == int((reason == KEPT).sum())
    torch.testing.assert_close(made.means, trained.means[torch.from_numpy(reason == KEPT)], rtol=0, atol=0)
    assert sum(record.removed.values()) == record.trained - record.cleaned
    floats = np.isin(reason, (BEFORE_SURFACE, ISOLATED))
    assert len(read_gaussians(littered.workspace.path(REMOVED))) == floats.sum()
    # The photographs are renders of the hill without floaters, rounded to 8 bits. Cameras are solved to a tenth of
    # a pixel, which costs all that is missing to 59 dB.
    assert record.compared == "test views"
    assert record.views == len(TEST_VIEWS)
    assert record.psnr_trained is not None and record.psnr_cleaned is not None
    assert record.psnr_cleaned > record.psnr_trained + 8
    assert record.psnr_cleaned > 40


def test_wire_that_stereo_misses_stays(tmp_path: Path) -> None:
    """It hangs thinner than a pixel before a surface that views measure behind it, and photographs show it."""
    hill, count = make_rendered(1), 80
    east = np.linspace(-16, 16, count)
    place = np.column_stack([east, 0.3 * east, 14.0 + 0.01 * east**2])
    wire = balls(place, 0.12, 0.95, np.tile([0.9, 0.1, 0.1], (count, 1)))
    shown = replace(hill, gaussians=Gaussians.concatenate([hill.gaussians, wire]))
    specks = balls(in_the_air(np.random.default_rng(1), 20, 6, 16), 0.3, 0.9, np.full((20, 3), 0.4))
    with single_thread():
        workspace = write_littered(tmp_path / "ws", shown, {"specks": specks})
    record, reason = cleaned(workspace)
    assert (reason[workspace.rows["specks"]] != KEPT).all()
    assert (reason[len(hill.gaussians) : workspace.truth] == KEPT).mean() >= 0.95
    assert (reason[: len(hill.gaussians)] == KEPT).mean() >= 0.995
    assert record.psnr_trained is not None and record.psnr_cleaned is not None
    assert record.psnr_cleaned > record.psnr_trained


@pytest.mark.parametrize("most", [900, 1500])
def test_number_is_obeyed_with_the_loss_stated(again: Littered, most: int) -> None:
    record, reason = cleaned(again, gaussians=most, refit_passes=2)
    assert record.cleaned == most == len(read_gaussians(again.workspace.path(CLEANED)))
    assert record.removed["consolidated"] == int((reason == CONSOLIDATED).sum()) > 0
    assert record.psnr_without_floaters is not None and record.psnr_cleaned is not None
    assert record.psnr_cleaned < record.psnr_without_floaters


def test_harmonics_are_limited_and_a_crop_is_taken(again: Littered, tmp_path: Path) -> None:
    trained = read_gaussians(again.workspace.path(GAUSSIANS))
    more = torch.cat([trained.sh, torch.full((len(trained), 15, 3), 0.1)], dim=1)
    write_gaussians(again.workspace.path(GAUSSIANS), Gaussians(**{**trained.tensors(), "sh": more}))
    record, _ = cleaned(again, floaters=False, sh_degree=1, refit_passes=0)
    assert record.sh_degree == read_gaussians(again.workspace.path(CLEANED)).sh_degree == 1
    assert record.cleaned == len(trained) - TRANSPARENT_ONES
    assert not (again.workspace.root / REMOVED).exists()
    with refused("nothing-left", DegenerateGeometryError):
        cleaned(again, floaters=False, min_opacity=0.99)


def deliver(littered: Littered, name: str, **options: object) -> dict[str, object]:
    return run_stage(littered.workspace, BY_NAME[name], options).manifest.values


def test_files_take_the_cleaned_model_in_the_same_place(again: Littered, caplog: pytest.LogCaptureFixture) -> None:
    workspace = again.workspace
    assert deliver(again, "export-ply")["model"] == "trained"
    before = load_json(GeorefSidecar, sidecar_path(workspace.path(SPLAT)))
    cleaned(again, gaussians=800, refit_passes=0)
    assert deliver(again, "export-ply")["model"] == "cleaned"  # and so it was made again
    assert len(read_gaussians(workspace.path(SPLAT))) == 800
    assert load_json(GeorefSidecar, sidecar_path(workspace.path(SPLAT))).origin == before.origin
    assert deliver(again, "export-spz", trained=True)["model"] == "trained"
    assert deliver(again, "export-tiles")["gaussians"] == 800
    assert (
        deliver(again, "export-ply", trained=True)["gaussians"]
        == len(read_gaussians(workspace.path(GAUSSIANS))) - TRANSPARENT_ONES
    )
    assert logged_codes(caplog) == []
    # Another training: the cleaned model is no longer its.
    write_gaussians(workspace.path(GAUSSIANS), read_gaussians(workspace.path(GAUSSIANS), slice(0, 1000)))
    with caplog.at_level(logging.WARNING):
        values = deliver(again, "export-spz", trained=False)
    assert (values["model"], values["gaussians"]) == ("trained", 1000)
    assert "cleaned-model-stale" in logged_codes(caplog)
    assert workspace.has(SPZ)

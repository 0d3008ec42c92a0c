"""`export-ply --measurable`: centres of Gaussians lie on the surface, in the place of those about it."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
import torch

from pipelines.core.errors import DegenerateGeometryError, ResourceError
from pipelines.core.products import load_json
from pipelines.core.runner import run_stage
from pipelines.core.stages import BY_NAME, GAUSSIANS, MEASURABLE_SPLAT, SPLAT
from pipelines.core.staleness import status
from pipelines.core.workspace import Workspace
from pipelines.deliver import measurable
from pipelines.deliver.measurable import passes_showing, with_discs
from pipelines.formats.georef_sidecar import GeorefSidecar, sidecar_path
from pipelines.geodesy.enu import enu_from_ecef
from pipelines.geometry.cameras import Pinhole
from pipelines.geometry.rotations import exp_so3
from pipelines.geometry.similarity import Similarity
from pipelines.splat.appearance import ShownView, refine_appearance, shuffled_passes
from pipelines.splat.gaussians import Gaussians, read_gaussians, write_gaussians
from pipelines.splat.rasterizer.api import RasterSettings
from pipelines.splat.rasterizer.cpu import CpuRasterizer
from pipelines.surface.fusion import SurfaceCloud
from pipelines.survey.navigation import load_survey
from tests.refusals import numbers, refused
from tests.splat_scenes import ground_height
from tests.trained_workspaces import own_copy

GEO_FROM_MODEL = Similarity(2.0, exp_so3(np.array([0.3, -0.2, 1.1])), np.array([100.0, 50.0, 3.0]))
SPACING_M = 0.25


def slope(count: int = 41) -> SurfaceCloud:
    """Return points of a plane that rises by one in two, its colour changing along it."""
    side = SPACING_M * (np.arange(count) - count // 2)
    east, north = (axis.ravel() for axis in np.meshgrid(side, side))
    normal = np.tile(np.array([-0.5, 0.0, 1.0]) / np.hypot(0.5, 1), (len(east), 1))
    red = np.round(128 + 100 * np.sin(east)).astype(np.uint8)
    rgb = np.stack([red, np.full_like(red, 120), 255 - red], axis=1)
    return SurfaceCloud(np.stack([east, north, 0.5 * east], axis=1), normal, rgb, np.full(len(east), 0.01))


def displaced(off_m: np.ndarray, surface: SurfaceCloud) -> Gaussians:
    """Return round Gaussians off the surface along its normal, over its middle."""
    middle = np.flatnonzero(np.hypot(*surface.position[:, :2].T) < 3)[: len(off_m)]
    place = surface.position[middle] + off_m[:, None] * surface.normal[middle]
    count = len(place)
    return Gaussians(
        torch.from_numpy(GEO_FROM_MODEL.inverse().apply(place)).float(),
        torch.tensor([1.0, 0, 0, 0]).repeat(count, 1),
        torch.full((count, 3), float(np.log(0.3))),
        torch.full((count,), 2.0),
        torch.zeros(count, 4, 3),
    )


def test_discs_replace_gaussians_beside_the_surface_and_no_others() -> None:
    surface = slope()
    off_m = np.concatenate([np.linspace(-0.24, 0.24, 40), [0.26, -0.3, 1.0, 8.0]])
    before = displaced(off_m, surface)
    after, discs = with_discs(before, surface, GEO_FROM_MODEL, SPACING_M)
    assert discs == len(surface.position)
    # All 40 within a spacing of a disc go; the four beyond stay as they are, before the discs.
    assert len(after) == 4 + discs
    torch.testing.assert_close(after.means[:4], before.means[40:])
    centre_in_geo = GEO_FROM_MODEL.apply(after.means[4:].numpy())
    # Centres are float32, at most 60 m from the origin of the model.
    np.testing.assert_allclose(centre_in_geo, surface.position, atol=2 * 60 * 2.0**-23)


def test_discs_lie_in_the_surface_and_close_it() -> None:
    """From above, no pixel sees more than a fifth of what lies behind, and the colour is that of the surface.

    Between four discs the transmittance is 0.2 (`splat.surface`), on a slope less; dilation only closes more.
    """
    surface = slope()
    empty = displaced(np.zeros(0), surface)
    discs, _ = with_discs(empty, surface, GEO_FROM_MODEL, SPACING_M)
    camera = Pinhole(40, 40, 100.0, 100.0, 20.0, 20.0)
    view = CpuRasterizer().render(discs, looking_down(), camera, RasterSettings(sh_degree=1, depth=True))
    assert float(view.alpha.min()) > 0.8
    # A ray meets the slope 20 m − east / 2 below the camera.
    slant = (np.arange(40) + 0.5 - 20) / 100
    east_m = 20 * slant / (1 + 0.5 * slant)
    red = (view.colour[20, :, 0] / view.alpha[20]).numpy()
    # A disc blurs over a σ of 0.125 m, and the dilation over 0.11 m: the sine loses 1.4 %. The order of the discs
    # moves colours by half a spacing at most, along which the sine changes by 0.05.
    assert np.abs(red - (128 + 100 * np.sin(east_m)) / 255).max() < 0.06
    assert view.expected_depth is not None
    depth_m = GEO_FROM_MODEL.scale * view.expected_depth[20].numpy()
    # The slope rises by a quarter of a spacing over half of one.
    assert np.abs(depth_m - (20 - 0.5 * east_m)).max() < 0.25 * SPACING_M


def looking_down() -> torch.Tensor:
    """Return the pose of a camera 10 units of the model above the origin of geo's slope, its x axis eastwards."""
    cam_from_geo = np.diag([1.0, -1.0, -1.0])
    matrix = np.eye(4)
    matrix[:3, :3] = cam_from_geo @ GEO_FROM_MODEL.rotation
    center = GEO_FROM_MODEL.inverse().apply(np.array([[0.0, 0.0, 20.0]]))[0]
    matrix[:3, 3] = -matrix[:3, :3] @ center
    return torch.tensor(matrix).float()


def test_appearance_refinement_finds_the_colours_and_moves_nothing() -> None:
    """Grey discs are shown images of the true ones, from twelve sides, and look alike from another."""
    discs, _ = with_discs(displaced(np.zeros(0), slope(21)), slope(21), GEO_FROM_MODEL, SPACING_M)
    grey = Gaussians(**{**discs.tensors(), "sh": torch.zeros_like(discs.sh)})
    camera, settings, rasterizer = Pinhole(32, 32, 120.0, 120.0, 16.0, 16.0), RasterSettings(1), CpuRasterizer()
    poses, middle = [], torch.tensor([0.0, 0.0, 10.0])
    for turn in np.linspace(0, 2 * np.pi, 13):
        tilt = torch.tensor(exp_so3(np.array([0.2 * np.sin(turn), 0.2 * np.cos(turn), 0.0]))).float()
        pose = looking_down()
        pose[:3, :3], pose[:3, 3] = tilt @ pose[:3, :3], tilt @ (pose[:3, 3] - middle) + middle
        poses.append(pose)
    poses[12] = looking_down()
    shown = [ShownView(pose, camera, rasterizer.render(discs, pose, camera, settings).colour) for pose in poses]
    order = shuffled_passes(12, 20, np.random.default_rng(1))
    after = refine_appearance(grey, shown.__getitem__, order, rasterizer, settings)
    for name in ("means", "quats_wxyz", "log_scales"):
        assert torch.equal(after.tensors()[name], grey.tensors()[name])
    error = [
        (rasterizer.render(splat, poses[12], camera, settings).colour - shown[12].colour).square().mean().sqrt()
        for splat in (grey, after)
    ]
    # 240 iterations at falling rates from 0.01 move coefficients by up to 1.5, and colours by 0.4.
    assert error[1] < 0.1 * error[0]


def test_a_disc_is_shown_as_often_whatever_the_overlap() -> None:
    """Cost follows what there is to learn, not the overlap; each view counts, and few come seven times."""
    for views_of_disc, passes in ((5.0, 7.0), (30.0, 5.0), (80.0, 1.875), (400.0, 1.0), (0.0, 7.0)):
        assert passes_showing(views_of_disc) == pytest.approx(passes)


@pytest.mark.slow
def test_command_puts_centres_on_the_surface(
    trained: list[tuple[Workspace, Workspace]], tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """In a file of its own, which leaves the ordinary one as it is, and is stale by itself."""
    caplog.set_level("INFO")
    root = tmp_path / "ws"
    workspace = own_copy(trained[0][0], root)
    origin = load_survey(workspace).origin
    run_stage(workspace, BY_NAME["export-ply"], {})
    plain, plain_bytes = (
        load_json(GeorefSidecar, sidecar_path(workspace.path(SPLAT))),
        workspace.path(SPLAT).read_bytes(),
    )
    unrefined, values = (
        run_stage(workspace, BY_NAME["export-measurable"], {"appearance_passes": passes}).manifest.values
        for passes in (0, 2)
    )
    told = re.search(r"about (\d+) discs [\d.]+ m apart, ([\d.]+) MB and ", caplog.text)
    assert told is not None
    assert int(told[1]) == pytest.approx(values["discs"], rel=0.3)
    made = workspace.path(MEASURABLE_SPLAT)
    sidecar, after = load_json(GeorefSidecar, sidecar_path(made)), read_gaussians(made)
    assert float(told[2]) == pytest.approx(made.stat().st_size / 1e6, rel=0.3)
    assert sidecar == plain  # The same frame, whatever is in it.
    assert workspace.path(SPLAT).read_bytes() == plain_bytes
    states = {row.stage: row.state for row in status(workspace)}
    assert (states["export-ply"], states["export-measurable"]) == ("current", "current")
    run_stage(workspace, BY_NAME["export-ply"], {"min_opacity": 0.1})
    assert made.exists()
    assert {row.stage: row.state for row in status(workspace)}["export-measurable"] == "current"
    assert len(after) == values["gaussians"] > values["discs"] > 1000
    assert sorted(path.name for path in (root / "measurable").iterdir()) == [
        "manifest.json",
        "splat.measurable.ply",
        "splat.measurable.ply.georef.json",
        "splat.measurable.ply.iso.xml",
    ]
    in_geo = enu_from_ecef(sidecar.ecef_from_file().apply(after.means.numpy()), origin)
    inner = np.hypot(in_geo[:, 0], in_geo[:, 1]) < 20
    above_m = (in_geo[:, 2] - ground_height(in_geo[:, 0], in_geo[:, 1]))[inner]
    # As for the point cloud: the hill is made of level discs, of which a pixel of 0.47 m shows sides and rims.
    assert np.sqrt(np.mean(above_m**2)) < values["spacing_m"] / 0.7
    assert 0 > values["psnr_change_db"] > unrefined["psnr_change_db"]


@pytest.mark.slow
def test_too_many_discs_are_refused(
    trained: list[tuple[Workspace, Workspace]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    root = tmp_path / "ws"
    own_copy(trained[0][0], root)
    monkeypatch.setattr(measurable, "free_memory_bytes", lambda _device: 2**27)
    with refused("memory-discs", ResourceError):
        run_stage(Workspace(root), BY_NAME["export-measurable"], {})
    assert not (root / MEASURABLE_SPLAT).exists()


@pytest.mark.slow
def test_a_model_without_a_surface_is_refused(trained: list[tuple[Workspace, Workspace]], tmp_path: Path) -> None:
    root = tmp_path / "ws"
    own_copy(trained[0][0], root)
    haze = read_gaussians(root / GAUSSIANS)
    haze.logit_opacities.fill_(-5.0)
    write_gaussians(root / GAUSSIANS, haze)
    (root / "train" / "manifest.json").unlink()  # A model put there by hand.
    with refused("no-common-surface", DegenerateGeometryError) as error:
        run_stage(Workspace(root), BY_NAME["export-measurable"], {})
    assert numbers(str(error.value)) == [12]

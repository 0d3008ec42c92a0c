"""Files of a model that was trained with the mip filter say so, and its renders have it."""

from __future__ import annotations

import gzip
from pathlib import Path

import pytest
import torch
from plyfile import PlyData

from pipelines.core.products import load_json, save_json
from pipelines.core.stages import MODEL
from pipelines.deliver import ply, spz
from pipelines.deliver.options import ExportPlyOptions, ExportSpzOptions
from pipelines.formats.splat_ply import join_splat_plys, write_splat_ply
from pipelines.formats.spz import decode_spz
from pipelines.geometry.cameras import Pinhole
from pipelines.splat.gaussians import Gaussians
from pipelines.splat.rasterizer.api import RasterSettings
from pipelines.splat.rasterizer.backends import rasterizer
from pipelines.survey.solution import TrainedModel
from tests.delivered_scenes import splat_arrays, write_trained


@pytest.mark.parametrize("mip_filter", [True, False])
def test_files_say_so(tmp_path: Path, mip_filter: bool) -> None:
    stage = write_trained(tmp_path / "ws", splat_arrays(), "export")
    model = load_json(TrainedModel, stage.workspace.path(MODEL))
    save_json(model.model_copy(update={"mip_filter": mip_filter}), stage.workspace.path(MODEL))
    ply.run(stage, ExportPlyOptions())
    # The comment of Brush, which other programs take up.
    assert PlyData.read(str(stage.out / "splat.ply")).comments == ["SplatRenderMode: mip"] * mip_filter
    for version in ("3", "4"):
        spz.run(stage, ExportSpzOptions.model_validate({"spz_version": version}))
        data = (stage.out / "splat.spz").read_bytes()
        head = gzip.decompress(data) if version == "3" else data
        assert head[14] == int(mip_filter)  # flags of the header: bit 0 is "antialiased"
        assert len(decode_spz(data)) == len(splat_arrays())


def test_joined_files_say_so(tmp_path: Path) -> None:
    for name in ("a", "b"):
        write_splat_ply(tmp_path / name, splat_arrays(), mip_filter=True)
    join_splat_plys([tmp_path / "a", tmp_path / "b"], tmp_path / "both", mip_filter=True)
    assert PlyData.read(str(tmp_path / "both")).comments == ["SplatRenderMode: mip"]


def test_light_of_a_speck_is_the_same_from_near_and_far() -> None:
    """A ball smaller than a pixel: its light falls with the square of the distance, as its picture does.

    Without the filter, the dilation gives it the light of 2π · 0.3 px² at any distance.
    """
    sigma_m, opacity = 0.02, 0.5
    ball = Gaussians(
        torch.zeros(1, 3),
        torch.tensor([[1.0, 0, 0, 0]]),
        torch.full((1, 3), sigma_m).log(),
        torch.logit(torch.tensor([opacity])),
        torch.full((1, 1, 3), 0.5 / 0.28209479),
    )
    camera, settings = Pinhole(31, 31, 50.0, 50.0, 15.5, 15.5), RasterSettings(0)

    def light(depth_m: float, *, mip_filter: bool) -> float:
        pose = torch.eye(4)
        pose[2, 3] = depth_m
        backend = rasterizer("cpu", mip_filter=mip_filter)
        return float(backend.render(ball, pose, camera, settings).alpha.sum())

    for depth_m in (2.0, 3.0, 4.0):
        true = opacity * 2 * torch.pi * (50.0 * sigma_m / depth_m) ** 2
        # Sums of pixels instead of the integral, and what lies below 1/255: 8 %.
        assert light(depth_m, mip_filter=True) == pytest.approx(true, rel=0.08)
        assert light(depth_m, mip_filter=False) > 1.5 * true

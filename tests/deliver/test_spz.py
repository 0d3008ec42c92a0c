"""The SPZ deliverable: a reader that knows SPZ's axes puts every Gaussian where the survey put it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from pipelines.core.errors import InputError
from pipelines.core.products import load_json
from pipelines.deliver.options import ExportSpzOptions
from pipelines.deliver.spz import run
from pipelines.formats.georef_sidecar import GeorefSidecar, sidecar_path
from pipelines.formats.spz import decode_spz, spz_georeference
from pipelines.geodesy.enu import enu_from_ecef
from pipelines.geometry.rotations import matrix_from_quat_xyzw
from pipelines.geometry.similarity import Similarity, covariance_at
from pipelines.splat.sh import evaluate_sh
from tests.delivered_scenes import GEO_FROM_MODEL, ORIGIN, covariance, splat_arrays, true_ecef, write_trained
from tests.oracles import read_spz
from tests.refusals import numbers, refused


def test_file_and_sidecar_put_the_gaussians_on_earth(tmp_path: Path) -> None:
    splat = splat_arrays()
    stage = write_trained(tmp_path / "ws", splat, "spz")
    summary = run(stage, ExportSpzOptions())
    read, sidecar = (
        read_spz(stage.out / "splat.spz"),
        load_json(GeorefSidecar, sidecar_path(stage.out / "splat.spz")),
    )
    # Half a step of 2^-12 m along each axis.
    places = sidecar.ecef_from_file().apply(read.means)
    np.testing.assert_allclose(places, true_ecef(splat), rtol=0, atol=np.sqrt(3) * 0.5 / 4096 + 1e-5)
    assert summary.values["gaussians"] == 40
    # The second axis points up, the third south: a viewer of SPZ sees the scene upright.
    up = enu_from_ecef(sidecar.ecef_from_file().apply(np.eye(3)), _place(sidecar.origin_lla))
    np.testing.assert_allclose(up, [[1, 0, 0], [0, 0, 1], [0, -1, 0]], atol=1e-8)


def _place(lla: tuple[float, float, float]) -> object:
    return type(ORIGIN)(lat_deg=lla[0], lon_deg=lla[1], alt_m=lla[2])


def test_colours_are_those_of_the_same_direction_on_earth(tmp_path: Path) -> None:
    splat = splat_arrays()
    stage = write_trained(tmp_path / "ws", splat, "spz")
    run(stage, ExportSpzOptions())
    read, sidecar = (
        read_spz(stage.out / "splat.spz"),
        load_json(GeorefSidecar, sidecar_path(stage.out / "splat.spz")),
    )
    direction_in_file = np.array([0.36, 0.48, 0.8])
    in_ecef = sidecar.ecef_from_file().rotation @ direction_in_file
    geo_from_ecef = enu_from_ecef(np.vstack([np.eye(3), np.zeros(3)]), ORIGIN)
    in_model = GEO_FROM_MODEL.rotation.T @ ((geo_from_ecef[:3] - geo_from_ecef[3]).T @ in_ecef)
    seen = evaluate_sh(torch.tensor(read.sh).double(), torch.tensor(direction_in_file))
    true = evaluate_sh(torch.tensor(splat.sh).double(), torch.tensor(in_model))
    # Sixteen independent errors, uniform within half a step of at most 1/8, have σ 0.034 · √(Σ Y²) = 0.036.
    assert (seen - true).abs().max() < 5 * 0.036
    assert true.std() > 0.15


def test_covariance_is_along_the_axes_of_the_file(tmp_path: Path) -> None:
    stage = write_trained(tmp_path / "ws", splat_arrays(), "spz")
    run(stage, ExportSpzOptions())
    sidecar = load_json(GeorefSidecar, sidecar_path(stage.out / "splat.spz"))
    point_in_file = np.array([[3.0, -2.0, 5.0]])
    to_ecef = sidecar.ecef_from_file()
    assert sidecar.covariance is not None
    in_file = covariance_at(point_in_file, sidecar.covariance, np.zeros(3))
    in_geo = covariance_at(enu_from_ecef(to_ecef.apply(point_in_file), ORIGIN), covariance(), np.zeros(3))
    frame = enu_from_ecef(np.vstack([np.eye(3), np.zeros(3)]), ORIGIN)
    geo_from_file = (frame[:3] - frame[3]).T @ to_ecef.rotation
    np.testing.assert_allclose(geo_from_file @ in_file @ geo_from_file.T, in_geo, rtol=1e-5, atol=1e-12)
    assert sidecar.georeference_sigma is not None
    assert sidecar.georeference_sigma.sigma_v_m == pytest.approx(np.sqrt(np.array(sidecar.covariance)[5, 5]))


def test_options_change_version_and_degree(tmp_path: Path) -> None:
    stage = write_trained(tmp_path / "ws", splat_arrays(), "spz")
    run(stage, ExportSpzOptions(spz_version="4", sh_degree=1))
    assert (stage.out / "splat.spz").read_bytes()[:8] == b"NGSP\x04\0\0\0"
    assert read_spz(stage.out / "splat.spz").sh.shape == (40, 4, 3)


def test_a_scene_that_is_too_large_is_refused(tmp_path: Path) -> None:
    splat = splat_arrays()
    splat.means[0] = [0, 4000, 0]
    stage = write_trained(tmp_path / "ws", splat, "spz")
    with refused("spz-range", InputError) as error:
        run(stage, ExportSpzOptions())
    assert {2048, 1, 40} <= set(numbers(str(error.value).replace("±", ""))) and "export-tiles" in str(error.value)
    assert not (stage.out / "splat.spz").exists()


def test_the_place_on_earth_is_embedded_on_request(tmp_path: Path) -> None:
    """What the file says of itself is what its sidecar says: a reader of either puts a Gaussian at its place."""
    splat = splat_arrays()
    stage = write_trained(tmp_path / "ws", splat, "spz")
    summary = run(stage, ExportSpzOptions(spz_version="4", embed_georeference=True))
    data = (stage.out / "splat.spz").read_bytes()
    place = spz_georeference(data)
    assert place is not None and place.crs == "EPSG:4978" and summary.values["georeference_embedded"]
    turned = Similarity(place.scale, matrix_from_quat_xyzw(place.quat_xyzw), np.array(place.origin))
    # Half a step of 2^-12 m along each axis.
    atol = np.sqrt(3) * 0.5 / 4096 + 1e-5
    np.testing.assert_allclose(turned.apply(decode_spz(data).means), true_ecef(splat), rtol=0, atol=atol)
    run(stage, ExportSpzOptions(spz_version="4"))
    assert spz_georeference((stage.out / "splat.spz").read_bytes()) is None
    with refused("spz-version", InputError):
        run(stage, ExportSpzOptions(embed_georeference=True))

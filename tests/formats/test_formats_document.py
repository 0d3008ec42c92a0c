"""The worked example in docs/formats.md: the sidecar is valid, the snippet runs, and its numbers are right."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pipelines.formats.georef_sidecar import GeorefSidecar, georeference_sigma
from pipelines.geodesy.enu import ecef_from_enu_rotation, ecef_from_lla, lla_from_ecef
from pipelines.geometry.rotations import matrix_from_quat_xyzw
from pipelines.geometry.similarity import covariance_at

DOCUMENT = (Path(__file__).parents[2] / "docs" / "formats.md").read_text(encoding="utf-8")


def block(language: str) -> str:
    block = re.search(rf"```{language}\n(.*?)```", DOCUMENT, re.DOTALL)
    assert block is not None
    return block[1]


@pytest.fixture
def result(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    """Return the variables that the snippet computes from the example, in a folder without other files."""
    (tmp_path / "splat.ply.georef.json").write_text(block("json"), encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    names: dict[str, Any] = {}
    exec(compile(block("python"), "docs/formats.md", "exec"), names)
    return names


def test_example_is_a_valid_sidecar_whose_frame_follows_from_its_origin() -> None:
    sidecar = GeorefSidecar.model_validate_json(block("json"))
    np.testing.assert_allclose(sidecar.origin, ecef_from_lla(sidecar.origin_lla), rtol=0, atol=1e-8)
    rotation = matrix_from_quat_xyzw(sidecar.rotation)
    np.testing.assert_allclose(rotation, ecef_from_enu_rotation(sidecar.origin_lla), rtol=0, atol=1e-14)
    sigma = sidecar.georeference_sigma
    assert sigma is not None
    assert sigma.sigma_h_m == pytest.approx(np.hypot(sigma.sigma_e_m, sigma.sigma_n_m))
    assert sigma.sigma_3d_m == pytest.approx(np.hypot(sigma.sigma_h_m, sigma.sigma_v_m))


def test_snippet_gives_the_printed_numbers(result: dict[str, Any]) -> None:
    x, y, z = result["p_ecef"]
    text = DOCUMENT.replace("−", "-")
    assert f"({x:.4f}, {y:.4f}, {z:.4f})" in text
    lat, lon, alt = lla_from_ecef(result["p_ecef"])
    assert f"{lat:.8f}° N, {-lon:.8f}° W, {alt:.4f} m" in " ".join(text.split())
    east, north, up = result["sigma_enu_m"]
    assert f"({east:.4f}, {north:.4f}, {up:.4f})" in text


def test_snippet_agrees_with_the_package(result: dict[str, Any]) -> None:
    sidecar = GeorefSidecar.model_validate_json(block("json"))
    expected = sidecar.ecef_from_file().apply(result["p_ply"])
    np.testing.assert_allclose(result["p_ecef"], expected, rtol=0, atol=1e-8)
    assert sidecar.covariance is not None
    cov = covariance_at(result["p_ply"][None], sidecar.covariance, np.zeros(3))
    np.testing.assert_allclose(result["sigma_enu_m"], np.sqrt(np.diagonal(cov[0])), rtol=1e-12)
    sigma = georeference_sigma(sidecar.covariance, result["p_ply"])
    assert sigma.sigma_h_m == pytest.approx(np.hypot(*result["sigma_enu_m"][:2]))
    assert georeference_sigma(sidecar.covariance, np.zeros(3)) == sidecar.georeference_sigma


@pytest.mark.parametrize("field", [info.alias or name for name, info in GeorefSidecar.model_fields.items()])
def test_every_field_is_described(field: str) -> None:
    assert f"`{field}`" in DOCUMENT

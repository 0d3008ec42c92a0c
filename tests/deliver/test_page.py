"""The page of the tiles: its content, its coordinates in a CRS, and that names stay text."""

from __future__ import annotations

import base64
import hashlib
import json
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from pydantic import ValidationError

from pipelines.core.figures import Headline
from pipelines.core.products import Remark
from pipelines.core.sentences import printable
from pipelines.deliver.options import CESIUM, PageOptions, SplatOptions
from pipelines.deliver.pages import (
    LocalCrs,
    ScenePage,
    fit_local_crs,
    scene_page,
    write_scene_page,
)
from pipelines.deliver.placement import solved_placement
from pipelines.deliver.splat import placed_splat
from pipelines.geodesy.crs import parse_crs
from pipelines.geodesy.enu import ecef_from_enu, ecef_from_enu_rotation, ecef_from_lla, lla_from_ecef
from pipelines.geodesy.vertical import parse_vertical
from pipelines.geometry.similarity import Similarity
from pipelines.splat.gaussians import Gaussians
from pipelines.survey.survey import Survey
from pipelines.survey.target_crs import target_crs
from tests.scenes import Measured, Noise, make_scene, survey_of, trained_model

HOSTILE = "</script><script>alert(1)</script><!-- & \u2028 \x1b[2J\u202e \" ' ` ${1} \\u003c Ω"


class Scripts(HTMLParser):
    """Scripts of a page, as a browser splits it."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.found: list[tuple[dict[str, str | None], str]] = []
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: Any) -> None:
        if tag == "script":
            self.found.append((dict(attrs), ""))

    def handle_data(self, data: str) -> None:
        if self.lasttag == "script" and self.found:
            attributes, text = self.found[-1]
            self.found[-1] = attributes, text + data


def surveyed() -> Survey:
    survey = survey_of(make_scene(gcps=4), Noise(), Measured(gcps=True), np.random.default_rng(2))
    first, second, *others = survey.control_points
    named = (first.model_copy(update={"name": HOSTILE}), second)
    return survey.model_copy(update={"control_points": named, "check_points": tuple(others)})


def page_of(survey: Survey, cautions: tuple[Remark, ...] = (), accuracy: Headline | None = None) -> ScenePage:
    means = np.random.default_rng(3).normal(0, 20, (500, 3))
    model = trained_model(Similarity()).model_copy(update={"cautions": cautions})
    gaussians = Gaussians(
        means=torch.from_numpy(means).float(),
        quats_wxyz=torch.tensor([1.0, 0, 0, 0]).repeat(500, 1),
        log_scales=torch.zeros(500, 3),
        logit_opacities=torch.zeros(500),
        sh=torch.zeros(500, 1, 3),
    )
    splat = placed_splat(gaussians, solved_placement(model, survey, means, accuracy), SplatOptions())
    middle_in_geo = splat.placement.file_from_geo.inverse().apply(np.zeros((1, 3)))
    target = target_crs(PageOptions(), survey.origin, middle_in_geo, survey.vertical)
    in_file = splat.gaussians.means.numpy()
    return scene_page(HOSTILE, splat.placement, in_file, survey=survey, target=target, cesium="Cesium/")


def test_names_cannot_leave_the_document_that_holds_them(tmp_path: Path) -> None:
    page = page_of(surveyed(), (Remark(code="odd", sentence=HOSTILE),))
    write_scene_page(page, tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["index.html"]
    (attributes, data), (_, program) = Scripts((tmp_path / "index.html").read_text(encoding="utf-8")).found
    assert attributes == {"type": "application/json", "id": "scene"}
    assert "<" not in data and ">" not in data and "\u2028" not in data
    assert ScenePage.model_validate(json.loads(data)) == page
    assert page.title == page.points[0].name == page.cautions[0] == printable(HOSTILE)
    assert "\\x1b[2J\\u202e" in page.title and "\u202e" not in data
    # Text enters the page by textContent alone.
    for way in ("innerHTML", "outerHTML", "insertAdjacentHTML", "document.write", "eval("):
        assert way not in program


class Policies(HTMLParser):
    """Content security policies of a page, by directive."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.found: dict[str, str] = {}
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: Any) -> None:
        named = dict(attrs)
        if tag == "meta" and named.get("http-equiv") == "Content-Security-Policy":
            self.found |= dict(directive.split(" ", 1) for directive in named["content"].split("; "))


@pytest.mark.parametrize(
    ("cesium", "library", "files"),
    [
        (CESIUM, CESIUM, f"'self' {CESIUM}"),
        ("Cesium/", "'self'", "'self'"),
        ("https://host/a;script-src*,'x\"/", "https://host/a%3Bscript-src%2A%2C%27x%22/", None),
    ],
)
def test_page_runs_its_own_script_and_cesium_alone(
    tmp_path: Path, cesium: str, library: str, files: str | None
) -> None:
    page = page_of(surveyed()).model_copy(update={"cesium": cesium})
    write_scene_page(page, tmp_path)
    text = (tmp_path / "index.html").read_text(encoding="utf-8")
    policy, program = Policies(text).found, text.partition("<script>")[2].partition("</script>")[0]
    own = base64.b64encode(hashlib.sha256(program.encode()).digest()).decode()
    assert policy["default-src"] == policy["base-uri"] == policy["form-action"] == "'none'"
    assert policy["script-src"] == f"'sha256-{own}' 'unsafe-eval' blob: {library}"
    assert policy["worker-src"] == f"blob: {library}" and policy["style-src"] == f"{library} 'unsafe-inline'"
    if files is not None:
        assert policy["connect-src"] == policy["img-src"] == f"{files} blob: data:"


def test_points_are_labelled_where_they_were_surveyed() -> None:
    survey = surveyed()
    page = page_of(survey)
    assert [point.kind for point in page.points] == ["control", "control", "check", "check"]
    for shown, point in zip(page.points, (*survey.control_points, *survey.check_points), strict=True):
        assert shown.name == printable(point.name)
        np.testing.assert_allclose(
            shown.ecef, ecef_from_enu(point.position_in_geo, survey.origin), rtol=0, atol=1e-8
        )


def test_page_says_what_coordinates_and_heights_mean() -> None:
    facts = {fact.name: fact.value for fact in reversed(page_of(surveyed()).facts)}
    assert facts["CRS"] == "EPSG:32632"
    assert facts["Heights"] == "ellipsoidal, as stated; of the survey's input: ellipsoidal, as stated"
    assert facts["Accuracy"] == "not known: nothing states it yet"
    assert "as nobody stated a CRS" in facts["Assumed"]


def evaluated(fit: LocalCrs, enu: np.ndarray) -> np.ndarray:
    """Coordinates of points, computed from the document alone, as the page does."""
    unit = enu / fit.half_extent_m
    powers = np.stack([np.prod(unit ** np.array(row), axis=1) for row in fit.exponents], axis=1)
    return powers @ np.array(fit.coefficients)


@pytest.mark.parametrize(
    ("crs", "lla", "half_m", "bound_m"),
    [
        ("EPSG:32632", (46.02, 7.75, 1620.0), 1000.0, 1e-4),
        ("EPSG:32632", (46.02, 7.75, 1620.0), 10_000.0, 0.02),
        ("EPSG:2056", (46.02, 7.75, 1620.0), 1000.0, 1e-3),
        ("EPSG:4326", (70.0, 180.0, 30.0), 1000.0, 1e-3),  # across the date line
        ("EPSG:4978", (-33.0, 151.0, 30.0), 5000.0, 1e-6),
        ("EPSG:2263", (40.7, -74.0, 30.0), 1000.0, 1e-3),  # in feet
    ],
)
def test_polynomials_are_the_crs(crs: str, lla: tuple[float, ...], half_m: float, bound_m: float) -> None:
    """The bound is the fourth order of a map projection, (d / R)⁴ R with a factor for its scale."""
    target = parse_crs(crs, vertical=parse_vertical("ellipsoidal"))
    fit = fit_local_crs(target, lla, (half_m, half_m, half_m))
    enu = np.random.default_rng(5).uniform(-half_m, half_m, (200, 3))
    places = lla_from_ecef(ecef_from_lla(lla) + enu @ ecef_from_enu_rotation(lla).T)
    error = evaluated(fit, enu) - target.xyz_from_lla(places)
    if target.is_geographic:
        error[:, 0] -= 360.0 * np.round(error[:, 0] / 360.0)
        error[:, :2] *= 111_000.0
    assert np.abs(error).max() < bound_m
    assert fit.error_m < bound_m
    for axis, unit_m in zip(
        fit.axes, (111_000.0,) * 2 + (1.0,) if target.is_geographic else (1.0,) * 3, strict=True
    ):
        assert 10.0**-axis.decimals * unit_m > fit.error_m  # no digit is shown that is not sure


def test_heights_are_named_by_what_they_count_from() -> None:
    place_lla, box = (46.02, 7.75, 1620.0), (100.0, 100.0, 100.0)
    names = [axis.name for axis in fit_local_crs(parse_crs("EPSG:32632"), place_lla, box).axes]
    assert names == ["E", "N", "h"]
    assert [axis.unit for axis in fit_local_crs(parse_crs("EPSG:4326"), place_lla, box).axes] == ["°", "°", "m"]


def test_address_of_the_library() -> None:
    assert PageOptions().cesium == CESIUM
    assert PageOptions(cesium="Cesium").cesium == "Cesium/"
    assert PageOptions(cesium="https://example.org/c/1.145").cesium == "https://example.org/c/1.145/"
    for bad in (
        "",
        " ",
        "javascript:alert(1)",
        "data:text/html,x",
        "file:///c/",
        "https:",
        "a b/",
        "c/?v=1",
        "c/#x",
    ):
        with pytest.raises(ValidationError, match=r"address|path"):
            PageOptions(cesium=bad)

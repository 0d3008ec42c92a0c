"""Falsified and clean surveys as files, through `georef run`, judged by what the sidecar of the splat states."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from pipelines.core.stages import REPORT, SPLAT
from tests.adjusted_scenes import adjusted_model, block
from tests.cli_runs import Georef, Result
from tests.falsified_surveys import CASES, CONTROL, FALSIFIED, FLIGHTS, falsified, generator_of
from tests.scenes import WITH_GCPS, Noise, survey_of
from tests.survey_files import QUICK, write_survey

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("one_thread", "children_here")]
# They name what nothing checks or nobody states, and blame no source.
EVERYDAY = {"no-control-points", "default-sigma"}
# What a similarity cannot show at check points 60 m away: SfM's own errors in blocks of twelve photographs.
OWN_M, SIGMAS = 0.06, 3.0
# Nothing in the files can show these: a map with no second source, and a bias with none.
HIDDEN = {"common bias of a consumer receiver"}


@pytest.mark.parametrize(("name", "flight"), CASES)
def test_a_falsified_survey_is_refused_cautioned_or_right(
    real_georef: Georef, tmp_path: Path, name: str, flight: str
) -> None:
    kind, of = FALSIFIED[name], block(*FLIGHTS[flight])
    rng = generator_of(name)
    model = adjusted_model(of, Noise(pixel_px=0.2), rng)
    arguments = write_survey(tmp_path / "files", falsified(kind, of, rng), model)
    ended = _run(real_georef, tmp_path / "ws", arguments)
    if ended.code == 1:
        error = json.loads(ended.out)["error"]
        assert error["code"] in kind.codes, error
        assert not kind.says or any(word in f"{error['message']} {error['remedy']}" for word in kind.says), error
        return
    assert ended.code == 0, ended.err
    sidecar, wrong_m = _statement(tmp_path / "ws")
    codes = {caution["code"] for caution in sidecar["cautions"]}
    if kind.named:
        assert codes & set(kind.codes), sidecar["cautions"]
    if kind.estimated or (name not in HIDDEN and codes <= EVERYDAY):
        accuracy = sidecar["georeferenceSigma"]
        assert wrong_m[0] <= SIGMAS * accuracy["sigma_h_m"] + OWN_M
        assert wrong_m[1] <= SIGMAS * accuracy["sigma_v_m"] + OWN_M


@pytest.mark.parametrize("seed", range(12))  # layouts × receivers, layouts × control
def test_a_clean_survey_is_right_and_blamed_for_nothing(real_georef: Georef, tmp_path: Path, seed: int) -> None:
    layout, images = (("orbit", 12), ("grid", 16), ("lines", 40), ("circle", 36))[seed % 4]
    fix_m = ((0.02, 0.02, 0.03), (0.05, 0.05, 0.08), (1.5, 1.5, 3.0))[seed % 3]
    of, rng = block(layout, images), np.random.default_rng(100 + seed)  # type: ignore[arg-type]
    noise = Noise(fix_m=fix_m, pixel_px=0.2)
    survey = survey_of(of.scene, noise, WITH_GCPS, rng)
    points = survey.control_points
    survey = survey.model_copy(
        update={"control_points": points[: (0, 3, 8)[seed // 2 % 3]], "check_points": points[CONTROL:]}
    )
    arguments = write_survey(tmp_path / "files", survey, adjusted_model(of, noise, rng))
    ended = _run(real_georef, tmp_path / "ws", arguments)
    assert ended.code == 0, ended.err
    sidecar, wrong_m = _statement(tmp_path / "ws")
    assert {caution["code"] for caution in sidecar["cautions"]} <= EVERYDAY | {"hardly-checked"}
    accuracy = sidecar["georeferenceSigma"]
    assert wrong_m[0] <= SIGMAS * accuracy["sigma_h_m"] + OWN_M
    assert wrong_m[1] <= SIGMAS * accuracy["sigma_v_m"] + OWN_M
    warned = [line for line in ended.err.splitlines() if line.startswith("warning:")]
    assert not [line for line in warned if "disagree" in line or "outlier" in line or "not used" in line], warned


def _run(georef: Georef, workspace: Path, arguments: tuple[object, ...]) -> Result:
    workspace.mkdir()
    (workspace / "georef.toml").write_text(QUICK, "utf-8")
    return georef("run", workspace, *arguments, "--json")


def _statement(workspace: Path) -> tuple[dict, tuple[float, float]]:
    """Sidecar of the splat, and RMS errors of the triangulated check points in metres, horizontal and vertical."""
    sidecar = json.loads((workspace / f"{SPLAT}.georef.json").read_text("utf-8"))
    triangulated = json.loads((workspace / REPORT).read_text("utf-8"))["checkpoints"]["triangulated"]
    return sidecar, (triangulated["rmse_h_m"], triangulated["rmse_v_m"])

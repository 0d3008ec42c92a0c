"""Falsified surveys, by kind: never a confident wrong statement."""

from __future__ import annotations

import numpy as np
import pytest

from pipelines.adjust.options import InitSim3Options
from pipelines.core.errors import InconsistencyError
from tests.adjusted_scenes import adjusted_model, block
from tests.falsified_surveys import CASES, CONTROL, FALSIFIED, FLIGHTS, Falsified, falsified
from tests.scenes import Noise
from tests.statements import Statement, state

SIGMAS = 3.0
pytestmark = pytest.mark.usefixtures("one_thread")


def outcome(
    kind: Falsified, flight: str, options: InitSim3Options | None = None
) -> tuple[Statement | str, np.ndarray]:
    """Return the statement, or the text of the refusal, and the true check points."""
    of, rng = block(*FLIGHTS[flight]), np.random.default_rng(len(kind.codes) + len(kind.says))
    model = adjusted_model(of, Noise(pixel_px=0.2), rng)
    true = of.scene.gcp_in_geo[CONTROL:]
    try:
        return state(falsified(kind, of, rng), model, options), true
    except InconsistencyError as error:
        return str(error), true


@pytest.mark.parametrize(("name", "flight"), CASES)
def test_no_confident_wrong_statement(name: str, flight: str) -> None:
    kind = FALSIFIED[name]
    result, true = outcome(kind, flight)
    if isinstance(result, str):
        assert any(word in result for word in kind.says), result
        return
    if kind.named or result.sigmas_off(true) > SIGMAS:
        assert result.codes & set(kind.codes), result.cautions


@pytest.mark.parametrize("name", ["control points apart by 20 m", "fixes drift by 5 m"])
def test_an_accepted_contradiction_becomes_a_caution(name: str) -> None:
    kind = FALSIFIED[name]
    refused, _ = outcome(kind, "orbit")
    assert isinstance(refused, str)
    accepted, _ = outcome(kind, "orbit", InitSim3Options(accept_inconsistency=True))
    assert isinstance(accepted, Statement)
    assert any(caution.sentence in refused for caution in accepted.cautions)

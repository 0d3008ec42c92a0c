"""Falsified surveys, by kind: never a confident wrong statement."""

from __future__ import annotations

import numpy as np
import pytest

from pipelines.adjust.options import InitSim3Options
from pipelines.core.errors import InconsistencyError
from tests.adjusted_scenes import adjusted_model, block
from tests.falsified_surveys import CASES, CONTROL, FALSIFIED, FLIGHTS, falsified, generator_of
from tests.refusals import said
from tests.scenes import Noise
from tests.statements import Statement, state

SIGMAS = 3.0
pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("one_thread")]


def outcome(
    name: str, flight: str, options: InitSim3Options | None = None
) -> tuple[Statement | InconsistencyError, np.ndarray]:
    """Return the statement, or the refusal, and the true check points."""
    of, rng = block(*FLIGHTS[flight]), generator_of(name)
    model = adjusted_model(of, Noise(pixel_px=0.2), rng)
    true = of.scene.gcp_in_geo[CONTROL:]
    try:
        return state(falsified(FALSIFIED[name], of, rng), model, options), true
    except InconsistencyError as error:
        return error, true


@pytest.mark.parametrize(("name", "flight"), CASES)
def test_no_confident_wrong_statement(name: str, flight: str) -> None:
    kind = FALSIFIED[name]
    result, true = outcome(name, flight)
    if isinstance(result, InconsistencyError):
        assert result.code in kind.codes, result
        assert not kind.says or any(word in str(result) for word in kind.says), result
    elif kind.named or result.sigmas_off(true) > SIGMAS:
        assert result.codes & set(kind.codes), result.cautions


@pytest.mark.parametrize("name", ["control points apart by 20 m", "fixes drift by 5 m"])
def test_an_accepted_inconsistency_becomes_a_caution(name: str) -> None:
    refused, _ = outcome(name, "orbit")
    assert isinstance(refused, InconsistencyError)
    accepted, _ = outcome(name, "orbit", InitSim3Options(accept_inconsistency=True))
    assert isinstance(accepted, Statement)
    assert said(accepted.cautions, refused.code) in str(refused)

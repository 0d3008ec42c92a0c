"""Difference of two epochs whose heights have one assumed datum: it is free of the datum's error."""

from __future__ import annotations

import numpy as np
import pytest

from pipelines.change.datum import shared_by
from pipelines.geodesy.vertical import VerticalDatum
from pipelines.survey.survey import FixSession, Survey, UsedTransformation
from tests.scenes import Measured, Noise, make_scene, survey_of

OWN_M2 = np.full((1, 3), 0.05**2)


def epoch(datum: tuple[float, float, float], *, crs: str = "EPSG:27572", vertical: str = "ellipsoidal") -> Survey:
    survey = survey_of(make_scene("orbit", points=1), Noise(), Measured(), np.random.default_rng(0))
    common = np.hypot((0.03, 0.03, 0.05), datum)
    session = FixSession(
        receiver="RTK fixed", sigma_common_m=tuple(common.tolist()), sigma_source="default", sigma_datum_m=datum
    )
    used = UsedTransformation(
        of="positions", file="geo.txt", crs=crs, operation=crs, accuracy_m=2.0, sigma_m=max(datum[0], 0.0)
    )
    stated = VerticalDatum(name=vertical, stated=False)
    return survey.model_copy(update={"sessions": (session,), "transformations": (used,), "vertical": stated})


@pytest.mark.parametrize("same_base", [False, True])
def test_one_system_cancels(same_base: bool) -> None:
    datum = (1.4, 1.4, 50.0)
    total = OWN_M2 + np.square(datum)
    shared = shared_by(epoch(datum), epoch(datum), same_base=same_base)
    # What is left is that of both flights; with one base, less.
    assert (np.sqrt(shared.of_difference(total, total)) <= np.sqrt(2) * 0.05 + 1e-9).all()


def test_two_systems_do_not() -> None:
    datum = (1.4, 1.4, 50.0)
    total = OWN_M2 + np.square(datum)
    other = shared_by(epoch(datum), epoch(datum, crs="EPSG:23031", vertical="EGM96"), same_base=False)
    left = np.sqrt(other.of_difference(total, total))
    assert (left >= np.sqrt(2) * np.array(datum)).all()

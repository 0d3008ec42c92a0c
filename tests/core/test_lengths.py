"""Lengths as text: from one metre on in metres."""

from __future__ import annotations

import re

import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipelines.core.figures import MISSING, Headline, length_text

FORM = re.compile(r"(-?[\d.]+) (cm|m)")


@pytest.mark.parametrize(
    ("metres", "text"),
    [
        (None, MISSING),
        (float("nan"), MISSING),
        (0.042, "4.2 cm"),
        (0.9994, "99.9 cm"),
        (0.9996, "1.00 m"),  # 100.0 cm, rounded
        (1.0, "1.00 m"),
        (2.572, "2.57 m"),
        (-2.572, "-2.57 m"),
        (31.41, "31.4 m"),
        (412.3, "412 m"),
    ],
)
def test_examples(metres: float | None, text: str) -> None:
    assert length_text(metres) == text


@given(st.floats(0.0, 1e6))
def test_no_length_of_a_metre_is_in_centimetres_and_none_is_lost(metres: float) -> None:
    match = FORM.fullmatch(length_text(metres))
    assert match is not None
    number, unit = float(match[1]), match[2]
    assert (unit == "cm") == (number < 100.0 and metres < 0.9995)
    back = number / (100.0 if unit == "cm" else 1.0)
    assert abs(back - metres) <= max(0.0005 + 1e-12, 0.0051 * metres)


def test_a_headline_has_one_unit_a_figure() -> None:
    far = Headline(kind="predicted", rmse_h_m=2.572, rmse_v_m=0.042)
    assert far.text == "predicted, not measured: σ H 2.57 m, V 4.2 cm"
    unknown = Headline(kind="predicted", rmse_h_m=0.03)
    assert unknown.text == "predicted, not measured: σ H 3.0 cm, V unknown"


def test_a_headline_with_a_blunder_has_both_figures() -> None:
    without = {"blunders": ("G7",), "rmse_h_without_m": 0.021, "rmse_v_without_m": 0.03}
    text = Headline(kind="measured", rmse_h_m=1.06, rmse_v_m=0.05, check_points=4, **without).text
    assert "RMSE H 1.06 m, V 5.0 cm" in text and "G7" in text and "RMSE H 2.1 cm, V 3.0 cm" in text


def test_a_headline_states_its_points_and_their_measurement() -> None:
    plain = Headline(kind="measured", rmse_h_m=0.032, rmse_v_m=0.05, check_points=47)
    assert "47 check points, triangulated, with the error of their survey" in plain.text
    text = plain.model_copy(update={"vegetated": 3, "beyond_class": 14}).text
    assert "47 check points outside vegetation, triangulated" in text and "14 of them exceed three times" in text

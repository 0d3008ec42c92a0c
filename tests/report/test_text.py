"""Figures as text: rounding, signs, dashes."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipelines.report.page import (
    FORMS,
    Page,
    count_text,
    metres,
    number_text,
    parts_per_million,
    render_page,
    share,
    signed,
    value_at,
)


@given(st.floats(-1e6, 1e6))
def test_text_of_metres_is_the_value_to_what_it_is_worth(value: float) -> None:
    shown = float(metres(value).replace("−", "-"))
    step = 1e-4 if abs(value) < 0.01 else 1e-3 if abs(value) < 10 else 1e-2
    assert shown == pytest.approx(value, abs=0.51 * step)
    assert not metres(value).startswith("−0.0000")


@given(st.one_of(st.none(), st.just(math.nan)))
def test_what_does_not_exist_is_a_dash(value: float | None) -> None:
    assert {number_text(value), metres(value), share(value), signed(value)} == {"–"}


def test_forms() -> None:
    assert (number_text(-0.001), number_text(-1.25), signed(0.0004), signed(-0.2)) == (
        "0.00",
        "−1.25",
        "+0.000",
        "−0.200",
    )
    assert (share(0.95), share(0.9754), share(1.0)) == ("95 %", "97.5 %", "100 %")
    assert (count_text(1234567), count_text(None)) == ("1\u2009234\u2009567", "–")
    durations = [FORMS["duration"](s) for s in (0.34, 48, 723, 7500, None)]
    assert durations == ["0.3 s", "48 s", "12 min 03 s", "2 h 05 min", "–"]
    assert (parts_per_million(9.64e-5), parts_per_million(0.01858)) == ("96.4 ppm", "1.86 %")


def test_value_at_a_path() -> None:
    document = {"points": [{"de_m": 0.1}, None], "crossed": None}
    assert value_at(document, "points.0.de_m") == 0.1
    assert value_at(document, "crossed.rmse_h_m") is None
    assert value_at(document, "points.1.de_m") is None
    with pytest.raises(KeyError):
        value_at(document, "points.0.dn_m")


def test_control_characters_of_names_are_shown() -> None:
    """C0 with ESC and DEL, C1, marks that turn the direction of writing, and signs that end lines."""
    unsafe = "\x00\x07\x1b\x7f\x9b\u202e\u2066\u200f\u2028"
    page = render_page(Page(f"a{unsafe}b<i>", unsafe, {unsafe: unsafe}, ()), "pipelines.report")
    assert not set(unsafe) & set(page)
    assert "a\\x00\\x07\\x1b\\x7f\\x9b\\u202e\\u2066\\u200f\\u2028b&lt;i&gt;" in page

"""Sentences for a client: what is typed is left out, what is told stays."""

from __future__ import annotations

import pytest

from pipelines.core.sentences import without_commands


@pytest.mark.parametrize(
    ("text", "told"),
    [
        (
            "The σ are too large: 99 % give 1.1 to 2. They are 1.4 times the errors. State --sigma-mark.",
            "The σ are too large: 99 % give 1.1 to 2. They are 1.4 times the errors.",
        ),
        ("marks scatter 0.15 of 1 px: state it with --sigma-mark.", "Marks scatter 0.15 of 1 px."),
        ("no --crs was given: the UTM zone of the scene", "The UTM zone of the scene"),
        ("Nothing checks it. `georef ingest --gcp FILE` would.", "Nothing checks it."),
        ("georef export-ply", ""),
        ("Those of /home/me/flight/a.csv and C:\\me\\b.csv are WGS84.", "Those of a.csv and b.csv are WGS84."),
        ("WGS 84 / UTM zone 32N; https://a.b/c; 3 px/m", "WGS 84 / UTM zone 32N; https://a.b/c; 3 px/m"),
        ("", ""),
    ],
)
def test_what_is_typed_is_left_out(text: str, told: str) -> None:
    assert without_commands(text) == told
    assert without_commands(told) == told

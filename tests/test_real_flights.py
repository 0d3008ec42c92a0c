"""The benchmark of real flights: its table says what the workspaces say, failures included."""

from __future__ import annotations

import argparse
import re
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest

from pipelines.core.manifest import Manifest
from pipelines.core.workspace import Workspace
from pipelines.survey.report import read_report
from tests.scripts import REPOSITORY, load_script

real_flights = load_script(REPOSITORY / "examples/flights/real_flights.py")

RUN = real_flights.Run(peak_mb=2345.0, error="", at="2026-11-27", version="0.1.0", hardware="a machine")
NOTHING = real_flights.Published({}, {}, "")


def _flight(name: str, title: str = "A flight", **values: str) -> object:
    return real_flights.Flight(name, title, "https://github.com/a/b", "flight", "a trap", **values)


@pytest.mark.slow
def test_table_and_page_say_what_the_products_say(finished: Workspace, tmp_path: Path) -> None:
    out = finished.root.parent
    flight = _flight(finished.root.name)
    cells = real_flights.row_of(flight, RUN, finished.root).strip("| ").split(" | ")
    values = Manifest.model_validate_json(finished.path("sfm/manifest.json").read_bytes()).values
    report = read_report(finished.path("evaluate/report.json"))
    made = [Manifest.model_validate_json(path.read_bytes()) for path in finished.root.glob("*/manifest.json")]
    minutes = sum(manifest.duration_s for manifest in made) / 60
    assert cells[1:4] == [f"{values['registered']} of {values['images']}", f"{minutes:.1f} min", "2.3 GB"]
    assert cells[4].startswith(report.headline.of_points)
    assert report.test_views is not None and cells[5] == f"{report.test_views.psnr_covered:.1f} dB"
    assert re.fullmatch(r"\d+ % of \d+\.\d\d ha", cells[6])

    arguments = argparse.Namespace(preset="smoke", out=out)
    failed = replace(RUN, error="/home/me/photos/a.jpg: is no photograph")
    flights, runs = (
        [flight, _flight("gone", "Another"), _flight("x", "Elsewhere")],
        {flight.name: RUN, "gone": failed},
    )
    page = real_flights.page_of(flights, runs, NOTHING, arguments, tmp_path)
    assert "| [A flight](#a-flight) |" in page and "**Failed**: a.jpg: is no photograph" in page
    assert re.search(r"\[Another\]\(#another\) \| – \|.*\| failed \|", page)
    assert page.count("Run with georef 0.1.0 on a machine, 2026-11-27.") == 2
    assert (tmp_path / f"real_{flight.name}.jpg").stat().st_size > 500
    assert "## Not run" in page and "/home/" not in page
    for code in real_flights.remarks(real_flights.figures_of(finished.root)).values():
        assert f"`{code}`" in page

    again = real_flights.published_in(page)
    assert set(again.rows) == set(again.sections) == {"A flight", "Another"}
    assert real_flights.page_of(flights, {}, again, arguments, tmp_path) == page


def test_a_page_keeps_the_flights_that_are_not_run_again(tmp_path: Path) -> None:
    """One flight is run again and fails now; the other has its former row, section, version and day."""
    flights = [_flight("a", "One"), _flight("b", "Two")]
    arguments = argparse.Namespace(preset="smoke", out=tmp_path)
    first = real_flights.page_of(flights, {"a": RUN, "b": RUN}, NOTHING, arguments, tmp_path)
    shared = "Most of them have the remarks `default-sigma`."
    first = first.replace("\n\n## One", f"\n\n{shared}\n\n## One")
    failed = replace(RUN, error="no overlap", at="2026-11-28", version="0.2.0")
    second = real_flights.page_of(flights, {"b": failed}, real_flights.published_in(first), arguments, tmp_path)
    assert second.index("| [One]") < second.index("| [Two]") < second.index(shared) < second.index("## One")
    one, two = second.split("## One")[1].split("## Two")
    assert one == first.split("## One")[1].split("## Two")[0]
    assert "**Failed**: no overlap" in two and "Run with georef 0.2.0 on a machine, 2026-11-28." in two


@pytest.mark.slow
def test_a_flight_that_fails_is_recorded_with_its_error(tmp_path: Path) -> None:
    (tmp_path / "data/flight/images").mkdir(parents=True)
    run = real_flights.run_flight(_flight("empty"), tmp_path / "data", tmp_path / "out", "smoke")
    assert "images" in run.error and run == real_flights.record_of(tmp_path / "out/empty")
    assert real_flights.row_of(_flight("empty"), run, tmp_path / "out/empty").endswith("| failed |")


def test_the_digest_tells_photographs_apart(tmp_path: Path) -> None:
    (tmp_path / "a.jpg").write_bytes(b"1")
    before = real_flights.digest(tmp_path)
    (tmp_path / "a.jpg").rename(tmp_path / "b.jpg")
    renamed = real_flights.digest(tmp_path)
    (tmp_path / "b.jpg").write_bytes(b"2")
    assert len({before, renamed, real_flights.digest(tmp_path)}) == 3


def test_remarks_of_most_flights_are_said_once() -> None:
    """A code of more than half of the flights is common; of two flights, none is."""
    first, second, third = {"a 1": "a", "b 1": "b"}, {"a 2": "a"}, {"c 3": "c", "a 3": "a"}
    assert real_flights.common_remarks([first, second, third]) == {"a"}
    assert real_flights.common_remarks([first, second]) == set()


@pytest.mark.parametrize(
    ("beside", "text"),
    [
        ({}, "30 of 43"),
        ({"companions": 33, "companions_registered": 32}, "30 of 43, and 32 of 33 of the other lenses"),
    ],
)
def test_the_lenses_of_a_rig_are_counted_apart(beside: dict[str, int], text: str) -> None:
    sfm = SimpleNamespace(values={"registered": 30, "images": 43, **beside})
    assert real_flights.registered(real_flights.Figures({"sfm": sfm}, None)) == text

"""One source of a position is wrong by a random rule: the survey is right within its σ, or says something.

Sources are EXIF, XMP and a table. A lone source of another hemisphere or unit states a place that exists, and has
nothing to be compared with: these rules are drawn where there are two. Heights below zero of a lone source are;
true ones below zero whose sign is lost are not. A constant shift within three times the σ that two receivers have
against each other (7 to 12 m here) is within the stated σ.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pytest

from pipelines.core.errors import GeorefError
from pipelines.ingest.options import IngestOptions
from pipelines.ingest.stage import survey_and_track
from pipelines.survey.survey import Survey
from tests.earth import enu_from_lla
from tests.photos import ASCII, BYTE, RATIONAL, Entry, Exif, dji_xmp, gps_entries, jpeg

COUNT = 8
SOURCES = ("EXIF", "XMP", "table")
# What is said of every survey without σ and datum, and tells nothing about its positions.
ALWAYS = {
    "default-position-sigma",
    "default-common-sigma",
    "focal-length",
    "vertical-datum-assumed",
    "time-zone",
    "crs-assumed",
    "positions-from-xmp",
    "images-without-position",
}
Rule = Callable[["Source", np.random.Generator], None]


@dataclass
class Source:
    """What one source states of each photograph: latitude, longitude, height (N, 3), and tags for EXIF's."""

    lla: np.ndarray
    tags: list[dict[int, Entry]] = field(default_factory=lambda: [{} for _ in range(COUNT)])
    xmp_height: list[str] | None = None


def sign(source: Source, rng: np.random.Generator) -> None:
    source.lla[:, rng.integers(3)] *= -1


def truncated(source: Source, rng: np.random.Generator) -> None:
    steps = [1 / 60, 1 / 3600, 1e-3, 1e-4]
    step = steps[rng.integers(len(steps))]
    source.lla[:, :2] = np.trunc(source.lla[:, :2] / step) * step


def whole_metres(source: Source, rng: np.random.Generator) -> None:
    step = (1.0, 10.0, 100.0)[rng.integers(3)]
    source.lla[:, 2] = np.trunc(source.lla[:, 2] / step) * step


def zero_height(source: Source, rng: np.random.Generator) -> None:
    source.lla[: (COUNT, 1)[rng.integers(2)], 2] = 0.0


def zero_place(source: Source, rng: np.random.Generator) -> None:
    source.lla[: (COUNT, 2)[rng.integers(2)], :2] = 0.0


def stale(source: Source, rng: np.random.Generator) -> None:
    first = (0, COUNT // 2)[rng.integers(2)]
    source.lla[first:] = source.lla[first]


def feet(source: Source, rng: np.random.Generator) -> None:
    source.lla[:, 2] /= 0.3048


def one_wrong(source: Source, rng: np.random.Generator) -> None:
    """One photograph alone: elsewhere, of another hemisphere, or with its height of another."""
    row, kind = rng.integers(COUNT), rng.integers(3)
    if kind == 0:
        source.lla[row, :2] += rng.choice([-1, 1]) * rng.uniform(1e-3, 1.0)
    elif kind == 1:
        source.lla[row, rng.integers(2)] *= -1
    else:
        source.lla[row, 2] *= rng.choice([-1.0, 1 / 0.3048])


def shifted(source: Source, rng: np.random.Generator) -> None:
    """Another datum, or another reference of heights: all by a constant."""
    if rng.random() < 0.5:
        source.lla[:, :2] += rng.uniform(3e-5, rng.choice([4e-4, 2e-3]), 2)
    else:
        source.lla[:, 2] += rng.uniform(2.0, 100.0)


def below_zero(source: Source, rng: np.random.Generator) -> None:
    """The height with a sign of its own, as of a wrong reference."""
    source.lla[:, 2] = -np.abs(source.lla[:, 2])


def text(source: Source, rng: np.random.Generator) -> None:
    kind = rng.integers(4)
    for tags, (lat, lon, height) in zip(source.tags, source.lla, strict=True):
        if kind == 0:
            tags[5] = (5, ASCII, str(int(height < 0)))
        elif kind == 1:
            tags[6] = (6, ASCII, f"{height:.3f} m")
        elif kind == 2:
            tags[6] = (6, ASCII, f"{abs(height) / 0.3048:.3f} ft")
        else:
            tags[2], tags[4] = (2, ASCII, f"{abs(lat):.8f}"), (4, ASCII, f"{abs(lon):.8f}")


def wrapped(source: Source, rng: np.random.Generator) -> None:
    source.xmp_height = [f"{2**32 / 1000 + height if height < 0 else height:.3f}" for height in source.lla[:, 2]]
    for tags, (lat, lon, height) in zip(source.tags, source.lla, strict=True):
        if height < 0:
            tags[5], tags[6] = (5, BYTE, 0), (6, RATIONAL, [(2**32 + round(height * 1000), 1000)])
        if lat < 0:
            tags[1], tags[2] = (1, ASCII, "N"), (2, RATIONAL, [(2**32 + round(lat * 1e7), 10**7)])
        if lon < 0:
            tags[3], tags[4] = (3, ASCII, "E"), (4, RATIONAL, [(2**32 + round(lon * 1e7), 10**7)])


ALONE: tuple[Rule, ...] = (truncated, whole_metres, zero_height, zero_place, stale, below_zero)
TAGS_ONLY: tuple[Rule, ...] = (text, wrapped)
COMPARED: tuple[Rule, ...] = (sign, feet, one_wrong)


def flight(rng: np.random.Generator) -> tuple[np.ndarray, float]:
    """Return latitudes, longitudes and heights (N, 3) of two lines, and the height of take-off."""
    lat, lon = rng.uniform(5, 60) * rng.choice([-1, 1]), rng.uniform(5, 170) * rng.choice([-1, 1])
    ground = rng.choice([rng.uniform(20, 2500), rng.uniform(-300, -120)])
    along, across = np.arange(COUNT) % (COUNT // 2) * 22.0, np.arange(COUNT) // (COUNT // 2) * 25.0
    north = along * 0.8 + across * 0.6 + rng.normal(0, 1.0, COUNT)
    east = -along * 0.6 + across * 0.8 + rng.normal(0, 1.0, COUNT)
    height = ground + rng.uniform(40, 110) + rng.normal(0, 0.7, COUNT)
    places = [lat + north / 111_200.0, lon + east / 111_200.0 / np.cos(np.radians(lat))]
    return np.column_stack([*np.round(places, 8), height.round(3)]), float(ground)


def written(folder: Path, sources: dict[str, Source], ground: float) -> IngestOptions:
    """Write photographs and the table of some sources; return the options that read them."""
    images = folder / "images"
    images.mkdir(parents=True)
    rows = ["image,lat,lon,alt"]
    for row in range(COUNT):
        exif = Exif(photo=[(0x9003, ASCII, f"2024:05:01 12:00:{3 * row:02d}"), (0x9011, ASCII, "+00:00")])
        packet = None
        if "EXIF" in sources:
            lat, lon, height = sources["EXIF"].lla[row]
            tags = {entry[0]: entry for entry in gps_entries(lat, lon, height)}
            exif.gps = list((tags | sources["EXIF"].tags[row]).values())
        if "XMP" in sources:
            lat, lon, height = sources["XMP"].lla[row]
            heights = sources["XMP"].xmp_height
            packet = dji_xmp(
                GpsLatitude=f"{lat:.8f}",
                GpsLongitude=f"{lon:.8f}",
                AbsoluteAltitude=f"{height:+.3f}" if heights is None else heights[row],
                RelativeAltitude=f"{height - ground:+.3f}",
            )
        if "table" in sources:
            lat, lon, height = sources["table"].lla[row]
            rows.append(f"P{row}.jpg,{lat:.8f},{lon:.8f},{height:.3f}")
        (images / f"P{row}.jpg").write_bytes(jpeg(row, size=(16, 12), exif=exif, xmp=packet))
    given: dict[str, object] = {"images": images}
    if "table" in sources:
        (folder / "t.csv").write_text("\n".join(rows))
        given["trajectory"] = folder / "t.csv"
    return IngestOptions.model_validate(given)


def said_of(survey: Survey) -> set[str]:
    return {remark.code for of in (survey.assumptions, survey.warnings, survey.cautions) for remark in of} - ALWAYS


def worst(survey: Survey, truth: np.ndarray) -> float:
    """Return the largest error of a fix over its whole σ, its own and the common one; infinite without a fix."""
    assert survey.origin is not None
    right = enu_from_lla(truth, survey.origin)
    errors = []
    for image, place in zip(survey.images, right, strict=True):
        if image.fix is None:
            return np.inf
        common = np.square(survey.sessions[image.fix.session].sigma_common_m)
        sigma = np.sqrt(np.diag(image.fix.cov_in_geo) + common)
        errors.append(np.abs(np.array(image.fix.position_in_geo) - place) / sigma)
    return float(np.max(errors))


def outcome(folder: Path, seed: int, *, spoil: bool) -> tuple[str, set[str], float]:
    """Return what was drawn, the codes that were said, and the worst error over σ."""
    rng = np.random.default_rng(seed)
    truth, ground = flight(rng)
    names = [name for name in SOURCES if rng.random() < 0.6] or [SOURCES[rng.integers(3)]]
    sources = {name: Source(truth.copy()) for name in names}
    drawn = "+".join(names)
    if spoil:
        wrong = names[rng.integers(len(names))]
        rules = ALONE if wrong == "table" else ALONE + TAGS_ONLY
        if len(names) > 1:
            rules += (*COMPARED, shifted)
        rule = rules[rng.integers(len(rules))]
        rule(sources[wrong], rng)
        drawn += f", {rule.__name__} in {wrong}"
    options = written(folder, sources, ground)
    try:
        survey, _ = survey_and_track(options, None)
    except GeorefError as error:
        return drawn, {error.code}, np.inf
    return drawn, said_of(survey), worst(survey, truth)


@pytest.mark.parametrize("seeds", [range(60), pytest.param(range(60, 560), marks=pytest.mark.slow)])
def test_a_wrong_source_is_never_silent(tmp_path: Path, seeds: range) -> None:
    silent = []
    for seed in seeds:
        drawn, said, error = outcome(tmp_path / str(seed), seed, spoil=True)
        if not said and error > 3.0:
            silent.append((seed, drawn, round(error, 1)))
    assert silent == []


def test_sources_that_agree_are_not_blamed(tmp_path: Path) -> None:
    for seed in range(40):
        drawn, said, error = outcome(tmp_path / str(seed), seed, spoil=False)
        assert said <= {"heights-below-zero", "default-datum-sigma"}, (seed, drawn)
        assert error < 0.1, (seed, drawn)  # of σ: the digits of the files

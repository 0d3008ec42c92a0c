"""Falsified surveys, by kind, and what must name the falsification.

Each ends with a refusal that names the cause, or with an error of at most three times the stated σ, or with a
caution that names the cause. The surveys are clean but for the falsification.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy.interpolate import CubicSpline

from pipelines.survey.survey import Fix, Mark, Survey, SurveyedPoint
from tests.adjusted_scenes import Block
from tests.scenes import CAMERA, WITH_GCPS, Noise, survey_of

CONTROL, STEP_S = 8, 2.0
FOOT_M = 0.3048
Positions = np.ndarray  # (n, 3) fixes in geo, NaN: none
Change = Callable[[Positions, np.random.Generator], Positions]


@dataclass(frozen=True)
class Falsified:
    """A falsification, and what must name it.

    Attributes:
        fixes: changes the fixes; None: no fixes.
        control: number of control points.
        points: changes the surveyed positions (c, 3) of the control points.
        marks: changes the marks of the control points, in pixels.
        codes: any of these of a caution or of the refusal.
        says: the cause or its numbers, any of which the refusal must name too.
        attitudes: whether the survey has attitudes.
        fix_m: σ of the fixes as drawn and as stated.
        defaults: whether σ of the control points is a default.
        flights: that the kind is tried on; empty: on the orbit, and on the grid if its shape matters.
        named: the caution or refusal has to come, whatever the error.
        estimated: `georef run` estimates the error and states σ that hold without it.
    """

    fixes: Change | None
    control: int = 0
    points: Change | None = None
    codes: tuple[str, ...] = ()
    says: tuple[str, ...] = ()
    attitudes: bool = True
    fix_m: tuple[float, float, float] = (0.02, 0.02, 0.03)
    defaults: bool = True
    marks: Callable[[float, float], tuple[float, float]] | None = None
    flights: tuple[str, ...] = ()
    named: bool = False
    estimated: bool = False


def as_they_are(fixes: Positions, rng: np.random.Generator) -> Positions:
    return fixes


def late(by_s: float) -> Change:
    def change(fixes: Positions, rng: np.random.Generator) -> Positions:
        time_s = STEP_S * np.arange(len(fixes))
        return CubicSpline(time_s, fixes)(np.clip(time_s - by_s, time_s[0] - STEP_S, None))

    return change


def behind(by_m: float) -> Change:
    """Leave the fixes behind along the track, by a time."""

    def change(fixes: Positions, rng: np.random.Generator) -> Positions:
        spacing_m = float(np.median(np.linalg.norm(np.diff(fixes, axis=0), axis=1)))
        time_s = STEP_S * np.arange(len(fixes))
        return CubicSpline(time_s, fixes)(time_s - by_m * STEP_S / spacing_m)

    return change


def inward(by_m: float) -> Change:
    """Move the antenna to where the cameras of an orbit look, level."""
    return lambda fixes, rng: fixes - by_m * fixes / np.linalg.norm(fixes[:, :2], axis=1)[:, None] * [1.0, 1.0, 0.0]


def half_of_them(*by_m: float) -> Change:
    """Shift half of the fixes, in no order."""
    return lambda fixes, rng: fixes + (rng.permutation(len(fixes)) < len(fixes) // 2)[:, None] * np.array(by_m)


def larger_map(factor: float) -> Change:
    def change(points: Positions, rng: np.random.Generator) -> Positions:
        middle = points.mean(axis=0)
        return (points - middle) * [factor, factor, 1.0] + middle

    return change


def few(count: int, noise_m: float) -> Change:
    def change(fixes: Positions, rng: np.random.Generator) -> Positions:
        chosen = np.linspace(0, len(fixes) - 1, count + 1)[:count].astype(int)
        some = np.full_like(fixes, np.nan)
        some[chosen] = fixes[chosen] + rng.normal(0, noise_m, (count, 3))
        return some

    return change


def noise(sigma_m: float) -> Change:
    return lambda fixes, rng: fixes + rng.normal(0, sigma_m, fixes.shape)


def mirror(fixes: Positions, rng: np.random.Generator) -> Positions:
    return fixes[:, [1, 0, 2]]


def drift(*by_m: float) -> Change:
    return lambda fixes, rng: fixes + np.linspace(0, 1, len(fixes))[:, None] * by_m


def step(*by_m: float) -> Change:
    return lambda fixes, rng: fixes + (np.arange(len(fixes)) >= len(fixes) // 2)[:, None] * np.array(by_m)


def shift(*by_m: float) -> Change:
    return lambda fixes, rng: fixes + np.array(by_m)


def feet(fixes: Positions, rng: np.random.Generator) -> Positions:
    return fixes * [1.0, 1.0, 1 / FOOT_M]


def downward(fixes: Positions, rng: np.random.Generator) -> Positions:
    return fixes * [1.0, 1.0, -1.0]


def other_images(fixes: Positions, rng: np.random.Generator) -> Positions:
    return rng.permutation(fixes)


def one_later(fixes: Positions, rng: np.random.Generator) -> Positions:
    return np.roll(fixes, 1, axis=0)


def wrong(share: float, size_m: float) -> Change:
    def change(fixes: Positions, rng: np.random.Generator) -> Positions:
        chosen = rng.permutation(len(fixes))[: round(share * len(fixes))]
        changed = fixes.copy()
        changed[chosen] += rng.normal(0, size_m, (len(chosen), 3))
        return changed

    return change


def first_off(count: int, *by_m: float) -> Change:
    return lambda points, rng: points + (np.arange(len(points)) < count)[:, None] * np.array(by_m)


HAND_HELD = noise(3.0)
CONSUMER = (1.5, 1.5, 3.0)
FALSIFIED = {
    "4 fixes, 2 m noise": Falsified(few(4, 2.0), codes=("sigma-rejected", "fix-outliers")),
    "5 fixes, 1 m noise": Falsified(few(5, 1.0), codes=("sigma-rejected",)),
    "3 fixes, 1.5 m noise": Falsified(
        few(3, 1.5), codes=("hardly-checked", "sigma-rejected"), attitudes=False
    ),
    "optimistic σ, 0.1 m noise": Falsified(noise(0.1), codes=("sigma-rejected",)),
    "optimistic σ, 2 m noise": Falsified(noise(2.0), codes=("sigma-rejected",)),
    "3 control points, one 5 m off": Falsified(None, 3, first_off(1, 3.0, 4.0, 0.0), ("hardly-checked",)),
    "4 control points, one 5 m off": Falsified(
        None, 4, first_off(1, 3.0, 4.0, 0.0), ("hardly-checked", "sigma-rejected")
    ),
    "5 control points, hand-held": Falsified(None, 5, HAND_HELD, ("sigma-rejected",)),
    "5 control points, hand-held, consumer": Falsified(
        as_they_are, 5, HAND_HELD, ("sigma-rejected",), fix_m=CONSUMER
    ),
    "3 control points, hand-held, RTK": Falsified(as_they_are, 3, HAND_HELD, ("sigma-rejected",)),
    "8 control points, 3 of them 5 m off": Falsified(
        as_they_are, 8, first_off(3, 3.0, 4.0, 0.0), ("sigma-rejected",)
    ),
    "8 control points, one 5 m off": Falsified(as_they_are, 8, first_off(1, 3.0, 4.0, 0.0), ("control-outliers",)),
    "mirrored, no attitudes": Falsified(mirror, codes=("axis-order", "upside-down"), attitudes=False),
    "mirrored": Falsified(mirror, codes=("axis-order", "upside-down")),
    "heights downward": Falsified(downward, codes=("heights-down", "upside-down")),
    "fixes drift by 5 m": Falsified(drift(3.0, 4.0, 0.0), codes=("drift",)),
    "heights drift by 4 m": Falsified(drift(0.0, 0.0, 4.0), codes=("drift",)),
    "second half shifted by 3 m": Falsified(step(2.0, 2.0, 1.0), codes=("step",)),
    "fixes of other images": Falsified(other_images, codes=("other-photographs", "clock", "upside-down")),
    "fixes one photograph late": Falsified(
        one_later, codes=("attitudes-inconsistent", "clock", "upside-down")
    ),
    "heights in feet": Falsified(feet, codes=("feet",)),
    "control points apart by 2 m": Falsified(as_they_are, 8, shift(1.2, 1.6, 0.0), ("fixes-shifted",)),
    "control points apart by 20 m": Falsified(
        as_they_are, 8, shift(12.0, 16.0, 0.0), ("control-shifted",), ("datum",)
    ),
    "control points apart by 1 km": Falsified(
        as_they_are, 8, shift(600.0, 800.0, 0.0), ("control-shifted",), ("datum",)
    ),
    "control points 48 m lower": Falsified(
        as_they_are, 8, shift(0.0, 0.0, -48.0), ("control-shifted",), ("geoid",)
    ),
    "3 control points apart by 1 m": Falsified(as_they_are, 3, shift(0.6, 0.8, 0.0), ("fixes-shifted",)),
    "3 good control points, fixes of 5 m": Falsified(
        noise(5.0), 3, codes=("sigma-rejected",), fix_m=(5.0, 5.0, 10.0)
    ),
    "common bias of a consumer receiver": Falsified(
        shift(2.0, 1.0, 4.0), codes=("no-control-points",), fix_m=CONSUMER
    ),
    "15 % of the fixes 15 m off": Falsified(wrong(0.15, 15.0), codes=("no-control-points",)),
    "half of the fixes 15 m off": Falsified(
        wrong(0.5, 15.0), codes=("sigma-rejected", "fix-outliers", "clock", "other-photographs")
    ),
    "40 % of the fixes 15 m off": Falsified(
        wrong(0.4, 15.0), codes=("fix-outliers",), says=("5 of 12 fixes",), named=True
    ),
    "half of the fixes 3 m east": Falsified(
        half_of_them(3.0, 0.0, 0.0), codes=("mixture",), says=("6 of 12 fixes",), flights=("orbit", "grid"),
        named=True,
    ),
    "noise of 0.5 m instead of 0.02 m": Falsified(noise(0.5), codes=("sigma-rejected",), named=True),
    "clock of GPS time": Falsified(
        late(18.0), codes=("clock", "upside-down"), says=("+18.0", "+17.9"), flights=("lines", "circle"),
        named=True,
    ),
    "clock 0.2 s late": Falsified(
        late(0.2), codes=("clock", "attitudes-inconsistent"), flights=("circle", "turns")
    ),
    "marks with y from below": Falsified(
        as_they_are, 8, marks=lambda x, y: (x, CAMERA.height - y), codes=("control-marks",),
        flights=("orbit", "grid"), named=True,
    ),
    "marks with x and y exchanged": Falsified(
        as_they_are, 8, marks=lambda x, y: (y, x), codes=("control-marks", "mark-outside-image"), named=True
    ),
    "marks of photographs of half the size": Falsified(
        as_they_are, 8, marks=lambda x, y: (x / 2, y / 2), codes=("control-marks",), flights=("orbit", "grid"),
        named=True,
    ),
    "control points 10 m off fixes of 5 m": Falsified(
        as_they_are, 8, shift(1.0, 10.15, 0.0), ("fixes-shifted",), fix_m=(5.0, 5.0, 10.0),
        flights=("orbit", "grid"), named=True,
    ),
    "control points in Web Mercator": Falsified(
        as_they_are, 8, larger_map(1 / np.cos(np.radians(46.0))), ("control-map",), ("Web Mercator",),
        flights=("orbit", "grid"), named=True,
    ),
    "control points in Web Mercator, consumer": Falsified(
        as_they_are, 8, larger_map(1 / np.cos(np.radians(46.0))), ("control-map",), ("Web Mercator",),
        fix_m=CONSUMER, named=True,
    ),
    "control points mirrored": Falsified(as_they_are, 8, mirror, ("control-map",), ("mirrored",), named=True),
    "clock late by 3 m of an orbit": Falsified(
        behind(3.0), codes=("clock", "fix-lag"), flights=("orbit", "turns"), named=True, estimated=True
    ),
    "fixes lag by 4 m, consumer": Falsified(
        behind(4.0), codes=("clock", "fix-lag"), fix_m=CONSUMER, flights=("lines",), named=True, estimated=True
    ),
    "lever arm of 1 m forward": Falsified(
        inward(1.0), codes=("lever-arm",), flights=("orbit",), named=True, estimated=True
    ),
    # Named; what is left of it after the estimate is 3.8 σ.
    "lever arm of 1 m forward, turning": Falsified(
        inward(1.0), codes=("lever-arm",), flights=("turns",), named=True
    ),
    "lever arm of 0.8 m backward": Falsified(
        inward(-0.8), codes=("lever-arm",), flights=("turns",), named=True, estimated=True
    ),
}  # fmt: skip
FLIGHTS = {
    "orbit": ("orbit", 12), "grid": ("grid", 12), "lines": ("lines", 40), "circle": ("circle", 36),
    "turns": ("orbit", 40),
}  # fmt: skip
# Each kind on the orbit; those that the flight's shape matters for on the grid too.
CASES = [
    (name, flight)
    for name, kind in FALSIFIED.items()
    for flight in kind.flights
    or (
        ("orbit", "grid")
        if kind.fixes not in (None, as_they_are)
        and kind.control == 0
        and not name.startswith(("5 fixes", "heights drift", "40 %", "noise of"))
        else ("orbit",)
    )
]


def generator_of(name: str) -> np.random.Generator:
    """Return the generator of a kind, whatever names it."""
    return np.random.default_rng(list(FALSIFIED).index(name))


def falsified(kind: Falsified, of: Block, rng: np.random.Generator) -> Survey:
    """Return the survey of a block, falsified."""
    measured = replace(WITH_GCPS, attitudes=kind.attitudes)
    survey = survey_of(of.scene, Noise(fix_m=kind.fix_m, pixel_px=0.2), measured, rng)
    places = np.array([image.fix.position_in_geo for image in survey.images if image.fix is not None])
    changed = np.full_like(places, np.nan) if kind.fixes is None else kind.fixes(places, rng)
    images = tuple(
        image.model_copy(update={"fix": _moved(image.fix, place), "timestamp_s": index * STEP_S})
        for index, (image, place) in enumerate(zip(survey.images, changed, strict=True))
    )
    control, checks = survey.control_points[: kind.control], survey.control_points[CONTROL:]
    if kind.points is not None:
        surveyed = kind.points(np.array([point.position_in_geo for point in control]), rng)
        control = tuple(_surveyed(point, place) for point, place in zip(control, surveyed, strict=True))
    if kind.marks is not None:
        control = tuple(_marked(point, kind.marks) for point in control)
    return survey.model_copy(
        update={
            "images": images,
            "control_points": control,
            "check_points": checks,
            "default_sigmas": ("control points",) if kind.defaults else (),
        }
    )


def _moved(fix: Fix | None, place: np.ndarray) -> Fix | None:
    if fix is None or not np.isfinite(place).all():
        return None
    return fix.model_copy(update={"position_in_geo": tuple(place.tolist())})


def _surveyed(point: SurveyedPoint, place: np.ndarray) -> SurveyedPoint:
    return point.model_copy(update={"position_in_geo": tuple(place.tolist())})


def _marked(point: SurveyedPoint, change: Callable[[float, float], tuple[float, float]]) -> SurveyedPoint:
    def marked(mark: Mark) -> Mark:
        x_px, y_px = change(mark.x_px, mark.y_px)
        return mark.model_copy(update={"x_px": x_px, "y_px": y_px})

    return point.model_copy(update={"marks": tuple(marked(mark) for mark in point.marks)})

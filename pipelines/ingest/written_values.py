"""Steps of written positions, by their digits, and heights that are none, by their zeros."""

from collections.abc import Sequence

import numpy as np

from pipelines.core.types import BoolArray, FloatArray
from pipelines.ingest.remarks import Remarks, shortened

M_PER_DEG = 111_320.0
# Steps that positions are written in, degrees: decimals of a minute and of a second, and of a degree.
_SEXAGESIMAL_DEG = frozenset(
    unit / 10.0**digits for unit, most in ((1 / 60, 6), (1 / 3600, 4)) for digits in range(most + 1)
)
_STEPS_DEG = sorted(_SEXAGESIMAL_DEG | {10.0**-digits for digits in range(8)}, reverse=True)
_STEPS_M = (100.0, 10.0, 1.0, 0.1, 0.01, 0.001)
_ROUNDED, _ROUNDED_PART = 6e-7, 0.005  # what writing a value once more, in six decimals or more, leaves of its step
_LEAST_VALUES = 4  # different ones, of which a common step is no chance
_LEAST_HEIGHT_M, _LEAST_APART_M = 10.0, 5.0  # of other heights, from which a zero among them is none
UNKNOWN_SIGMA_M = 1000.0


def digits_sigma_m(
    places: FloatArray, heights: FloatArray, *, degrees: bool, of: str, remarks: Remarks
) -> FloatArray:
    """Return σ horizontal and vertical (2,) of the steps that places (N, 2) and heights (N,) are written in.

    All heights the same are an assumption: such were planned or rounded, and not measured.

    Values may be rounded or cut off, which their digits do not tell: σ is that of a value cut off. Steps that make
    more than a metre are a caution.
    """
    step_m = step_of_places(places) * M_PER_DEG if degrees else step_of_heights(places.ravel())
    sigma_m: FloatArray = np.array([step_m, step_of_heights(heights)]) / np.sqrt(3.0)
    for step, name, code in (
        (step_m, "positions", "position-digits"),
        (step_of_heights(heights), "heights", "height-digits"),
    ):
        if step / np.sqrt(3.0) > 1.0:
            remarks.caution(
                code,
                f"The {name} of {of} are written in steps of {step:.0f} m: {step / np.sqrt(3.0):.1f} m is added to "
                "their σ.",
            )
    known = heights[np.isfinite(heights)]
    if len(known) > _LEAST_VALUES and np.ptp(known) == 0.0:
        remarks.assume("one-height-for-all", f"All {len(known)} heights of {of} are exactly {known[0]:.1f} m.")
    return sigma_m


def step_of_places(places: FloatArray, *, compared: bool = False) -> float:
    """Return the step in degrees that latitudes and longitudes (N, 2) are written in, 0 if it is unknown.

    Whole minutes and seconds are how degrees are cut off. Round decimals of a degree are so only in both axes, or
    where they are compared with another source of the same places.
    """
    whole = _common_step(places.ravel(), (1 / 60, 1 / 3600), _LEAST_VALUES - 1)
    step = whole or _common_step(places.ravel(), _STEPS_DEG, _LEAST_VALUES)
    varied = all(len(np.unique(axis[np.isfinite(axis)])) >= _LEAST_VALUES for axis in places.T)
    return step if varied or compared or step in _SEXAGESIMAL_DEG else 0.0


def step_of_heights(heights: FloatArray) -> float:
    """Return the step in metres that lengths are written in, 0 if it is unknown."""
    coarse = _common_step(heights, _STEPS_M[:2], 2) if np.isfinite(heights).sum() > _LEAST_VALUES else 0.0
    return coarse or _common_step(heights, _STEPS_M, _LEAST_VALUES)


def _common_step(values: FloatArray, steps: Sequence[float], least: int) -> float:
    """Return the coarsest of some steps that all values are multiples of; 0 for none, or of too few values."""
    known = np.unique(values[np.isfinite(values)])
    if len(known) < least:
        return 0.0
    off = ((step, np.abs(known - np.round(known / step) * step).max()) for step in steps)
    return next((step for step, most in off if most < min(_ROUNDED, _ROUNDED_PART * step)), 0.0)


def zero_heights(heights: FloatArray, names: Sequence[str], of: str, remarks: Remarks) -> tuple[BoolArray, bool]:
    """Return which heights (N,) of exactly 0 are none, and whether all are 0, so that none is known."""
    known = np.isfinite(heights)
    zero = known & (heights == 0.0)
    if zero.sum() < 1:
        return zero, False
    if zero.sum() == known.sum():
        remarks.caution(
            "heights-all-zero",
            f"All {int(zero.sum())} heights of {of} are 0 m, which says nothing: σ of {UNKNOWN_SIGMA_M:.0f} m.",
        )
        return np.zeros_like(zero), True
    others = heights[known & ~zero]
    if abs(float(np.median(others))) < _LEAST_HEIGHT_M or np.abs(others).min() < _LEAST_APART_M:
        return np.zeros_like(zero), False
    remarks.warn(
        "height-zero",
        f"{int(zero.sum())} heights of 0 m among heights of {others.min():.0f} to {others.max():.0f} m are none, "
        f"and are not used: {shortened([names[row] for row in np.flatnonzero(zero).tolist()])}.",
    )
    return zero, False

"""Cautions of a comparison with a reference."""

from __future__ import annotations

from pipelines.core.cautions import Caution
from pipelines.evaluate.reference.comparison import ComparedReference

_SHIFTED_SIGMAS = 3.0
_SEEN = 0.05


def cautions_of_reference(found: ComparedReference) -> tuple[Caution, ...]:
    """Return the limits of a comparison with a reference."""
    comparison, sentences = found.comparison, []
    for assumption in found.assumptions:
        sentences.append(("reference-heights", assumption[0].upper() + assumption[1:] + "."))
    fine = max(comparison.spacing_m, comparison.model_spacing_m)
    least = comparison.groups[0].scores[0].threshold_m
    if fine > least:
        sentences.append(
            (
                "reference-spacing",
                f"Points are {fine:.3f} m apart: shares within shorter distances, and C2C, say more about the "
                "spacing than about the surface. M3C2 does not depend on it.",
            )
        )
    shift = comparison.shift
    if shift is not None and comparison.aligned == "none":
        sigma = [max(s, comparison.georeference_sigma_m or 0.0, comparison.sigma_m) for s in shift.sigma_m]
        if any(abs(value) > _SHIFTED_SIGMAS * s for value, s in zip(shift.enu_m, sigma, strict=True)):
            sentences.append(
                (
                    "reference-shifted",
                    "The model lies off the reference as a whole: moving it by "
                    f"{shift.enu_m[0]:+.3f} m east, {shift.enu_m[1]:+.3f} m north and {shift.enu_m[2]:+.3f} m up "
                    "fits best, which is more than three times the σ of both (--reference-align shift judges the "
                    "shape alone).",
                )
            )
    if comparison.seen < _SEEN:
        sentences.append(
            (
                "reference-unseen",
                f"Photographs saw {100 * comparison.seen:.1f} % of the reference's points within the scene.",
            )
        )
    return tuple(Caution(code=code, sentence=sentence) for code, sentence in sentences)

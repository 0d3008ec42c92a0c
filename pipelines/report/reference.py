"""Comparison of the surface with a reference cloud: map, histogram, and the figures by class and slope."""

from __future__ import annotations

from dataclasses import dataclass

from pipelines.core.stages import REFERENCE_HISTOGRAM, REFERENCE_MAP
from pipelines.pages.pictures import Picture, png_file
from pipelines.report.evaluated import EvaluatedSurvey


@dataclass(frozen=True)
class ReferenceFacts:
    """Pictures of a comparison.

    Attributes:
        is_compared: whether `evaluate` had a reference.
        map, histogram: None: nothing was measured.
    """

    is_compared: bool
    map: Picture | None
    histogram: Picture | None


def reference_facts(evaluated: EvaluatedSurvey) -> ReferenceFacts:
    """Return the pictures of the comparison with a reference.

    Raises:
        InputError: a picture is damaged.
    """
    if evaluated.report.reference is None:
        return ReferenceFacts(False, None, None)
    paths = (evaluated.workspace.root / product for product in (REFERENCE_MAP, REFERENCE_HISTOGRAM))
    return ReferenceFacts(True, *(png_file(path) if path.is_file() else None for path in paths))

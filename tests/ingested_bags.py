"""Bags through `georef ingest`, and what the survey must say of a flight."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from pipelines.geometry.rotations import log_so3, matrix_from_quat_xyzw
from pipelines.survey.survey import Survey
from tests import bags

Ingest = Callable[..., Survey]
Refusal = Callable[..., dict[str, Any]]


def check(survey: Survey, flight: bags.Flight, *, tolerance_m: float = 1e-3, attitude: bool = True) -> None:
    """The survey has the flight's cameras, to a millimetre and a hundredth of a degree."""
    centers, rotations = bags.expected(flight, survey.origin)
    assert len(survey.images) == flight.count
    positions = np.array([image.fix.position_in_geo for image in survey.images if image.fix])
    np.testing.assert_allclose(positions, centers, rtol=0, atol=tolerance_m)
    if attitude:
        quats = [image.attitude.quat_xyzw for image in survey.images if image.attitude]
        turned = log_so3(matrix_from_quat_xyzw(quats) @ np.swapaxes(rotations, 1, 2))
        assert np.degrees(np.linalg.norm(turned, axis=1)).max() < 0.01


def remarked(survey: Survey, code: str, *parts: str) -> bool:
    """Whether a warning or an assumption has the code and all parts (numbers, topics, files)."""
    remarks = (*survey.warnings, *survey.assumptions)
    return any(one.code == code and all(part in one.text for part in parts) for one in remarks)

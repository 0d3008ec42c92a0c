"""Geodetic points of known truth in the tangent plane, in one step."""

from __future__ import annotations

from numpy.typing import ArrayLike

from pipelines.core.types import FloatArray
from pipelines.geodesy.enu import Origin, ecef_from_lla, enu_from_ecef


def enu_from_lla(lla: ArrayLike, origin: Origin) -> FloatArray:
    """Return tangent-plane points (…, 3) in metres at `origin` of geodetic points (…, 3)."""
    return enu_from_ecef(ecef_from_lla(lla), origin)

"""Points that two dates have in common: tracks of the later one, with their places in the solution of the earlier.

`sfm --earlier` finds them and writes them beside the SfM model. They are measurements of the later survey: where
the earlier solution has put the points that its photographs see.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, replace
from pathlib import Path
from typing import ClassVar

import numpy as np

from pipelines.core.fingerprints import first_hash
from pipelines.core.products import ArrayProduct, save_npz
from pipelines.core.stages import SOLVED_PLACES
from pipelines.core.types import BoolArray, FloatArray, IntArray
from pipelines.core.workspace import Workspace
from pipelines.geodesy.enu import Origin, ecef_from_enu_rotation, enu_from_ecef, lla_of


@dataclass(frozen=True)
class CommonPoints(ArrayProduct):
    """N points of the SfM models of two dates.

    Attributes:
        point_id, earlier_point_id: COLMAP's ids in the later and in the earlier model; each at most once.
        matches: pairs of photographs across the dates that agree on the point.
        position_in_ecef, cov_in_ecef: place by the earlier solution (m), and its covariance (m²) by the earlier
            photographs' own marks, which is independent between points.
        sigma_m: σ east, north, up of the earlier solution, root mean square over its scene.
        cov_similarity, pivot_in_ecef: covariance of the earlier similarity, as in `SimilarityRecord`, along
            Earth-centred axes about a pivot: later places share its error.
        spread: share of the ground common to both dates, in blocks, that has points.
        found: number of points as `sfm` has found them.
        factor: of the variance of points and marks, by the test of the adjustment; 1 as `sfm` writes it.
        checked: whether something checks the σ of the earlier positions.
        earlier, solution: folder of the earlier workspace, and `solution_hash` of what was solved there.
    """

    FORMS: ClassVar = {
        "point_id": ("i", "N"),
        "earlier_point_id": ("i", "N"),
        "matches": ("i", "N"),
        "position_in_ecef": ("f", "N", 3),
        "cov_in_ecef": ("f", "N", 3, 3),
        "sigma_m": ("f", 3),
        "cov_similarity": ("f", 7, 7),
        "pivot_in_ecef": ("f", 3),
        "spread": ("f",),
        "found": ("i",),
        "factor": ("f",),
        "checked": ("b",),
        "earlier": None,
        "solution": None,
    }

    point_id: IntArray
    earlier_point_id: IntArray
    matches: IntArray
    position_in_ecef: FloatArray
    cov_in_ecef: FloatArray
    sigma_m: FloatArray
    cov_similarity: FloatArray
    pivot_in_ecef: FloatArray
    spread: FloatArray
    found: IntArray
    factor: FloatArray
    checked: BoolArray
    earlier: str
    solution: str

    def __len__(self) -> int:
        return len(self.point_id)

    @property
    def name(self) -> str:
        """Name of the earlier workspace."""
        return Path(self.earlier).name

    def save(self, path: Path) -> None:
        save_npz(path, {name: getattr(self, name) for name in self.FORMS})

    def scaled(self, factor: float) -> CommonPoints:
        """Return the points with their variance, and that of their marks, times a factor."""
        return replace(self, factor=np.asarray(float(self.factor) * factor))

    def without(self, point_id: Collection[int]) -> CommonPoints:
        """Return the points but for some, by COLMAP's ids in the later model."""
        kept = ~np.isin(self.point_id, np.array(list(point_id), dtype=np.int64))
        rows = {
            name: getattr(self, name)[kept] for name, form in self.FORMS.items() if form is not None and "N" in form
        }
        return replace(self, **rows)

    def position_in_geo(self, origin: Origin) -> FloatArray:
        """Return the places (N, 3) in the `geo` of an origin."""
        return enu_from_ecef(self.position_in_ecef, origin)

    def cov_in_geo(self, origin: Origin) -> FloatArray:
        """Return the covariances (N, 3, 3) along the axes of the `geo` of an origin, times the factor."""
        axes = ecef_from_enu_rotation(lla_of(origin))
        return np.asarray(float(self.factor) * (axes.T @ self.cov_in_ecef @ axes))

    def similarity_in_geo(self, origin: Origin) -> tuple[FloatArray, FloatArray]:
        """Return the covariance (7, 7) of the earlier similarity and its pivot (3,) in the `geo` of an origin."""
        turn = np.eye(7)
        turn[1:4, 1:4] = turn[4:, 4:] = ecef_from_enu_rotation(lla_of(origin)).T
        return np.asarray(turn @ self.cov_similarity @ turn.T), enu_from_ecef(self.pivot_in_ecef, origin)

    def is_of(self, workspace: Workspace) -> bool:
        """Return whether a workspace holds the solution that the points were taken from."""
        return solution_hash(workspace) == self.solution


def solution_hash(workspace: Workspace) -> str:
    """Return the hash of where the solution of a workspace, that of its training if there is one, puts things.

    A training that keeps the cameras has the hash of what it keeps: it may follow `sfm` of the later date.
    """
    return first_hash(workspace, SOLVED_PLACES, {})

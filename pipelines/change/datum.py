"""Common datum of two epochs: σ of the difference that both adjustments predict, and what both share.

With C₁ and C₂ the covariances of a point by both adjustments, that of the difference is C₁ + C₂ − 2 S. S is what
both share, by axis and as a translation: the surveyed coordinates of common control points, on request the base.
Each adjustment takes of an error the share w of its source in the datum: w_c = V_f / (V_f + V_c) of the control
points, V_c and V_f being the variances of the mean control point and of the mean fix, and 1 − w_c of the fixes.

Where points in common tie both adjustments (`georef sfm --earlier`), the covariance of the difference is theirs
(`change.tied`): the place on Earth is one error, which both share.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipelines.adjust.accuracy_grid import AccuracyGrid
from pipelines.adjust.posterior import Posterior
from pipelines.adjust.solution import posterior_of
from pipelines.core.products import Remark, is_checked
from pipelines.core.types import FloatArray
from pipelines.core.workspace import Workspace
from pipelines.geodesy.crs import PointCrs
from pipelines.geodesy.enu import ecef_from_enu, ecef_from_lla, enu_from_ecef
from pipelines.survey.navigation import load_survey
from pipelines.survey.solution import read_sfm, read_solution
from pipelines.survey.survey import FixSession, Survey

_SAME_PLACE_M = 0.02  # between the coordinates of one control point in both surveys
_MOST_SHARED = 0.98  # of the smaller variance: the difference of two flights is never exact


@dataclass(frozen=True)
class Epoch:
    """Survey of an epoch with its predicted σ over the scene; `grid` None: not known, for the `reason`."""

    survey: Survey
    grid: AccuracyGrid | None
    reason: str
    cautions: tuple[Remark, ...]
    posterior: Posterior

    def geo_from_plan(self, crs: PointCrs, plan: FloatArray) -> FloatArray:
        """Return places (N, 3) in this survey's `geo` of places (N, 2) in a CRS, at the height of its origin."""
        lla = crs.lla_from_xyz(np.column_stack([plan, np.zeros(len(plan))]))
        lla[:, 2] = self.survey.origin_on_earth.alt_m
        return np.asarray(enu_from_ecef(ecef_from_lla(lla), self.survey.origin_on_earth))

    def variance_at(self, crs: PointCrs, plan: FloatArray) -> FloatArray:
        """Return the variances (N, 3) east, north and up in m² of places (N, 2) in a CRS; zeros: not known."""
        if self.grid is None:
            return np.zeros((len(plan), 3))
        return np.asarray(np.diagonal(self.grid.cov_at(self.geo_from_plan(crs, plan)), axis1=1, axis2=2))


def load_epoch(workspace: Workspace) -> Epoch:
    """Return an epoch of a workspace; errors as of `read_solution` and `posterior_of`."""
    solution = read_solution(workspace)
    survey, cautions = solution.weighted(load_survey(workspace)), solution.cautions
    posterior = posterior_of(workspace, solution, read_sfm(workspace, solution))
    if not is_checked(cautions):
        return Epoch(survey, None, "nothing checks the σ of the positions", cautions, posterior)
    reason = "" if posterior.grid is not None else "the scene has too few points"
    return Epoch(survey, posterior.grid, reason, cautions, posterior)


@dataclass(frozen=True)
class Shared:
    """Errors that two epochs share: variance (3,) east, north, up in m² by source, and names of control points.

    `by_system_m2` is that of one reference system with one assumption or transformation, which the difference is
    free of.
    """

    control: tuple[str, ...]
    by_control_m2: FloatArray
    by_base_m2: FloatArray
    by_system_m2: FloatArray

    def of_difference(self, first: FloatArray, second: FloatArray) -> FloatArray:
        """Return the variances (N, 3) of the difference from those (N, 3) of both epochs."""
        first, second = (np.maximum(each - self.by_system_m2, 0.0) for each in (first, second))
        common = np.minimum(self.by_control_m2 + self.by_base_m2, _MOST_SHARED * np.minimum(first, second))
        return np.asarray(first + second - 2 * common)


def same_photographs(before: Survey, after: Survey) -> tuple[str, ...]:
    """Return the names in the later survey of the photographs that are in both, by their content."""
    there = {image.sha256 for image in before.images if image.sha256}
    return tuple(image.name for image in after.images if image.sha256 in there)


def shared_by(before: Survey, after: Survey, *, same_base: bool) -> Shared:
    """Return what two surveys share: control points of one name and place, and the base if the user says so."""
    there = {point.name: point for point in before.control_points}
    pairs = []
    for point in after.control_points:
        other = there.get(point.name)
        if other is None:
            continue
        here = ecef_from_enu(np.array([point.position_in_geo]), after.origin_on_earth)
        apart = np.linalg.norm(here - ecef_from_enu(np.array([other.position_in_geo]), before.origin_on_earth))
        if apart < _SAME_PLACE_M:
            pairs.append((other, point))
    none = np.zeros(3)
    control_share = [_share_of_control(survey) for survey in (before, after)]
    by_control = by_base = none
    if pairs:
        error = np.mean(
            [np.minimum(np.diag(one.cov_in_geo), np.diag(two.cov_in_geo)) for one, two in pairs], axis=0
        )
        counts = len(before.control_points) * len(after.control_points)
        by_control = control_share[0] * control_share[1] * error * len(pairs) / counts
    if same_base and before.sessions and after.sessions:
        error = np.minimum(*(_of_base(survey.sessions[0]) for survey in (before, after)))
        by_base = (1 - control_share[0]) * (1 - control_share[1]) * error
    by_system = np.minimum(*(_of_system(survey) for survey in (before, after)))
    systems = [
        {(used.crs, used.operation) for used in survey.transformations if used.sigma_m}
        for survey in (before, after)
    ]
    by_system[:2] *= systems[0] == systems[1]
    by_system[2] *= before.vertical.name == after.vertical.name
    return Shared(tuple(point.name for _, point in pairs), by_control, by_base, by_system)


def _of_base(session: FixSession) -> FloatArray:
    """Return the variance (3,) of the common error of a session, without that of its reference system."""
    return np.asarray(np.maximum(np.square(session.sigma_common_m) - np.square(session.sigma_datum_m), 0.0))


def _of_system(survey: Survey) -> FloatArray:
    """Return the variance (3,) that a survey has of its reference system, but for a doubtful zero of heights."""
    if survey.control_points:
        return np.asarray(survey.sigma_datum_m) ** 2
    sigma_m: FloatArray = np.max(
        [session.sigma_datum_m for session in survey.sessions] or [(0.0, 0.0, 0.0)], axis=0
    )
    if any(image.fix is not None and image.fix.sigma_zero_m for image in survey.images):
        sigma_m[2] = 0.0
    return sigma_m**2


def _share_of_control(survey: Survey) -> FloatArray:
    """Return the share (3,) of the control points in the datum, by axis."""
    if not survey.control_points:
        return np.zeros(3)
    of_control = 1.0 / np.sum([1.0 / np.diag(point.cov_in_geo) for point in survey.control_points], axis=0)
    fixes = [image.fix for image in survey.images if image.fix is not None]
    if not fixes:
        return np.ones(3)
    of_fixes = 1.0 / np.sum([1.0 / np.diag(fix.cov_apart) for fix in fixes], axis=0)
    if survey.sessions:
        of_fixes = of_fixes + np.square(survey.sessions[0].sigma_common_m)
    return np.asarray(of_fixes / (of_fixes + of_control))

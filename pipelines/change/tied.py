"""Epochs that points in common tie: one was adjusted onto the other, or both onto a third, in one step or several.

The covariance of a difference over several steps is the sum of theirs. What a date does not follow of the shape of
the one before it may cancel in the next step: the sum is no less than the truth.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import shapely

from pipelines.adjust.accuracy_grid import AccuracyGrid
from pipelines.adjust.relative import Relative, Solved, relative
from pipelines.change.datum import Epoch, load_epoch
from pipelines.core.products import Remark
from pipelines.core.stages import ADJUSTMENT, COMMON_POINTS, MODEL
from pipelines.core.types import BoolArray, FloatArray
from pipelines.core.workspace import Workspace
from pipelines.geodesy.crs import PointCrs
from pipelines.geodesy.enu import lla_from_enu
from pipelines.survey.change_report import ChangedRegion, CommonDates
from pipelines.survey.common_points import CommonPoints, solution_hash

_MOST_DATES = 30
_LEAST_INSIDE = 3  # points in common in a region, of which one may be wrong
_STILL = 0.5  # of the mean change of a region: points that moved less have not moved with it


@dataclass(frozen=True)
class Step:
    """Epoch that was adjusted onto an earlier one; the grid is of their difference, over the scene of `epoch`."""

    epoch: Epoch
    relative: Relative
    grid: AccuracyGrid
    spread: float


@dataclass(frozen=True)
class Tied:
    """Steps from one epoch to another, at least one."""

    steps: tuple[Step, ...]

    def variance_at(self, crs: PointCrs, plan: FloatArray) -> FloatArray:
        """Return the variances (N, 3) east, north and up in m² of the difference at places (N, 2) in a CRS."""
        cov = sum(step.grid.cov_at(step.epoch.geo_from_plan(crs, plan)) for step in self.steps)
        return np.asarray(np.diagonal(cov, axis1=1, axis2=2))

    @property
    def common(self) -> CommonDates:
        """Record of the points, of the step with the fewest, and of the σ in the median over the scene."""
        sigma = np.sqrt(sum(np.median(step.grid.sigma_m, axis=0) ** 2 for step in self.steps))
        weakest = min(self.steps, key=lambda step: int(step.relative.used.sum()))
        return CommonDates(
            steps=len(self.steps),
            points=len(weakest.relative.used),
            used=int(weakest.relative.used.sum()),
            spread=min(step.spread for step in self.steps),
            sigma_h_m=float(np.sqrt((sigma[:2] ** 2).mean())),
            sigma_v_m=float(sigma[2]),
        )

    def lla(self) -> FloatArray:
        """Return the points in common of all steps (J, 3) as latitude, longitude, height."""
        parts = [
            lla_from_enu(step.relative.position_in_geo, step.epoch.survey.origin_on_earth) for step in self.steps
        ]
        return np.concatenate(parts)

    @property
    def used(self) -> BoolArray:
        return np.concatenate([step.relative.used for step in self.steps])

    @property
    def missed_m(self) -> FloatArray:
        """Later minus earlier place (J, 3) of the points, east, north, up of their step."""
        return np.concatenate([step.relative.missed_m for step in self.steps])


def contradicted(tied: Tied, regions: Sequence[ChangedRegion], polygons: Sequence[Any], crs: PointCrs) -> list[str]:
    """Return the names of found regions in which points in common lie where they lay at the other date.

    Photographs show the same marks in the same places then: one of both surfaces is wrong. Polygons are in the plan
    of the CRS.
    """
    plan, used, up_m = crs.xyz_from_lla(tied.lla())[:, :2], tied.used, tied.missed_m[:, 2]
    found = []
    for region, polygon in zip(regions, polygons, strict=True):
        inside = used & shapely.contains_xy(polygon, plan[:, 0], plan[:, 1])
        if not region.name.startswith("R") or inside.sum() < _LEAST_INSIDE:
            continue
        if abs(float(np.median(up_m[inside]))) < _STILL * abs(region.net_m3) / region.area_m2:
            found.append(region.name)
    return found


def tied_by(
    epochs: tuple[Epoch, Epoch], workspaces: tuple[Workspace, Workspace]
) -> tuple[Tied | None, tuple[Remark, ...]]:
    """Return how points in common tie two epochs, in either order; None: nothing does.

    A warning says that an epoch was tied to another solution of the other than the present one.

    Raises:
        GeorefError: an epoch between them cannot be read.
    """
    known = {one.root.resolve(): epoch for one, epoch in zip(workspaces, epochs, strict=True)}
    lines = [_earlier_dates(one, workspaces) for one in workspaces]
    hashes = [[solution_hash(date) for date in line] for line in lines]
    meeting = next((one for one in hashes[1] if one in hashes[0]), None)
    if meeting is None:
        warnings = tuple(
            _solved_again(*workspaces[::order]) for order in (1, -1) if _is_older(*workspaces[::order])
        )
        return None, warnings
    steps = []
    for line, of_line in zip(lines, hashes, strict=True):
        for later, earlier in pairwise(line[: of_line.index(meeting) + 1]):
            step = _step(*(known.get(one.root.resolve()) or load_epoch(one) for one in (later, earlier)))
            if step is None:
                return None, ()
            steps.append(step)
    return (Tied(tuple(steps)) if steps else None), ()


def _step(later: Epoch, earlier: Epoch) -> Step | None:
    """Return the step between two epochs; None: their scene has too few points, or the points take no part."""
    common = later.survey.common
    if common is None or later.posterior.common is None:
        return None
    solved = [Solved(one.posterior, one.survey.origin_on_earth) for one in (later, earlier)]
    found = relative(solved[0], solved[1], common)
    return None if found.grid is None else Step(later, found, found.grid, float(common.spread))


def _earlier_dates(workspace: Workspace, others: Sequence[Workspace]) -> list[Workspace]:
    """Return a workspace, and the earlier dates that it is tied to in steps, as far as they are there."""
    line = [workspace]
    while len(line) <= _MOST_DATES and line[-1].has(COMMON_POINTS):
        common = CommonPoints.load(line[-1].path(COMMON_POINTS))
        there = (Workspace(Path(common.earlier)), *others)
        found = next((one for one in there if _is_solved(one) and common.is_of(one)), None)
        if found is None:
            break
        line.append(found)
    return line


def _is_solved(workspace: Workspace) -> bool:
    return workspace.has(MODEL) or workspace.has(ADJUSTMENT)


def _is_older(earlier: Workspace, later: Workspace) -> bool:
    """Return whether a workspace was tied to an older solution of another."""
    if not later.has(COMMON_POINTS):
        return False
    common = CommonPoints.load(later.path(COMMON_POINTS))
    return Path(common.earlier).resolve() == earlier.root.resolve() and not common.is_of(earlier)


def _solved_again(earlier: Workspace, later: Workspace) -> Remark:
    sentence = (
        f"{later.root.name} was tied to an older solution of {earlier.root.name}, which was solved or trained "
        f"again since: the points in common do not count. `georef run {later.root}` ties it again."
    )
    return Remark(code="earlier-solved-again", sentence=sentence)

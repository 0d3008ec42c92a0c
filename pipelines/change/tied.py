"""Epochs that points in common tie: one was adjusted onto the other, or both onto a third, in one step or several.

The covariance of a difference over several steps is the sum of theirs. What a date does not follow of the shape of
the one before it may cancel in the next step: the sum is no less than the truth.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

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
_HALF = 0.5  # of a change: a point that moved less has not moved with it; of a region: more is the whole


@dataclass(frozen=True)
class Step:
    """Epoch that was adjusted onto an earlier one; the grid is of their difference, over the scene of `epoch`."""

    epoch: Epoch
    relative: Relative
    grid: AccuracyGrid
    spread: float

    @property
    def lla(self) -> FloatArray:
        """Points in common (J, 3) as latitude, longitude, height."""
        return lla_from_enu(self.relative.position_in_geo, self.epoch.survey.origin_on_earth)


@dataclass(frozen=True)
class Dated:
    """Workspace of a date, and its epoch."""

    workspace: Workspace
    epoch: Epoch


@dataclass(frozen=True)
class Surfaces:
    """Difference of the surfaces of two epochs.

    Attributes:
        risen_m: returns the differences (N,) at places (N, 2) in the CRS; NaN: not known.
        length_m: over which errors of the surfaces are correlated.
    """

    crs: PointCrs
    risen_m: Callable[[FloatArray], FloatArray]
    length_m: float


@dataclass(frozen=True)
class Contradicted:
    """Regions by their places in a list: those that points in common contradict as a whole, and in a part."""

    whole: tuple[int, ...] = ()
    part: tuple[int, ...] = ()


@dataclass(frozen=True)
class Tied:
    """Steps from one epoch to another, at least one, in order.

    `dates` are the epochs that they lead along; empty where both epochs were tied to a third, older one.
    """

    steps: tuple[Step, ...]
    dates: tuple[Dated, ...] = ()

    def between(self, first: int, last: int) -> Tied:
        """Return the steps between two of the dates."""
        return Tied(self.steps[first:last], self.dates[first : last + 1])

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
        return np.concatenate([step.lla for step in self.steps])

    @property
    def used(self) -> BoolArray:
        return np.concatenate([step.relative.used for step in self.steps])

    @property
    def missed_m(self) -> FloatArray:
        """Later minus earlier place (J, 3) of the points, east, north, up of their step."""
        return np.concatenate([step.relative.missed_m for step in self.steps])


def contradicted(
    tied: Tied,
    regions: Sequence[ChangedRegion],
    polygons: Sequence[shapely.Geometry],
    surfaces: Surfaces,
) -> Contradicted:
    """Return which found regions points in common contradict, in each step between the epochs.

    A point is a witness where the surfaces differ by half of the region's mean change at least: not at its rim. A
    witness contradicts if it has moved by less than half of that difference: photographs of both dates show the
    same marks in the same place. It speaks for the ground around it over which errors of a surface are correlated.
    Polygons are in the plan of the CRS.
    """
    whole, part = [], []
    for index, (region, polygon) in enumerate(zip(regions, polygons, strict=True)):
        if not region.name.startswith("R"):
            continue
        least_m = least_of_witness_m(region)
        shares = [_contradicted_share(step, polygon, surfaces, least_m) for step in tied.steps]
        if min(shares) >= _HALF:
            whole.append(index)
        elif min(shares) > 0:
            part.append(index)
    return Contradicted(tuple(whole), tuple(part))


def least_of_witness_m(region: ChangedRegion) -> float:
    """Return by how much surfaces differ at a witness: half of the region's mean change, in metres."""
    return _HALF * abs(region.net_m3) / region.area_m2


def _contradicted_share(step: Step, polygon: shapely.Geometry, surfaces: Surfaces, least_m: float) -> float:
    """Return the share of a polygon for which points speak that have not moved; 0: too few, or outvoted."""
    plan = surfaces.crs.xyz_from_lla(step.lla)[:, :2]
    inside = shapely.contains_xy(polygon, plan[:, 0], plan[:, 1])
    plan, used, up_m = plan[inside], step.relative.used[inside], np.abs(step.relative.missed_m[inside, 2])
    differs_m = np.abs(surfaces.risen_m(plan))
    witness, stands = differs_m >= least_m, up_m < _HALF * differs_m
    still = witness & stands & used
    # A point that has moved disagrees with the others and is not used; as a witness it counts all the same.
    if still.sum() < _LEAST_INSIDE or still.sum() <= (witness & ~stands).sum():
        return 0.0
    ground = shapely.MultiPoint(plan[still]).buffer(surfaces.length_m / surfaces.crs.horizontal_unit)
    return float(ground.intersection(polygon).area / polygon.area)


def tied_by(
    epochs: tuple[Epoch, Epoch], workspaces: tuple[Workspace, Workspace]
) -> tuple[Tied | None, tuple[Remark, ...]]:
    """Return how points in common tie two epochs, in either order; None: nothing does.

    A warning says that an epoch was tied to another solution of the other than the present one.

    Raises:
        GeorefError: an epoch between them cannot be read.
    """
    known = {one.root.resolve(): Dated(one, epoch) for one, epoch in zip(workspaces, epochs, strict=True)}
    lines = [_earlier_dates(one, workspaces) for one in workspaces]
    hashes = [[solution_hash(date) for date in line] for line in lines]
    meeting = next((one for one in hashes[1] if one in hashes[0]), None)
    if meeting is None:
        warnings = tuple(
            _solved_again(*workspaces[::order]) for order in (1, -1) if _is_older(*workspaces[::order])
        )
        return None, warnings

    def dated(workspace: Workspace) -> Dated:
        key = workspace.root.resolve()
        if key not in known:
            known[key] = Dated(workspace, load_epoch(workspace))
        return known[key]

    ways = [
        [dated(one) for one in line[: of_line.index(meeting) + 1]]
        for line, of_line in zip(lines, hashes, strict=True)
    ]
    down = [_step(later.epoch, earlier.epoch) for later, earlier in pairwise(ways[0])]
    up = [_step(later.epoch, earlier.epoch) for later, earlier in pairwise(ways[1])][::-1]
    steps = [step for step in (*down, *up) if step is not None]
    if not steps or len(steps) < len(down) + len(up):
        return None, ()
    dates = () if down and up else (*ways[0], *ways[1][-2::-1])
    return Tied(tuple(steps), dates), ()


def _step(later: Epoch, earlier: Epoch) -> Step | None:
    """Return the step between two epochs; None: their scene has too few points, or the points take no part."""
    common = later.survey.common
    if common is None or later.posterior.common is None:
        return None
    solved = [Solved(one.posterior, one.survey.origin_on_earth) for one in (later, earlier)]
    comparison = relative(solved[0], solved[1], common)
    return None if comparison.grid is None else Step(later, comparison, comparison.grid, float(common.spread))


def _earlier_dates(workspace: Workspace, others: Sequence[Workspace]) -> list[Workspace]:
    """Return a workspace, and the earlier dates that it is tied to in steps, as far as they are there."""
    line = [workspace]
    while len(line) <= _MOST_DATES and line[-1].has(COMMON_POINTS):
        common = CommonPoints.load(line[-1].path(COMMON_POINTS))
        there = (Workspace(Path(common.earlier)), *others)
        earlier = next((one for one in there if _is_solved(one) and common.is_of(one)), None)
        if earlier is None:
            break
        line.append(earlier)
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
        f"{later.root.name} was tied to an older solution of {earlier.root.name}, which has put its cameras "
        "elsewhere since: the points in common do not count."
    )
    remedy = f"`georef run {later.root}` ties it again."
    return Remark(code="earlier-solved-again", sentence=sentence, remedy=remedy)

"""Adjustment onto an earlier date by the points that both have in common: its start, and what limits it.

The later date is adjusted onto the cameras of the earlier one, which stay as they were solved: the files of the
earlier date are made from them, and change is measured against these files. The error of the earlier place is one
unknown of the later adjustment (`earlier-date` in `adjust.state`), beside the common errors of the later fixes.
"""

import numpy as np

from pipelines.adjust.joint import Consistency, Start
from pipelines.adjust.system import Linearised
from pipelines.adjust.terms import EarlierPoints
from pipelines.core.errors import DegenerateGeometryError
from pipelines.core.products import NOT_CHECKED, Remark
from pipelines.core.types import BoolArray, FloatArray
from pipelines.geometry.similarity import Similarity, umeyama
from pipelines.geometry.sparse_model import SparseModel
from pipelines.geometry.statistics import RansacOptions, cauchy_weight, mad_sigma, ransac
from pipelines.survey.solution import SimilarityEstimate
from pipelines.survey.survey import Survey

FEW_COMMON = 30  # points: a lens, and the shape of a block, take more
NARROW_SPREAD = 0.25  # share of the ground in common that has points
_DISAGREE = 1 / 3  # of the points: beyond chance, and beyond what is usual of ground that has changed
_TOLERANCE = 0.02  # of the extent: a bent model is right to about one part in a hundred
_STEPS = 10
_BLOCKS, _LEAST_IN_BLOCK = 8, 3  # blocks along the longer side of the ground, and points of one that can outvote
_EVIDENT = 3.0  # σ


def common_similarity(
    local: FloatArray, in_geo: FloatArray, rng: np.random.Generator
) -> tuple[Similarity, BoolArray]:
    """Return the similarity that most points (N, 3) agree on, and the mask (N,) of those that do.

    They agree within a fiftieth of their extent, which a model that is bent by its lens keeps, and a false match
    does not.

    Raises:
        DegenerateGeometryError: fewer than three points, or all on a line.
    """
    extent = float(np.median(np.linalg.norm(in_geo - np.median(in_geo, axis=0), axis=1))) if len(in_geo) else 0.0
    tolerance = max(2 * _TOLERANCE * extent, 1e-6)

    def squares(similarity: Similarity) -> FloatArray:
        return np.asarray(((similarity.apply(local) - in_geo) ** 2).sum(axis=1) / tolerance**2)

    consensus = ransac(
        len(local), lambda rows: umeyama(local[rows], in_geo[rows]), squares, RansacOptions(3, 1.0), rng
    )
    similarity = consensus.model
    for _ in range(_STEPS):
        near = squares(similarity) <= 1.0
        if near.sum() < 3:
            raise DegenerateGeometryError("common-points-apart", "The points agree on no common place.")
        scale = max(mad_sigma((similarity.apply(local) - in_geo)[near].ravel()) / tolerance, 1e-9)
        weight = cauchy_weight(squares(similarity) / scale**2, 3) * near
        similarity = umeyama(local, in_geo, weight)
    return similarity, np.asarray(squares(similarity) <= 1.0)


def start_at_common(survey: Survey, model: SparseModel, aligned: SimilarityEstimate) -> tuple[Start, ...]:
    """Return the start that the points in common with an earlier date set; none: there are none."""
    common = survey.common
    if common is None:
        return ()
    here, row, there = np.intersect1d(model.point_id, common.point_id, return_indices=True)
    if len(here) < 3:
        return ()
    in_geo = common.position_in_geo(survey.origin_on_earth)[there]
    try:
        similarity, _ = common_similarity(model.point_in_local[row], in_geo, np.random.default_rng(0))
    except DegenerateGeometryError:
        return ()
    record = similarity.to_record("local", "geo")
    return (Start(aligned.model_copy(update={"geo_from_local": record}), at_control=True),)


def outliers_in_common(near: Linearised, consistency: Consistency) -> tuple[int, ...]:
    """Return COLMAP's ids of the points in common that disagree with the others.

    Ground that has moved takes its points with it: where most of the points in a block disagree, all are left out.
    """
    term = near.problem.term(EarlierPoints.kind)
    if not isinstance(term, EarlierPoints):
        return ()
    used = consistency.used[term.kind].copy()
    plan = term.position_in_geo[:, :2]
    side = max(float(np.ptp(plan, axis=0).max()) / _BLOCKS, 1e-6)
    blocks = np.unique(np.floor((plan - plan.min(axis=0)) / side), axis=0, return_inverse=True)[1].reshape(-1)
    count = np.bincount(blocks)
    moved = (np.bincount(blocks, ~used) > count / 2) & (count >= _LEAST_IN_BLOCK)
    used[moved[blocks]] = False
    return tuple(int(name) for name, good in zip(term.name, used, strict=True) if not good)


def cautions_of_common(survey: Survey, near: Linearised, consistency: Consistency) -> tuple[Remark, ...]:
    """Return what limits a survey that is tied to an earlier date: few points, on one side, or a worse place."""
    common, term = survey.common, near.problem.term(EarlierPoints.kind)
    if common is None or not isinstance(term, EarlierPoints):
        return ()
    outliers = [str(name) for name in outliers_in_common(near, consistency)]
    used, cautions = ~np.isin(term.name, outliers), []
    count, spread = int(used.sum()), float(common.spread)
    if count < FEW_COMMON:
        sentence = f"{count} points tie this date to {common.name}, where {FEW_COMMON} are enough for its shape."
        remedy = "Give sfm a larger --max-features."
        cautions.append(Remark(code="few-common-points", sentence=sentence, remedy=remedy))
    if spread < NARROW_SPREAD:
        sentence = (
            f"The points in common with {common.name} cover {spread:.0%} of the ground that both dates show: the "
            "difference of both is known there, and less beyond it."
        )
        cautions.append(Remark(code="common-points-in-a-corner", sentence=sentence))
    if float((~used).mean()) > _DISAGREE:
        sentence = (
            f"{int((~used).sum())} of {len(used)} points in common with {common.name} disagree with the others: "
            "much of the ground has moved."
        )
        cautions.append(Remark(code="common-points-disagree", sentence=sentence))
    if not bool(common.checked):
        sentence = f"The places are those of {common.name}, of which nothing checks the stated σ."
        cautions.append(Remark(code=NOT_CHECKED, sentence=sentence))
    return (*cautions, *_of_place(consistency, common.name))


def _of_place(consistency: Consistency, name: str) -> tuple[Remark, ...]:
    """Return the caution that this survey's own measurements know the place better than the earlier date."""
    for error in consistency.estimates:
        if error.name != "earlier-date" or not all(error.observed):
            continue
        value, sigma, prior = (np.array(part) for part in (error.value, error.sigma, error.prior))
        if not ((np.abs(value) > _EVIDENT * sigma) | (prior > _EVIDENT * sigma)).any():
            continue
        east, north, up = value.tolist()
        sentence = (
            f"Own measurements put this date {east:+.2f} m east, {north:+.2f} m north and {up:+.2f} m up of its "
            f"place by {name}, ± {sigma.max():.2f} m at most. It has taken over that place, with a σ of "
            f"{prior.max():.2f} m."
        )
        remedy = f"For its own, solve this date alone, and {name} with this one as --earlier."
        return (Remark(code="earlier-date-less-accurate", sentence=sentence, remedy=remedy),)
    return ()

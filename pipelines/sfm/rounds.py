"""Alignment in rounds: what is tried when the first model leaves photographs out, or has a lens that cannot be.

1. The mapper, with the lens free.
2. Once more with the lens held, at that of a large sound model, else at what the photographs state: a model of few
   photographs, or of flat ground, finds a lens that fits it alone, and no other photograph fits that.
3. Photographs and small models that stay out are joined by their matches with the largest one (`joining.py`).
4. Photographs that still stay out are matched where positions, attitudes and the model predict their features
   (`predicted_matches.py`), and joined.
5. Learned features for the photographs that stay out, and the mapper again.
6. Models that stay apart are placed beside the largest by their positions; then step 4 again.
"""

import logging
from dataclasses import dataclass, replace
from types import ModuleType
from typing import Any

import numpy as np

from pipelines.core.progress import Progress
from pipelines.core.types import IntArray
from pipelines.sfm.colmap_database import has_added_features, verified_matches
from pipelines.sfm.features import SfmJob, candidate_pairs
from pipelines.sfm.joining import Join, join_by_matches
from pipelines.sfm.learned_weights import missing_for_learned
from pipelines.sfm.lens_check import lenses_astray
from pipelines.sfm.mapping import MapperName, map_database, replaced_lens
from pipelines.sfm.parts import ModelPart, join_parts
from pipelines.sfm.predicted_matches import add_predicted
from pipelines.survey.survey import Survey

log = logging.getLogger(__name__)

_WHOLE = 0.95  # of the photographs: one model of as many needs no further round
_FEWEST_FOR_LENS = 10  # photographs of a model whose lens counts for others
_FITS_AS_WELL = 1.25  # reprojection error with the lens held, over that with it free
_ENOUGH_MATCHES = 100  # verified ones of a pair: learned features add little to these
_MOST_NAMED = 5
_MOST_LEARNED_PAIRS = 4000  # hours on two cores
_NEIGHBOURS = 3  # of a photograph with learned features, by matches: with these it makes points of them


@dataclass(frozen=True)
class MappedModels:
    """The models of a round, the largest first, and how they were made."""

    models: list[Any]
    mapper: MapperName
    lens_held: bool = False

    @property
    def registered(self) -> int:
        return int(self.models[0].num_reg_images()) if self.models else 0

    def covered(self) -> int:
        """Return the number of photographs in any of the models."""
        return len({image_id for model in self.models for image_id in model.reg_image_ids()})


def map_in_rounds(colmap: ModuleType, job: SfmJob, progress: Progress) -> MappedModels:
    """Return the models of a database with features and matches after as many rounds as they need.

    The first model is the largest, with those beside it that positions place; none: no two photographs match.
    """
    if job.options.features == "learned":
        _add_learned(colmap, job, candidate_pairs(job.survey, job.options), progress)
    best = MappedModels(*map_database(colmap, job, progress))
    best = _with_lens_held(colmap, job, best, progress)
    best, joins = _joined_by_matches(colmap, job, best, progress)
    best, joins = _joined_by_prediction(colmap, job, best, joins, progress)
    if not _whole(best, job.survey) and job.options.features == "auto" and missing_for_learned() is None:
        pairs = _pairs_to_add(colmap, job, best)
        if len(pairs) and _add_learned(colmap, job, pairs, progress):
            again = MappedModels(*map_database(colmap, job, progress, lens_held=best.lens_held), best.lens_held)
            again, joins_again = _joined_by_matches(colmap, job, again, progress)
            if _merit(again) > _merit(best):
                best, joins = again, joins_again
    if len(best.models) > 1 and best.registered < len(job.survey.images):
        _tell_of_parts(best, len(job.survey.images))
        alone = best.registered  # Joining adds photographs to this very model.
        largest, parts = join_parts(colmap, best.models, job.survey)
        _tell_of_joins(parts, alone)
        best, joins = _joined_by_prediction(colmap, job, replace(best, models=[largest]), joins, progress)
    _tell_of_ties(best, joins)
    return best


def _joined_by_matches(
    colmap: ModuleType, job: SfmJob, mapped: MappedModels, progress: Progress
) -> tuple[MappedModels, tuple[Join, ...]]:
    """Return the models, of which the largest has what its matches tie to it.

    The global mapper's model has too few points for that, and leaves out one photograph of twenty at most.
    """
    if not mapped.models or mapped.mapper == "global":
        return mapped, ()
    largest, joins = join_by_matches(colmap, job, mapped.models[0], progress)
    return replace(mapped, models=[largest, *mapped.models[1:]]), joins


def _joined_by_prediction(
    colmap: ModuleType, job: SfmJob, mapped: MappedModels, joins: tuple[Join, ...], progress: Progress
) -> tuple[MappedModels, tuple[Join, ...]]:
    """Return the models and all joins, after matches were sought where the largest model predicts them."""
    while mapped.models and mapped.mapper != "global" and mapped.registered < len(job.survey.images):
        if not add_predicted(colmap, job, mapped.models[0], progress):
            break
        mapped, more = _joined_by_matches(colmap, job, mapped, progress)
        joins += more
        if not more:
            break
    return mapped, joins


def _with_lens_held(colmap: ModuleType, job: SfmJob, free: MappedModels, progress: Progress) -> MappedModels:
    """Return the better of the models and those with the lens held, where the first has a reason to doubt it."""
    if not free.models:
        return free
    astray = lenses_astray(free.models[0], job.survey)
    if not astray and _whole(free, job.survey):
        return free
    if astray:
        why = "; ".join(f"camera {camera} has {reason}" for camera, reason in astray.items())
        log.info("The model of %d photographs is solved again with the lens held: %s.", free.registered, why)
    with replaced_lens(colmap, job.database, _sound_lens(free, job.survey)):
        models, mapper = map_database(colmap, job, progress, lens_held=True)
    held = MappedModels(models, mapper, lens_held=True)
    as_many = held.covered() >= free.covered() and held.registered >= free.registered
    if astray and as_many and _error_px(held) <= _FITS_AS_WELL * _error_px(free):
        return held
    # As many photographs, and a better fit, with the lens free speak for the free one: then the tags are wrong.
    return held if _merit(held) > _merit(free) else free


def _error_px(mapped: MappedModels) -> float:
    return float(mapped.models[0].compute_mean_reprojection_error())


def _merit(mapped: MappedModels) -> tuple[int, int]:
    return mapped.registered, mapped.covered()


def _whole(mapped: MappedModels, survey: Survey) -> bool:
    return mapped.registered >= _WHOLE * len(survey.images)


def _sound_lens(mapped: MappedModels, survey: Survey) -> dict[int, Any]:
    """Return the cameras of the largest model that determines sound ones; none: no model does."""
    for model in mapped.models:
        if model.num_reg_images() >= _FEWEST_FOR_LENS and not lenses_astray(model, survey):
            used = {model.images[image_id].camera_id for image_id in model.reg_image_ids()}
            return {camera_id: model.cameras[camera_id].params.copy() for camera_id in used}
    return {}


def _pairs_to_add(colmap: ModuleType, job: SfmJob, mapped: MappedModels) -> IntArray:
    """Return the pairs (P, 2) to match by learned features: those that may connect photographs apart come first.

    A photograph joins a model by features that are points of it. The photographs of those pairs are therefore
    matched with their neighbours too, although these have matches enough: these are of other features.
    """
    apart = set(range(len(job.survey.images))) - {i - 1 for i in mapped.models[0].reg_image_ids()}
    matched = verified_matches(colmap, job.database)
    candidates = candidate_pairs(job.survey, job.options).tolist()
    wanted = [
        (a, b) for a, b in candidates if (a in apart or b in apart) and matched.get((a, b), 0) < _ENOUGH_MATCHES
    ]
    beside: dict[int, list[tuple[int, int]]] = {index: [] for pair in wanted for index in pair}
    for pair in sorted(matched, key=lambda pair: (-matched[pair], pair)):
        if matched[pair] >= _ENOUGH_MATCHES:
            for index in set(pair) & set(beside):
                beside[index].append(pair)
    nearest = {pair for pairs in beside.values() for pair in pairs[:_NEIGHBOURS]}
    return np.array([*wanted, *sorted(nearest)], dtype=np.int64).reshape(-1, 2)


def _add_learned(colmap: ModuleType, job: SfmJob, pairs: IntArray, progress: Progress) -> int:
    """Add learned features and matches once; the number of pairs that they match."""
    from pipelines.sfm.learned_features import add_learned  # and torch

    if has_added_features(colmap, job.database):
        return 1
    if len(pairs) > _MOST_LEARNED_PAIRS and job.options.features == "auto":
        log.warning(
            "%d pairs of photographs wait for learned features, which would take hours; %d at most are matched. "
            "For all: --features learned.",
            len(pairs), _MOST_LEARNED_PAIRS, extra={"code": "learned-pairs-limited"},
        )  # fmt: skip
        pairs = pairs[np.linspace(0, len(pairs) - 1, _MOST_LEARNED_PAIRS).astype(int)]
    return add_learned(colmap, job, pairs, progress)


def _tell_of_ties(mapped: MappedModels, joins: tuple[Join, ...]) -> None:
    if not joins:
        return
    images = mapped.models[0].images
    count = sum(len(join.images) for join in joins)
    each = "; ".join(
        f"{', '.join(images[image_id].name for image_id in join.images[:_MOST_NAMED])}"
        f"{' …' if len(join.images) > _MOST_NAMED else ''}: {join.tie.matches} matches in {join.tie.pairs} pairs, "
        f"{join.tie.points} of them points of the others, σ {100 * join.tie.sigma:.2g} %"
        for join in joins
    )
    log.warning(
        "%d photographs are joined to the others by few points, where the mapper leaves them out: check them. "
        "Their σ is that of their place beside the others, of the distance to the ground. %s.",
        count, each, extra={"code": "joined-by-matches"},
    )  # fmt: skip


def _tell_of_parts(mapped: MappedModels, photographs: int) -> None:
    sizes = [model.num_reg_images() for model in mapped.models]
    log.info(
        "The survey fell apart into %d models of %s images; the largest has %d of %d photographs.",
        len(sizes), ", ".join(map(str, sizes)), mapped.registered, photographs,
    )  # fmt: skip


def _tell_of_joins(parts: tuple[ModelPart, ...], largest: int) -> None:
    joined = [part.photographs for part in parts if not part.apart]
    if joined:
        log.warning(
            "The survey consists of %d models that share no photographs, of %s; they are placed beside each other "
            "by their positions alone. Their places to each other are as accurate as these.",
            1 + len(joined), ", ".join(map(str, [largest, *joined])), extra={"code": "survey-in-parts"},
        )  # fmt: skip
    for part in parts:
        if part.apart:
            log.warning(
                "A model of %d photographs stays apart: %s.",
                part.photographs, part.apart, extra={"code": "model-apart"},
            )  # fmt: skip

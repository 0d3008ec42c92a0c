"""Pairs of photographs to match, and their features and matches in a database of COLMAP: of a survey, or a chunk.

Pairs are chosen by positions and viewing directions. COLMAP works in small steps, which survive an interruption.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from pipelines.core.machine import chosen_threads
from pipelines.core.progress import Progress
from pipelines.core.stages import MASKS
from pipelines.core.types import FloatArray, IntArray
from pipelines.formats.image_file import read_bytes, require_unchanged
from pipelines.geometry.rotations import matrix_from_quat_xyzw
from pipelines.sfm.colmap_database import add_matches, rename_images, write_frame
from pipelines.sfm.guided_matches import GuidedFeatures, guided_matches
from pipelines.sfm.near_matches import SiftFeatures
from pipelines.sfm.options import SfmOptions
from pipelines.survey.survey import Survey, SurveyImage

# Between views that differ by a larger angle SIFT finds hardly any matches.
MAX_ANGLE_DEG = 60.0
_SECTORS = 8
_CANDIDATES_PER_NEIGHBOR = 8  # nearest images from which the neighbours are chosen


def select_pairs(position: FloatArray, axis: FloatArray, max_neighbors: int) -> IntArray:
    """Return the pairs (P, 2), i < j, of images that may show the same place; sorted, unique.

    1. Half of an image's neighbours are the nearest with a similar viewing direction.
    2. The others are the nearest in each of eight directions. With a dense forward overlap, these connect a flight
       line to the lines beside it.
    3. Images without a position are paired with all others, and each image with its successor in the list.

    Args:
        position: (N, 3) metres in geo, NaN where unknown.
        axis: (N, 3) unit vectors of the optical axes in geo, NaN where unknown.
    """
    count = len(position)
    located = np.flatnonzero(np.isfinite(position).all(axis=1))
    chosen = {(i, i + 1) for i in range(count - 1)}
    for i in map(int, np.flatnonzero(~np.isfinite(position).all(axis=1))):
        chosen.update((min(i, j), max(i, j)) for j in range(count) if j != i)
    if len(located) > 1:
        tree = cKDTree(position[located])
        reach = min(len(located), max_neighbors * _CANDIDATES_PER_NEIGHBOR + 1)
        for i in map(int, located):
            near = located[tree.query(position[i], k=reach)[1]]
            looks_away = axis[near] @ axis[i] < np.cos(np.radians(MAX_ANGLE_DEG))  # unknown (NaN) passes
            near = near[(near != i) & ~looks_away]
            for j in spread_of(position[near] - position[i], max_neighbors):
                chosen.add((min(i, int(near[j])), max(i, int(near[j]))))
    return np.array(sorted(chosen), dtype=np.int64).reshape(-1, 2)


def spread_of(offset: FloatArray, limit: int) -> list[int]:
    """Return up to `limit` candidates, sorted by distance: the nearest half, then the nearest of each sector."""
    order = list(range(min(len(offset), limit // 2)))
    sector = (np.arctan2(offset[:, 1], offset[:, 0]) // (2 * np.pi / _SECTORS)).astype(int)
    rank = np.zeros(len(offset), dtype=int)
    for value in np.unique(sector):
        members = np.flatnonzero(sector == value)
        rank[members] = np.arange(len(members))
    rest = [int(j) for j in np.lexsort((np.arange(len(offset)), rank)) if j >= len(order)]
    return order + rest[: limit - len(order)]


_EXHAUSTIVE_UP_TO = 20
_IMAGES_PER_STEP = 4
_PAIRS_PER_STEP = 48
# Draws of RANSAC for a pair: they find an essential matrix that 32 % of the matches obey, with a probability of
# 99.9 %. Pairs without a common place would use up COLMAP's 10 000 (examples/benchmarks/results/training.md,
# "Time to quality"). COLMAP's 100 at least take twice the time, and find the same inliers.
_FEWEST_TRIALS, _MOST_TRIALS = 30, 2_000


@dataclass(frozen=True)
class SfmJob:
    """Inputs of a reconstruction, or of a part of one."""

    survey: Survey  # photographs with priors of their cameras, positions and attitudes
    images: Path  # folder of the photographs
    database: Path  # path of COLMAP's database; an existing one is continued
    options: SfmOptions
    masks: Path | None = None  # folder of masks, NAME.png; None: no photograph has one

    @property
    def sparse(self) -> Path:
        return self.database.parent / "sparse"


def masks_beside(survey_file: str, survey: Survey) -> Path | None:
    """Return the folder of the masks that `ingest` has written beside its survey; None: it has written none."""
    masked = any(image.mask_sha256 for image in survey.images)
    return Path(survey_file).parent / Path(MASKS).name if masked else None


def candidate_pairs(survey: Survey, options: SfmOptions) -> IntArray:
    """Return the pairs to match as indices (P, 2) into `survey.images`.

    All pairs are matched if there are up to 20 images, or if no image has a fix. Otherwise position and viewing
    direction decide. Of a rig, they decide for the reference lens, and the others follow.
    """
    if survey.companions:
        return _pairs_of_rigs(survey, options)
    count = len(survey.images)
    located = any(image.fix for image in survey.images)
    if options.pairs == "exhaustive" or count <= _EXHAUSTIVE_UP_TO or not located:
        return np.stack(np.triu_indices(count, k=1), axis=1)
    unknown = (np.nan, np.nan, np.nan)
    position = np.array([image.fix.position_in_geo if image.fix else unknown for image in survey.images])
    axis = np.array(
        [
            matrix_from_quat_xyzw(image.attitude.quat_xyzw)[:, 2] if image.attitude else unknown
            for image in survey.images
        ]
    )
    return select_pairs(position, axis, options.max_neighbors)


def _pairs_of_rigs(survey: Survey, options: SfmOptions) -> IntArray:
    """Return the pairs of a survey with companions among its images, which follow the others.

    Each lens is matched with itself at the instants of which the reference lens's photographs are matched, and with
    the others at the same instant.
    """
    number = {image.name: index for index, image in enumerate(survey.images)}
    others = {each.name for each in survey.companions}
    alone = tuple(image for image in survey.images if image.name not in others)
    pairs = candidate_pairs(survey.model_copy(update={"images": alone, "companions": ()}), options).tolist()
    of: dict[int, dict[int, int]] = {}
    for each in survey.companions:
        of.setdefault(number[each.beside], {})[each.camera_id] = number[each.name]
    chosen = {(a, b) for a, b in pairs}
    for a, b in pairs:
        chosen |= {(of[a][lens], of[b][lens]) for lens in set(of.get(a, ())) & set(of.get(b, ()))}
    for reference, lenses in of.items():
        chosen |= set(combinations([reference, *lenses.values()], 2))
    ordered = sorted((min(pair), max(pair)) for pair in chosen)
    return np.array(ordered, dtype=np.int64).reshape(-1, 2)


def extract_features(colmap: ModuleType, job: SfmJob, images: Sequence[int], progress: Progress) -> None:
    """Detect the features of photographs, given as indices, and write them into the database.

    Raises:
        InputError: a photograph is not that of the survey, or a camera prior is none of COLMAP's cameras.
    """
    options = colmap.FeatureExtractionOptions()
    options.max_image_size = job.options.max_image_size
    options.num_threads = chosen_threads(job.options.threads)
    options.sift.max_num_features = job.options.max_features
    _restore_names(colmap, job)
    write_frame(colmap, job.database, job.survey, images, job.options)
    size = {prior.camera_id: (prior.width, prior.height) for prior in job.survey.cameras}
    with progress.task("features", len(images)) as task:
        # COLMAP refuses photographs without a mask where it reads masks: these are read apart.
        alike: dict[tuple[int, bool], list[SurveyImage]] = {}
        for index in images:
            image = job.survey.images[index]
            alike.setdefault((image.camera_id, bool(image.mask_sha256)), []).append(image)
        for (camera_id, masked), of_kind in sorted(alike.items()):
            reader = colmap.ImageReaderOptions()
            reader.existing_camera_id = camera_id
            if masked and job.masks is not None:
                reader.mask_path = job.masks
            options.sift.first_octave = -1 if job.options.doubles(size[camera_id]) else 0
            for step in steps(of_kind, _IMAGES_PER_STEP):
                for image in step:
                    path = job.images / image.name
                    require_unchanged(read_bytes(path), image.sha256, path)
                colmap.extract_features(
                    job.database,
                    job.images,
                    image_names=[image.name for image in step],
                    reader_options=reader,
                    extraction_options=options,
                )
                task.advance(len(step))


def match_features(colmap: ModuleType, job: SfmJob, pairs: IntArray, progress: Progress) -> None:
    """Match pairs (P, 2) of photographs whose features are in the database, and verify the matches."""
    features: dict[int, GuidedFeatures] = {}  # of the last step's photographs
    with _numbered(colmap, job), progress.task("matching", len(pairs)) as task:
        for step in steps(pairs, _PAIRS_PER_STEP):
            with colmap.Database.open(job.database) as opened:
                unverified = [(a, b) for a, b in step.tolist() if not opened.exists_two_view_geometry(a + 1, b + 1)]
                unmatched = [(a, b) for a, b in unverified if not opened.exists_matches(a + 1, b + 1)]
                features = {
                    index: features.get(index) or GuidedFeatures(SiftFeatures.read(opened, index + 1))
                    for index in sorted({index for pair in unmatched for index in pair})
                }
            add_matches(colmap, job.database, _guided(features, unmatched, chosen_threads(job.options.threads)))
            colmap.verify_matches(job.database, _listed(job, unverified), verification(colmap, job))
            task.advance(len(step))


def _guided(
    features: Mapping[int, GuidedFeatures], pairs: list[tuple[int, int]], threads: int
) -> dict[tuple[int, int], IntArray]:
    """Return the guided matches (M, 2) of pairs of photographs."""
    with ThreadPoolExecutor(threads) as pool:
        found = pool.map(lambda pair: guided_matches(features[pair[0]], features[pair[1]]), pairs)
        return dict(zip(pairs, found, strict=True))


def verify_matches(colmap: ModuleType, job: SfmJob, pairs: IntArray, progress: Progress) -> None:
    """Verify the matches of pairs (P, 2) that are in the database."""
    with _numbered(colmap, job), progress.task("verification", len(pairs)) as task:
        for step in steps(pairs, _PAIRS_PER_STEP):
            colmap.verify_matches(job.database, _listed(job, step.tolist()), verification(colmap, job))
            task.advance(len(step))


def verification(colmap: ModuleType, job: SfmJob) -> Any:
    """Return COLMAP's options of the geometric verification of a pair, with the job's seed."""
    options = colmap.TwoViewGeometryOptions()
    options.ransac.random_seed = job.options.seed
    options.ransac.min_num_trials, options.ransac.max_num_trials = _FEWEST_TRIALS, _MOST_TRIALS
    return options


@contextmanager
def _numbered(colmap: ModuleType, job: SfmJob) -> Iterator[None]:
    """Let numbers be the images' names: COLMAP reads pairs from a text in which a blank ends a name."""
    names = [image.name for image in job.survey.images]
    rename_images(colmap, job.database, {name: _number(index) for index, name in enumerate(names)})
    try:
        yield
    finally:
        _restore_names(colmap, job)
    _listing(job).unlink(missing_ok=True)


def _listed(job: SfmJob, pairs: Iterable[Sequence[int]]) -> Path:
    """Return the file that lists pairs of numbered images for COLMAP."""
    lines = (f"{_number(a)} {_number(b)}\n" for a, b in pairs)
    _listing(job).write_text("".join(lines), encoding="utf-8")
    return _listing(job)


def _listing(job: SfmJob) -> Path:
    return job.database.with_name("pairs.txt")


def _restore_names(colmap: ModuleType, job: SfmJob) -> None:
    """Restore the names of images; a run that was killed while it matched has left numbers in their place."""
    names = [image.name for image in job.survey.images]
    rename_images(colmap, job.database, {_number(index): name for index, name in enumerate(names)})


def _number(index: int) -> str:
    return f"{index:06d}"


def steps(items: Any, size: int) -> Iterator[Any]:
    """Yield the items in slices of `size`; the last may be shorter."""
    for begin in range(0, len(items), size):
        yield items[begin : begin + size]

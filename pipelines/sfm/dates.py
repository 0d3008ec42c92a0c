"""Points in common with an earlier date: features matched across the dates, and the tracks of both that they tie.

The earlier workspace is read and never written. Its features come from its database, its cameras and points from
its solution. A pair of tracks is common if verified matches tie them, and if it fits the similarity that most pairs
agree on. Ground that has changed has few such pairs, and no part of the ground has more of a say than another.

Where too few pairs agree, or all in one corner, SIFT's features are matched again by looser tests, between more
photographs, and then the learned features that both dates have: of another season, SIFT finds next to nothing.
"""

import logging
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from pipelines.adjust.earlier_date import FEW_COMMON, NARROW_SPREAD, common_similarity
from pipelines.adjust.posterior import Posterior
from pipelines.adjust.relative import Solved
from pipelines.adjust.solution import posterior_of
from pipelines.core.errors import DamagedPartialError, DegenerateGeometryError, InputError
from pipelines.core.machine import chosen_threads
from pipelines.core.plan import photograph_folder
from pipelines.core.products import is_checked
from pipelines.core.progress import Progress
from pipelines.core.stages import SPARSE, SURVEY
from pipelines.core.types import BoolArray, FloatArray, IntArray
from pipelines.core.workspace import Workspace
from pipelines.formats.colmap import flatten, load_reconstruction
from pipelines.geodesy.enu import ecef_from_enu, ecef_from_enu_rotation, lla_of
from pipelines.geometry.cameras import ColmapDatabase, ColmapImage, Reconstruction
from pipelines.geometry.rotations import matrix_from_quat_xyzw
from pipelines.geometry.sparse_model import SparseModel
from pipelines.sfm.colmap_database import FEATURES, add_features, copy_rows, drop_added_features, remove_database
from pipelines.sfm.features import MAX_ANGLE_DEG, SfmJob, masks_beside, spread_of, steps, verification
from pipelines.sfm.learned_weights import missing_for_learned
from pipelines.survey.common_points import CommonPoints, solution_hash
from pipelines.survey.navigation import load_survey
from pipelines.survey.solution import read_sfm, read_solution
from pipelines.survey.survey import Survey, SurveyImage

log = logging.getLogger(__name__)

DATABASE = "sfm/database.db"
_NEIGHBOURS = 8  # earlier photographs that a later one is matched with
_EXHAUSTIVE_UP_TO = 400  # pairs across the dates
_PAIRS_PER_STEP = 48
_LEAST = 8  # points in common: fewer agree by chance, and check nothing
_LEAST_MATCHES = 15  # verified ones of a pair, as COLMAP's own mapper asks for
_BLOCKS = 12  # along the longer side of the ground in common
_SPREAD_BLOCKS = 6
_LEAST_SHARE = 0.1  # of the pairs of tracks: three of them agree with one in a hundred of any others
_SAME_PX = 0.5  # between learned features found again and those in a database
_LOOSE_RATIO = 0.9  # of the distances of a descriptor to the nearest two, where SIFT's own is 0.8
_MOST = 600  # points: more say nothing new of some dozen modes of deformation, and cost time in every stage
_REACH = 3.0  # heights of flight between a photograph and the nearest of the other date
_FARTHEST_M = 30.0  # between the positions of both dates beyond that reach: consumer receivers err by metres


@dataclass(frozen=True)
class SolvedDate:
    """Earlier date as it was solved: its survey, SfM model and posterior; read only."""

    workspace: Workspace
    survey: Survey
    sfm: SparseModel
    posterior: Posterior

    @classmethod
    def load(cls, root: Path, later: Survey) -> "SolvedDate":
        """Read the earlier date of a later survey.

        Raises:
            MissingProductError: the workspace is not solved; names the command.
            InputError: a product is damaged; either date has no place on Earth; the earlier one has no features; or
                the two lie apart.
        """
        workspace = Workspace(root)
        solution = read_solution(workspace)
        sfm, survey = read_sfm(workspace, solution), solution.weighted(load_survey(workspace))
        if survey.origin is None or later.origin is None:
            which = "The earlier" if survey.origin is None else "This"
            message = (
                f"{which} survey has a local metric frame and no place on Earth, which two dates need to share."
            )
            raise InputError("not-on-earth", message, path=root, field="--earlier")
        if not workspace.has(DATABASE):
            message = "has no features (sfm/database.db), as an imported model has none."
            remedy = "Solve it from photographs."
            raise InputError("earlier-without-features", message, path=root, field="--earlier", remedy=remedy)
        date = cls(workspace, survey, sfm, posterior_of(workspace, solution, sfm))
        date._require_near(later)
        return date

    @cached_property
    def center_in_ecef(self) -> FloatArray:
        """Solved projection centres (n, 3)."""
        return ecef_from_enu(self.posterior.solution.center_in_geo, self.survey.origin_on_earth)

    @cached_property
    def axis_in_ecef(self) -> FloatArray:
        """Solved optical axes (n, 3)."""
        solution = self.posterior.solution
        in_geo = solution.poses.cam_from_model[:, 2] @ solution.similarity.rotation.T
        return np.asarray(in_geo @ ecef_from_enu_rotation(lla_of(self.survey.origin_on_earth)).T)

    @cached_property
    def at(self) -> Solved:
        return Solved(self.posterior, self.survey.origin_on_earth)

    def _require_near(self, later: Survey) -> None:
        position, _ = _recorded(later)
        known = np.isfinite(position).all(axis=1)
        if not known.any():
            return
        distance, _ = cKDTree(self.center_in_ecef).query(position[known])
        rays = np.linalg.norm(self.at.network.rays(), axis=1) * self.posterior.solution.similarity.scale
        reach_m = _REACH * float(np.median(rays)) + _FARTHEST_M
        if float(distance.min()) > reach_m:
            message = (
                f"has nothing in common with this survey: the nearest photographs of both dates are "
                f"{distance.min():.0f} m apart, and those of the earlier date see {np.median(rays):.0f} m far."
            )
            raise InputError("earlier-apart", message, path=self.workspace.root, field="--earlier")


def tie_to_earlier(
    colmap: ModuleType, job: SfmJob, model: Reconstruction, earlier: SolvedDate, progress: Progress
) -> CommonPoints:
    """Return the points that a `pycolmap.Reconstruction` has in common with an earlier date.

    Raises:
        DegenerateGeometryError: too few points are common; says how far the search came.
        InputError: the features of the earlier date cannot be read.
    """
    flat, best = flatten(model), _Ties.none()
    with _both_dates(colmap, job, model, earlier) as dates:
        for name, tied in dates.rounds(colmap, job, progress):
            ties = tied.agreeing(flat, earlier)
            log.info(
                "%s: %d points tie the dates, of %d verified matches in %d pairs; they cover %.0f %% of the ground "
                "in common.", name, len(ties), ties.matches, ties.pairs, 100 * ties.spread,
            )  # fmt: skip
            best = ties if best.pairs == 0 or len(ties) > len(best) else best
            if len(best) >= FEW_COMMON and best.spread >= NARROW_SPREAD:
                break
    if len(best) < _LEAST:
        message = (
            f"{best.pairs} pairs of photographs across the dates have {best.matches} verified matches, which "
            f"tie {len(best)} points that agree; {_LEAST} are needed. Nothing on the ground looks the same at both "
            "dates, or scale, season or light differ too much."
        )
        remedy = (
            "Solve both dates with --features learned, which finds what a season leaves, or with a larger "
            "--max-features. Or solve this date alone: --forget earlier."
        )
        raise DegenerateGeometryError("earlier-not-tied", message, remedy=remedy)
    return _placed(best, earlier)


def pairs_across(
    survey: Survey, model: Reconstruction, earlier: SolvedDate, neighbours: int
) -> list[tuple[int, int]]:
    """Return the pairs (later image id, index of an earlier camera) that may show the same place.

    Few pairs are all taken. Otherwise, half of a photograph's `neighbours` are the nearest that look in a similar
    direction, and the others are the nearest in each of eight directions. Without a position it has none.
    """
    ids = sorted(model.reg_image_ids())
    count = len(earlier.center_in_ecef)
    if len(ids) * count <= _EXHAUSTIVE_UP_TO:
        return [(image_id, other) for image_id in ids for other in range(count)]
    position, axis = _recorded(survey)
    tree, pairs = cKDTree(earlier.center_in_ecef), []
    turn = ecef_from_enu_rotation(lla_of(survey.origin_on_earth))
    for image_id in ids:
        here = position[image_id - 1]
        if not np.isfinite(here).all():
            continue
        near = np.atleast_1d(tree.query(here, k=min(count, _NEIGHBOURS * neighbours))[1])
        looks_away = earlier.axis_in_ecef[near] @ axis[image_id - 1] < np.cos(np.radians(MAX_ANGLE_DEG))
        near = near[~looks_away]  # unknown (NaN) passes
        offset = (earlier.center_in_ecef[near] - here) @ turn
        pairs += [(image_id, int(near[row])) for row in spread_of(offset, neighbours)]
    return pairs


def _recorded(survey: Survey) -> tuple[FloatArray, FloatArray]:
    """Return positions and optical axes (n, 3) of the photographs as recorded, Earth-centred; NaN: unknown."""
    unknown, origin = np.full(3, np.nan), survey.origin_on_earth
    in_geo = np.array([image.fix.position_in_geo if image.fix else unknown for image in survey.images])
    axis = np.array(
        [
            matrix_from_quat_xyzw(image.attitude.quat_xyzw)[:, 2] if image.attitude else unknown
            for image in survey.images
        ]
    )
    return ecef_from_enu(in_geo, origin), axis @ ecef_from_enu_rotation(lla_of(origin)).T


@dataclass(frozen=True)
class _Ties:
    """Pairs of tracks: COLMAP's ids of points in the later and the earlier model, and the pairs of photographs."""

    later: IntArray
    earlier: IntArray
    votes: IntArray
    matches: int  # verified ones, of all features
    pairs: int  # of photographs
    spread: float = 0.0

    @classmethod
    def none(cls) -> "_Ties":
        nothing = np.zeros(0, dtype=np.int64)
        return cls(nothing, nothing, nothing, 0, 0)

    def __len__(self) -> int:
        return len(self.later)

    def agreeing(self, model: SparseModel, earlier: SolvedDate) -> "_Ties":
        """Return the pairs that agree on a similarity, thinned to an even number in each block; none: by chance."""
        sfm, solution = earlier.sfm, earlier.posterior.solution
        row = _rows(model.point_id, self.later)
        other = _rows(sfm.point_id, self.earlier)
        known = (row >= 0) & (other >= 0)
        row, other = row[known], other[known]
        nothing = self._at(np.zeros(0, dtype=np.int64))
        if len(row) < 3:
            return nothing
        in_geo = solution.similarity.apply(solution.point_in_model(sfm))
        try:
            similarity, near = common_similarity(model.point_in_local[row], in_geo[other], np.random.default_rng(0))
        except DegenerateGeometryError:
            return nothing
        if near.mean() < _LEAST_SHARE:
            return nothing
        ties = self._at(np.flatnonzero(known)[near])
        place, ground = in_geo[other[near]], (in_geo, similarity.apply(model.point_in_local))
        length = np.bincount(sfm.obs_point, minlength=len(sfm.point_id))[other[near]]
        length = length + np.bincount(model.obs_point, minlength=len(model.point_id))[row[near]]
        chosen = _thinned(place, ties.votes * 1000 + length, ground)
        return replace(ties._at(chosen), spread=_spread(place[chosen], ground))

    def _at(self, rows: IntArray) -> "_Ties":
        return replace(self, later=self.later[rows], earlier=self.earlier[rows], votes=self.votes[rows])


def _rows(ids: IntArray, wanted: IntArray) -> IntArray:
    """Return the rows of wanted ids in ascending ids; −1: not among them."""
    place = np.minimum(np.searchsorted(ids, wanted), len(ids) - 1)
    return np.where(ids[place] == wanted, place, -1)


def _blocks(ground: tuple[FloatArray, FloatArray], count: int) -> tuple[FloatArray, float]:
    """Return the corner (2,) and the side of blocks over the ground that both of two clouds cover."""
    quantiles = [np.quantile(cloud[:, :2], [0.02, 0.98], axis=0) for cloud in ground]
    low, high = np.maximum(*(each[0] for each in quantiles)), np.minimum(*(each[1] for each in quantiles))
    return low, max(float((high - low).max()) / count, 1e-6)


def _thinned(place: FloatArray, merit: IntArray, ground: tuple[FloatArray, FloatArray]) -> IntArray:
    """Return the best rows of each block, so many of each that the sum is at most `_MOST`."""
    low, side = _blocks(ground, _BLOCKS)
    _, block = np.unique(np.floor((place[:, :2] - low) / side), axis=0, return_inverse=True)
    block = block.reshape(-1)
    order = np.lexsort((-merit, block))
    rank = np.arange(len(order)) - np.searchsorted(block[order], block[order])
    each = np.bincount(block)
    most = max((m for m in range(1, int(each.max()) + 1) if np.minimum(each, m).sum() <= _MOST), default=1)
    return np.sort(order[rank < most])


def _spread(place: FloatArray, ground: tuple[FloatArray, FloatArray]) -> float:
    """Return the share of the blocks with points of both dates that have points in common."""
    low, side = _blocks(ground, _SPREAD_BLOCKS)

    def occupied(cloud: FloatArray) -> set[tuple[int, int]]:
        return {(int(x), int(y)) for x, y in np.floor((cloud[:, :2] - low) / side)}

    both = occupied(ground[0]) & occupied(ground[1])
    inside = {(x, y) for x, y in both if 0 <= x < _SPREAD_BLOCKS and 0 <= y < _SPREAD_BLOCKS}
    return len(occupied(place) & inside) / max(len(inside), 1)


def _placed(ties: _Ties, earlier: SolvedDate) -> CommonPoints:
    """Return pairs of tracks with their places by the earlier solution."""
    position, cov = earlier.at.placed(ties.earlier)
    known: BoolArray = np.asarray(np.isfinite(cov).all(axis=(1, 2)))
    similarity, pivot = earlier.at.similarity_in_ecef
    return CommonPoints(
        point_id=ties.later[known],
        earlier_point_id=ties.earlier[known],
        matches=ties.votes[known],
        position_in_ecef=position[known],
        cov_in_ecef=cov[known],
        sigma_m=earlier.at.sigma_m,
        cov_similarity=similarity,
        pivot_in_ecef=pivot,
        spread=np.asarray(ties.spread),
        found=np.asarray(int(known.sum())),
        factor=np.asarray(1.0),
        checked=np.asarray(is_checked(earlier.posterior.solution.cautions)),
        earlier=str(earlier.workspace.root.absolute()),
        solution=solution_hash(earlier.workspace),
    )


@dataclass(frozen=True)
class _BothDates:
    """Database with the features of both dates; the ids of the earlier images follow those of the later."""

    path: Path
    first: int  # added to COLMAP's ids of the earlier images
    later: Any  # pycolmap.Reconstruction
    earlier: Any
    date: SolvedDate  # the earlier one
    added: dict[int, FloatArray]  # places (n, 2) of the learned features of images that have some, by their numbers
    known: dict[int, IntArray] = field(default_factory=dict)  # points of the features of images

    def rounds(self, colmap: ModuleType, job: SfmJob, progress: Progress) -> Iterator[tuple[str, _Ties]]:
        """Yield the tracks that are tied by SIFT, by SIFT with looser tests, and by learned features beside it."""
        pairs = self._pairs(job, _NEIGHBOURS)
        self._match(colmap, job, pairs, progress, loosely=False)
        yield "SIFT", self._ties(colmap, pairs)
        more = sorted({*pairs, *self._pairs(job, 2 * _NEIGHBOURS)})
        with colmap.Database.open(self.path) as database:  # COLMAP matches no pair twice
            database.clear_matches()
            database.clear_two_view_geometries()
        self._match(colmap, job, more, progress, loosely=True)
        yield "SIFT, loosely", self._ties(colmap, more)
        if self._match_learned(colmap, job, pairs, progress):
            yield "learned features", self._ties(colmap, more)

    def _pairs(self, job: SfmJob, neighbours: int) -> list[tuple[int, int]]:
        """Return the pairs that may show the same place, by the numbers of their images."""
        ids = self.date.sfm.image_id
        pairs = pairs_across(job.survey, self.later, self.date, neighbours)
        return [(a, self.first + int(ids[b])) for a, b in pairs]

    def _match(
        self, colmap: ModuleType, job: SfmJob, pairs: list[tuple[int, int]], progress: Progress, *, loosely: bool
    ) -> None:
        matching, pairing = colmap.FeatureMatchingOptions(), colmap.ImportedPairingOptions()
        matching.num_threads = chosen_threads(job.options.threads)
        if loosely:
            matching.sift.max_ratio, matching.guided_matching = _LOOSE_RATIO, True

        def match(listing: Path) -> None:
            pairing.match_list_path = listing
            colmap.match_image_pairs(self.path, matching, pairing, verification(colmap, job))

        self._by_steps(pairs, match, "matching across the dates", progress)

    def _by_steps(
        self, pairs: list[tuple[int, int]], work: Callable[[Path], None], name: str, progress: Progress
    ) -> None:
        """Give lists of some pairs each, which are files, to a function of COLMAP."""
        listing = self.path.with_name("pairs_across.txt")
        with progress.task(name, len(pairs)) as task:
            for step in steps(pairs, _PAIRS_PER_STEP):
                listing.write_text("".join(f"{a:09d} {b:09d}\n" for a, b in step), encoding="utf-8")
                work(listing)
                task.advance(len(step))
        listing.unlink(missing_ok=True)

    def _match_learned(
        self, colmap: ModuleType, job: SfmJob, pairs: list[tuple[int, int]], progress: Progress
    ) -> bool:
        """Add matches of the learned features that both dates have; whether there are any.

        Their descriptors are kept nowhere: the photographs are read again, and a feature is known by its place.
        """
        photographs = self._photographs(job)
        usable = self.added.keys() & photographs.keys()
        wanted = [pair for pair in pairs if usable.issuperset(pair)]
        if not wanted or missing_for_learned() is not None:
            return False
        from pipelines.sfm.learned_features import LearnedMatcher  # and torch

        matcher = LearnedMatcher(job.options.threads)
        numbers = sorted({number for pair in wanted for number in pair})
        features, rows = {}, {}
        with progress.task("learned features", len(numbers)) as task:
            for number in numbers:
                found = features[number] = matcher.features(*photographs[number])
                apart, row = cKDTree(self.added[number]).query(found.in_photograph_px())
                rows[number] = np.where(apart < _SAME_PX, row, -1)
                task.advance()
        matches = {}
        with progress.task("learned matches", len(wanted)) as task:
            for a, b in wanted:
                one, two = matcher.matches(features[a], features[b]).T
                both = np.column_stack([rows[a][one], rows[b][two]])
                both = both[(both >= 0).all(axis=1)]
                if len(both):
                    matches[a - 1, b - 1] = both
                task.advance()
        add_features(colmap, self.path, {number - 1: self.added[number] for number in numbers}, matches)

        def verify(listing: Path) -> None:
            colmap.verify_matches(self.path, listing, verification(colmap, job))

        self._by_steps([(a + 1, b + 1) for a, b in matches], verify, "verification", progress)
        return bool(matches)

    def _photographs(self, job: SfmJob) -> dict[int, tuple[SfmJob, SurveyImage]]:
        """Return the registered photographs of both dates, and where each lies, by their numbers."""
        home, survey = self.date.workspace, self.date.survey
        folder, masks = photograph_folder(home, survey.image_dir), masks_beside(str(home.path(SURVEY)), survey)
        there = SfmJob(survey, folder, home.path(DATABASE), job.options, masks)
        photographs: dict[int, tuple[SfmJob, SurveyImage]] = {}
        for first, model, date in ((0, self.later, job), (self.first, self.earlier, there)):
            image = {each.name: each for each in date.survey.images}
            known = {number: model.images[number].name for number in model.reg_image_ids()}
            photographs |= {first + number: (date, image[name]) for number, name in known.items() if name in image}
        return photographs

    def _ties(self, colmap: ModuleType, pairs: list[tuple[int, int]]) -> _Ties:
        """Return the tracks that the verified matches of some pairs tie."""
        votes: Counter[tuple[int, int]] = Counter()
        with colmap.Database.open(self.path) as database:
            ties = [self._tied(database, a, b) for a, b in pairs if database.exists_two_view_geometry(a, b)]
        for of_pair, _ in ties:
            votes.update(of_pair)
        return _one_to_one(votes, sum(matches for _, matches in ties), len(pairs))

    def _tied(self, database: ColmapDatabase, a: int, b: int) -> tuple[set[tuple[int, int]], int]:
        """Return the pairs of points (later, earlier) that two images tie, and their number of verified matches."""
        rows = np.asarray(database.read_two_view_geometry(a, b).inlier_matches, dtype=np.int64).reshape(-1, 2)
        if len(rows) < _LEAST_MATCHES:
            return set(), len(rows)
        points = self._points(a), self._points(b)
        rows = rows[(rows[:, 0] < len(points[0])) & (rows[:, 1] < len(points[1]))]
        both = np.column_stack([points[0][rows[:, 0]], points[1][rows[:, 1]]])
        return {(int(one), int(two)) for one, two in both[(both >= 0).all(axis=1)]}, len(rows)

    def _points(self, number: int) -> IntArray:
        """Return `_points_of` of the image with a number in the database, which many pairs ask for."""
        if number not in self.known:
            later = number < self.first
            image = self.later.images[number] if later else self.earlier.images[number - self.first]
            self.known[number] = _points_of(image)
        return self.known[number]


def _points_of(image: ColmapImage) -> IntArray:
    """Return the points (K,) of the features of an image of a `pycolmap.Reconstruction`; −1: none."""
    return np.array([point.point3D_id if point.has_point3D() else -1 for point in image.points2D], dtype=np.int64)


def _one_to_one(votes: Counter[tuple[int, int]], matches: int, pairs: int) -> _Ties:
    """Return the pairs of tracks that each other's votes prefer."""
    best: tuple[dict[int, tuple[int, int]], dict[int, tuple[int, int]]] = ({}, {})
    for pair, count in sorted(votes.items()):
        for side, key in enumerate(pair):
            if count > best[side].get(key, (0, 0))[0]:
                best[side][key] = (count, pair[1 - side])
    kept = [(*pair, count) for pair, count in sorted(votes.items()) if _is_best(pair, best)]
    table = np.array(kept, dtype=np.int64).reshape(-1, 3)
    return _Ties(table[:, 0], table[:, 1], table[:, 2], matches, pairs)


def _is_best(pair: tuple[int, int], best: tuple[dict[int, tuple[int, int]], ...]) -> bool:
    return best[0][pair[0]][1] == pair[1] and best[1][pair[1]][1] == pair[0]


@contextmanager
def _both_dates(
    colmap: ModuleType, job: SfmJob, model: Reconstruction, earlier: SolvedDate
) -> Iterator[_BothDates]:
    """Make a database of the registered photographs of both dates with their features; it is removed at the end."""
    path = job.database.with_name("dates.db")
    other = load_reconstruction(earlier.workspace.path(SPARSE))
    first = max(model.images) + 1
    cameras = max(model.cameras) + 1
    remove_database(path)
    try:
        with colmap.Database.open(path) as database, colmap.DatabaseTransaction(database):
            _write_images(colmap, database, model, 0, 0)
            _write_images(colmap, database, other, first, cameras)
        ids = [sorted(one.reg_image_ids()) for one in (model, other)]
        copy_rows(job.database, path, FEATURES, [image_id - 1 for image_id in ids[0]])
        try:
            copy_rows(earlier.workspace.path(DATABASE), path, FEATURES, [i - 1 for i in ids[1]], shift=first)
        except DamagedPartialError as error:
            raise InputError("earlier-features", str(error), field="--earlier") from error
        added = _added_features(colmap, path)
        drop_added_features(path)
        yield _BothDates(path, first, model, other, earlier, added)
    finally:
        remove_database(path)


def _added_features(colmap: ModuleType, path: Path) -> dict[int, FloatArray]:
    """Return the places (n, 2) of features without SIFT's descriptors, by the numbers of images that have some."""
    features = {}
    with colmap.Database.open(path) as database:
        for image in database.read_all_images():
            number = image.image_id
            sift = database.num_descriptors_for_image(number)
            if database.num_keypoints_for_image(number) > sift:
                features[number] = np.asarray(database.read_keypoints(number), dtype=np.float64)[sift:, :2]
    return features


def _write_images(
    colmap: ModuleType, database: ColmapDatabase, model: Reconstruction, first: int, cameras: int
) -> None:
    """Write the solved cameras and the registered images of a model, their ids moved, into a database."""
    for camera in model.cameras.values():
        moved = colmap.Camera(
            model=camera.model_name, width=camera.width, height=camera.height, params=camera.params
        )
        moved.camera_id, moved.has_prior_focal_length = cameras + camera.camera_id, True
        database.write_camera(moved, use_camera_id=True)
        rig = colmap.Rig(rig_id=moved.camera_id)
        rig.add_ref_sensor(moved.sensor_id)
        database.write_rig(rig, use_rig_id=True)
    for image_id in sorted(model.reg_image_ids()):
        camera_id, number = cameras + model.images[image_id].camera_id, first + image_id
        row = colmap.Image(name=f"{number:09d}", camera_id=camera_id, image_id=number)
        database.write_image(row, use_image_id=True)
        frame = colmap.Frame(frame_id=number, rig_id=camera_id)
        frame.add_data_id(row.data_id)
        database.write_frame(frame, use_frame_id=True)

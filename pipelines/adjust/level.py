"""Level of a survey by what its photographs know of the vertical, without positions.

Recorded attitudes know it best. Without them, the cameras of a mission share a tilt: nadir, or a constant pitch
without roll. Seen from all cameras, the vertical then has one direction, whatever their headings, and only the true
vertical has it in all of them: two opposite headings suffice. The scatter of the photographs about it tells how
steady they were held; what leans one of them may lean all, as wind does, so that its σ is that of one photograph.
Where all headings are the same, no roll and a view straight down are assumed, with a wider σ. The ground helps a
little: it is level on the whole, but for the slopes that most sites have.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from pipelines.adjust.alignment import Alignment, Correspondences, RotationPrior, SimilarityState, adjust
from pipelines.core.errors import DegenerateGeometryError
from pipelines.core.types import FloatArray, IntArray
from pipelines.geometry.rotations import exp_so3
from pipelines.geometry.similarity import Similarity
from pipelines.geometry.sparse_model import SparseModel
from pipelines.geometry.statistics import cauchy_weight
from pipelines.survey.survey import Survey

_LEAST_CAMERAS, _POINTS = 4, 20_000
_ROUNDS = 20
_MEDIAN_NORMAL = 0.6745  # median of the absolute value of a standard normal
# Least σ of a lean that all photographs share, such as into the wind; σ of a mount's roll, and of a view down.
_LEAST_LEAN, _SIGMA_ROLL, _SIGMA_NADIR = np.radians(1.0), np.radians(3.0), np.radians(5.0)
_SIGMA_PITCH = np.radians(40.0)  # of a camera that does not look straight down, where headings do not tell
_NEAR_NADIR, _UPRIGHT = np.cos(np.radians(20.0)), np.sin(np.radians(45.0))
_LEAST_SCATTER = np.radians(0.05)
_SAME_LINE = np.cos(np.radians(30.0))  # of two headings
_WORST = np.radians(30.0)  # σ beyond which a level is none
SIGMA_SLOPE = np.radians(6.0)  # of the ground of a site, on the whole
_TILTED_SIGMAS, _TILTED = 3.0, np.radians(5.0)  # of an alignment against the level, beyond which it is wrong
_HELD = 1e-3  # rad
_STEEPEST = np.radians(45.0)  # beyond, a plane of points is a wall
_FLAT = 0.25  # thickness of the points about their plane, over its shorter extent


@dataclass(frozen=True)
class KnownLevel:
    """Upward direction (3,) in `local`, with the covariance (3, 3) in rad² of its turn, and where it comes from."""

    up_in_local: FloatArray
    cov_rad2: FloatArray
    recorded: bool

    @property
    def sigma_rad(self) -> float:
        """σ of the tilt about its worse axis."""
        return float(np.sqrt(np.linalg.eigvalsh(self.cov_rad2)[-1]))


def level_of(survey: Survey, model: SparseModel, recorded: RotationPrior | None) -> KnownLevel | None:
    """Return the level by the recorded attitudes, else by the photographs; None: they do not tell it."""
    if recorded is not None:
        up = recorded.rotation[2]
        across = np.eye(3) - np.outer(up, up)
        turn = recorded.rotation.T @ recorded.cov_rad2 @ recorded.rotation
        return KnownLevel(up, across @ turn @ across, recorded=True)
    if len(model.image_name) < _LEAST_CAMERAS:
        return None
    time_s = {image.name: image.timestamp_s for image in survey.images}
    known = [time_s.get(name) for name in model.image_name]
    order = np.argsort([np.nan if one is None else one for one in known] if None not in known else model.image_name)
    level = level_by_views(model.rotation_cam_from_local[order], model.image_camera_id[order])
    level = _with_ground(level, ground_normal(model, level.up_in_local))
    return level if level.sigma_rad < _WORST else None


def ground_normal(model: SparseModel, up_in_local: FloatArray) -> FloatArray | None:
    """Return the normal (3,) in local, near an upward direction, of the plane of the points; None: they have none.

    Points far from the others, as at a horizon, do not count.
    """
    point = model.point_in_local[:: max(1, len(model.point_in_local) // _POINTS)]
    if len(point) < 3 * _LEAST_CAMERAS:
        return None
    away = np.linalg.norm(point - np.median(point, axis=0), axis=1)
    point = point[away <= 2.0 * np.median(away)]
    weight, normal = np.ones(len(point)), np.zeros(3)
    for _ in range(_ROUNDS):
        apart = point - weight @ point / weight.sum()
        extent, axes = np.linalg.eigh((weight[:, None] * apart).T @ apart / weight.sum())
        if extent[0] > _FLAT**2 * extent[1]:
            return None
        normal = axes[:, 0] * (1.0 if axes[:, 0] @ up_in_local >= 0 else -1.0)
        missed = np.abs(apart @ normal)
        weight = 1.0 / np.maximum(missed, 0.1 * float(np.median(missed)) + 1e-12)
    return normal


def _with_ground(level: KnownLevel, normal: FloatArray | None) -> KnownLevel:
    """Return a level with the ground's as a further, weak one."""
    if normal is None:
        return level
    turn = np.cross(level.up_in_local, normal)
    angle = float(np.arctan2(np.linalg.norm(turn), level.up_in_local @ normal))
    if angle > _STEEPEST:
        return level
    up = level.up_in_local
    across = np.eye(3) - np.outer(up, up)
    expected = SIGMA_SLOPE**2 + float(np.trace(level.cov_rad2)) / 2
    variance = SIGMA_SLOPE**2 / float(cauchy_weight(np.array(angle**2 / expected), 2))
    gain = level.cov_rad2 @ np.linalg.pinv(level.cov_rad2 + variance * across)
    moved = exp_so3(gain @ (turn * angle / max(float(np.linalg.norm(turn)), 1e-12))) @ up
    return KnownLevel(moved, level.cov_rad2 - gain @ level.cov_rad2, recorded=False)


def level_by_views(cam_from_local: FloatArray, camera_id: IntArray) -> KnownLevel:
    """Return the level of cameras (n, 3, 3) in the order of their times, each lens (n,) with a tilt of its own."""
    lenses, lens = np.unique(camera_id, return_inverse=True)
    up, weight = np.zeros(3), np.ones(len(lens))
    for _ in range(_ROUNDS):
        up, mean = _common_direction(cam_from_local, lens, weight)
        missed = cam_from_local @ up - mean[lens]
        scale = max(float(np.median((missed**2).sum(axis=1))) / 1.386, _LEAST_SCATTER**2)  # median of χ², 2 degrees
        weight = cauchy_weight((missed**2).sum(axis=1) / scale, 2)
    axes = np.linalg.svd(up[None])[2][1:]  # (2, 3) square to the vertical
    axes[1] *= np.sign(np.cross(axes[0], axes[1]) @ up)
    return _weighted(cam_from_local, lens, len(lenses), up, axes)


def _common_direction(
    cam_from_local: FloatArray, lens: IntArray, weight: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return the direction (3,) that each lens sees most alike, upward, and how it sees it (lenses, 3)."""
    sums = np.zeros((int(lens.max()) + 1, 3, 3))
    np.add.at(sums, lens, weight[:, None, None] * cam_from_local)
    total = np.bincount(lens, weight)
    up = np.linalg.eigh(np.einsum("lki,lkj->ij", sums / total[:, None, None], sums))[1][:, -1]
    seen = sums @ up / total[:, None]
    upward = float(-(seen[lens, 1] + seen[lens, 2]).mean())
    sign = 1.0 if upward >= 0 else -1.0
    return sign * up, sign * seen / np.linalg.norm(seen, axis=1, keepdims=True)


def _weighted(
    cam_from_local: FloatArray, lens: IntArray, lenses: int, up: FloatArray, axes: FloatArray
) -> KnownLevel:
    """Return the vertical near `up` with roll and pitch weighted by their scatter, and its covariance.

    Unknowns are the turn of the vertical along two axes, and roll and pitch of each lens.
    """
    count, scatter = len(lens), np.full(2, np.radians(3.0))
    weight = np.ones((count, 2))
    step, covariance = np.zeros(2 + 2 * lenses), np.eye(2)
    seen = cam_from_local @ up
    mean = np.stack([seen[lens == one].mean(axis=0) for one in range(lenses)])
    mean /= np.linalg.norm(mean, axis=1, keepdims=True)
    of_lens = np.stack([_roll_and_pitch(one) for one in mean])  # (lenses, 2, 3)
    missed = np.einsum("nak,nk->na", of_lens[lens], seen)
    design = np.zeros((count, 2, 2 + 2 * lenses))
    design[:, :, :2] = -np.einsum("nak,nki,bi->nab", of_lens[lens], cam_from_local, axes)
    design[np.arange(count), 0, 2 + 2 * lens] = design[np.arange(count), 1, 3 + 2 * lens] = 1.0
    lines = _lines(cam_from_local, up)
    for _ in range(_ROUNDS):
        prior, expected = _tilt_prior(mean, of_lens, scatter)
        information, right = np.diag(np.r_[0.0, 0.0, prior]), np.r_[0.0, 0.0, prior * expected]
        whitened = weight / scatter**2
        information = information + np.einsum("nap,na,naq->pq", design, whitened, design)
        right = right + np.einsum("nap,na,na->p", design, whitened, missed)
        step = np.linalg.solve(information, right)
        residual = missed - design @ step
        robust = np.median(np.abs(residual), axis=0) / _MEDIAN_NORMAL * np.sqrt(count / max(count - 2.0, 1.0))
        scatter = np.maximum(robust, _LEAST_SCATTER)
        weight = cauchy_weight(residual**2 / scatter**2, 1)
        # A line counts once: its photographs share wind, speed and the way in which they were triggered.
        information[:2, :2] *= lines / count
        information[:2, 2:] *= lines / count
        information[2:, :2] *= lines / count
        lines_information = (information[2:, 2:] - np.diag(prior)) * lines / count + np.diag(prior)
        within = information[:2, :2] - information[:2, 2:] @ np.linalg.solve(lines_information, information[2:, :2])
        value, vector = np.linalg.eigh(within)
        covariance = (vector / np.maximum(value, _WORST**-2 / 100.0)) @ vector.T
    moved = up + axes.T @ step[:2]
    moved = moved / np.linalg.norm(moved)
    across = axes - np.outer(axes @ moved, moved)
    # The covariance is that of the shift of `up`; a turn about an axis shifts it square to that axis.
    turned = np.cross(moved, across)
    lean = max(_LEAST_LEAN, float(scatter[0]))
    cov = turned.T @ (covariance + lean**2 * np.eye(2)) @ turned
    return KnownLevel(moved, cov, recorded=False)


def _roll_and_pitch(seen: FloatArray) -> FloatArray:
    """Return the directions (2, 3) in a camera along which its roll and its pitch move the vertical (3,)."""
    sideways = np.eye(3)[0 if abs(seen[0]) < _UPRIGHT else 1]
    roll = sideways - (sideways @ seen) * seen
    roll = roll / np.linalg.norm(roll)
    return np.stack([roll, np.cross(seen, roll)])


def _tilt_prior(mean: FloatArray, of_lens: FloatArray, scatter: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the information (2 lenses,) on roll and pitch of each lens beyond its mean, and their values there."""
    information, expected = [], []
    for seen, axes in zip(mean, of_lens, strict=True):
        sideways = np.eye(3)[0 if abs(seen[0]) < _UPRIGHT else 1]
        is_nadir = -seen[2] > _NEAR_NADIR
        information.append(1.0 / max(_SIGMA_ROLL, float(scatter[0])) ** 2)
        expected.append(-float(sideways @ seen) / float(sideways @ axes[0]))
        information.append(1.0 / max(_SIGMA_NADIR if is_nadir else _SIGMA_PITCH, float(scatter[1])) ** 2)
        down = np.array([0.0, 1.0, 0.0])
        expected.append(-float(down @ seen) / float(down @ axes[1]) if is_nadir else 0.0)
    return np.array(information), np.array(expected)


def _lines(cam_from_local: FloatArray, up: FloatArray) -> int:
    """Return the number of stretches of one heading, in the order of the cameras."""
    ahead = cam_from_local[:, 2] - cam_from_local[:, 1]
    ahead = ahead - np.outer(ahead @ up, up)
    ahead = ahead / np.maximum(np.linalg.norm(ahead, axis=1, keepdims=True), 1e-12)
    lines, first = 1, ahead[0]
    for one in ahead:
        if one @ first < _SAME_LINE:
            lines, first = lines + 1, one
    return lines


def levelled(level: KnownLevel, center_in_local: FloatArray, position_in_geo: FloatArray) -> Similarity:
    """Return the similarity geo ← local that keeps the level, with heading, scale and shift by the plan.

    Raises:
        DegenerateGeometryError: the positions do not determine the heading.
    """
    up = level.up_in_local
    east = np.linalg.svd(up[None])[2][1]
    turn = np.stack([east, np.cross(up, east), up])
    flat = center_in_local @ turn.T
    source, target = flat[:, 0] + 1j * flat[:, 1], position_in_geo[:, 0] + 1j * position_in_geo[:, 1]
    weight, factor, shift = np.ones(len(source)), 0j, 0j
    for _ in range(_ROUNDS):
        middle = (weight @ source) / weight.sum(), (weight @ target) / weight.sum()
        away, wanted = source - middle[0], target - middle[1]
        spread = float(weight @ np.abs(away) ** 2)
        if spread <= 0 or weight @ np.abs(wanted) ** 2 <= 0:
            raise DegenerateGeometryError("heading-open", "The positions do not determine the heading.")
        factor = (weight * np.conj(away)) @ wanted / spread
        shift = middle[1] - factor * middle[0]
        missed = np.abs(target - factor * source - shift)
        weight = 1.0 / np.maximum(missed, 1e-3 + 0.1 * float(np.median(missed)))
    scale = float(np.abs(factor))
    if not scale > 0:
        raise DegenerateGeometryError("heading-open", "The positions do not determine the heading.")
    cosine, sine = factor.real / scale, factor.imag / scale
    rotation = np.array([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]]) @ turn
    height = float(np.median(position_in_geo[:, 2] - scale * flat[:, 2]))
    return Similarity(scale, rotation, np.array([shift.real, shift.imag, height]))


def kept_level(alignment: Alignment, level: KnownLevel | None, data: Correspondences) -> Alignment:
    """Return the alignment of camera centres with their fixes, held to the level where it is tilted against it.

    Drifting heights tilt an alignment of fixes that count as independent.
    """
    if level is None or len(data) < 3:
        return alignment
    tilt = float(np.arccos(np.clip(alignment.geo_from_local.rotation[2] @ level.up_in_local, -1.0, 1.0)))
    if tilt < max(_TILTED_SIGMAS * level.sigma_rad, _TILTED):
        return alignment
    try:
        start = levelled(level, data.in_local, data.in_geo)
    except DegenerateGeometryError:
        return alignment
    prior = RotationPrior(start.rotation, np.diag([_HELD, _HELD, 1.0]) ** 2)
    solution = adjust(data, SimilarityState(start, np.ones(len(data), dtype=bool)), prior)
    covariance = solution.covariance.copy()
    covariance[1:3, 1:3] += level.sigma_rad**2 * np.eye(2)
    return replace(alignment, solution=replace(solution, covariance=covariance))

"""The place of a part beside a model, by the matches between their photographs alone.

The mapper adds a photograph that shows 30 points of the model. A pair of photographs that overlaps by a strip has
hundreds of matches there, but few points that a third photograph shows, and the photographs beyond stay out. Yet
each match measures the place of the part:

1. Of a point of the model: the part's photograph shows it (two equations), which gives the photograph's place.
2. Of a point of the part: the model's photograph shows it (two equations), which gives the part's scale.
3. Of neither: the two rays meet (one equation), which gives rotation and direction.

Together they determine the similarity model ← part. It counts only if they determine it well.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from types import ModuleType
from typing import Self

import numpy as np

from pipelines.core.types import BoolArray, FloatArray, IntArray
from pipelines.formats.colmap import lens_of_colmap
from pipelines.geometry.cameras import Camera, Reconstruction, bearings, project_each
from pipelines.geometry.similarity import Similarity, covariance_at, perturbation
from pipelines.geometry.statistics import CAUCHY_95, NORMAL_MAD, cauchy_weight

_FEWEST_POINTS = 4  # of the model, and of a part that has a scale: one gives the scale, the others check it
_FEWEST_MATCHES = 30  # COLMAP's fewest points by which it adds a photograph
_LEAST_SHARE = 0.6  # of the matches that agree with the place
_GATE_PX = 4.0  # COLMAP's, of an observation of a model
_RESECTION_GATE_PX = 8.0
_LEAST_SIGMA_PX = 0.5
_MOST_SIGMA = 0.03  # of the part's centres, over the distance to the ground
_STARTS = 4  # photographs, and pairs, from which the place is sought
_MOST_MATCHES = 400  # that are used, those of points first
_MOST_STEPS = 30
_KINDS = 5  # of residuals
_FAR_PX = 1e3  # residual of a point behind the camera


@dataclass(frozen=True)
class Side:
    """M matches in one of two models: the photograph's camera, pixel, ray, and the point if it has one."""

    cameras: dict[int, Camera]
    image: IntArray  # (M,) COLMAP's numbers
    camera: IntArray  # (M,) keys of `cameras`
    xy_px: FloatArray  # (M, 2)
    bearing: FloatArray  # (M, 3) unit vectors in the camera's frame
    cam_from_model: FloatArray  # (M, 3, 3) rotations
    center: FloatArray  # (M, 3) in the model's frame
    point: FloatArray  # (M, 3) in the model's frame; NaN: the match is of no point of it

    @property
    def is_point(self) -> BoolArray:
        return np.asarray(np.isfinite(self.point).all(axis=1))

    @property
    def ray(self) -> FloatArray:
        """Unit vectors (M, 3) in the model's frame."""
        return np.asarray(np.einsum("mji,mj->mi", self.cam_from_model, self.bearing))

    @property
    def focal_px(self) -> FloatArray:
        focal_px = {key: camera.mean_focal_px for key, camera in self.cameras.items()}
        return np.array([focal_px[key] for key in self.camera.tolist()])

    def moved(self, model_from_part: Similarity) -> Self:
        return replace(
            self,
            cam_from_model=self.cam_from_model @ model_from_part.rotation.T,
            center=model_from_part.apply(self.center),
            point=model_from_part.apply(self.point),
        )

    def residuals_px(self, point: FloatArray) -> FloatArray:
        """Return pixels (M, 2) of points (M, 3) minus those seen; NaN behind the camera and where there is none."""
        in_cam = np.einsum("mij,mj->mi", self.cam_from_model, point - self.center)
        return project_each(self.cameras, self.camera, in_cam) - self.xy_px

    def of(self, rows: BoolArray) -> Self:
        names = ("image", "camera", "xy_px", "bearing", "cam_from_model", "center", "point")
        return replace(self, **{name: getattr(self, name)[rows] for name in names})


@dataclass(frozen=True)
class Tie:
    """The place of a part, model ← part, its σ, and the matches that agree with it."""

    model_from_part: Similarity
    sigma: float  # of the part's centres, over their distance to the ground
    matches: int
    pairs: int
    points: int  # matches of points of the model


def side_of(model: Reconstruction, image: Sequence[int], row: Sequence[int]) -> Side:
    """Return matches (M,), features given by image and row, as parts of a `pycolmap.Reconstruction`."""
    cameras = {key: lens_of_colmap(each) for key, each in model.cameras.items()}
    images = {key: model.images[key] for key in set(image)}
    pose = {key: each.cam_from_world().matrix() for key, each in images.items()}
    center = {key: each.projection_center() for key, each in images.items()}
    seen = [images[key].points2D[index] for key, index in zip(image, row, strict=True)]
    nowhere = np.full(3, np.nan)
    camera = np.array([images[key].camera_id for key in image], dtype=np.int64)
    xy_px = np.array([each.xy for each in seen], dtype=np.float64).reshape(-1, 2)
    bearing = np.empty((len(seen), 3))
    for key in set(camera.tolist()):
        bearing[camera == key] = bearings(cameras[key], xy_px[camera == key])
    return Side(
        cameras,
        np.array(image, dtype=np.int64),
        camera,
        xy_px,
        bearing,
        np.array([pose[key][:, :3] for key in image]).reshape(-1, 3, 3),
        np.array([center[key] for key in image]).reshape(-1, 3),
        np.array([model.points3D[each.point3D_id].xyz if each.has_point3D() else nowhere for each in seen]).reshape(
            -1, 3
        ),
    )


def tie(colmap: ModuleType, model: Side, part: Side, *, has_scale: bool, seed: int = 0) -> Tie | str:
    """Return the place of a part by its matches with a model, or the reason why they do not determine it.

    Args:
        has_scale: the part has two photographs or more, so that its scale is to be found.
    """
    sound = np.isfinite(np.concatenate([model.bearing, part.bearing], axis=1)).all(axis=1)
    model, part = model.of(sound), part.of(sound)
    if len(model.image) < _FEWEST_MATCHES:
        return f"{len(model.image)} matches tie it to the model, and {_FEWEST_MATCHES} are needed"
    points = int(model.is_point.sum())
    if points < _FEWEST_POINTS or (has_scale and part.is_point.sum() < _FEWEST_POINTS):
        return (
            f"of its {len(model.image)} matches with the model, {points} are of points of the model and "
            f"{int(part.is_point.sum())} of its own points, and {_FEWEST_POINTS} are needed"
        )
    used = _chosen(model, part)
    model, part = model.of(used), part.of(used)
    best, fit = None, np.inf
    alike = np.ones(_KINDS)
    for start in _starts(colmap, model, part, has_scale=has_scale, seed=seed):
        model_from_part, cost = _refined(model, part, start, alike, has_scale=has_scale)
        if cost < fit:
            best, fit = model_from_part, cost
    if best is None:
        return "no place of it agrees with its matches"
    best, _ = _refined(model, part, best, _sigma_px(model, part, best), has_scale=has_scale)
    return _judged(model, part, best, has_scale=has_scale)


def _chosen(model: Side, part: Side) -> BoolArray:
    """Return which of M matches (M,) are used: those of points first, the others drawn evenly."""
    count = len(model.image)
    order = np.argsort(~(model.is_point | part.is_point), kind="stable")
    points = int((model.is_point | part.is_point).sum())
    if points < _MOST_MATCHES:
        rest = np.linspace(points, count - 1, min(count - points, _MOST_MATCHES - points)).astype(int)
        kept = np.concatenate([order[:points], order[rest]])
    else:
        kept = order[np.linspace(0, points - 1, _MOST_MATCHES).astype(int)]
    chosen = np.zeros(count, dtype=bool)
    chosen[kept] = True
    return chosen


def _judged(model: Side, part: Side, model_from_part: Similarity, *, has_scale: bool) -> Tie | str:
    worst_px = np.nanmax(np.abs(_equations(model, part, model_from_part)), axis=1)
    agree = worst_px < _GATE_PX
    if agree.sum() < max(_FEWEST_MATCHES, _LEAST_SHARE * len(agree)):
        return f"{int(agree.sum())} of its {len(agree)} matches with the model agree with one place"
    # Rays along the base meet whatever the distance: points alone contradict a place shifted along it.
    points, own = int((agree & model.is_point).sum()), int((agree & part.is_point).sum())
    sides = ((points, model, "points of the model"), *(((own, part, "its own points"),) if has_scale else ()))
    for count, side, which in sides:
        known = int(side.is_point.sum())
        if count < max(_FEWEST_POINTS, _LEAST_SHARE * known):
            return (
                f"{count} of the {known} {which} among its matches agree with one place, of which "
                f"{100 * _LEAST_SHARE:.0f} % and {_FEWEST_POINTS} are needed"
            )
    sigma = _sigma(model, part, model_from_part, has_scale=has_scale)
    if not sigma < _MOST_SIGMA:
        return f"its matches leave its place open by {100 * sigma:.0f} % of the distance to the ground"
    pairs = len(set(zip(model.image[agree].tolist(), part.image[agree].tolist(), strict=True)))
    return Tie(model_from_part, sigma, int(agree.sum()), pairs, points)


def _equations(model: Side, part: Side, model_from_part: Similarity) -> FloatArray:
    """Return the residuals (M, 5) in pixels: of the model's point, of the part's, of the rays; NaN: none."""
    moved = part.moved(model_from_part)
    equations = np.full((len(model.image), 5), np.nan)
    for columns, seen, side in ((slice(0, 2), moved, model), (slice(2, 4), model, moved)):
        rows = side.is_point
        behind = np.nan_to_num(seen.of(rows).residuals_px(side.point[rows]), nan=_FAR_PX)
        equations[rows, columns] = np.clip(behind, -_FAR_PX, _FAR_PX)
    rays = ~(model.is_point | part.is_point)
    base, one, other = (moved.center - model.center)[rays], model.ray[rays], moved.ray[rays]
    across, over = np.cross(base, one), np.cross(base, other)
    # Sampson's distance: the planes of the base and each ray are apart by this angle, shared by both rays.
    size = np.sqrt((across**2).sum(axis=1) + (over**2).sum(axis=1))
    equations[rays, 4] = model.focal_px[rays] * (across * other).sum(axis=1) / np.maximum(size, 1e-300)
    return equations


def _sigma_px(model: Side, part: Side, model_from_part: Similarity) -> FloatArray:
    """Return σ (5,) of each kind of residual: points near the rim of a model are less exact than rays."""
    size = np.abs(_equations(model, part, model_from_part))
    kinds = [size[:, :2], size[:, 2:4], size[:, 4:]]
    sigma = [NORMAL_MAD * np.nanmedian(kind) if np.isfinite(kind).any() else _LEAST_SIGMA_PX for kind in kinds]
    return np.asarray(np.maximum(np.repeat(sigma, [2, 2, 1]), _LEAST_SIGMA_PX))


def _refined(
    model: Side, part: Side, start: Similarity, sigma_px: FloatArray, *, has_scale: bool
) -> tuple[Similarity, float]:
    """Return the place that fits best near a start, and its robust cost."""
    from scipy.optimize import least_squares

    solved = least_squares(
        partial(_residuals, model, part, start, sigma_px),
        np.zeros(7 if has_scale else 6),
        x_scale="jac",
        loss="cauchy",
        f_scale=CAUCHY_95,
        max_nfev=_MOST_STEPS,
    )
    return _at(solved.x, part, start), float(solved.cost)


def _residuals(model: Side, part: Side, start: Similarity, sigma_px: FloatArray, delta: FloatArray) -> FloatArray:
    """Return the residuals (K,) of all that was measured, over their σ, after a correction of the place."""
    equations = _equations(model, part, _at(delta, part, start)) / sigma_px
    return np.asarray(equations[np.isfinite(equations)])


def _at(delta: FloatArray, part: Side, start: Similarity) -> Similarity:
    """Return the place after a correction, (δ ln s), δω, δt about the part's centre."""
    full = np.concatenate([np.zeros(7 - len(delta)), delta])
    return perturbation(full, start.apply(part.center.mean(axis=0))) @ start


def _sigma(model: Side, part: Side, model_from_part: Similarity, *, has_scale: bool) -> float:
    """Return the largest σ of the part's centres by the matches, over the median distance to the model's points."""
    count = 7 if has_scale else 6
    at = partial(_residuals, model, part, model_from_part, _sigma_px(model, part, model_from_part))
    residual = at(np.zeros(count))
    depth = float(np.median(np.linalg.norm((model.point - model.center)[model.is_point], axis=1)))
    step = 1e-6 * np.concatenate([np.ones(count - 3), np.full(3, depth)])
    jacobian = np.stack([(at(h) - at(-h)) / (2 * h.sum()) for h in np.diag(step)], axis=1)
    weighted = jacobian * np.sqrt(cauchy_weight(residual**2, 1))[:, None]
    normal = weighted.T @ weighted * np.outer(step, step) * 1e12  # its unknowns in radians and depths
    values, vectors = np.linalg.eigh(normal)
    if values[0] <= 1e-12 * values[-1]:
        return np.inf
    unit = step * 1e6
    covariance = np.zeros((7, 7))
    covariance[7 - count :, 7 - count :] = (vectors / values) @ vectors.T * np.outer(unit, unit)
    centers = model_from_part.apply(np.unique(part.center, axis=0))
    of_centers = covariance_at(centers, covariance, model_from_part.apply(part.center.mean(axis=0)))
    return float(np.sqrt(np.trace(of_centers, axis1=1, axis2=2).max())) / depth


def _starts(colmap: ModuleType, model: Side, part: Side, *, has_scale: bool, seed: int) -> Iterator[Similarity]:
    """Yield places of the part: by its photographs' places, by the model's in the part, by the poses of pairs."""
    yield from _by_resection(colmap, model, part, has_scale=has_scale, seed=seed)
    if has_scale:
        for model_from_part in _by_resection(colmap, part, model, has_scale=True, seed=seed):
            yield model_from_part.inverse()
    pairs = list(zip(model.image.tolist(), part.image.tolist(), strict=True))
    for pair in sorted(set(pairs), key=lambda pair: (-pairs.count(pair), pair))[:_STARTS]:
        rows = np.array([each == pair for each in pairs])
        yield from _by_pair(colmap, model.of(rows), part.of(rows), has_scale=has_scale, seed=seed)


def _by_resection(
    colmap: ModuleType, model: Side, part: Side, *, has_scale: bool, seed: int
) -> Iterator[Similarity]:
    """Yield places of the part by photographs of it that show points of the model."""
    shown = {image: part.image == image for image in sorted(set(part.image[model.is_point].tolist()))}
    options = colmap.AbsolutePoseEstimationOptions()
    options.ransac.max_error, options.ransac.random_seed = _RESECTION_GATE_PX, seed
    of_most = sorted(shown, key=lambda image: -int((shown[image] & model.is_point).sum()))
    for image in of_most[:_STARTS]:
        rows = shown[image] & model.is_point
        if rows.sum() < _FEWEST_POINTS:
            return
        lens = part.cameras[int(part.camera[rows][0])]
        camera = colmap.Camera(model=lens.model, width=lens.width, height=lens.height, params=lens.params)
        resection = colmap.estimate_and_refine_absolute_pose(part.xy_px[rows], model.point[rows], camera, options)
        if resection is None:
            continue
        pose = resection["cam_from_world"].matrix()
        cam_from_part, center = part.cam_from_model[rows][0], part.center[rows][0]
        rotation = pose[:, :3].T @ cam_from_part
        seen = shown[image] & part.is_point
        scale = 1.0
        if has_scale:
            placed = replace(
                part.of(seen),
                cam_from_model=np.broadcast_to(pose[:, :3], (int(seen.sum()), 3, 3)),
                center=np.broadcast_to(-pose[:, :3].T @ pose[:, 3], (int(seen.sum()), 3)),
            )
            scale = _ratio(_depths(placed, model.of(seen)), part.of(seen))
        if np.isfinite(scale):
            model_from_part = Similarity(scale, rotation, np.zeros(3))
            yield replace(model_from_part, translation=-pose[:, :3].T @ pose[:, 3] - model_from_part.apply(center))


def _by_pair(colmap: ModuleType, model: Side, part: Side, *, has_scale: bool, seed: int) -> Iterator[Similarity]:
    """Yield the place of the part by the pose of one pair of photographs, and points that both models have."""
    if len(model.image) < _FEWEST_MATCHES or not model.is_point.any() or (has_scale and not part.is_point.any()):
        return
    lenses = [side.cameras[int(side.camera[0])] for side in (model, part)]
    one, other = (
        colmap.Camera(model=lens.model, width=lens.width, height=lens.height, params=lens.params) for lens in lenses
    )
    options = colmap.TwoViewGeometryOptions()
    options.ransac.random_seed, options.compute_relative_pose = seed, True
    same = np.repeat(np.arange(len(model.image), dtype=np.uint32)[:, None], 2, axis=1)
    geometry = colmap.estimate_calibrated_two_view_geometry(one, model.xy_px, other, part.xy_px, same, options)
    if geometry.cam2_from_cam1 is None:
        return
    pose = geometry.cam2_from_cam1.matrix()
    cam_from_model = pose[:, :3] @ model.cam_from_model[0]
    base = -cam_from_model.T @ pose[:, 3]  # of length one
    count = len(part.image)
    turned = replace(part, cam_from_model=np.broadcast_to(cam_from_model, (count, 3, 3)))
    turned = replace(turned, center=model.center + base)
    known = model.is_point
    length = _ratio(_depths(model.of(known), turned.of(known)), model.of(known))
    scale = 1.0
    if has_scale:
        own = part.is_point
        scale = _ratio(_depths(turned.of(own), model.of(own)), part.of(own)) / length
    if not (np.isfinite(length) and np.isfinite(scale) and length > 0 and scale > 0):
        return
    model_from_part = Similarity(scale, cam_from_model.T @ part.cam_from_model[0], np.zeros(3))
    yield replace(
        model_from_part, translation=model.center[0] + base / length - model_from_part.apply(part.center[0])
    )


def _depths(one: Side, other: Side) -> FloatArray:
    """Return the distances (M,) along the rays of `one` to where those of `other` pass nearest; NaN: parallel."""
    base, a, b = other.center - one.center, one.ray, other.ray
    cosine, along, beside = (a * b).sum(axis=1), (a * base).sum(axis=1), (b * base).sum(axis=1)
    sine2 = 1 - cosine**2
    return np.asarray((along - cosine * beside) / np.where(sine2 > 1e-9, sine2, np.nan))


def _ratio(distance: FloatArray, side: Side) -> float:
    """Return the median of distances (M,) over those of a side's points; NaN: none is positive."""
    ratio = distance / np.linalg.norm(side.point - side.center, axis=1)
    ratio = ratio[np.isfinite(ratio) & (ratio > 0)]
    return float(np.median(ratio)) if len(ratio) else np.nan

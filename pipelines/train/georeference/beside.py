"""Losses on the georeference beside the measurements: L_rel, and control points through the rendered depth.

Both exist in training alone. L_rel is a function of other measurements, and no measurement itself.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from pipelines.adjust.state import SystematicErrors
from pipelines.adjust.terms import ControlPoints, Fixes
from pipelines.core.errors import InputError
from pipelines.core.types import FloatArray, IntArray
from pipelines.geometry.statistics import root_information
from pipelines.survey.adjustment import GeolocatedPoints
from pipelines.survey.scene import Scene
from pipelines.survey.survey import Survey
from pipelines.train.georeference.unknowns import SolutionUnknowns, TensorSimilarity

# σ of the rendered surface at a mark, as a fraction of its distance: 12 cm at 60 m.
SURFACE_SIGMA = 2e-3
_WORTH = 0.1  # share of the fixes' information on the scale that L_rel may repeat
_PAIRS = 300
# Candidates drawn for each pair in use. The longest are used, because short pairs hardly constrain the scale.
_DRAWN = 3


@dataclass(frozen=True)
class LongPairs:
    """Distances between P pairs of intersected points, or of cameras with fixes: L_rel.

    The distances are functions of the fixes, not independent measurements.

    The points are fixed at their SfM positions. In the bundle, they would follow the corrections of the cameras,
    which keep their mean position, rotation and size (`SolutionUnknowns`). Fixed points are therefore right to
    first order for the scale, the only quantity that the pairs determine.
    """

    distance_in_model: Tensor | None  # (P,) float64; None: between the cameras below
    camera: Tensor | None  # (P, 2) int64 indices into the cameras; None: between fixed points
    distance_in_geo: Tensor  # (P,) float64 metres
    weight: Tensor  # (P,) float64, 1/σ of the measured distance in 1/m
    share: float = 1.0  # limits their information on the scale to a tenth of that of the fixes

    def __len__(self) -> int:
        return len(self.distance_in_geo)

    def residuals(self, at: SolutionUnknowns) -> Tensor:
        """Return s |x_i − x_j| − |X_i − X_j| (P,) in metres."""
        if self.camera is None:
            assert self.distance_in_model is not None
            distance = self.distance_in_model
        else:
            center = at.moved()[1]
            distance = (center[self.camera[:, 0]] - center[self.camera[:, 1]]).norm(dim=1)
        return at.similarity().scale * distance - self.distance_in_geo


def long_pairs(scene: Scene, fixes: Fixes, points: GeolocatedPoints | None, seed: int) -> LongPairs | None:
    """Return 300 long distances across the scene: between located points, else between cameras with fixes.

    Located points are functions of the same few fixes (`adjust.alignment`), and contain the lens's errors as well.
    Counted as independent measurements, hundreds of pairs would claim a σ of the scale many times below that of the
    fixes. Their purpose is to steady the scale, not to decide it. None: their share of the information is zero.

    There are at least two fixes; the seed is that of the pairs. An InputError: points of another model.
    """
    if points is not None and not np.array_equal(points.point_id, scene.sparse.point_id):
        raise InputError(
            "points-of-another-model",
            "The located points belong to another SfM model: run `georef geolocate` again.",
        )
    located = np.zeros(0, dtype=np.int64) if points is None else np.flatnonzero(points.inlier)
    if points is not None and len(located) >= 2:
        in_model, in_geo, cov_in_geo = scene.point_in_model, points.position_in_geo, points.cov_in_geo
        in_model, in_geo, cov_in_geo = in_model[located], in_geo[located], cov_in_geo[located]
        i, j = _longest(in_model, seed)
        pairs, inside = None, torch.from_numpy(np.linalg.norm(in_model[i] - in_model[j], axis=1))
    else:
        in_geo, cov_in_geo = fixes.position_in_geo, fixes.cov
        i, j = _longest(scene.poses.cam_center_in_model[fixes.camera], seed)
        pairs, inside = torch.from_numpy(np.column_stack([fixes.camera[i], fixes.camera[j]])), None
    apart = in_geo[i] - in_geo[j]
    distance = np.linalg.norm(apart, axis=1)
    along = apart / distance[:, None]
    variance = np.einsum("pi,pij,pj->p", along, cov_in_geo[i] + cov_in_geo[j], along)
    distances = LongPairs(inside, pairs, torch.from_numpy(distance), torch.from_numpy(variance**-0.5))
    of_pairs = float((distances.distance_in_geo * distances.weight).square().sum())
    root, place = fixes.root_information, fixes.position_in_geo
    weight = (root**2).sum(axis=(1, 2))
    arm = place - weight @ place / weight.sum()
    of_fixes = float(((root @ arm[:, :, None]) ** 2).sum())  # on ln s, about the weighted mean of the fixes
    share = min(1.0, _WORTH * of_fixes / of_pairs) if of_pairs > 0 else 0.0
    return replace(distances, share=share) if share > 0 else None


def _longest(place: FloatArray, seed: int) -> tuple[IntArray, IntArray]:
    """Return the row numbers (P,), (P,) of pairs of points (n, 3): the longest third of randomly drawn pairs."""
    rng = np.random.default_rng(seed)
    first = rng.integers(0, len(place), _DRAWN * _PAIRS)
    second = (first + rng.integers(1, len(place), len(first))) % len(place)
    length = np.linalg.norm(place[first] - place[second], axis=1)
    longest = np.sort(np.argsort(-length, kind="stable")[:_PAIRS])
    return first[longest], second[longest]


@dataclass(frozen=True)
class DepthMarks:
    """Image marks of the control points, K in all, each projected onto the rendered surface on its own."""

    camera: Tensor  # (K,) int64 indices
    xy: Tensor  # (K, 2) float64, x/z and y/z of the marks' rays
    xy_by_lens: Tensor  # (K, 2, L) float64, derivative of `xy` by the lens parameters
    position_in_geo: Tensor  # (K, 3) float64 metres, surveyed
    root_information: Tensor  # (K, 3, 3) float64 of survey, mark and surface together, in 1/m
    share: Tensor  # (K,) float64, one over the number of marks of the same point
    points: int  # J, of the control points
    views: int  # training views, all rendered equally often
    rows: dict[int, slice]  # slice of the K marks, by camera
    earlier: slice | None = None  # place of the earlier date's error among the systematic errors

    def rays(self, rows: slice, lens: Tensor) -> Tensor:
        """Return the rays x/z and y/z (K', 2) of a slice of the marks, to first order in the lens change (L,)."""
        return self.xy[rows] + self.xy_by_lens[rows] @ lens if len(lens) else self.xy[rows]


def depth_marks(scene: Scene, survey: Survey, marks: ControlPoints, errors: SystematicErrors) -> DepthMarks:
    """Return the marks of the control points for projection onto the rendered surface.

    The surface's error has a σ of `SURFACE_SIGMA` times the distance, along each axis. All marks of a point share
    this error, because they show one piece of the surface. Marks in test views are not rendered.
    """
    order = np.argsort(marks.camera, kind="stable")
    order = order[np.isin(marks.camera[order], scene.train)]
    point, camera, bearing = marks.point[order], marks.camera[order], marks.bearing_in_cam[order]
    center = scene.geo_from_model.apply(scene.poses.cam_center_in_model)[camera]
    distance = np.linalg.norm(marks.position_in_geo[point] - center, axis=1)
    surveyed = {each.name: np.array(each.cov_in_geo) for each in survey.control_points}
    lateral, surface = marks.sigma_rad[order] * distance, SURFACE_SIGMA * distance
    of_survey = np.array([surveyed[name] for name in marks.name])[point]
    of_mark = of_survey + (lateral**2 + surface**2)[:, None, None] * np.eye(3)
    by_lens, z = marks.bearing_by_lens[order], bearing[:, 2:, None]
    count = np.bincount(point, minlength=len(marks))
    seen = [np.searchsorted(camera, [index, index + 1]).tolist() for index in np.unique(camera)]
    return DepthMarks(
        camera=torch.from_numpy(camera),
        xy=torch.from_numpy(bearing[:, :2] / bearing[:, 2:]),
        xy_by_lens=torch.from_numpy(by_lens[:, :2] / z - bearing[:, :2, None] * by_lens[:, 2:] / z**2),
        position_in_geo=torch.from_numpy(marks.position_in_geo[point]),
        root_information=torch.from_numpy(root_information(of_mark)),
        share=torch.from_numpy(1.0 / count[point]),
        points=len(marks),
        views=len(scene.train),
        earlier=errors.columns("earlier-date"),
        rows={int(index): slice(*ends) for index, ends in zip(np.unique(camera), seen, strict=True)},
    )


def depth_residuals(
    pose: tuple[Tensor, Tensor],
    geo_from_model: TensorSimilarity,
    position_in_geo: Tensor,
    xy: Tensor,
    depth_m: Tensor,
) -> Tensor:
    """Return T(c_i + R_iᵀ z (x, y, 1)) − X_j (K, 3) in metres, of the K marks of one camera.

    T is `geo_from_model`; the pose has a rotation cam ← model (3, 3) and a centre (3,). Each mark has the surveyed
    position (K, 3), its ray x/z and y/z (K, 2), and the rendered depth (K,) along the camera's z axis.
    """
    rotation, center = pose
    ray = torch.nn.functional.pad(xy, (0, 1), value=1.0)
    point = center + (depth_m[:, None] * ray) @ rotation
    return geo_from_model.apply(point) - position_in_geo

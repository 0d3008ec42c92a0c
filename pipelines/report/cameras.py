"""Photographs of a survey: adjusted positions with error ellipses, residuals of fixes, overlap; and its lenses."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.sparse import csr_matrix, triu
from scipy.sparse.csgraph import connected_components

from pipelines.adjust.posterior import Posterior
from pipelines.core.products import is_checked
from pipelines.core.types import BoolArray, FloatArray, IntArray, vector3
from pipelines.geometry.cameras import LENGTHS, Camera, parameter_names, parameters_in
from pipelines.geometry.network import Network
from pipelines.report.page import Picture, picture_of_png
from pipelines.report.place import Texts, heads_of, map_coordinates, texts_of
from pipelines.report.plots.charts import correlation_matrix, fix_series, residual_field
from pipelines.report.plots.plans import (
    match_plan,
    movement_plan,
    overlap_plan,
)
from pipelines.report.views import reprojection_residuals
from pipelines.survey.area import overlap_of
from pipelines.survey.headline import NOTHING_CHECKS
from pipelines.survey.solution import FixDifferences, Solution, fix_differences
from pipelines.survey.survey import FixSession, Survey
from pipelines.survey.target_crs import TargetCrs


@dataclass(frozen=True)
class FlightBias:
    """Mean residual of the used fixes, and the scatter about it, by axis (east, north, up) in metres."""

    axis: str
    mean_m: float
    sigma_m: float
    within: tuple[float, float, float]  # shares of the fixes within one, two, three stated σ


@dataclass(frozen=True)
class Outlier:
    """Fix that the solution has left out: name of the photograph, and the length of its residual in metres."""

    name: str
    residual_m: float


@dataclass(frozen=True)
class CameraRow:
    """Row of the table of photographs: coordinates in the CRS; east, north, up in metres; None: not known.

    `use` is `train`, `test`, or `outlier` for a fix that was left out.
    """

    name: str
    use: str
    measured: Texts | None
    adjusted: Texts
    difference_m: tuple[float, float, float] | None
    sigma_m: tuple[float, float, float] | None
    sha256: str


@dataclass(frozen=True)
class CamerasFacts:
    """Positions of the photographs; a picture, factor or σ is None where there is none."""

    photographs: int  # in the survey
    registered: int  # in the SfM model; the others are `unregistered`
    unregistered: tuple[str, ...]
    fixes: int  # registered photographs with a fix
    sessions: tuple[FixSession, ...]  # without repeats, each with the σ of its common error
    map: Picture  # adjusted positions, with arrows and ellipses, magnified
    arrow_factor: float | None
    ellipse_factor: float | None
    no_sigma: str  # why there are no ellipses; empty: there are
    series: Picture | None  # in time if `by_time`; otherwise, in the order of the photographs
    by_time: bool
    bias: tuple[FlightBias, ...]  # of the used fixes; empty without fixes
    outliers: tuple[Outlier, ...]
    largest_fix: tuple[str, float] | None  # largest residual of a used fix along an axis, in its stated σ
    median_sigma_h_m: float | None
    median_sigma_v_m: float | None
    rows: tuple[CameraRow, ...]
    axes: Texts  # names of the coordinates with their units


def cameras_facts(survey: Survey, posterior: Posterior, crs: TargetCrs) -> CamerasFacts:
    """Return what the section on cameras shows: residuals of the fixes, and σ of position and attitude."""
    solution, names = posterior.solution, posterior.sparse.image_name
    checked, fixes, registered = is_checked(solution.cautions), fix_differences(solution, survey), set(names)
    moved = np.full((len(names), 3), np.nan)
    is_outlier: BoolArray = np.zeros(len(names), dtype=bool)
    moved[fixes.camera], is_outlier[fixes.camera] = fixes.difference_in_geo, fixes.is_outlier
    covariance = posterior.camera_cov[:, 3:, 3:] if checked else None
    drawn = movement_plan(
        solution.center_in_geo[:, :2],
        moved[:, :2],
        None if covariance is None else covariance[:, :2, :2],
        is_outlier,
        map_coordinates(crs),
    )
    by_name = {image.name: image.fix for image in survey.images}
    stated = [fix.cov_apart for camera in fixes.camera if (fix := by_name[names[camera]]) is not None]
    # Stated σ (F, 3) along east, north and up, without the error that a session shares.
    stated_m = np.asarray(np.sqrt(np.diagonal(np.array(stated).reshape(-1, 3, 3), axis1=1, axis2=2)))
    series, by_time = _series(survey, names, fixes, stated_m)
    sigma_m = None if covariance is None else np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
    return CamerasFacts(
        photographs=len(survey.images),
        registered=len(names),
        unregistered=tuple(image.name for image in survey.images if image.name not in registered),
        fixes=len(fixes.camera),
        sessions=tuple(dict.fromkeys(survey.sessions)),
        map=picture_of_png(drawn.png),
        arrow_factor=drawn.arrow_factor,
        ellipse_factor=drawn.ellipse_factor,
        no_sigma="" if checked else NOTHING_CHECKS,
        series=series,
        by_time=by_time,
        bias=bias_of(fixes, stated_m),
        outliers=tuple(
            Outlier(names[camera], float(np.linalg.norm(difference)))
            for camera, difference, left_out in zip(
                fixes.camera, fixes.difference_in_geo, fixes.is_outlier, strict=True
            )
            if left_out
        ),
        largest_fix=_largest(fixes, stated_m, names),
        median_sigma_h_m=None if sigma_m is None else float(np.median(np.hypot(sigma_m[:, 0], sigma_m[:, 1]))),
        median_sigma_v_m=None if sigma_m is None else float(np.median(sigma_m[:, 2])),
        rows=_rows(solution, survey, crs, moved, is_outlier, sigma_m=sigma_m),
        axes=heads_of(crs),
    )


def _largest(fixes: FixDifferences, stated_m: FloatArray, names: Sequence[str]) -> tuple[str, float] | None:
    """Return photograph and size of the largest residual of a used fix along an axis, in its stated σ (F, 3)."""
    used = np.flatnonzero(~fixes.is_outlier)
    if not len(used):
        return None
    ratio = (np.abs(fixes.difference_in_geo[used]) / np.maximum(stated_m[used], 1e-12)).max(axis=1)
    return names[fixes.camera[used[ratio.argmax()]]], float(ratio.max())


def bias_of(fixes: FixDifferences, stated_m: FloatArray) -> tuple[FlightBias, ...]:
    """Return mean and scatter of the residuals of the used fixes, and how many are within their stated σ (F, 3).

    The result is empty with fewer than two.
    """
    used, stated = fixes.difference_in_geo[~fixes.is_outlier], stated_m[~fixes.is_outlier]
    if len(used) < 2:
        return ()
    means, scatter = used.mean(axis=0).tolist(), used.std(axis=0, ddof=1).tolist()
    shares = np.stack([(np.abs(used) <= times * stated).mean(axis=0) for times in (1, 2, 3)], axis=1)
    return tuple(
        FlightBias(axis, mean, sigma, vector3(within))
        for axis, mean, sigma, within in zip(("east", "north", "up"), means, scatter, shares, strict=True)
    )


def _series(
    survey: Survey, names: Sequence[str], fixes: FixDifferences, stated_m: FloatArray
) -> tuple[Picture | None, bool]:
    """Return the picture of the residuals in time, and whether the times are known."""
    if not len(fixes.camera):
        return None, False
    by_name = {image.name: image for image in survey.images}
    images = [by_name[names[camera]] for camera in fixes.camera]
    known = [image.timestamp_s for image in images if image.timestamp_s is not None]
    by_time = len(known) == len(images) and len(set(known)) > 1
    abscissa = np.array(known) - min(known) if by_time else 1.0 + np.arange(len(images), dtype=np.float64)
    title = "time since the first photograph in s" if by_time else "photograph, in order of names"
    return picture_of_png(fix_series(abscissa, title, fixes.difference_in_geo, stated_m, fixes.is_outlier)), by_time


def _rows(
    solution: Solution,
    survey: Survey,
    crs: TargetCrs,
    moved: FloatArray,
    is_outlier: BoolArray,
    *,
    sigma_m: FloatArray | None,
) -> tuple[CameraRow, ...]:
    center = solution.center_in_geo
    adjusted = texts_of(crs, center)
    has_fix = np.atleast_1d(np.isfinite(moved).all(axis=1))
    measured = dict(zip(np.flatnonzero(has_fix).tolist(), texts_of(crs, (center - moved)[has_fix]), strict=True))
    sha256 = {image.name: image.sha256 for image in survey.images}
    return tuple(
        CameraRow(
            name=camera.name,
            use="outlier" if is_outlier[index] else camera.split,
            measured=measured.get(index),
            adjusted=adjusted[index],
            difference_m=vector3(moved[index]) if has_fix[index] else None,
            sigma_m=None if sigma_m is None else vector3(sigma_m[index]),
            sha256=sha256.get(camera.name, ""),
        )
        for index, camera in enumerate(solution.cameras)
    )


_REGIONS = 16  # along the longer side of an image
_LEAST_OBSERVATIONS = 10  # of a region that has an arrow
_MOST_LENSES = 8  # that are shown with pictures


@dataclass(frozen=True)
class LensParameter:
    """Parameter of a lens, after COLMAP; `start` before SfM, value and σ after the adjustment; None: not known."""

    name: str
    unit: str
    start: float | None
    value: float
    sigma: float | None


@dataclass(frozen=True)
class LensFacts:
    """Lens of a camera."""

    camera_id: int
    make_model: str  # as recorded in the photographs; may be empty
    camera: Camera
    photographs: int  # registered ones
    observations: int  # of SfM points
    rmse_px: float | None  # length of the residuals; None: no observations
    parameters: tuple[LensParameter, ...]
    correlation: Picture | None  # of the parameters; None: not known
    residuals: Picture | None  # mean by image region; None beyond the first lenses, or without any
    factor: float | None  # magnification of its arrows; None: no arrows


@dataclass(frozen=True)
class LensesFacts:
    """Lenses of a survey, of which the first `drawn` have pictures."""

    rmse_px: float | None  # length of all residuals; None: no observations
    sigma_px: float | None  # of an image coordinate, by the residuals of the SfM model; None: not known
    observations: int
    points: int
    photographs: int
    lenses: tuple[LensFacts, ...]
    drawn: int
    no_sigma: str  # why σ is not known; empty if known


def lenses_facts(survey: Survey, posterior: Posterior, network: Network) -> LensesFacts:
    """Return what the section on lenses shows: parameters with σ and correlations, and residuals over the image."""
    sparse, residual = posterior.sparse, reprojection_residuals(network)
    covariance = posterior.of_lens()
    longest = sparse.lenses.longest
    camera_of = sparse.image_camera_id[sparse.obs_image]
    lenses = []
    for slot, (key, camera) in enumerate(sparse.cameras.items()):
        mine = slice(slot * longest, slot * longest + len(camera.params))
        rows = np.flatnonzero(camera_of == key)
        lenses.append(
            _lens(
                survey,
                key,
                camera,
                photographs=int((sparse.image_camera_id == key).sum()),
                xy_px=sparse.obs_xy_px[rows],
                residual_px=residual[rows],
                covariance=None if covariance is None else covariance[mine, mine],
                drawn=slot < _MOST_LENSES,
            )
        )
    return LensesFacts(
        rmse_px=_rmse(residual),
        sigma_px=posterior.solution.sigma_px,
        observations=len(residual),
        points=len(sparse.point_id),
        photographs=len(sparse.image_name),
        lenses=tuple(lens for lens in lenses if lens.photographs),
        drawn=min(len(lenses), _MOST_LENSES),
        no_sigma="the lens was frozen" if covariance is None else "",
    )


def mean_by_region(
    xy_px: FloatArray, residual_px: FloatArray, size_px: tuple[int, int]
) -> tuple[FloatArray, FloatArray]:
    """Return mean (R, C, 2) and RMS (R, C) of residuals by image region, rows from the top; NaN: too few.

    Residuals (M, 2) that are NaN do not count; `xy_px` (M, 2) are their places in an image of a width and height.
    """
    width, height = size_px
    side = max(width, height) / _REGIONS
    columns, rows = max(1, round(width / side)), max(1, round(height / side))
    good = np.isfinite(residual_px).all(axis=1)
    cell = np.floor(xy_px[good] / [width / columns, height / rows]).astype(np.int64)
    cell = np.clip(cell, 0, [columns - 1, rows - 1])
    index, values = cell[:, 1] * columns + cell[:, 0], residual_px[good]
    count = np.bincount(index, minlength=rows * columns).astype(np.float64)
    count[count < _LEAST_OBSERVATIONS] = np.nan
    mean = np.stack([np.bincount(index, values[:, axis], rows * columns) for axis in (0, 1)], axis=-1)
    square = np.bincount(index, (values**2).sum(axis=1), rows * columns)
    return (mean / count[:, None]).reshape(rows, columns, 2), np.sqrt(square / count).reshape(rows, columns)


def _lens(
    survey: Survey,
    key: int,
    camera: Camera,
    *,
    photographs: int,
    xy_px: FloatArray,
    residual_px: FloatArray,
    covariance: FloatArray | None,
    drawn: bool,
) -> LensFacts:
    prior = next((prior for prior in survey.cameras if prior.camera_id == key), None)
    start = None
    if prior is not None:
        start = parameters_in(prior.camera, camera.model)
    names = parameter_names(camera)
    sigma = None if covariance is None else np.sqrt(np.maximum(np.diag(covariance), 0.0))
    size = (camera.width, camera.height)
    field = factor = None
    if drawn and len(residual_px):
        mean, rms = mean_by_region(xy_px, residual_px, size)
        png, factor = residual_field(size, mean, rms, f"Camera {key}: residuals by image region")
        field = picture_of_png(png)
    correlation = None
    if drawn and covariance is not None and sigma is not None and (sigma > 0).all():
        correlation = picture_of_png(correlation_matrix(names, covariance / np.outer(sigma, sigma)))
    return LensFacts(
        camera_id=key,
        make_model="" if prior is None else prior.make_model,
        camera=camera,
        photographs=photographs,
        observations=len(residual_px),
        rmse_px=_rmse(residual_px),
        parameters=tuple(
            LensParameter(
                name=name,
                unit="px" if name in LENGTHS else "",
                start=None if start is None else float(start[index]),
                value=float(camera.params[index]),
                sigma=None if sigma is None else float(sigma[index]),
            )
            for index, name in enumerate(names)
        ),
        correlation=correlation,
        residuals=field,
        factor=factor,
    )


def _rmse(residual_px: FloatArray) -> float | None:
    good = residual_px[np.isfinite(residual_px).all(axis=1)]
    return float(np.sqrt((good**2).sum(axis=1).mean())) if len(good) else None


ENOUGH_PHOTOGRAPHS = 5
TIED_POINTS = 15  # that two photographs share, as SfM demands of a pair
_MOST_LINKS = 4000  # that are drawn


@dataclass(frozen=True)
class OverlapFacts:
    """Overlap of a survey; the map and its figures are None without a scene."""

    overlap: Picture | None
    cell_m: float | None
    median: float | None  # photographs that see half of the cells or more
    enough_share: float | None  # of the cells, that at least `enough` photographs see
    enough: int
    matches: Picture  # photographs that share points, with the strongest `drawn_links` of `links`
    links: int
    drawn_links: int
    tied_points: int  # that a pair must share to count as tied
    median_tied: float  # photographs that one is tied to; `least_tied` has fewest
    least_tied: str
    least_tied_count: int
    parts: int  # groups of photographs without a common point; 1: all are connected


def overlap_facts(posterior: Posterior, network: Network, scene: FloatArray, crs: TargetCrs) -> OverlapFacts:
    """Return what the section on overlap shows: photographs by cell, pairs of photographs by shared points.

    The network has the image observations; the scene (N, 3) is in `geo`.
    """
    solution, sparse = posterior.solution, posterior.sparse
    center, raster = solution.center_in_geo[:, :2], overlap_of(solution, sparse, scene)
    inside = np.zeros(0) if raster is None else raster.count[raster.count >= 0]
    pairs, shared = links_of(network)
    strongest = np.argsort(-shared, kind="stable")[:_MOST_LINKS]
    tied, parts = ties_of(len(center), pairs, shared)
    least, coordinates = int(tied.argmin()), map_coordinates(crs)
    return OverlapFacts(
        overlap=None
        if raster is None
        else picture_of_png(overlap_plan(raster.count, raster.corner, raster.cell_m, center, coordinates)),
        cell_m=None if raster is None else raster.cell_m,
        median=float(np.median(inside)) if len(inside) else None,
        enough_share=float((inside >= ENOUGH_PHOTOGRAPHS).mean()) if len(inside) else None,
        enough=ENOUGH_PHOTOGRAPHS,
        matches=picture_of_png(match_plan(center, pairs[strongest], shared[strongest], coordinates)),
        links=len(pairs),
        drawn_links=len(strongest),
        tied_points=TIED_POINTS,
        median_tied=float(np.median(tied)),
        least_tied=sparse.image_name[least],
        least_tied_count=int(tied[least]),
        parts=parts,
    )


def links_of(network: Network) -> tuple[IntArray, IntArray]:
    """Return the pairs (P, 2) of photographs that share points, and the number (P,) of points that they share."""
    images, points = len(network.camera_id), len(network.point_in_world)
    seen = csr_matrix(
        (np.ones(len(network.obs_image), dtype=np.int64), (network.obs_image, network.obs_point)), (images, points)
    )
    seen.data[:] = 1  # a point that is observed twice in one photograph counts once
    shared = triu(seen @ seen.T, k=1).tocoo()
    return np.column_stack([shared.row, shared.col]).astype(np.int64), shared.data.astype(np.int64)


def ties_of(images: int, pairs: IntArray, shared: IntArray) -> tuple[IntArray, int]:
    """Return the number (n,) of photographs that each is tied to, and the number of groups without a tie."""
    strong = pairs[shared >= TIED_POINTS]
    tied = np.bincount(strong.ravel(), minlength=images).astype(np.int64)
    graph = csr_matrix((np.ones(len(strong)), (strong[:, 0], strong[:, 1])), (images, images))
    return tied, int(connected_components(graph, directed=False)[0])

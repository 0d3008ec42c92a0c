"""Lenses of a survey: reprojection residuals by image region, parameters with σ, and their correlations."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipelines.core.types import FloatArray
from pipelines.geometry.cameras import LENGTHS, Camera, parameter_names, parameters_in
from pipelines.pages.pictures import Picture, picture_of_png
from pipelines.plots.observations import correlation_matrix, residual_field
from pipelines.report.evaluated import EvaluatedSurvey
from pipelines.scene.survey import CameraPrior, Survey

_REGIONS = 16  # along the longer side of an image
_LEAST_OBSERVATIONS = 10  # of a region that has an arrow
_MOST_LENSES = 8  # that are shown with pictures


@dataclass(frozen=True)
class LensParameter:
    """Parameter of a lens.

    Attributes:
        name: after COLMAP.
        unit: `px`, or empty.
        start: before SfM; None: not known.
        value: after the adjustment.
        sigma: of `value`; None: not known.
    """

    name: str
    unit: str
    start: float | None
    value: float
    sigma: float | None


@dataclass(frozen=True)
class LensFacts:
    """Lens of a camera.

    Attributes:
        camera_id: of the SfM model.
        make_model: as recorded in the photographs; may be empty.
        model: COLMAP's name of the camera model.
        width_px, height_px: of the photographs.
        photographs: number of registered ones.
        observations: number of image observations of SfM points.
        rmse_px: root mean square length of their residuals; None: no observations.
        parameters: in COLMAP's order.
        correlation: picture; None: not known.
        residuals: mean residual by image region; None beyond the first lenses, or without observations.
        factor: magnification of its arrows; None: no arrows.
    """

    camera_id: int
    make_model: str
    model: str
    width_px: int
    height_px: int
    photographs: int
    observations: int
    rmse_px: float | None
    parameters: tuple[LensParameter, ...]
    correlation: Picture | None
    residuals: Picture | None
    factor: float | None


@dataclass(frozen=True)
class LensesFacts:
    """Lenses of a survey.

    Attributes:
        rmse_px: root mean square length of all residuals; None: no observations.
        sigma_px: σ of an image coordinate that follows from the residuals of the SfM model; None: not known.
        observations, points, photographs: numbers.
        lenses: one for each camera.
        drawn: number of lenses with pictures.
        no_sigma: reason why σ is not known; empty if known.
    """

    rmse_px: float | None
    sigma_px: float | None
    observations: int
    points: int
    photographs: int
    lenses: tuple[LensFacts, ...]
    drawn: int
    no_sigma: str


def lenses_facts(evaluated: EvaluatedSurvey) -> LensesFacts:
    """Return the lenses of an evaluated survey, and the residuals of its image observations."""
    sparse, residual = evaluated.solved.sparse, evaluated.residual_px
    covariance = evaluated.posterior.of_lens()
    longest = sparse.lenses.longest
    camera_of = sparse.image_camera_id[sparse.obs_image]
    lenses = []
    for slot, (key, camera) in enumerate(sparse.cameras.items()):
        mine = slice(slot * longest, slot * longest + len(camera.params))
        rows = np.flatnonzero(camera_of == key)
        lenses.append(
            _lens(
                evaluated.solved.survey,
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
        sigma_px=evaluated.solved.model.sigma_px,
        observations=len(residual),
        points=len(sparse.point_id),
        photographs=len(sparse.image_name),
        lenses=tuple(lens for lens in lenses if lens.photographs),
        drawn=min(len(lenses), _MOST_LENSES),
        no_sigma="the lens was held" if covariance is None else "",
    )


def mean_by_region(
    xy_px: FloatArray, residual_px: FloatArray, size_px: tuple[int, int]
) -> tuple[FloatArray, FloatArray]:
    """Return mean (R, C, 2) and RMS (R, C) of residuals by image region, rows from the top; NaN: too few.

    Args:
        xy_px: (M, 2) places in the image.
        residual_px: (M, 2); NaN rows do not count.
        size_px: width and height of the image.
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
    start = None if prior is None else parameters_in(_camera_of(prior), camera.model)
    names = parameter_names(camera)
    sigma = None if covariance is None else np.sqrt(np.maximum(np.diag(covariance), 0.0))
    size = (camera.width, camera.height)
    field = None
    if drawn and len(residual_px):
        mean, rms = mean_by_region(xy_px, residual_px, size)
        field = residual_field(size, mean, rms, f"Camera {key}: residuals by image region")
    correlation = None
    if drawn and covariance is not None and sigma is not None and (sigma > 0).all():
        correlation = picture_of_png(correlation_matrix(names, covariance / np.outer(sigma, sigma)))
    return LensFacts(
        camera_id=key,
        make_model="" if prior is None else prior.make_model,
        model=camera.model,
        width_px=camera.width,
        height_px=camera.height,
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
        residuals=None if field is None else picture_of_png(field.png),
        factor=None if field is None else field.factor,
    )


def _camera_of(prior: CameraPrior) -> Camera:
    return Camera(prior.model, prior.width, prior.height, np.array(prior.params))


def _rmse(residual_px: FloatArray) -> float | None:
    good = residual_px[np.isfinite(residual_px).all(axis=1)]
    return float(np.sqrt((good**2).sum(axis=1).mean())) if len(good) else None

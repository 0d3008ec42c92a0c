"""σ of a click: nobody points better than to about a pixel of the page, and pixels widen with the distance."""

import numpy as np

from pipelines.core.types import FloatArray
from pipelines.surface.picking import SurfaceReader
from pipelines.view.pictures import ViewerCamera, ViewFrame

SIGMA_PX = 0.8  # along both axes of the page: of a hand that is off by a pixel at most, or by one as its own σ
_STEP_PX = 2.0  # to both sides, at which the surface is looked at
_STEEPEST = 6.0  # length on the surface over that across the line of sight, from which it is another surface


def pointing_covariance(
    reader: SurfaceReader, frame: ViewFrame, camera: ViewerCamera, pixel: tuple[float, float]
) -> FloatArray:
    """Return the covariance (3, 3) in m² that a click of `SIGMA_PX` gives a point of the surface.

    The point moves on the surface, as the renders beside the pixel show it. At an edge, beside which lies another
    surface, it moves across the line of sight.
    """
    columns = []
    for axis in np.eye(2):
        ends, across_m = [], 0.0
        for sign in (-1.0, 1.0):
            sight = frame.sight(camera, *(np.array(pixel) + sign * _STEP_PX * axis))
            distance = reader.rendered_distance(sight)
            if distance is not None:
                ends.append(reader.renderer.geo_from_model.apply(sight.at(distance)[None])[0])
                across_m = distance * sight.pixel_rad * reader.renderer.geo_from_model.scale
        if len(ends) < 2 and not across_m:
            return np.zeros((3, 3))
        along = (ends[1] - ends[0]) / (2 * _STEP_PX) if len(ends) == 2 else np.full(3, np.inf)
        if not np.linalg.norm(along) <= _STEEPEST * across_m:
            along = across_m * (camera.rotation.T @ np.append(axis, 0.0))
        columns.append(along)
    turned = np.array(columns).T
    return np.asarray(SIGMA_PX**2 * turned @ turned.T)

"""Mistakes in control points: how their marks were measured, and how their map lies against the fixes."""

from __future__ import annotations

import numpy as np

from pipelines.adjust.hypotheses import fit, mirrored
from pipelines.adjust.observations import control_correspondences, fix_correspondences
from pipelines.adjust.similarity_fit import Correspondences
from pipelines.core.errors import DegenerateGeometryError
from pipelines.core.types import FloatArray
from pipelines.geodesy.vertical import FOOT_M, MOST_GEOID_M
from pipelines.geometry.sparse_model import SparseModel
from pipelines.robust.statistics import typical_sigma
from pipelines.survey.survey import Survey

# A shift of all fixes up to this is everyday work with an autonomous base station.
EVERYDAY_SHIFT_M = 5.0
_LEAST_FEET_M = 50.0
_FEET_PART = 0.05  # of a height, by which cameras are higher than control points
# Size of the photographs in which marks were measured, and the factor of their pixels.
_SCALES = {"1/2": 2.0, "1/3": 3.0, "1/4": 4.0, "2 times": 0.5, "3 times": 1 / 3, "4 times": 0.25}
_MIRRORED_M = 0.3  # scatter about the SfM model, below which control points fit as they are
_LEAST, _SIGMAS, _NEAR_SIGMAS, _LEAST_SCALE = 5, 5.0, 2.0, 0.01
# From x, y and the height of the photograph to the pixels x, y without a mistake.
_AS_STATED = np.eye(2, 3)
_FROM_BELOW = np.array([[1.0, 0.0, 0.0], [0.0, -1.0, 1.0]])
_EXCHANGED = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0]])


def mistake_in_marks(survey: Survey, model: SparseModel) -> str | None:
    """Return the mistake without which the marks of most control points would meet.

    None: more than half of the points meet as they are, or no known mistake explains the others.
    """
    points = survey.control_points
    height_px = {name: model.camera_of(index).height for index, name in enumerate(model.image_name)}

    def meeting(change: FloatArray) -> int:
        """Return how many points meet after a change (2, 3) of x, y, height; a missing image has no height."""
        changed = []
        for point in points:
            marks = []
            for mark in point.marks:
                x_px, y_px = (change @ [mark.x_px, mark.y_px, height_px.get(mark.image, 0)]).tolist()
                marks.append(mark.model_copy(update={"x_px": x_px, "y_px": y_px}))
            changed.append(point.model_copy(update={"marks": tuple(marks)}))
        return len(control_correspondences(survey.model_copy(update={"control_points": tuple(changed)}), model)[0])

    changes = {
        "their y counts from the lower edge of the photograph: count it from the upper one": _FROM_BELOW,
        "their x and y are exchanged": _EXCHANGED,
    }
    for size, scale in _SCALES.items():
        sentence = f"they were measured in photographs of {size} the size: measure in these, or scale the marks"
        changes[sentence] = scale * _AS_STATED
    stated = meeting(_AS_STATED)
    most, sentence = max(((meeting(change), name) for name, change in changes.items()), key=lambda one: one[0])
    explains = most >= max(2, 2 * stated) and most > len(points) / 2
    return f"{sentence}; then {most} of {len(points)} meet" if explains else None


def mistake_in_map(survey: Survey, model: SparseModel) -> str | None:
    """Return the mistake of a map of control points that has another size or other axes than the fixes, or None.

    At least five fixes and five control points are needed: the scatter of fewer shows too little.
    """
    fixes, control = fix_correspondences(survey, model), control_correspondences(survey, model)[0]
    if min(len(fixes), len(control)) < _LEAST:
        return None
    try:
        (by_fixes, fix_m), (by_control, control_m) = (fit(one.in_local, one.in_geo) for one in (fixes, control))
        mirrored_m = fit(control.in_local, mirrored(control.in_geo))[1]
    except DegenerateGeometryError:
        return None
    if control_m > _MIRRORED_M and mirrored_m < control_m / 10.0:
        return "their map is mirrored: east and north are exchanged; check the order of the columns and the CRS"
    ratio = by_control.scale / by_fixes.scale
    sigma = float(np.hypot(_sigma_of_scale(fixes, fix_m), _sigma_of_scale(control, control_m)))
    causes = {
        1.0 / np.cos(np.radians(survey.origin.lat_deg)): "Web Mercator (EPSG:3857) has this scale at this latitude",
        FOOT_M: "the coordinates are in metres, although their CRS has feet",
        1.0 / FOOT_M: "the coordinates are in feet, although their CRS has metres",
    }
    near = min(causes, key=lambda scale: abs(np.log(ratio / scale)))
    is_known = abs(np.log(ratio / near)) < _NEAR_SIGMAS * sigma + _LEAST_SCALE
    # Poor coordinates have any scale: one without a known cause has to be twice as evident.
    if abs(np.log(ratio)) < (_SIGMAS if is_known else 2.0 * _SIGMAS) * sigma + _LEAST_SCALE:
        return None
    cause = causes[near] if is_known else "another unit or map projection"
    return f"their map is {ratio:.4g} times as large as that of the fixes: {cause}"


def _sigma_of_scale(positions: Correspondences, scatter_m: float) -> float:
    """Return the σ of ln(scale): of the scatter, or of errors as large as stated that drift over the flight."""
    size_m = float(np.sqrt(((positions.in_geo - positions.in_geo.mean(axis=0)) ** 2).sum(axis=1).mean()))
    return float(max(scatter_m / len(positions) ** 0.5, typical_sigma(positions.cov_in_geo)) / size_m)


def shift_sentence(shift_m: FloatArray, survey: Survey) -> str:
    """Return the likely cause of a constant shift (3,) between fixes and control points: east, north, up.

    Of which of the two it is, is of no account. The survey has control points.
    """
    height_m = survey.origin.alt_m + np.median([point.position_in_geo[2] for point in survey.control_points])
    horizontal, vertical = float(np.hypot(shift_m[0], shift_m[1])), abs(float(shift_m[2]))
    for sign in (-1.0, 1.0):
        other_m = height_m + sign * float(shift_m[2])
        for high, low, side in ((height_m, other_m, "control points"), (other_m, height_m, "fixes")):
            if vertical > _LEAST_FEET_M and abs(high * FOOT_M - low) < _FEET_PART * abs(low):
                return f"the heights of the {side} are in feet, and taken for metres"
    if horizontal < 0.2 * vertical and 5.0 < vertical < MOST_GEOID_M:
        return (
            f"heights apart by {vertical:.1f} m: one above the ellipsoid, the other above a geoid or the take-off"
        )
    if horizontal < 0.2 * vertical and vertical >= MOST_GEOID_M:
        return "heights above another zero: the take-off, or another unit"
    if horizontal > 100_000.0:
        return "another zone, or exchanged axes"
    if horizontal > 20.0:
        return "another datum, or another realisation of it"
    if horizontal > EVERYDAY_SHIFT_M:
        return (
            "the position of the base station, the datum, or US survey feet taken for international ones (10 m in "
            "5 000 km)"
        )
    return "the position of the base station, the datum, or the antenna offset"

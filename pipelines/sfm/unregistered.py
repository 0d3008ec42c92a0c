"""Reasons why photographs are not in a model: their verified matches, and what of these is in the model.

A photograph is added to a model by points that it shares with it: a match with one photograph of the model counts
only where a second one shows the same point, since two photographs alone leave the distance between two parts open.
"""

from pathlib import Path
from types import ModuleType

import numpy as np

from pipelines.core.products import Remark
from pipelines.geometry.cameras import Reconstruction

_NEEDED = 30  # COLMAP's fewest points by which it adds a photograph
_MOST_LISTED = 10


def unregistered(colmap: ModuleType, database: Path, model: Reconstruction, remedy: str = "") -> tuple[Remark, ...]:
    """Return the warning that says for each photograph of a database why it is not in a model; none if all are.

    `remedy` is that of the warning.
    """
    inside = {image_id: model.images[image_id] for image_id in model.reg_image_ids()}
    with colmap.Database.open(database) as opened:
        names = {image.image_id: image.name for image in opened.read_all_images()}
        lost = sorted(set(names) - set(inside), key=lambda image_id: names[image_id])
        matches: dict[int, dict[int, int]] = {image_id: {} for image_id in lost}
        shared: dict[int, dict[int, int]] = {image_id: {} for image_id in lost}
        for pair, inliers in zip(*opened.read_two_view_geometry_num_inliers(), strict=True):
            first, second = colmap.pair_id_to_image_pair(pair)
            for one, other in ((first, second), (second, first)):
                if one not in matches or not inliers:
                    continue
                matches[one][other] = int(inliers)
                if other in inside:
                    rows = np.asarray(opened.read_two_view_geometry(one, other).inlier_matches)[:, 1]
                    # A model of an earlier round lacks the features that were added to the database after it.
                    points = inside[other].points2D
                    known = rows[rows < len(points)]
                    shared[one][other] = sum(points[int(row)].has_point3D() for row in known)
    if not lost:
        return ()
    reasons = [f"{names[one]}: {_reason(matches[one], shared[one], names)}" for one in lost[:_MOST_LISTED]]
    more = f"; and {len(lost) - _MOST_LISTED} more" if len(lost) > _MOST_LISTED else ""
    many = "photographs are" if len(lost) > 1 else "photograph is"
    sentence = f"{len(lost)} {many} not registered. {'; '.join(reasons)}{more}."
    return (Remark(code="photographs-not-registered", sentence=sentence, remedy=remedy),)


def _reason(matches: dict[int, int], shared: dict[int, int], names: dict[int, str]) -> str:
    if not matches:
        return "no verified matches with any photograph (texture or overlap is too low)"
    if not shared:
        best = max(matches, key=lambda other: matches[other])
        return f"matches only photographs that are not registered either, best {names[best]} ({matches[best]})"
    best = max(shared, key=lambda other: matches[other])
    text = f"{matches[best]} matches with {names[best]}, of which {shared[best]} are points of the model"
    if shared[best] < _NEEDED:
        return f"{text}: {_NEEDED} are needed, so places that it and two photographs of the model show"
    return f"{text}, which do not agree with one place of the camera"

"""Local metric frame of a survey that nothing places on Earth: its level, scale and origin before the adjustment.

Known distances set the scale. Nothing measures the vertical, the heading and the place: they are assumed, and the
adjustment leaves them as they are (`adjust.terms.LocalFrame`).

The vertical, by the first of these that applies:

1. Recorded attitudes, such as a gimbal's.
2. `photographs`: mean upward direction of the photographs.
3. `plane`: the direction that is most nearly square to the plane of the cameras and to the photographs' x axes,
   which are level where no photograph is tilted sideways. The photographs decide which side is up.
"""

from typing import Literal

import numpy as np

from pipelines.adjust.measurements import attitude_prior, intersect_in_local
from pipelines.core.errors import DegenerateGeometryError
from pipelines.core.products import Remark
from pipelines.core.sentences import listed
from pipelines.core.types import FloatArray
from pipelines.geometry.similarity import Similarity
from pipelines.geometry.sparse_model import SparseModel
from pipelines.geometry.statistics import residual_stats
from pipelines.survey.marks import mark_rays
from pipelines.survey.solution import SimilarityEstimate
from pipelines.survey.survey import Survey

Up = Literal["plane", "photographs"]
_LEAST_UP = 0.1  # length of a mean of unit vectors, below which they have no common direction


def local_similarity(survey: Survey, model: SparseModel, up: Up) -> tuple[SimilarityEstimate, Remark]:
    """Return the start of the adjustment in a local metric frame, and what is assumed of that frame.

    Raises:
        DegenerateGeometryError: no known distance has ends that registered photographs determine, or the
            photographs have no upward direction in common.
    """
    scale = _scale(survey, model)
    rotation, source, remedy = _level(survey, model, up)
    center = model.cam_center_in_local.mean(axis=0)
    similarity = Similarity(scale, rotation, -scale * rotation @ center)
    none = residual_stats(np.zeros((0, 3)))
    initial = SimilarityEstimate(
        geo_from_local=similarity.to_record("local", "geo"),
        method="robust",
        correspondences={"gnss": 0, "gcp": 0, "points": 0},
        inliers={"gnss": 0, "gcp": 0, "points": 0},
        residuals={"gnss": none, "gcp": none, "points": none},
        condition_number=1.0,  # the scale is the one quantity that is estimated
        layout="volume",
        attitude_used=False,
    )
    sentence = (
        f"The local frame has the middle of the cameras as its origin, and its vertical is {source} σ of the "
        "result are those of the shape and the scale in this frame."
    )
    return initial, Remark(code="local-frame-level", sentence=sentence, remedy=remedy)


def _scale(survey: Survey, model: SparseModel) -> float:
    """Return metres for a unit of local: the median over the known distances."""
    wanted = [distance for distance in survey.distances if distance.use == "control"]
    rays = mark_rays([end for distance in wanted for end in distance.ends], model)
    marked = rays.marks_of_point >= 2
    point = np.full((len(marked), 3), np.nan)
    point[marked] = intersect_in_local(model, rays.of_points(marked))[0]
    length = np.linalg.norm(point[::2] - point[1::2], axis=1)
    known = np.isfinite(length) & (length > 0)
    if not known.any():
        names = listed([distance.name for distance in wanted])
        raise DegenerateGeometryError(
            "no-scale",
            (
                f"No known distance has two ends that registered photographs determine ({names}), and nothing "
                "else sets the scale."
            ),
            remedy="Mark the ends in more photographs, or give positions or control points to `georef ingest`.",
        )
    measured = np.array([distance.distance_m for distance in wanted])
    return float(np.median(measured[known] / length[known]))


def _level(survey: Survey, model: SparseModel, up: Up) -> tuple[FloatArray, str, str]:
    """Return the rotation (3, 3) geo ← local, where its vertical comes from, and what to type for another."""
    recorded = attitude_prior(survey, model)
    if recorded is not None:
        return recorded.rotation, "that of the recorded attitudes.", ""
    rotation, center = model.rotation_cam_from_local, model.cam_center_in_local
    upward = -(rotation[:, 1] + rotation[:, 2]).mean(axis=0)  # upward in the photographs, and against their views
    remedy = ""
    if up == "photographs":
        vertical, source = (
            -rotation[:, 1].mean(axis=0),
            "assumed to be the mean upward direction of the photographs.",
        )
    else:
        across, away = rotation[:, 0], center - center.mean(axis=0)
        spread = across.T @ across / len(across) + away.T @ away / max(float((away**2).sum()), 1e-300)
        vertical = np.linalg.eigh(spread)[1][:, 0]
        vertical = vertical * np.where(vertical @ upward < 0, -1.0, 1.0)
        source = "assumed to be square to the plane of the cameras."
        remedy = "For a facade, give --up photographs."
    length = float(np.linalg.norm(vertical))
    if length < _LEAST_UP:
        raise DegenerateGeometryError(
            "no-common-up", "The photographs have no upward direction in common. Level the frame by --up plane."
        )
    vertical = vertical / length
    # The heading is arbitrary: x is along the longest extent of the cameras in plan.
    flat = (center - center.mean(axis=0)) @ (np.eye(3) - np.outer(vertical, vertical))
    along = np.linalg.svd(flat, full_matrices=False)[2][0]
    along = along - vertical * (along @ vertical)
    if np.linalg.norm(along) < _LEAST_UP:
        along = np.cross(vertical, np.eye(3)[np.argmin(np.abs(vertical))])
    along = along / np.linalg.norm(along)
    return np.stack([along, np.cross(vertical, along), vertical]), source, remedy

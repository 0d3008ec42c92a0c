"""Positions of a table against those in the photographs' EXIF, image by image, in view of the σ of both.

EXIF is not used where a table is given. But two receivers that disagree by far more than their σ are a
contradiction that nothing later would notice: heights in feet, another zone, exchanged axes, times that are off.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from pipelines.core.cautions import Caution
from pipelines.core.errors import ContradictionError
from pipelines.core.types import FloatArray
from pipelines.geodesy.enu import ecef_from_enu_rotation, lla_from_ecef
from pipelines.geodesy.vertical import FOOT_M, MOST_GEOID_M
from pipelines.ingest.image_poses import ImagePoses
from pipelines.ingest.notes import Notes
from pipelines.ingest.options import IngestOptions
from pipelines.ingest.photo_folder import Photo
from pipelines.ingest.photo_poses import poses_from_tags
from pipelines.robust.statistics import mad_sigma

_SIGMAS, _LEAST_M = 4.0, 1.0
_MOST_CONTRADICTING = 1 / 3
# Another unit shows if heights differ by this many times what σ allow, and that unit leaves this part of a height.
_EVIDENT, _UNIT_PART = 2.0, 0.05
_KILOMETRES_M = 2_000.0


def compare_with_exif(
    poses: ImagePoses, photos: Sequence[Photo], path: Path, options: IngestOptions, notes: Notes
) -> None:
    """Compare the positions of a table with those of EXIF.

    Args:
        poses: by the table.
        photos: the photographs.
        path: of the table.
        options: of `ingest`.
        notes: cautions of what differs.

    Raises:
        ContradictionError: most positions differ beyond the σ of both, and the options do not accept that.
    """
    # Stated σ are those of the table: a track good to centimetres says nothing about the photographs' receiver.
    own_sigma = options.model_copy(update={"sigma_h": None, "sigma_v": None})
    exif = poses_from_tags(photos, own_sigma, Notes())
    both = np.flatnonzero(poses.located & exif.located)
    if not len(both):
        return
    lla = lla_from_ecef(exif.position_in_ecef[both])
    enu_from_ecef = np.swapaxes(ecef_from_enu_rotation(lla), 1, 2)
    apart = np.einsum("nij,nj->ni", enu_from_ecef, poses.position_in_ecef[both] - exif.position_in_ecef[both])
    sigma = np.hypot(poses.sigma_enu_m[both], exif.sigma_enu_m[both])
    in_table = lla_from_ecef(poses.position_in_ecef[both])[:, 2]
    heights = _heights(np.column_stack([in_table, lla[:, 2]]), apart[:, 2], sigma[:, 2], path)
    found = [*_horizontal(apart, sigma, path), *heights]
    for fatal, caution in found:
        if fatal and not options.accept_contradiction:
            raise ContradictionError(
                f"{path}: {caution.sentence}. Correct what is wrong, or go on with --accept-contradiction"
            )
        notes.caution(caution)


def _horizontal(apart: FloatArray, sigma: FloatArray, path: Path) -> list[tuple[bool, Caution]]:
    distance = np.hypot(apart[:, 0], apart[:, 1])
    allowed = np.maximum(_SIGMAS * np.hypot(sigma[:, 0], sigma[:, 1]), _LEAST_M)
    contradicting = distance > allowed
    if contradicting.mean() <= _MOST_CONTRADICTING:
        return []
    typical = float(np.median(distance))
    scatter = float(np.hypot(mad_sigma(apart[:, 0]), mad_sigma(apart[:, 1])))
    if typical > _KILOMETRES_M:
        cause = f"are {typical / 1000:.0f} km from those in EXIF: another CRS or zone, or exchanged axes?"
    elif scatter < 0.2 * typical:
        east, north = np.median(apart[:, :2], axis=0)
        cause = (
            f"are shifted by {east:+.1f} m east and {north:+.1f} m north against EXIF: another datum, or a base "
            "station in a wrong place?"
        )
    else:
        cause = (
            f"differ from those in EXIF by {typical:.1f} m, in changing directions: times that are off, exchanged "
            "axes, or rows of other images?"
        )
    sentence = f"{int(contradicting.sum())} of {len(apart)} positions in {path.name} {cause}"
    return [(True, Caution(code="table-against-exif", sentence=sentence))]


def _heights(
    heights_m: FloatArray, apart_m: FloatArray, sigma_m: FloatArray, path: Path
) -> list[tuple[bool, Caution]]:
    """Compare heights (n, 2) of table and EXIF, which are apart (n,), with the σ (n,) of both."""
    offset, spread = float(np.median(apart_m)), mad_sigma(apart_m)
    allowed = max(_SIGMAS * float(np.median(sigma_m)), _LEAST_M)
    if abs(offset) <= allowed:
        return []
    for factor, cause in (
        (FOOT_M, "in feet, and taken for metres"),
        (1 / FOOT_M, "in metres, and taken for feet"),
    ):
        left = abs(float(np.median(heights_m[:, 0] * factor - heights_m[:, 1])))
        tolerance = max(_UNIT_PART * abs(float(np.median(heights_m[:, 1]))), allowed / _SIGMAS)
        if abs(offset) > _EVIDENT * allowed and left < tolerance:
            sentence = f"the heights in {path.name} are {cause}: those in EXIF are {factor:.4g} times as large"
            return [(True, Caution(code="feet", sentence=sentence))]
    sentence = (
        f"the heights in {path.name} differ from those in EXIF by {offset:+.1f} m (± {spread:.1f} m): one is above "
        "the ellipsoid, the other above a geoid, the take-off or a barometer's zero; see --vertical"
    )
    return [(abs(offset) > MOST_GEOID_M, Caution(code="heights-apart", sentence=sentence))]

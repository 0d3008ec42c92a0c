"""What the tags of photographs hold: what is unusable, corrected or repeated, and what there is but positions."""

from collections.abc import Sequence
from datetime import UTC, datetime

import numpy as np

from pipelines.core.types import FloatArray
from pipelines.ingest.photo_folder import Photo
from pipelines.ingest.remarks import Remarks, shortened

_LEAST = 3
_REPEATED = 0.3  # of the photographs, from which repeats are no hovering
_SAME_DEG = 1e-9


def note_tags(photos: Sequence[Photo], remarks: Remarks) -> None:
    """Note tags that are not used, and those of a wrong form with the way in which they are read."""
    for problem in sorted({problem for photo in photos for problem in photo.tags.problems}):
        with_it = [photo.name for photo in photos if problem in photo.tags.problems]
        remarks.warn_counted("exif-unusable", with_it, f"Tags of images are not used, because {problem}")
    for correction in sorted({correction for photo in photos for correction in photo.tags.corrections}):
        with_it = [photo.name for photo in photos if correction in photo.tags.corrections]
        remarks.warn_counted("tag-corrected", with_it, correction.removesuffix("."))
    remarks.warn_counted(
        "exif-orientation",
        [photo.name for photo in photos if photo.tags.orientation != 1],
        "Images have an EXIF orientation, which is ignored: pixels are read as stored",
    )


def note_repeats(names: Sequence[str], lat_lon_deg: FloatArray, time_s: FloatArray, remarks: Remarks) -> None:
    """Note places (N, 2), NaN where unknown, that photographs of other moments repeat."""
    known = np.flatnonzero(np.isfinite(lat_lon_deg).all(axis=1))
    if len(known) < _LEAST:
        return
    if np.ptp(lat_lon_deg[known], axis=0).max() < _SAME_DEG:
        remarks.caution(
            "one-position-for-all",
            f"All {len(known)} photographs have one position: programs write that of an album, and receivers "
            "without a fix repeat the last. It says nothing about the size or the heading of the survey.",
        )
        return
    if np.isfinite(time_s[known]).all():
        known = known[np.argsort(time_s[known], kind="stable")]
    places, times = lat_lon_deg[known], time_s[known]
    same = np.abs(np.diff(places, axis=0)).max(axis=1) < _SAME_DEG
    same &= ~(np.abs(np.diff(times)) < 0.5)  # two cameras of one moment; an unknown time is another
    if same.sum() >= max(2.0, _REPEATED * len(known)):
        remarks.caution(
            "positions-repeat",
            f"{int(same.sum())} of {len(known)} photographs repeat the position of the one before them: "
            f"{shortened([names[row] for row in known[1:][same]])}. The receiver had no new fix, or the "
            "camera hovered.",
        )


def contents(photos: Sequence[Photo]) -> str:
    """Return a sentence on what the tags of photographs hold beside whole positions; empty if nothing."""
    found = []
    models = sorted({photo.tags.make_model.strip() for photo in photos} - {""})
    if models:
        found.append(f"the camera ({', '.join(models[:3])})")
    flat = sum(photo.tags.gps is not None and photo.tags.gps.alt_m is None for photo in photos)
    if flat:
        found.append(f"latitudes and longitudes without a height of {flat}")
    times = [photo.tags.timestamp_s for photo in photos if photo.tags.timestamp_s is not None]
    if times:
        first, last = (
            datetime.fromtimestamp(time, UTC).strftime("%Y-%m-%d %H:%M:%S") for time in (min(times), max(times))
        )
        found.append(f"times of {len(times)} ({first} to {last})")
    drone = [photo.tags.dji for photo in photos if photo.tags.dji is not None]
    attitudes = sum(bool(tags.gimbal_yaw_pitch_roll_deg or tags.mount_yaw_pitch_roll_deg) for tags in drone)
    if attitudes:
        found.append(f"attitudes of {attitudes}")
    heights = [tags.relative_altitude_m for tags in drone if tags.relative_altitude_m is not None]
    if heights:
        found.append(f"heights above take-off of {len(heights)} ({min(heights):.1f} to {max(heights):.1f} m)")
    absolute = [tags.absolute_altitude_m for tags in drone if tags.absolute_altitude_m is not None]
    if absolute:
        found.append(f"absolute altitudes of {len(absolute)} ({min(absolute):.1f} to {max(absolute):.1f} m)")
    lenses = [photo.tags.lens for photo in photos]
    if focal := sum(bool(lens.focal_mm or lens.focal_35mm_mm) for lens in lenses):
        found.append(f"focal lengths of {focal}")
    problems = sorted({problem for photo in photos for problem in photo.tags.problems})
    reasons = f" Not used: {'; '.join(problems[:3])}." if problems else ""
    if not found:
        return f"Their tags hold no time, camera or attitude either.{reasons}"
    return f"The tags of {len(photos)} photographs hold {', '.join(found)}.{reasons}"

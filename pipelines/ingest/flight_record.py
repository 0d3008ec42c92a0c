"""Everything that a flight left: photographs, their cameras, measured poses, and the navigation by time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from pipelines.core.errors import InputError
from pipelines.ingest.image_poses import ImagePoses
from pipelines.ingest.notes import Notes
from pipelines.ingest.photo_folder import Photo
from pipelines.ingest.recorded_navigation import RecordedNavigation
from pipelines.scene.survey import CameraPrior

LEAST_IMAGES = 3


@dataclass(frozen=True)
class FlightRecord:
    """What was read of a flight.

    Attributes:
        folder: of the photographs.
        photos: the N photographs.
        cameras: before any reconstruction.
        camera_of: id of each photograph's camera, by name.
        poses: measured, of the N photographs.
        navigation: None where it was not recorded by time.
    """

    folder: Path
    photos: list[Photo]
    cameras: tuple[CameraPrior, ...]
    camera_of: dict[str, int]
    poses: ImagePoses
    navigation: RecordedNavigation | None


def require_enough(photos: Sequence[Photo], source: Path, field: str, notes: Notes) -> None:
    """Refuse fewer photographs than a survey needs.

    Raises:
        InputError: fewer than three.
    """
    if len(photos) < LEAST_IMAGES:
        raise too_few(len(photos), source, field, notes)


def too_few(count: int, source: Path, field: str, notes: Notes) -> InputError:
    """Return the error of fewer photographs than a survey needs, with everything that was noted on the way."""
    reasons = "".join(f"; {warning}" for warning in notes.warnings)
    return InputError(f"{count} usable images, a survey needs {LEAST_IMAGES}{reasons}", path=source, field=field)

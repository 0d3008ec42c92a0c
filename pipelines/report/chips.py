"""Image chips: small pieces of the photographs around the marks of surveyed points."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from pipelines.core.errors import InputError
from pipelines.core.photograph_folder import photograph_folder
from pipelines.core.progress import Progress
from pipelines.core.types import ByteArray
from pipelines.formats.image_file import read_bytes, require_unchanged
from pipelines.pages.pictures import Picture, picture_of
from pipelines.report.evaluated import EvaluatedSurvey

_SIDE_SHARE = 1 / 60  # of the longer side of the photographs
_LEAST_SIDE_PX = 48
_SHOWN_PX = 192  # side of a chip in the page

Pixel = tuple[float, float]


@dataclass(frozen=True)
class WantedChip:
    """Mark to be shown.

    Attributes:
        owner: kind and name of the point.
        image: index of the photograph.
        mark: pixel of the mark.
        adjusted: where the measured point projects; None: not measured.
        surveyed: where the surveyed point projects; None: behind the camera.
    """

    owner: tuple[str, str]
    image: int
    mark: Pixel
    adjusted: Pixel | None
    surveyed: Pixel | None


@dataclass(frozen=True)
class Chip:
    """Chip with its symbols, in pixels of the photograph from the chip's upper left corner.

    Attributes:
        image: name of the photograph.
        picture: the piece of the photograph.
        side_px: of the piece, in pixels of the photograph.
        mark, adjusted, surveyed: symbols; None: there is none, or it is outside.
        distance_px: from the mark to the adjusted point; None: not measured.
    """

    image: str
    picture: Picture
    side_px: int
    mark: Pixel
    adjusted: Pixel | None
    surveyed: Pixel | None
    distance_px: float | None


def cut_chips(
    evaluated: EvaluatedSurvey, wanted: Sequence[WantedChip], progress: Progress
) -> tuple[dict[tuple[str, str], tuple[Chip, ...]], int]:
    """Return chips by kind and name of their points, and their side in pixels of the photographs.

    Photographs are decoded one at a time, each once.

    Raises:
        InputError: a photograph cannot be read, or has changed since `ingest`.
    """
    sparse = evaluated.solved.sparse
    longest = max((max(camera.width, camera.height) for camera in sparse.cameras.values()), default=0)
    side = max(_LEAST_SIDE_PX, 2 * round(_SIDE_SHARE * longest / 2))
    by_image: dict[int, list[WantedChip]] = defaultdict(list)
    for chip in wanted:
        by_image[chip.image].append(chip)
    chips: dict[tuple[str, str], list[Chip]] = defaultdict(list)
    with progress.task("image chips", len(by_image)) as task:
        for image, of_image in by_image.items():
            name = sparse.image_name[image]
            photograph = _photograph(evaluated, name)
            for chip in of_image:
                chips[chip.owner].append(_cut(photograph, name, chip, side))
            task.advance()
    return {owner: tuple(mine) for owner, mine in chips.items()}, side


def _photograph(evaluated: EvaluatedSurvey, name: str) -> ByteArray:
    survey = evaluated.solved.survey
    path = photograph_folder(evaluated.workspace, survey.image_dir) / name
    image = survey.image(name)
    data = read_bytes(path)
    require_unchanged(data, "" if image is None else image.sha256, path)
    pixels = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
    if pixels is None:
        raise InputError("does not decode: put the photograph back", path=path)
    return np.asarray(pixels[..., ::-1])


def _cut(photograph: ByteArray, name: str, wanted: WantedChip, side: int) -> Chip:
    """Return the piece around a mark; what lies outside the photograph is black."""
    corner = np.floor(np.array(wanted.mark) - side / 2).astype(int)
    piece = np.zeros((side, side, 3), dtype=np.uint8)
    height, width = photograph.shape[:2]
    low, high = np.clip(corner, 0, [width, height]), np.clip(corner + side, 0, [width, height])
    (x0, y0), (x1, y1) = low - corner, high - corner
    piece[y0:y1, x0:x1] = photograph[low[1] : high[1], low[0] : high[0]]
    shown = cv2.resize(piece, (_SHOWN_PX, _SHOWN_PX), interpolation=cv2.INTER_CUBIC)

    def inside(pixel: Pixel | None) -> Pixel | None:
        if pixel is None:
            return None
        x, y = (np.array(pixel) - corner).tolist()
        return (x, y) if 0 <= x <= side and 0 <= y <= side else None

    x_px, y_px = (np.array(wanted.mark) - corner).tolist()
    distance = None if wanted.adjusted is None else float(np.hypot(*np.subtract(wanted.adjusted, wanted.mark)))
    return Chip(
        image=name,
        picture=picture_of(np.asarray(shown)),
        side_px=side,
        mark=(x_px, y_px),
        adjusted=inside(wanted.adjusted),
        surveyed=inside(wanted.surveyed),
        distance_px=distance,
    )

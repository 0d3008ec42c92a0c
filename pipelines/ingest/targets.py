"""Coded targets on the ground (ArUco, AprilTag), found in the photographs and taken as marks of surveyed points."""

import re
from collections import Counter, defaultdict
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np

from pipelines.core.errors import InputError
from pipelines.core.files import replace_text
from pipelines.core.machine import thread_count
from pipelines.core.progress import Progress
from pipelines.core.types import ByteArray
from pipelines.formats.fiducials import FoundTag, dictionary_named, dictionary_names, find_tags, tag_count
from pipelines.formats.tables import table_text
from pipelines.ingest.flight_record import FlightRecord
from pipelines.ingest.ground_points import GroundFile, GroundPoint
from pipelines.ingest.remarks import Remarks, shortened
from pipelines.survey.photographs import decoded_photograph
from pipelines.survey.survey import Mark

LISTING, SHEET = "targets.csv", "targets.png"
_NUMBER = re.compile(r"(\d+)\s*$")
_OFF_SIGMAS, _OFF_PX = 3.0, 1.0  # from a mark by hand: both must be exceeded for a warning
_CHIP_PX, _TEXT_PX, _ACROSS, _MOST_CHIPS = 96, 26, 12, 600
_COLUMNS = ("point", "image", "x_px", "y_px", "sigma_px", "side_px", "dictionary", "number", "outcome")
_USED = "used"


@dataclass(frozen=True)
class TargetMark:
    """Tag that was found in a photograph, the point that it marks, and what became of it."""

    image: str
    tag: FoundTag
    point: str
    outcome: str
    chip: ByteArray


def numbered_dictionaries(text: Sequence[str]) -> tuple[str, ...]:
    """Return OpenCV's names of dictionaries.

    Raises:
        InputError: there is none of that name.
    """
    found = [dictionary_named(name) for name in text]
    if None in found:
        unknown = text[found.index(None)]
        raise InputError(
            "unknown-dictionary",
            f"{unknown!r} is no dictionary of tags. There are {', '.join(dictionary_names())}.",
            field="--targets",
        )
    return tuple(dict.fromkeys(name for name in found if name))


def mark_targets(
    files: Sequence[GroundFile | None],
    record: FlightRecord,
    names: Sequence[str],
    remarks: Remarks,
    progress: Progress,
) -> tuple[tuple[GroundFile | None, ...], list[TargetMark]]:
    """Return ground points with the marks of the tags that bear their numbers, and all tags that were found.

    The number of a point is the one at the end of its name: tag 7 marks `7`, `GCP07` and `T-7`. A mark by hand in
    the same photograph stays. A tag that a photograph shows twice is a mistake, and marks nothing.

    Raises:
        InputError: an unknown dictionary, or two points with the number of a tag.
    """
    dictionaries = numbered_dictionaries(names)
    points = [point for file in files if file is not None for point in file.points]
    of_number = _points_by_number(points, max(map(tag_count, dictionaries)), remarks)
    by_hand = {(point.name, mark.image): mark for point in points for mark in point.marks}
    found: list[TargetMark] = []
    added: dict[str, list[Mark]] = defaultdict(list)
    off, twice, foreign = [], [], Counter[str]()
    for image, tags in _tags_in(record, dictionaries, progress):
        count = Counter(tag.number for tag, _ in tags)
        for tag, chip in tags:
            point = of_number.get(tag.number)
            outcome = _USED
            if count[tag.number] > 1:
                outcome = "twice in this photograph"
                twice.append(f"{tag.number} in {image}")
            elif point is None:
                outcome = "no point has this number"
                foreign[str(tag.number)] += 1
            elif (mark := by_hand.get((point.name, image))) is not None:
                away_px = float(np.hypot(*(tag.center_px - [mark.x_px, mark.y_px])))
                outcome = f"marked by hand, {away_px:.2f} px away"
                if away_px > max(_OFF_PX, _OFF_SIGMAS * float(np.hypot(tag.sigma_px, mark.sigma_px))):
                    off.append(f"{point.name} in {image} ({away_px:.1f} px)")
            else:
                x_px, y_px = tag.center_px.tolist()
                added[point.name].append(Mark(image=image, x_px=x_px, y_px=y_px, sigma_px=tag.sigma_px))
            found.append(TargetMark(image, tag, point.name if point else "", outcome, chip))
    remarks.warn_counted(
        "target-off-mark", off, "Tags lie elsewhere than the marks by hand, which stay; look at both"
    )
    remarks.warn_counted("target-twice", twice, "Tags are in one photograph more than once and mark nothing")
    remarks.warn_counted(
        "target-of-no-point",
        [f"{number} ({times} times)" for number, times in sorted(foreign.items())],
        "Tags were found whose number ends no point's name",
    )
    if not added:
        remarks.warn(
            "no-target-found", f"No tag of {', '.join(dictionaries)} was found that has the number of a point."
        )
    marked = tuple(
        file
        and replace(
            file, points=tuple(replace(each, marks=(*each.marks, *added[each.name])) for each in file.points)
        )
        for file in files
    )
    return marked, found


def _points_by_number(points: Sequence[GroundPoint], count: int, remarks: Remarks) -> dict[int, GroundPoint]:
    by_number: dict[int, GroundPoint] = {}
    without = []
    for point in points:
        match = _NUMBER.search(point.name)
        if match is None or int(match[1]) >= count:
            without.append(point.name)
            continue
        other = by_number.setdefault(int(match[1]), point)
        if other is not point and other.name != point.name:
            raise InputError(
                "target-number-twice",
                f"{other.name} and {point.name} both end in {int(match[1])}, the number of one tag. Rename one.",
                field="--targets",
            )
    if not by_number:
        raise InputError(
            "no-numbered-point",
            f"No ground point's name ends in the number of a tag, 0 to {count - 1}: {shortened(without)}. Name "
            "each point by its tag, e.g. GCP7, in --gcp or --checkpoints.",
            field="--targets",
        )
    remarks.warn_counted("point-without-tag-number", without, "Points have no number of a tag in their name")
    return by_number


def _tags_in(
    record: FlightRecord, dictionaries: Sequence[str], progress: Progress
) -> list[tuple[str, list[tuple[FoundTag, ByteArray]]]]:
    """Return the tags of each photograph with a picture of each, several photographs at once."""

    def found(name: str, sha256: str) -> list[tuple[FoundTag, ByteArray]]:
        pixels = decoded_photograph(record.folder / name, sha256)
        if pixels is None:
            return []
        grey = np.asarray(cv2.cvtColor(pixels, cv2.COLOR_BGR2GRAY), dtype=np.uint8)
        return [(tag, _chip(pixels, tag)) for tag in find_tags(grey, dictionaries)]

    every = []
    with progress.task("targets", len(record.photos)) as task, ThreadPoolExecutor(thread_count()) as pool:
        work = [(photo.name, pool.submit(found, photo.name, photo.file.sha256)) for photo in record.photos]
        try:
            for name, future in work:
                every.append((name, future.result()))
                task.advance()
        finally:
            pool.shutdown(cancel_futures=True)
    return every


def _chip(pixels: ByteArray, tag: FoundTag) -> ByteArray:
    """Return the surroundings of a tag (96, 96, 3) with a cross at its centre."""
    reach = max(1.2 * float(np.abs(tag.corners_px - tag.center_px).max()), 8.0)
    zoom = _CHIP_PX / 2 / reach
    place = np.array(
        [[zoom, 0, _CHIP_PX / 2 - zoom * tag.center_px[0]], [0, zoom, _CHIP_PX / 2 - zoom * tag.center_px[1]]]
    )
    chip = cv2.warpAffine(pixels, place, (_CHIP_PX, _CHIP_PX), flags=cv2.INTER_AREA)
    cv2.drawMarker(chip, (_CHIP_PX // 2, _CHIP_PX // 2), (0, 60, 255), cv2.MARKER_CROSS, 14, 1)
    return np.asarray(chip, dtype=np.uint8)


def list_targets(found: Sequence[TargetMark], folder: Path) -> None:
    """Write what was found as a table and as one picture of chips, those of a point beside each other."""
    ordered = sorted(found, key=lambda each: (each.point, each.tag.number, each.image))
    rows: list[list[object]] = [list(_COLUMNS)]
    for each in ordered:
        tag = each.tag
        numbers = [f"{value:.3f}" for value in (*tag.center_px, tag.sigma_px)]
        side, kind = f"{tag.side_px:.1f}", (tag.dictionary, tag.number)
        rows.append([each.point, each.image, *numbers, side, *kind, each.outcome])
    folder.mkdir(parents=True, exist_ok=True)
    replace_text(folder / LISTING, table_text(rows))
    shown = ordered[:_MOST_CHIPS]
    if not shown:
        return
    cell = np.full((len(shown), _CHIP_PX + _TEXT_PX, _CHIP_PX + 4, 3), 255, dtype=np.uint8)
    for place, each in zip(cell, shown, strict=True):
        place[:_CHIP_PX, :_CHIP_PX] = each.chip
        colour = (30, 30, 30) if each.outcome == _USED else (0, 0, 200)
        for row, words in enumerate((each.point or f"tag {each.tag.number}", Path(each.image).name[-16:])):
            corner = (1, _CHIP_PX + 11 * (row + 1))
            cv2.putText(place, words, corner, cv2.FONT_HERSHEY_SIMPLEX, 0.33, colour, 1, cv2.LINE_AA)
    cell = np.concatenate([cell, np.full((-len(shown) % _ACROSS, *cell.shape[1:]), 255, dtype=np.uint8)])
    height, width = cell.shape[1:3]
    sheet = cell.reshape(-1, _ACROSS, height, width, 3).transpose(0, 2, 1, 3, 4).reshape(-1, _ACROSS * width, 3)
    (folder / SHEET).write_bytes(cv2.imencode(".png", sheet)[1].tobytes())

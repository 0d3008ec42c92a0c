"""Coded targets: tags in the photographs become marks of the surveyed points that have their numbers.

A point has the number that its name is or ends in: 12, GCP12. A mark by hand always stands.
"""

import os
import re
from collections import Counter, defaultdict
from collections.abc import Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

import cv2
import numpy as np

from pipelines.core.errors import InputError
from pipelines.core.files import replace_texts
from pipelines.core.progress import SILENT, Progress
from pipelines.core.types import ByteArray
from pipelines.formats.fiducials import FoundTag, find_tags, tag_count
from pipelines.formats.image_file import read_bytes
from pipelines.formats.tables import table_text
from pipelines.ingest.remarks import Remarks, shortened
from pipelines.report.page import Page, Picture, Section, limited, picture_of, render_page
from pipelines.survey.survey import Mark

TABLE, PAGE = "targets.csv", "targets.html"
_SAME_PX = 1.0  # tags of two dictionaries at one place are one tag: some dictionaries begin as others
_LEAST_OFF_PX, _FAR_SIGMAS = 1.0, 3.0  # of a tag from a mark by hand
_MOST_CHIPS, _MOST_CHIPS_OF_IMAGE = 400, 40
_CHIP_SHARE, _CHIP_PX = 1.8, 128  # width in sides of the tag, and as stored
_PACKAGE = __name__.rpartition(".")[0]  # its folder `templates` has the section of the page


def numbers_of_points(names: Iterable[str], dictionaries: Sequence[str]) -> dict[int, str]:
    """Return the name of the point of each number that a tag can have; a name without a number has no tag.

    Raises:
        InputError: two points have one number.
    """
    most = max(map(tag_count, dictionaries))
    points: dict[int, str] = {}
    for name in sorted(set(names)):
        digits = re.search(r"[0-9]{1,9}$", name)
        if digits is None or int(digits[0]) >= most:
            continue
        other = points.setdefault(int(digits[0]), name)
        if other != name:
            raise InputError(
                "target-number-ambiguous",
                (f"The tag {int(digits[0])} may be point {other} or point {name}: both names end in its number."),
                field="--targets",
                remedy="Rename one of them.",
            )
    return points


@dataclass(frozen=True)
class SeenTag:
    """Tag in a photograph, with a picture of it, which the first of a photograph have."""

    image: str
    tag: FoundTag
    chip: Picture | None

    def mark(self) -> Mark:
        x_px, y_px = self.tag.center_px.tolist()
        return Mark(image=self.image, x_px=x_px, y_px=y_px, sigma_px=self.tag.sigma_px)


@dataclass
class Targets:
    """Tags of a survey's photographs, and the points whose numbers they have; each is used once at the most.

    Attributes:
        seen: all tags, in the order of the photographs.
        points: names of points by number.
        use: by place in `seen`, what became of a tag: `yes`, or why it is no mark.
        off: marks by hand that tags contradict, for the warning.
    """

    seen: tuple[SeenTag, ...]
    points: Mapping[int, str]
    use: dict[int, str] = field(default_factory=dict)
    off: list[str] = field(default_factory=list)

    def beside(self, name: str, by_hand: tuple[Mark, ...]) -> tuple[Mark, ...]:
        """Return the marks of a point: those made by hand, then those of its tags in all other photographs.

        Raises:
            InputError: tags of two dictionaries have the point's number.
        """
        standing, marks = {mark.image: mark for mark in by_hand}, list(by_hand)
        rows = [row for row, one in enumerate(self.seen) if self.points.get(one.tag.number) == name]
        count = Counter(self.seen[row].image for row in rows)
        kinds: dict[str, str] = {}
        for row in rows:
            one = self.seen[row]
            mine = one.mark()
            if count[one.image] > 1:
                self.use[row] = "twice in the photograph"
            elif one.image in standing:
                self.use[row] = "marked by hand"
                hand = standing[one.image]
                off_px = float(np.hypot(hand.x_px - mine.x_px, hand.y_px - mine.y_px))
                far_px = max(_LEAST_OFF_PX, _FAR_SIGMAS * float(np.hypot(hand.sigma_px, mine.sigma_px)))
                if off_px > far_px:
                    self.off.append(f"{name} in {one.image} ({off_px:.1f} px)")
            else:
                self.use[row] = "yes"
                kinds.setdefault(one.tag.dictionary, one.image)
                marks.append(mine)
        if len(kinds) > 1:
            places = " and ".join(f"{kind} ({image})" for kind, image in kinds.items())
            raise InputError(
                "target-in-two-dictionaries",
                f"Tags of {places} have the number of point {name}.",
                field="--targets",
                remedy="Give --targets the one that was laid out.",
            )
        return tuple(marks)

    def note(self, remarks: Remarks) -> None:
        """Record how many marks are those of tags, and which tags are none."""
        used = [row for row, use in self.use.items() if use == "yes"]
        if not self.seen:
            remarks.warn(
                "no-target-found",
                "No photograph shows a tag of the stated dictionary.",
                "Is --targets another one, or are the tags less than 20 pixels wide?",
            )
        else:
            names = {self.points[self.seen[row].tag.number] for row in used}
            remarks.assume(
                "marks-of-targets",
                f"{len(used)} marks of {len(names)} points are those of tags; σ of each is measured ({TABLE}).",
            )
        remarks.warn_counted(
            "target-not-where-marked", self.off, "Tags lie elsewhere than marks made by hand, which are kept"
        )
        twice = [self._title(row) for row, use in self.use.items() if use.startswith("twice")]
        remarks.warn_counted(
            "target-twice", twice, "Tags that a photograph shows more than once are not used there"
        )
        strange = Counter(one.tag.number for one in self.seen if one.tag.number not in self.points)
        remarks.warn_counted(
            "target-of-no-point",
            [f"{number} in {count} photographs" for number, count in sorted(strange.items())],
            "Numbers of tags that no point has",
        )

    def _title(self, row: int) -> str:
        return f"{self.seen[row].tag.number} in {self.seen[row].image}"

    def write(self, folder: Path) -> None:
        """Write the list of all tags and the page with their pictures into a folder."""
        rows: list[tuple[object, ...]] = [
            ("point", "image", "x_px", "y_px", "sigma_px", "side_px", "dictionary", "number", "used")
        ]
        for row, one in enumerate(self.seen):
            tag = one.tag
            decimal = (f"{value:.3f}" for value in (*tag.center_px, tag.sigma_px, tag.side_px))
            point = self.points.get(tag.number, "")
            rows.append((point, one.image, *decimal, tag.dictionary, tag.number, self.use.get(row, "no point")))
        folder.mkdir(parents=True, exist_ok=True)
        page = render_page(self._page(), _PACKAGE)
        replace_texts({folder / TABLE: table_text(rows), folder / PAGE: page})

    def _page(self) -> Page:
        by_point: dict[str, list[tuple[SeenTag, str]]] = defaultdict(list)
        for row, one in enumerate(self.seen):
            if one.chip is not None:
                by_point[self.points[one.tag.number]].append((one, self.use.get(row, "no point")))
        each = max(1, _MOST_CHIPS // max(1, len(by_point)))
        chips = [(name, *chip) for name, mine in sorted(by_point.items()) for chip in mine[:each]][:_MOST_CHIPS]
        about = {
            "tags": f"{len(self.seen)}, of which {sum(use == 'yes' for use in self.use.values())} are marks",
            "points": f"{len(by_point)} with tags: {shortened(sorted(by_point))}" if by_point else "none with tags",
        }
        facts = {"chips": chips, "count": len(self.seen), "table": TABLE}
        return Page("Targets", "Tags in the photographs", about, [Section("tags", "Tags", "targets.html", facts)])


def find_targets(
    folder: Path,
    images: Sequence[str],
    dictionaries: Sequence[str],
    points: Mapping[int, str],
    progress: Progress = SILENT,
) -> Targets:
    """Return the tags of some dictionaries in the photographs of a folder; one that does not decode shows none."""
    look = partial(_tags_in, folder=folder, dictionaries=dictionaries, points=points)
    seen: list[SeenTag] = []
    with progress.task("targets", len(images)) as task, ThreadPoolExecutor(min(4, os.cpu_count() or 1)) as pool:
        for seen_in_image in pool.map(look, images):
            seen += seen_in_image
            task.advance()
    return Targets(tuple(seen), points)


def _tags_in(image: str, folder: Path, dictionaries: Sequence[str], points: Mapping[int, str]) -> list[SeenTag]:
    flags = cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION
    pixels = cv2.imdecode(np.frombuffer(read_bytes(folder / image), np.uint8), flags)
    if pixels is None:
        return []
    grey = np.asarray(pixels, dtype=np.uint8)
    kept: list[FoundTag] = []
    for tag in find_tags(grey, dictionaries):
        same = (one.number == tag.number and np.abs(one.center_px - tag.center_px).max() < _SAME_PX for one in kept)
        if not any(same):
            kept.append(tag)
    seen = []
    for index, tag in enumerate(kept):
        has_chip = index < _MOST_CHIPS_OF_IMAGE and tag.number in points
        seen.append(SeenTag(image, tag, _chip(grey, tag) if has_chip else None))
    return seen


def _chip(grey: ByteArray, tag: FoundTag) -> Picture:
    """Return a square cut of a photograph with a tag's centre in its middle; grey beyond the rim."""
    half = int(np.ceil(_CHIP_SHARE / 2 * np.ptp(tag.corners_px, axis=0).max()))
    x, y = np.floor(tag.center_px).astype(int)
    square = np.full((2 * half, 2 * half), 127, dtype=np.uint8)
    top, left = max(0, y - half), max(0, x - half)
    part = grey[top : y + half, left : x + half]
    row, column = top - (y - half), left - (x - half)
    square[row : row + part.shape[0], column : column + part.shape[1]] = part
    return picture_of(limited(np.repeat(square[..., None], 3, axis=2), _CHIP_PX))

"""ArUco and AprilTag targets: their patterns, and tags found in a photograph (the sole home of cv2.aruco).

A tag is a black square with a pattern of black and white modules inside, and a white margin around. Its corners
begin at the top left of the pattern and go clockwise. Places are pixels, the centre of the top-left pixel
(0.5, 0.5).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any

import cv2
import numpy as np

from pipelines.core.types import ByteArray, FloatArray
from pipelines.geometry.statistics import NORMAL_MAD

LEAST_SIDE_PX = 12.0  # of a tag that is looked for: a module of the smallest dictionary has two pixels then
# A side leaves out its ends, where the other sides blur it.
_END_SHARE = 0.12
_LEAST_PROFILES, _MOST_PROFILES = 6, 80  # grey values along normals of a side
_REACH_MODULES, _LEAST_REACH_PX, _MOST_REACH_PX = 0.8, 1.5, 6.0  # half length of a profile
_LEAST_MODULE_PX = 1.5  # as seen obliquely: in smaller modules a side is drawn towards the pattern within
_STEP_PX = 0.25  # between its grey values
_ROUNDS = 3  # of the refinement: profiles follow the sides that were found
_LEAST_CONTRAST = 15.0  # of a profile, of 255 grey values
_NOISE_SHARE = 0.1  # of the steepest rise of a profile, below which a rise is noise
_LEAST_SHARE = 0.7  # of a side's profiles that show its edge: the others are hidden, or in a shadow's edge
_LEAST_LIKENESS = 0.8  # correlation of a tag's modules with its pattern
_FAR_SIGMAS = 3.0  # of an edge's place from its side, beyond which it is left out
_LEAST_SIGMA_PX = 0.02  # grey values are interpolated between pixels: no edge is known better
# Neighbouring profiles are a pixel apart and share grey values: this many count as one.
_PROFILES_OF_ONE = 2.0
# A lens that bends the sides displaces the middle along the radius three times as much as it bends lines across it.
_BEND_FACTOR = 3.0


@dataclass(frozen=True)
class FoundTag:
    """Tag in a photograph; `sigma_px` is the σ of its centre along each axis.

    The centre (2,) is where the diagonals of its corners (4, 2) meet, which is the image of the tag's middle.
    """

    dictionary: str
    number: int
    center_px: FloatArray
    corners_px: FloatArray
    sigma_px: float

    @property
    def side_px(self) -> float:
        """Length of the shortest side."""
        return float(_side_lengths(self.corners_px).min())


def _dictionaries() -> dict[str, str]:
    """Return OpenCV's names of dictionaries by their capitals; some stand there in two spellings."""
    names = sorted(name for name in dir(cv2.aruco) if name.startswith("DICT_"))
    return {name.upper(): name for name in names}


def dictionary_named(text: str) -> str | None:
    """Return the name of a dictionary in OpenCV's spelling, whatever the case of the text; None: there is none."""
    return _dictionaries().get(text.upper())


def dictionary_names() -> tuple[str, ...]:
    """Return the names of all dictionaries."""
    return tuple(_dictionaries().values())


@cache
def _dictionary(name: str) -> Any:
    return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, name))


def tag_count(dictionary: str) -> int:
    """Return how many tags a dictionary has; their numbers begin with 0."""
    return len(_dictionary(dictionary).bytesList)


@cache
def tag_modules(dictionary: str, number: int) -> ByteArray:
    """Return the modules (n, n) of a tag with its black border, 1 for white; the first row is at the top."""
    table = _dictionary(dictionary)
    side = table.markerSize + 2
    return np.asarray(cv2.aruco.generateImageMarker(table, number, side) > 127, dtype=np.uint8)


def find_tags(grey: ByteArray, dictionaries: Sequence[str]) -> list[FoundTag]:
    """Return the tags of some dictionaries in a photograph (H, W); those whose sides show no clear edge are not.

    OpenCV finds and decodes them. Their corners are then refined: each side is a line through the places where the
    grey values along its normals rise, by least squares; corners are where lines meet. σ of the centre follows from
    the scatter of these places about their lines, and from the bend of the sides, which is the lens's.
    """
    # OpenCV's defaults overlook tags that are small in a large photograph.
    parameters = cv2.aruco.DetectorParameters()
    parameters.minMarkerPerimeterRate = 4 * LEAST_SIDE_PX / max(grey.shape)
    parameters.perspectiveRemovePixelPerCell = 8
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_CONTOUR
    tags = []
    for name in dictionaries:
        detector = cv2.aruco.ArucoDetector(_dictionary(name), parameters)
        corners, numbers, _ = detector.detectMarkers(grey)
        modules = _dictionary(name).markerSize + 2
        for number, rough in zip([] if numbers is None else numbers.ravel().tolist(), corners, strict=True):
            # OpenCV counts from the centre of the first pixel.
            sides = _refined(grey, rough.reshape(4, 2).astype(np.float64) + 0.5, modules)
            if sides is None or not _shows(grey, _corners(sides.lines), tag_modules(name, int(number))):
                continue
            middle, sigma = _center_with_sigma(sides)
            tags.append(FoundTag(name, int(number), middle, _corners(sides.lines), sigma))
    return tags


def _shows(grey: ByteArray, corners: FloatArray, modules: ByteArray) -> bool:
    """Return whether the square of corners (4, 2) shows modules (n, n): it may be hidden, or another one."""
    count = len(modules)
    square = np.array([[0, 0], [count, 0], [count, count], [0, count]], dtype=np.float32)
    # cv2 counts from the centre of the first pixel, and so does the grid, whose pixels are modules.
    matrix = cv2.getPerspectiveTransform(square - np.float32(0.5), (corners - 0.5).astype(np.float32))
    seen = cv2.warpPerspective(grey, matrix, (count, count), flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP)
    return bool(np.corrcoef(seen.ravel().astype(np.float64), modules.ravel())[0, 1] >= _LEAST_LIKENESS)


@dataclass(frozen=True)
class _Sides:
    """Sides of a tag: side k leads from corner k to the next.

    Attributes:
        lines: (4, 3) unit normal n and distance d: n · p = d.
        cov: (4, 2, 2) covariance of each line's displacement along its normal in its middle, and of its turn.
        middles: (4, 2) of the sides.
        bend_px: how far the middles of opposite sides lie to the same side of lines through their ends, beyond
            their noise: as far as the lens, and not the tag, has bent them.
    """

    lines: FloatArray
    cov: FloatArray
    middles: FloatArray
    bend_px: float


def _refined(grey: ByteArray, corners: FloatArray, modules: int) -> _Sides | None:
    """Return the sides of a tag near its corners (4, 2); None where a side has no clear edge."""
    for _ in range(_ROUNDS):
        fitted = [_side(grey, np.roll(corners, -k, axis=0), modules) for k in range(4)]
        if any(side is None for side in fitted):
            return None
        lines, cov, bows = (np.array(part) for part in zip(*(side for side in fitted if side), strict=True))
        moved = _corners(lines)
        # A refined tag is the tag that was decoded: its corners stay within a module.
        if not np.isfinite(moved).all() or np.abs(moved - corners).max() > _side_lengths(corners).max() / modules:
            return None
        middles, corners = (corners + np.roll(corners, -1, axis=0)) / 2, moved
    outward = bows[:, :1] * lines[:, :2]
    common = (outward[:2] + outward[2:]) / 2
    return _Sides(lines, cov, middles, float(np.sqrt(max(0.0, float((common**2).sum() - bows[:, 1].sum() / 4)))))


def _side_lengths(corners: FloatArray) -> FloatArray:
    return np.asarray(np.linalg.norm(corners - np.roll(corners, -1, axis=0), axis=1))


def _side(
    grey: ByteArray, corners: FloatArray, modules: int
) -> tuple[FloatArray, FloatArray, tuple[float, float]] | None:
    """Return the line (3,) of the first side of corners (4, 2), its covariance (2, 2), and its bow.

    The covariance is that of displacement and turn. The bow is how far its middle lies outward of a line through
    its ends, with its variance.
    """
    start, end = corners[:2]
    length = float(np.linalg.norm(end - start))
    along = (end - start) / length
    normal = np.array([along[1], -along[0]])  # outward: corners go clockwise, and y goes down
    count = int(np.clip(length * (1 - 2 * _END_SHARE), _LEAST_PROFILES, _MOST_PROFILES))
    along_side = np.linspace(_END_SHARE - 0.5, 0.5 - _END_SHARE, count) * length
    depth = float(normal @ (start + end - corners[2] - corners[3])) / 2 / modules  # of a module, inward
    if depth < _LEAST_MODULE_PX:
        return None
    reach = float(np.clip(_REACH_MODULES * depth, _LEAST_REACH_PX, _MOST_REACH_PX))
    offset = np.arange(-reach, reach + _STEP_PX / 2, _STEP_PX)
    middle = (start + end) / 2
    pixel = middle + along_side[:, None, None] * along + offset[:, None] * normal - 0.5
    if (pixel < 0).any() or (pixel > np.array(grey.shape[::-1]) - 1).any():
        return None
    maps = pixel.astype(np.float32)
    # Of a large photograph only the part around the side: cv2's maps have 16 bits.
    corner = np.floor(maps.min(axis=(0, 1))).astype(int)
    last = np.ceil(maps.max(axis=(0, 1))).astype(int) + 1
    part = grey[corner[1] : last[1], corner[0] : last[0]].astype(np.float32)
    maps = (pixel - corner).astype(np.float32)
    profile = cv2.remap(part, maps[..., 0], maps[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    rise = np.diff(profile.astype(np.float64), axis=1)
    rise = np.maximum(rise - _NOISE_SHARE * rise.max(axis=1, keepdims=True), 0.0)
    least = max(_LEAST_PROFILES - 1, _LEAST_SHARE * count)  # of profiles that must show the edge
    clear = rise.sum(axis=1) >= _LEAST_CONTRAST
    if clear.sum() < least:
        return None
    along_side = along_side[clear]
    edge = rise[clear] @ (offset[:-1] + _STEP_PX / 2) / rise[clear].sum(axis=1)
    used = np.ones(len(edge), dtype=bool)
    for _ in range(3):
        design = np.stack([np.ones(used.sum()), along_side[used]], axis=1)
        (shift, slope), *_ = np.linalg.lstsq(design, edge[used], rcond=None)
        residual = edge - shift - slope * along_side
        scatter = max(NORMAL_MAD * float(np.median(np.abs(residual[used]))), _LEAST_SIGMA_PX)
        used = np.abs(residual) <= _FAR_SIGMAS * scatter
        if used.sum() < least:
            return None
    variance = max(float(residual[used] @ residual[used]) / (used.sum() - 2), _LEAST_SIGMA_PX**2) * _PROFILES_OF_ONE
    design = np.stack([np.ones(used.sum()), along_side[used]], axis=1)
    cov = variance * np.linalg.inv(design.T @ design)
    curved = np.column_stack([design, along_side[used] ** 2 * (4 / length**2)])
    bow = -float(np.linalg.lstsq(curved, edge[used], rcond=None)[0][2])
    bow_variance = variance * float(np.linalg.inv(curved.T @ curved)[2, 2])
    turned = normal - slope * along
    turned /= np.linalg.norm(turned)
    line = np.array([*turned, turned @ (middle + shift * normal)])
    return line, cov, (bow, bow_variance)


def _corners(lines: FloatArray) -> FloatArray:
    """Return where each side's line (4, 3) meets that of the side before (4, 2); not finite: nowhere."""
    signed = lines * [1, 1, -1]
    at = np.cross(signed, np.roll(signed, 1, axis=0))
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(at[:, :2] / at[:, 2:])


def _center(lines: FloatArray) -> FloatArray:
    """Return where the diagonals of the corners meet (2,)."""
    corners = np.column_stack([_corners(lines), np.ones(4)])
    at = np.cross(np.cross(corners[0], corners[2]), np.cross(corners[1], corners[3]))
    return np.asarray(at[:2] / at[2])


def _center_with_sigma(sides: _Sides) -> tuple[FloatArray, float]:
    """Return the centre (2,) and its σ along each axis: from the covariance of the sides, and their bend."""
    center, step, cov = _center(sides.lines), 1e-4, np.zeros((2, 2))
    for k in range(4):
        normal = sides.lines[k, :2]
        tangent = np.array([-normal[1], normal[0]])
        shifted, turned = sides.lines.copy(), sides.lines.copy()
        shifted[k, 2] += step
        turned[k, :2] = normal - step * tangent
        turned[k, 2] = turned[k, :2] @ sides.middles[k] + (sides.lines[k, 2] - normal @ sides.middles[k])
        jacobian = np.stack([(_center(lines) - center) / step for lines in (shifted, turned)], axis=1)
        cov += jacobian @ sides.cov[k] @ jacobian.T
    bend_px = _BEND_FACTOR * sides.bend_px
    return center, float(np.sqrt(np.trace(cov) / 2 + bend_px**2))

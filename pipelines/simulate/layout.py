"""Layout of a town: a complex on its square, streets around it, buildings between them, gardens, trees, cars.

The ground is painted in metres of the town's axes.
"""

from dataclasses import dataclass
from itertools import product
from typing import Literal

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from pipelines.core.types import ByteArray, FloatArray
from pipelines.simulate.mesh import Color
from pipelines.simulate.textures import GroundPlan, Pyramid

Roof = Literal["flat", "gable", "hip"]
REACH_M = 128.0  # half side of the painted ground
SQUARE_M = 38.0  # half side of the central square
RING_M = 44.0  # middle of the street around it
OUTER_M = 101.0  # middle of the outer street
GRASS, PAVING, ASPHALT = (255, 0, 0), (0, 255, 0), (0, 0, 255)  # kinds of ground
KERB: Color = (0.36, 0.35, 0.33)
_PIXEL_M = 0.125
_SUBPIXEL = 4  # binary digits of OpenCV's coordinates after the point
_TAR: Color = (0.085, 0.085, 0.09)
_LINE: Color = (0.72, 0.72, 0.70)


class GroundPainter:
    """Paints colour and kind of the ground together, in metres of the town's axes."""

    def __init__(self) -> None:
        side = round(2 * REACH_M / _PIXEL_M)
        self.color = np.zeros((side, side, 3), dtype=np.uint8)
        self.kind = np.zeros((side, side, 3), dtype=np.uint8)
        self.built = np.zeros((side, side), dtype=np.uint8)

    def polygon(self, corners: ArrayLike, color: Color, kind: tuple[int, int, int] | None) -> None:
        """Fill a polygon (N, 2); without `kind`, the kind of the ground below the paint stays."""
        pixels = _pixels(corners)
        tone = tuple(float(255 * c**0.5) for c in color)
        cv2.fillPoly(self.color, [pixels], tone, cv2.LINE_AA, _SUBPIXEL)
        if kind is not None:
            cv2.fillPoly(self.kind, [pixels], kind, cv2.LINE_AA, _SUBPIXEL)

    def box(
        self, low: tuple[float, float], high: tuple[float, float], color: Color, kind: tuple[int, int, int] | None
    ) -> None:
        self.polygon(_rectangle(low, high), color, kind)

    def is_free(self, x: float, y: float, margin_m: float) -> bool:
        """Return whether the ground within `margin_m` is not built on."""
        r = round(margin_m / _PIXEL_M)
        j, i = round((x + REACH_M) / _PIXEL_M), round((y + REACH_M) / _PIXEL_M)
        return not self.built[max(i - r, 0) : i + r + 1, max(j - r, 0) : j + r + 1].any()

    def kind_at(self, x: float, y: float) -> ByteArray:
        """Return the kind (3,) of the ground: shares of grass, paving and asphalt, 0 … 255."""
        side = self.kind.shape[0] - 1
        j, i = (min(max(round((c + REACH_M) / _PIXEL_M), 0), side) for c in (x, y))
        return np.asarray(self.kind[i, j])

    def ground_plan(self) -> GroundPlan:
        """Return the plan, darker at the foot of walls, where less sky is visible."""
        near = cv2.GaussianBlur(self.built, (0, 0), 1.1 / _PIXEL_M).astype(np.float32) / 255
        shaded = self.color * (1 - 0.35 * near)[..., None]
        return GroundPlan(Pyramid(shaded.astype(np.uint8), _PIXEL_M), Pyramid(self.kind, _PIXEL_M), REACH_M)


def _pixels(corners: ArrayLike) -> NDArray[np.int32]:
    scaled = (np.asarray(corners, dtype=np.float64) + REACH_M) / _PIXEL_M - 0.5
    return np.asarray(np.round(scaled * 2**_SUBPIXEL).astype(np.int32))


def _rectangle(low: tuple[float, float], high: tuple[float, float]) -> list[tuple[float, float]]:
    (x0, y0), (x1, y1) = low, high
    return [(x0, y0), (x1, y0), (x1, y1), (x0, y1)]


def paint_meadows(painter: GroundPainter, rng: np.random.Generator) -> None:
    """Paint patches of grass and earth of some metres, everywhere."""
    for _ in range(260):
        middle, size = rng.uniform(-REACH_M, REACH_M, 2), rng.uniform(1.5, 7)
        angles = np.sort(rng.uniform(0, 2 * np.pi, 9))
        reach = size * rng.uniform(0.5, 1.0, 9)
        outline = middle + reach[:, None] * np.stack([np.cos(angles), np.sin(angles)], axis=1)
        base = np.array([(0.16, 0.20, 0.07), (0.08, 0.13, 0.04), (0.24, 0.20, 0.12)][rng.integers(3)])
        painter.polygon(outline, tuple(base * rng.uniform(0.8, 1.2)), GRASS)


def paint_streets(painter: GroundPainter, rng: np.random.Generator) -> None:
    """Paint two square rings of streets and those that join them, with kerbs, wear and markings."""
    end = OUTER_M + 3.5
    for walk, color, kind in ((2.2, KERB, PAVING), (0.0, _TAR, ASPHALT)):
        for middle in (RING_M, OUTER_M):
            outer, half = middle + 3.5 + walk, 3.5 + walk
            for side in (-middle, middle):
                painter.box((side - half, -outer), (side + half, outer), color, kind)
                painter.box((-outer, side - half), (outer, side + half), color, kind)
        for a, b in ((RING_M, end), (-end, -RING_M)):
            painter.box((a, -3.5 - walk), (b, 3.5 + walk), color, kind)
            painter.box((-3.5 - walk, a), (3.5 + walk, b), color, kind)
    _paint_wear(painter, rng)
    for middle in (RING_M, OUTER_M):
        for start in np.arange(-middle + 6, middle - 6, 6.0):
            for side in (-middle, middle):
                painter.box((side - 0.12, start), (side + 0.12, start + 3.0), _LINE, None)
                painter.box((start, side - 0.12), (start + 3.0, side + 0.12), _LINE, None)
    for bar in np.arange(-3.0, 3.1, 1.2):
        for sign in (-1, 1):
            near, far = sorted((sign * (RING_M + 6.5), sign * (RING_M + 9.5)))
            painter.box((near, bar - 0.3), (far, bar + 0.3), _LINE, None)
            painter.box((bar - 0.3, near), (bar + 0.3, far), _LINE, None)


def _paint_wear(painter: GroundPainter, rng: np.random.Generator) -> None:
    """Paint repairs and manhole covers on the streets."""
    for _ in range(1400):
        x, y = rng.uniform(-OUTER_M - 3, OUTER_M + 3, 2)
        if painter.kind_at(x, y)[2] < 200:
            continue
        tone = float(rng.uniform(0.045, 0.16))
        if rng.random() < 0.3:
            angle = np.linspace(0, 2 * np.pi, 13)[:-1]
            outline = np.array([x, y]) + 0.38 * np.stack([np.cos(angle), np.sin(angle)], axis=1)
            painter.polygon(outline, (0.04, 0.04, 0.04), None)
        else:
            length, width = rng.uniform(0.5, 4.0), rng.uniform(0.4, 1.6)
            painter.box((x, y), (x + length, y + width), (tone, tone, tone), None)


def paint_square(painter: GroundPainter, rng: np.random.Generator) -> None:
    """Paint the paved square in the middle, with slabs of different tones."""
    half = SQUARE_M
    painter.box((-half, -half), (half, half), (0.40, 0.36, 0.30), PAVING)
    for x in np.arange(-half, half, 4.0):
        for y in np.arange(-half, half, 4.0):
            if rng.random() < 0.45:
                tone = rng.uniform(0.20, 0.5)
                color = (tone, tone * rng.uniform(0.75, 0.95), tone * rng.uniform(0.55, 0.85))
                painter.box((x + 0.1, y + 0.1), (x + 3.9, y + 3.9), color, None)
    for _ in range(14):
        x, y = rng.uniform(-half + 3, half - 9, 2)
        length, width = rng.uniform(3, 7, 2)
        painter.box((x - 0.3, y - 0.3), (x + length + 0.3, y + width + 0.3), (0.5, 0.48, 0.45), PAVING)
        painter.box((x, y), (x + length, y + width), (0.12, 0.2, 0.05), GRASS)
        for _ in range(12):
            flower = rng.uniform([x, y], [x + length - 0.5, y + width - 0.5])
            color = [(0.55, 0.07, 0.08), (0.6, 0.45, 0.05), (0.5, 0.2, 0.5), (0.7, 0.7, 0.65)][rng.integers(4)]
            painter.box(tuple(flower), tuple(flower + 0.45), color, None)


def paint_yard(painter: GroundPainter, x: float, y: float, rng: np.random.Generator) -> None:
    """Paint a plot without a building: a car park or a playing field."""
    if rng.random() < 0.6:
        painter.box((x - 9, y - 9), (x + 9, y + 9), (0.12, 0.12, 0.12), ASPHALT)
        for bay in np.arange(-8.0, 8.1, 2.6):
            for low, high in ((-8.5, -3.5), (3.5, 8.5)):
                painter.box((x + bay - 0.07, y + low), (x + bay + 0.07, y + high), _LINE, None)
        return
    painter.box((x - 9, y - 7), (x + 9, y + 7), (0.30, 0.12, 0.07), ASPHALT)
    for inset in (0.8, 3.0):
        painter.box((x - 9 + inset, y - 7 + inset), (x + 9 - inset, y - 6.85 + inset), _LINE, None)
        painter.box((x - 9 + inset, y + 6.85 - inset), (x + 9 - inset, y + 7 - inset), _LINE, None)
    painter.box((x - 0.08, y - 6.2), (x + 0.08, y + 6.2), _LINE, None)


@dataclass(frozen=True)
class TownStyle:
    """Properties by which towns differ."""

    relief_m: float  # variation of the terrain in the town
    storeys: tuple[int, int]  # fewest and most of a building with a flat roof
    flat_share: float  # of the buildings
    tower_storeys: int
    trees: int
    built_share: float  # of the plots


STYLES = {
    "city": TownStyle(3.0, (2, 7), 0.6, 8, 170, 0.86),
    "village": TownStyle(6.0, (1, 2), 0.12, 4, 260, 0.62),
}


@dataclass(frozen=True)
class BuildingPlan:
    """Plan of a building: centre (2,) and size in the town's axes; `turned` if its length runs north."""

    center: tuple[float, float]
    length_m: float
    width_m: float
    storeys: int
    floor_m: float
    roof: Roof
    turned: bool = False


@dataclass(frozen=True)
class TownLayout:
    """Places of buildings, trees (x, y, height) and cars (x, y, whether north) in the town's axes."""

    plan: GroundPlan
    buildings: list[BuildingPlan]
    trees: list[tuple[float, float, float]]
    cars: list[tuple[float, float, bool]]


def make_town_layout(style: TownStyle, rng: np.random.Generator) -> TownLayout:
    """Return where the town has houses, trees and cars, and its painted ground, drawn from the generator."""
    painter = GroundPainter()
    painter.box((-REACH_M, -REACH_M), (REACH_M, REACH_M), (0.11, 0.17, 0.05), GRASS)
    paint_meadows(painter, rng)
    paint_streets(painter, rng)
    paint_square(painter, rng)
    buildings = [*_complex(style), *_town_buildings(style, painter, rng)]
    for building in buildings:
        size = (building.length_m, building.width_m)
        half = np.array(size[::-1] if building.turned else size) / 2
        low, high = np.array(building.center) - half, np.array(building.center) + half
        painter.box(tuple(low - 1.0), tuple(high + 1.0), KERB, PAVING)
        floor = _pixels(_rectangle(tuple(low), tuple(high)))
        cv2.fillPoly(painter.built, [floor], 255, cv2.LINE_8, _SUBPIXEL)
    cars = _park(rng)
    trees = _plant(style, painter, rng)
    return TownLayout(painter.ground_plan(), buildings, trees, cars)


def _complex(style: TownStyle) -> list[BuildingPlan]:
    """Return the complex in the middle: a hall, a tower, and wings of other heights."""
    tower = style.tower_storeys
    roof: Roof = "flat" if style.flat_share > 0.5 else "hip"
    return [
        BuildingPlan((0.0, -2.0), 30.0, 16.0, max(2, tower // 3), 3.6, "flat"),
        BuildingPlan((-8.5, 10.9), 11.0, 10.0, tower, 3.2, roof),
        BuildingPlan((9.0, 11.8), 16.0, 12.0, max(2, tower // 2), 3.3, "gable"),
        BuildingPlan((11.0, -13.85), 12.0, 8.0, max(2, tower // 2 + 1), 3.2, "flat"),
    ]


def _town_buildings(style: TownStyle, painter: GroundPainter, rng: np.random.Generator) -> list[BuildingPlan]:
    """Return buildings on the plots between the streets, and scattered outside the town; paint empty plots."""
    buildings = []
    line = (-85.5, -63.0, -40.0, -18.0, 18.0, 40.0, 63.0, 85.5)
    for x, y in product(line, line):
        if max(abs(x), abs(y)) < 60:
            continue
        if rng.random() > style.built_share:
            paint_yard(painter, x, y, rng)
        else:
            buildings.append(_building_plan(style, x, y, rng))
    for _ in range(40):
        angle, distance = rng.uniform(0, 2 * np.pi), rng.uniform(152, 230)
        buildings.append(_building_plan(style, distance * np.cos(angle), distance * np.sin(angle), rng))
    return buildings


def _building_plan(style: TownStyle, x: float, y: float, rng: np.random.Generator) -> BuildingPlan:
    flat = rng.random() < style.flat_share
    return BuildingPlan(
        (x + rng.uniform(-1.5, 1.5), y + rng.uniform(-1.5, 1.5)),
        float(rng.uniform(12, 17)),
        float(rng.uniform(8.5, 13)),
        int(rng.integers(style.storeys[0], style.storeys[1] + 1)) if flat else int(rng.integers(1, 4)),
        float(rng.uniform(2.9, 3.5)),
        "flat" if flat else ("gable" if rng.random() < 0.6 else "hip"),
        bool(rng.random() < 0.5),
    )


def _park(rng: np.random.Generator) -> list[tuple[float, float, bool]]:
    """Return cars at the kerbs of the streets: (x, y, whether the car points north)."""
    cars: list[tuple[float, float, bool]] = []
    for middle in (RING_M, OUTER_M):
        for along in np.arange(-middle + 9, middle - 9, 6.2):
            for side in (-middle, middle):
                for north in (True, False):
                    if rng.random() < 0.3 and abs(along) > 7:
                        across = side + float(rng.choice([-2.4, 2.4]))
                        cars.append((across, along, True) if north else (along, across, False))
    return cars


def _plant(style: TownStyle, painter: GroundPainter, rng: np.random.Generator) -> list[tuple[float, float, float]]:
    """Return trees on free grass: (x, y, height)."""
    trees: list[tuple[float, float, float]] = []
    placed: FloatArray = np.zeros((0, 2))
    for x, y in rng.uniform(-185, 185, (12 * style.trees, 2)):
        inside = max(abs(x), abs(y)) < REACH_M
        # The square stays open for flights along the facades of the complex.
        open_square = max(abs(x), abs(y)) < SQUARE_M + 6
        blocked = inside and (painter.kind_at(x, y)[0] < 200 or not painter.is_free(x, y, 3.5))
        if blocked or open_square or (len(placed) and np.linalg.norm(placed - [x, y], axis=1).min() < 4.0):
            continue
        placed = np.concatenate([placed, [[x, y]]])
        trees.append((x, y, float(rng.uniform(5, 10.5))))
        if len(trees) == style.trees:
            break
    return trees

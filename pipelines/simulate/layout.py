"""Layout of a town: a complex on its square, streets around it, buildings between them, gardens, trees, cars."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from pipelines.core.types import FloatArray
from pipelines.simulate.buildings import Roof
from pipelines.simulate.ground_paint import (
    GRASS,
    KERB,
    OUTER_M,
    PAVING,
    REACH_M,
    RING_M,
    SQUARE_M,
    GroundPainter,
    paint_meadows,
    paint_square,
    paint_streets,
    paint_yard,
)
from pipelines.simulate.textures import GroundPlan


@dataclass(frozen=True)
class TownStyle:
    """Properties by which towns differ.

    Attributes:
        relief_m: variation of the terrain in the town.
        storeys: fewest and most storeys of a building.
        flat_share: share of flat roofs.
        tower_storeys: storeys of the tower in the middle.
        trees: number of trees.
        built_share: share of the plots that are built on.
    """

    relief_m: float
    storeys: tuple[int, int]
    flat_share: float
    tower_storeys: int
    trees: int
    built_share: float


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


@dataclass
class TownLayout:
    """Places of buildings, trees (x, y, height) and cars (x, y, whether north) in the town's axes."""

    plan: GroundPlan
    buildings: list[BuildingPlan] = field(default_factory=list)
    trees: list[tuple[float, float, float]] = field(default_factory=list)
    cars: list[tuple[float, float, bool]] = field(default_factory=list)


def make_town_layout(style: TownStyle, rng: np.random.Generator) -> TownLayout:
    """Return the layout of a town, with its ground painted."""
    painter = GroundPainter()
    painter.box((-REACH_M, -REACH_M), (REACH_M, REACH_M), (0.11, 0.17, 0.05), GRASS)
    paint_meadows(painter, rng)
    paint_streets(painter, rng)
    paint_square(painter, rng)
    buildings = [*_complex(style), *_town_buildings(style, painter, rng)]
    for building in buildings:
        half = (
            np.array(
                [building.width_m, building.length_m] if building.turned else [building.length_m, building.width_m]
            )
            / 2
        )
        low, high = np.array(building.center) - half, np.array(building.center) + half
        painter.box(tuple(low - 1.0), tuple(high + 1.0), KERB, PAVING)
        painter.occupy(tuple(low), tuple(high))
    cars = _park(painter, rng)
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
    for x in line:
        for y in line:
            if max(abs(x), abs(y)) < 60:
                continue
            free = rng.random() > style.built_share
            if free:
                paint_yard(painter, x, y, rng)
                continue
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


def _park(painter: GroundPainter, rng: np.random.Generator) -> list[tuple[float, float, bool]]:
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

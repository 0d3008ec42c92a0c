"""Simulated town: buildings, trees and cars as triangles, painted ground, sun, and sites of targets."""

from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from pipelines.core.types import FloatArray, IntArray
from pipelines.formats.fiducials import tag_modules
from pipelines.simulate.layout import STYLES, BuildingPlan, Roof, TownLayout, make_town_layout
from pipelines.simulate.mesh import (
    Color,
    Material,
    Mesh,
    MeshBuilder,
    Mound,
    Terrain,
    TextureParameters,
    add_terrain,
    make_terrain,
)
from pipelines.simulate.options import EpochOptions, TargetKind
from pipelines.simulate.textures import TAG_DICTIONARIES, GroundPlan

SiteKind = Literal["ground", "roof", "wall"]
_TARGET_LIFT_M = 0.03
_FOOT_M = 2.5  # walls continue below the ground, which is not level

PLASTERS: tuple[Color, ...] = (
    (0.62, 0.55, 0.42), (0.70, 0.66, 0.58), (0.55, 0.36, 0.24), (0.48, 0.50, 0.46), (0.60, 0.44, 0.30),
    (0.36, 0.42, 0.47),
)  # fmt: skip
STONES: tuple[Color, ...] = ((0.42, 0.20, 0.13), (0.50, 0.40, 0.28), (0.36, 0.31, 0.26), (0.47, 0.26, 0.17))
TILES: tuple[Color, ...] = ((0.36, 0.13, 0.07), (0.28, 0.12, 0.08), (0.17, 0.15, 0.15), (0.42, 0.20, 0.11))
SHEETS: tuple[Color, ...] = ((0.24, 0.23, 0.22), (0.36, 0.34, 0.30), (0.17, 0.18, 0.19))
FRAMES: tuple[Color, ...] = ((0.75, 0.74, 0.70), (0.20, 0.14, 0.09), (0.12, 0.16, 0.14), (0.55, 0.52, 0.48))
CARS: tuple[Color, ...] = (
    (0.60, 0.60, 0.62), (0.04, 0.04, 0.05), (0.45, 0.05, 0.04), (0.06, 0.11, 0.32), (0.20, 0.21, 0.22),
    (0.70, 0.70, 0.66),
)  # fmt: skip
CROWNS: tuple[Color, ...] = ((0.09, 0.16, 0.04), (0.13, 0.19, 0.05), (0.06, 0.12, 0.04), (0.19, 0.20, 0.06))


@dataclass(frozen=True)
class TargetSite:
    """Place for a survey target: position (3,) and outward unit normal (3,) in geo."""

    position: FloatArray
    normal: FloatArray
    kind: SiteKind

    @property
    def target_position(self) -> FloatArray:
        """Centre (3,) of the target's face: its board stands a little off the surface behind it."""
        return self.position + _TARGET_LIFT_M * self.normal


@dataclass(frozen=True)
class Building:
    """Rectangular building with one roof.

    Its centre (3,) in geo is at ground level, the rows of its axes (3, 3) are along, across, up.
    """

    center: FloatArray
    axes: FloatArray
    length_m: float
    width_m: float
    storeys: int
    floor_m: float
    roof: Roof

    @property
    def height_m(self) -> float:
        return self.storeys * self.floor_m + 0.3

    def at(self, x: float, y: float, z: float) -> FloatArray:
        """Return the geo position (3,) of a place in the building's own axes."""
        return self.center + np.array([x, y, z]) @ self.axes

    def rectangle(self, half_l: float, half_w: float, z: float) -> list[FloatArray]:
        """Return the corners, counter-clockwise from above, of a level rectangle about the building's middle."""
        return [self.at(x * half_l, y * half_w, z) for x, y in ((-1, -1), (1, -1), (1, 1), (-1, 1))]


@dataclass(frozen=True)
class SceneChange:
    """Change of the town since the first flight: its kind, and its outline (K, 2) in geo."""

    kind: str
    outline: FloatArray


@dataclass(frozen=True)
class SimulatedScene:
    """Town to photograph."""

    mesh: Mesh  # metres in geo
    plan: GroundPlan
    axes: FloatArray  # (3, 3) rows: the town's east, north and up in geo
    sun: FloatArray  # (3,) unit vector towards the sun
    sites: tuple[TargetSite, ...]  # places where a survey target can be fixed
    complex_m: tuple[float, float]  # half lengths along the axes of the complex in the middle
    buildings: tuple[Building, ...]  # those of the complex first
    changes: tuple[SceneChange, ...] = ()  # since the first flight


# Places of the changes in the town's axes, on the square around the complex, and their sizes.
_EXCAVATION_M, _HEAP_M = ((-28.0, 4.0), 8.0), ((28.0, 4.0), 7.0)
_NEW = BuildingPlan((-8.0, -29.0), 12.0, 8.0, 2, 2.9, "flat")
_DEMOLISHED = 3  # index in `SimulatedScene.buildings`, of the complex
_GROWN = 1.15
_OUTLINE = 48  # corners of a round outline
_TURNED_RAD, _SUN_ELEVATION_RAD = 1.9, 0.65  # of the sun of other light


_FIRST = EpochOptions()


def build_scene(name: str, seed: np.random.SeedSequence, options: EpochOptions = _FIRST) -> SimulatedScene:
    """Build a town of one of the `STYLES`, as it is in the epoch of the options.

    The random numbers of all that stays are the same in both epochs.
    """
    changed = options.changed
    style = STYLES[name]
    rng = np.random.default_rng(seed)
    turn = rng.uniform(0.15, 0.45)
    axes = np.array([[np.cos(turn), np.sin(turn), 0.0], [-np.sin(turn), np.cos(turn), 0.0], [0.0, 0.0, 1.0]])
    terrain = make_terrain(style.relief_m, rng)
    changes: list[SceneChange] = []
    for kind, (middle, radius_m), sign in (("excavation", _EXCAVATION_M, -1), ("heap", _HEAP_M, 1)):
        if kind in changed:
            mound = Mound((np.array([*middle, 0.0]) @ axes)[:2], radius_m, sign * options.change_height)
            terrain = replace(terrain, mounds=(*terrain.mounds, mound))
            angle = np.linspace(0, 2 * np.pi, _OUTLINE, endpoint=False)
            circle = mound.middle + radius_m * np.stack([np.cos(angle), np.sin(angle)], axis=1)
            changes.append(SceneChange(kind, circle))
    layout = make_town_layout(style, rng)
    builder = MeshBuilder()
    add_terrain(builder, terrain, axes, TextureParameters((0.1, 0.15, 0.05)))
    places = rng.uniform(-95, 95, (260, 2))
    positions = np.concatenate([places, terrain.height(places)[:, None]], axis=1)
    on_ground = zip(positions, terrain.normal(places), strict=True)
    sites = [TargetSite(position, normal, "ground") for position, normal in on_ground]
    buildings = tuple(_building(plan, terrain, axes) for plan in layout.buildings)
    gone = slice(0, 0)
    for number, building in enumerate(buildings):
        first = builder.count
        sites += _add_building(builder, building, rng)
        if number == _DEMOLISHED and "demolished" in changed:
            gone = slice(first, builder.count)
            changes.append(SceneChange("demolished", _outline(building)))
    _add_furniture(builder, layout, terrain, axes, rng, growth=_GROWN if "growth" in changed else 1.0)
    azimuth, elevation = rng.uniform(2.2, 4.1), np.radians(rng.uniform(42, 56))
    if options.epoch == "2" and options.light == "other":
        azimuth, elevation = azimuth - np.copysign(_TURNED_RAD, azimuth - np.pi), _SUN_ELEVATION_RAD
    if "new" in changed:
        building = _building(_NEW, terrain, axes)
        _add_building(builder, building, rng)
        buildings = (*buildings, building)
        changes.append(SceneChange("new", _outline(building)))
    sun = np.array([np.sin(azimuth) * np.cos(elevation), np.cos(azimuth) * np.cos(elevation), np.sin(elevation)])
    mesh = _mesh_without(builder.build(), gone)
    return SimulatedScene(mesh, layout.plan, axes, sun, tuple(sites), (17.5, 18.5), buildings, tuple(changes))


def _outline(building: Building) -> FloatArray:
    return np.array(building.rectangle(building.length_m / 2, building.width_m / 2, 0.0))[:, :2]


def _mesh_without(mesh: Mesh, gone: slice) -> Mesh:
    kept = np.ones(len(mesh.corners), dtype=bool)
    kept[gone] = False
    return Mesh(
        **{name: values if name == "texture_params" else values[kept] for name, values in vars(mesh).items()}
    )


def target_axes(scene: SimulatedScene, site: TargetSite) -> tuple[FloatArray, FloatArray]:
    """Return the directions (3,) right and up on the face of a target, in geo."""
    side = np.array([0.0, 0.0, 1.0]) if site.kind == "wall" else scene.axes[1]
    u_axis = np.cross(side, site.normal)
    u_axis /= np.linalg.norm(u_axis)
    return u_axis, np.cross(site.normal, u_axis)


def target_corners(scene: SimulatedScene, site: TargetSite, width_m: float) -> FloatArray:
    """Return the corners (4, 3) of a square on the face of a target, clockwise from the upper left one."""
    axes = np.stack(target_axes(scene, site))
    return site.target_position + width_m / 2 * np.array([[-1, 1], [1, 1], [1, -1], [-1, -1]]) @ axes


def with_targets(
    scene: SimulatedScene, sites: list[TargetSite], width_m: float, kind: TargetKind, number: IntArray
) -> SimulatedScene:
    """Return the scene with a target of `width_m` at every site, quarters or a tag of a number (P,) on a board."""
    if not sites:
        return scene
    builder = MeshBuilder()
    is_tag = kind != "quarters"
    style = int(kind == "apriltag")
    quarters = builder.add_texture(TextureParameters((0.5, 0.5, 0.5), pitch_m=width_m))
    modules = len(tag_modules(TAG_DICTIONARIES[style], 0))
    board_m = width_m * (modules + 2) / modules if is_tag else width_m  # a module of white around
    for site, its_number in zip(sites, number.tolist(), strict=True):
        texture = quarters
        if is_tag:
            parameters = TextureParameters((0.5, 0.5, 0.5), style=style, pitch_m=width_m, shift_m=(its_number, 0.0))
            texture = builder.add_texture(parameters)
        material, frame = Material.TAG if is_tag else Material.TARGET, target_axes(scene, site)
        d, c, b, a = target_corners(scene, site, board_m)
        builder.triangles(np.array([[a, b, c], [a, c, d]]), material, texture, (site.target_position, *frame))
    return replace(scene, mesh=joined(scene.mesh, builder.build()))


def joined(first: Mesh, second: Mesh) -> Mesh:
    """Return two meshes as one: the second follows the first, with its textures renumbered."""
    shifted = replace(second, texture=second.texture + np.int32(len(first.texture_params)))
    names = vars(first)
    return Mesh(**{name: np.concatenate([getattr(first, name), getattr(shifted, name)]) for name in names})


def _on_ground(xy: tuple[float, float], terrain: Terrain, axes: FloatArray) -> FloatArray:
    place = np.array([*xy, 0.0]) @ axes
    place[2] = terrain.height(place[:2])
    return place


def _building(plan: BuildingPlan, terrain: Terrain, axes: FloatArray) -> Building:
    turned_axes = np.stack([axes[1], -axes[0], axes[2]]) if plan.turned else axes
    center = _on_ground(plan.center, terrain, axes)
    return Building(center, turned_axes, plan.length_m, plan.width_m, plan.storeys, plan.floor_m, plan.roof)


def _add_furniture(
    builder: MeshBuilder,
    layout: TownLayout,
    terrain: Terrain,
    axes: FloatArray,
    rng: np.random.Generator,
    *,
    growth: float,
) -> None:
    for x, y, height in layout.trees:
        _add_tree(builder, _on_ground((x, y), terrain, axes), growth * height, rng)
    for x, y, north in layout.cars:
        foot = _on_ground((x, y), terrain, axes)
        up = terrain.normal(foot[None, :2])[0]
        along = axes[1] if north else axes[0]
        along = along - (along @ up) * up
        along /= np.linalg.norm(along)
        _add_car(builder, foot, np.stack([along, np.cross(up, along), up]), rng)


def _varied(rng: np.random.Generator, colors: tuple[Color, ...]) -> Color:
    chosen = np.array(colors[rng.integers(len(colors))])
    varied = np.clip(chosen * rng.uniform(0.85, 1.15) * rng.uniform(0.93, 1.07, 3), 0.02, 0.9)
    return (float(varied[0]), float(varied[1]), float(varied[2]))


def _add_shifted(builder: MeshBuilder, texture: TextureParameters, rng: np.random.Generator) -> int:
    shift_m = (float(rng.uniform(0, 400)), float(rng.uniform(0, 400)))
    return builder.add_texture(replace(texture, shift_m=shift_m))


def _add_building(builder: MeshBuilder, building: Building, rng: np.random.Generator) -> list[TargetSite]:
    style = int(rng.integers(3))
    wall = TextureParameters(
        base=_varied(rng, STONES if style == 1 else PLASTERS),
        accent=_varied(rng, FRAMES),
        style=style,
        floor_m=building.floor_m,
        pitch_m=float(rng.uniform(2.3, 3.6)),
        window_m=(float(rng.uniform(0.9, 1.7)), float(rng.uniform(1.2, 1.7))),
        sill_m=float(rng.uniform(0.7, 1.0)),
        top_m=building.storeys * building.floor_m,
        shop=bool(rng.random() < 0.35),
    )
    sites = _add_walls(builder, building, wall, rng)
    if building.roof == "flat":
        return sites + _add_flat_roof(builder, building, rng)
    _add_pitched_roof(builder, building, wall, rng)
    return sites


def _add_walls(
    builder: MeshBuilder, building: Building, wall: TextureParameters, rng: np.random.Generator
) -> list[TargetSite]:
    top = building.height_m + (0.8 if building.roof == "flat" else 0.0)
    ring = building.rectangle(building.length_m / 2, building.width_m / 2, 0.0)
    sites = []
    for start, end in pairwise([*ring, ring[0]]):
        length = float(np.linalg.norm(end - start))
        along = (end - start) / length
        up = np.array([0.0, 0.0, 1.0])
        count = max(1, round(length / wall.pitch_m))
        texture = _add_shifted(builder, replace(wall, pitch_m=length / count), rng)
        a, b, c, d = start - _FOOT_M * up, end - _FOOT_M * up, end + top * up, start + top * up
        builder.triangles(np.array([[a, b, c], [a, c, d]]), Material.WALL, texture, (start, along, up))
        normal = np.cross(along, up)
        for share in np.arange(1.2, length - 1.0, 1.9):
            height = float(rng.uniform(1.5, max(1.6, building.height_m - 1.0)))
            sites.append(TargetSite(start + along * share + up * height, normal, "wall"))
    return sites


def _add_flat_roof(builder: MeshBuilder, building: Building, rng: np.random.Generator) -> list[TargetSite]:
    half_l, half_w, top = building.length_m / 2, building.width_m / 2, building.height_m
    sheet = _add_shifted(builder, TextureParameters(_varied(rng, SHEETS), _varied(rng, SHEETS)), rng)
    builder.quad(building.rectangle(half_l, half_w, top), Material.FLAT_ROOF, sheet)
    metal = _add_shifted(builder, TextureParameters((0.45, 0.46, 0.47)), rng)
    free = [(x, y) for x in (-0.6, 0.0, 0.6) for y in (-0.5, 0.5)]
    rng.shuffle(free)
    for x, y in free[: int(rng.integers(1, 4))]:
        size = rng.uniform([1.2, 1.0, 0.8], [3.4, 2.4, 2.2])
        builder.box(building.at(x * half_l, y * half_w, top), size, building.axes, Material.PLAIN, metal)
    if rng.random() < 0.5 and half_l > 5:
        _add_solar(builder, building, free[4], rng)
        return [_roof_site(building, free[3]), _roof_site(building, free[5])]
    return [_roof_site(building, place) for place in free[3:]]


def _roof_site(building: Building, place: tuple[float, float]) -> TargetSite:
    position = building.at(place[0] * building.length_m / 2, place[1] * building.width_m / 2, building.height_m)
    return TargetSite(position, np.array([0.0, 0.0, 1.0]), "roof")


def _add_solar(
    builder: MeshBuilder, building: Building, place: tuple[float, float], rng: np.random.Generator
) -> None:
    x, y, top = place[0] * building.length_m / 2, place[1] * building.width_m / 2, building.height_m
    texture = _add_shifted(builder, TextureParameters((0.02, 0.03, 0.07)), rng)
    reach = min(2.5, building.length_m / 8)
    sides = [(-reach, -0.8, 0.2), (reach, -0.8, 0.2), (reach, 0.8, 0.9), (-reach, 0.8, 0.9)]
    builder.quad([building.at(x + dx, y + dy, top + dz) for dx, dy, dz in sides], Material.SOLAR, texture)


def _add_pitched_roof(
    builder: MeshBuilder, building: Building, wall: TextureParameters, rng: np.random.Generator
) -> None:
    half_l, half_w, top, over = building.length_m / 2, building.width_m / 2, building.height_m, 0.45
    slope = float(rng.uniform(0.55, 0.95))
    ridge, eave = top + half_w * slope, top - over * slope
    back = half_w if building.roof == "hip" else -over
    tile = _add_shifted(builder, TextureParameters(_varied(rng, TILES)), rng)
    ends = [building.at(-half_l + back, 0.0, ridge), building.at(half_l - back, 0.0, ridge)]
    corners = building.rectangle(half_l + over, half_w + over, eave)
    builder.quad([corners[0], corners[1], ends[1], ends[0]], Material.TILES, tile)
    builder.quad([corners[2], corners[3], ends[0], ends[1]], Material.TILES, tile)
    if building.roof == "hip":
        _add_hip(builder, (corners[1], corners[2], ends[1]), tile)
        _add_hip(builder, (corners[3], corners[0], ends[0]), tile)
    else:
        gable = _add_shifted(builder, wall, rng)
        for sign in (-1.0, 1.0):
            low = building.at(sign * half_l, -sign * half_w, top), building.at(sign * half_l, sign * half_w, top)
            peak = building.at(sign * half_l, 0.0, ridge)
            frame = (building.at(sign * half_l, -sign * half_w, 0.0), sign * building.axes[1], building.axes[2])
            builder.triangles(np.array([[*low, peak]]), Material.WALL, gable, frame)
    brick = _add_shifted(builder, TextureParameters(_varied(rng, STONES)), rng)
    x, y = rng.uniform(-0.5, 0.5) * (half_l - 1), rng.uniform(-0.5, 0.5) * half_w
    foot = top + (half_w - abs(y)) * slope - 0.8
    builder.box(building.at(x, y, foot), (0.9, 0.7, 2.2), building.axes, Material.PLAIN, brick)


def _add_hip(builder: MeshBuilder, corners: tuple[FloatArray, FloatArray, FloatArray], tile: int) -> None:
    a, b, peak = corners
    along = (b - a) / np.linalg.norm(b - a)
    up = (peak - a) - ((peak - a) @ along) * along
    builder.triangles(np.array([[a, b, peak]]), Material.TILES, tile, (a, along, up / np.linalg.norm(up)))


def _ball() -> tuple[FloatArray, NDArray[np.intp]]:
    """Return vertices (42, 3) and faces (80, 3) of a unit sphere: an icosahedron, divided once."""
    golden = (1 + 5**0.5) / 2
    vertices = np.array(
        [[-1, golden, 0], [1, golden, 0], [-1, -golden, 0], [1, -golden, 0], [0, -1, golden], [0, 1, golden],
         [0, -1, -golden], [0, 1, -golden], [golden, 0, -1], [golden, 0, 1], [-golden, 0, -1], [-golden, 0, 1]]
    )  # fmt: skip
    faces = np.array(
        [[0, 11, 5], [0, 5, 1], [0, 1, 7], [0, 7, 10], [0, 10, 11], [1, 5, 9], [5, 11, 4], [11, 10, 2], [10, 7, 6],
         [7, 1, 8], [3, 9, 4], [3, 4, 2], [3, 2, 6], [3, 6, 8], [3, 8, 9], [4, 9, 5], [2, 4, 11], [6, 2, 10],
         [8, 6, 7], [9, 8, 1]]
    )  # fmt: skip
    a, b, c = np.moveaxis(vertices[faces], 1, 0)
    ab, bc, ca = a + b, b + c, c + a
    split = np.concatenate([np.stack(t, axis=1) for t in ((a, ab, ca), (b, bc, ab), (c, ca, bc), (ab, bc, ca))])
    split /= np.linalg.norm(split, axis=-1, keepdims=True)
    unique, index = np.unique(np.round(split.reshape(-1, 3), 9), axis=0, return_inverse=True)
    return unique, index.reshape(-1, 3)


_BALL_VERTICES, _BALL_FACES = _ball()


def _add_tree(builder: MeshBuilder, foot: FloatArray, height_m: float, rng: np.random.Generator) -> None:
    bark = _add_shifted(builder, TextureParameters((0.13, 0.10, 0.07)), rng)
    builder.box(foot - [0, 0, 0.5], (0.35, 0.35, 0.6 * height_m), np.eye(3), Material.PLAIN, bark)
    red, green, blue = _varied(rng, CROWNS)
    light = (2.1 * red, 2.1 * green, 2.1 * blue)
    leaf = _add_shifted(builder, TextureParameters((red, green, blue), light), rng)
    for _ in range(3):
        radius = height_m * rng.uniform(0.2, 0.3)
        aside, above = rng.normal(0, 0.12 * height_m, 2), height_m * rng.uniform(0.55, 0.78)
        middle = foot + np.array([*aside, above])
        lumps = radius * rng.uniform(0.8, 1.2, (len(_BALL_VERTICES), 1)) * _BALL_VERTICES
        frame = (np.zeros(3), np.array([0.8, 0.3, 0.52]), np.array([-0.35, 0.85, 0.39]))
        corners = (middle + lumps)[_BALL_FACES]
        builder.triangles(corners, Material.LEAVES, leaf, frame, _BALL_VERTICES[_BALL_FACES])


def _add_car(builder: MeshBuilder, foot: FloatArray, axes: FloatArray, rng: np.random.Generator) -> None:
    """Add a parked car; `foot` (3,) in geo, `axes` (3, 3) rows along, across, up."""
    color = _varied(rng, CARS)
    body = _add_shifted(builder, TextureParameters(color), rng)
    cabin = _add_shifted(builder, TextureParameters(color, top_m=1.0), rng)
    builder.box(foot + 0.25 * axes[2], (4.3, 1.8, 0.7), axes, Material.CAR, body)
    builder.box(foot + 0.95 * axes[2] - 0.2 * axes[0], (2.4, 1.6, 0.55), axes, Material.CAR, cabin)

"""The scene as a whole: mesh, painted ground, sun, and places for survey targets."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from pipelines.core.types import FloatArray
from pipelines.simulate.buildings import House, Spot, add_car, add_house, add_tree
from pipelines.simulate.layout import STYLES, Layout, Plot, make_layout
from pipelines.simulate.mesh import Finish, Material, Mesh, MeshBuilder
from pipelines.simulate.terrain import Terrain, add_terrain, make_terrain
from pipelines.simulate.textures import GroundPlan


@dataclass(frozen=True)
class Scene:
    """A town to photograph.

    Attributes:
        mesh: its triangles, metres in geo.
        plan: what is painted on the ground.
        axes: (3, 3) rows: the town's east, north and up in geo.
        sun: (3,) unit vector towards the sun.
        spots: places where a survey target can be fixed.
        complex_m: half lengths, along the town's axes, of the complex in the middle.
    """

    mesh: Mesh
    plan: GroundPlan
    axes: FloatArray
    sun: FloatArray
    spots: tuple[Spot, ...]
    complex_m: tuple[float, float]


def make_scene(name: str, seed: np.random.SeedSequence) -> Scene:
    """Build a town of one of the `STYLES`."""
    style = STYLES[name]
    rng = np.random.default_rng(seed)
    turn = rng.uniform(0.15, 0.45)
    axes = np.array([[np.cos(turn), np.sin(turn), 0.0], [-np.sin(turn), np.cos(turn), 0.0], [0.0, 0.0, 1.0]])
    terrain = make_terrain(style.relief_m, rng)
    layout = make_layout(style, rng)
    builder = MeshBuilder()
    add_terrain(builder, terrain, axes, Finish((0.1, 0.15, 0.05)))
    spots = _ground_spots(terrain, rng)
    for plot in layout.plots:
        spots += add_house(builder, _house(plot, terrain, axes), rng)
    _add_furniture(builder, layout, terrain, axes, rng)
    azimuth, elevation = rng.uniform(2.2, 4.1), np.radians(rng.uniform(42, 56))
    sun = np.array([np.sin(azimuth) * np.cos(elevation), np.cos(azimuth) * np.cos(elevation), np.sin(elevation)])
    return Scene(builder.build(), layout.plan, axes, sun, tuple(spots), (17.5, 18.5))


def _on_ground(xy: tuple[float, float], terrain: Terrain, axes: FloatArray) -> FloatArray:
    place = np.array([*xy, 0.0]) @ axes
    place[2] = terrain.height(place[:2])
    return np.asarray(place)


def _house(plot: Plot, terrain: Terrain, axes: FloatArray) -> House:
    own = np.stack([axes[1], -axes[0], axes[2]]) if plot.turned else axes
    center = _on_ground(plot.center, terrain, axes)
    return House(center, own, plot.length_m, plot.width_m, plot.storeys, plot.floor_m, plot.roof)


def _add_furniture(
    builder: MeshBuilder, layout: Layout, terrain: Terrain, axes: FloatArray, rng: np.random.Generator
) -> None:
    for x, y, height in layout.trees:
        add_tree(builder, _on_ground((x, y), terrain, axes), height, rng)
    for x, y, north in layout.cars:
        foot = _on_ground((x, y), terrain, axes)
        up = terrain.normal(foot[None, :2])[0]
        along = axes[1] if north else axes[0]
        along = along - (along @ up) * up
        along /= np.linalg.norm(along)
        add_car(builder, foot, np.stack([along, np.cross(up, along), up]), rng)


def _ground_spots(terrain: Terrain, rng: np.random.Generator) -> list[Spot]:
    places = rng.uniform(-95, 95, (260, 2))
    normals = terrain.normal(places)
    positions = np.concatenate([places, terrain.height(places)[:, None]], axis=1)
    return [Spot(position, normal, "ground") for position, normal in zip(positions, normals, strict=True)]


def with_targets(scene: Scene, spots: list[Spot], width_m: float) -> Scene:
    """The scene with a black and white board of `width_m` at every spot."""
    if not spots:
        return scene
    builder = MeshBuilder()
    finish = builder.finish(Finish((0.5, 0.5, 0.5), pitch_m=width_m))
    for spot in spots:
        side = np.array([0.0, 0.0, 1.0]) if spot.kind == "wall" else scene.axes[1]
        u_axis = np.cross(side, spot.normal)
        u_axis /= np.linalg.norm(u_axis)
        v_axis = np.cross(spot.normal, u_axis)
        middle, half = spot.target_position, width_m / 2
        a, b, c, d = (middle + half * (i * u_axis + j * v_axis) for i, j in ((-1, -1), (1, -1), (1, 1), (-1, 1)))
        builder.triangles(np.array([[a, b, c], [a, c, d]]), Material.TARGET, finish, (middle, u_axis, v_axis))
    boards = builder.build()
    return replace(scene, mesh=_join(scene.mesh, boards))


def _join(first: Mesh, second: Mesh) -> Mesh:
    shifted = replace(second, finish=second.finish + np.int32(len(first.finishes)))
    names = vars(first)
    return Mesh(**{name: np.concatenate([getattr(first, name), getattr(shifted, name)]) for name in names})

"""Simulated scene: mesh, painted ground, sun, and sites for survey targets."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from pipelines.core.types import FloatArray
from pipelines.simulate.buildings import Building, TargetSite, add_building, add_car, add_tree
from pipelines.simulate.layout import STYLES, BuildingPlan, TownLayout, make_town_layout
from pipelines.simulate.mesh import (
    Material,
    Mesh,
    MeshBuilder,
    Terrain,
    TextureParameters,
    add_terrain,
    make_terrain,
)
from pipelines.simulate.textures import GroundPlan


@dataclass(frozen=True)
class SimulatedScene:
    """Town to photograph.

    Attributes:
        mesh: its triangles, metres in geo.
        plan: paint of the ground.
        axes: (3, 3) rows: the town's east, north and up in geo.
        sun: (3,) unit vector towards the sun.
        sites: places where a survey target can be fixed.
        complex_m: half lengths, along the town's axes, of the complex in the middle.
        buildings: those of the complex first.
    """

    mesh: Mesh
    plan: GroundPlan
    axes: FloatArray
    sun: FloatArray
    sites: tuple[TargetSite, ...]
    complex_m: tuple[float, float]
    buildings: tuple[Building, ...]


def build_scene(name: str, seed: np.random.SeedSequence) -> SimulatedScene:
    """Build a town of one of the `STYLES`."""
    style = STYLES[name]
    rng = np.random.default_rng(seed)
    turn = rng.uniform(0.15, 0.45)
    axes = np.array([[np.cos(turn), np.sin(turn), 0.0], [-np.sin(turn), np.cos(turn), 0.0], [0.0, 0.0, 1.0]])
    terrain = make_terrain(style.relief_m, rng)
    layout = make_town_layout(style, rng)
    builder = MeshBuilder()
    add_terrain(builder, terrain, axes, TextureParameters((0.1, 0.15, 0.05)))
    places = rng.uniform(-95, 95, (260, 2))
    positions = np.concatenate([places, terrain.height(places)[:, None]], axis=1)
    on_ground = zip(positions, terrain.normal(places), strict=True)
    sites = [TargetSite(position, normal, "ground") for position, normal in on_ground]
    buildings = tuple(_building(plan, terrain, axes) for plan in layout.buildings)
    for building in buildings:
        sites += add_building(builder, building, rng)
    _add_furniture(builder, layout, terrain, axes, rng)
    azimuth, elevation = rng.uniform(2.2, 4.1), np.radians(rng.uniform(42, 56))
    sun = np.array([np.sin(azimuth) * np.cos(elevation), np.cos(azimuth) * np.cos(elevation), np.sin(elevation)])
    return SimulatedScene(builder.build(), layout.plan, axes, sun, tuple(sites), (17.5, 18.5), buildings)


def _on_ground(xy: tuple[float, float], terrain: Terrain, axes: FloatArray) -> FloatArray:
    place = np.array([*xy, 0.0]) @ axes
    place[2] = terrain.height(place[:2])
    return place


def _building(plan: BuildingPlan, terrain: Terrain, axes: FloatArray) -> Building:
    own = np.stack([axes[1], -axes[0], axes[2]]) if plan.turned else axes
    center = _on_ground(plan.center, terrain, axes)
    return Building(center, own, plan.length_m, plan.width_m, plan.storeys, plan.floor_m, plan.roof)


def _add_furniture(
    builder: MeshBuilder, layout: TownLayout, terrain: Terrain, axes: FloatArray, rng: np.random.Generator
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


def with_targets(scene: SimulatedScene, sites: list[TargetSite], width_m: float) -> SimulatedScene:
    """Return the scene with a black and white board of `width_m` at every site."""
    if not sites:
        return scene
    builder = MeshBuilder()
    texture = builder.add_texture(TextureParameters((0.5, 0.5, 0.5), pitch_m=width_m))
    for site in sites:
        side = np.array([0.0, 0.0, 1.0]) if site.kind == "wall" else scene.axes[1]
        u_axis = np.cross(side, site.normal)
        u_axis /= np.linalg.norm(u_axis)
        v_axis = np.cross(site.normal, u_axis)
        middle, half = site.target_position, width_m / 2
        a, b, c, d = (middle + half * (i * u_axis + j * v_axis) for i, j in ((-1, -1), (1, -1), (1, 1), (-1, 1)))
        builder.triangles(np.array([[a, b, c], [a, c, d]]), Material.TARGET, texture, (middle, u_axis, v_axis))
    return replace(scene, mesh=joined(scene.mesh, builder.build()))


def joined(first: Mesh, second: Mesh) -> Mesh:
    """Return the triangles of two meshes in one."""
    shifted = replace(second, texture=second.texture + np.int32(len(first.texture_params)))
    names = vars(first)
    return Mesh(**{name: np.concatenate([getattr(first, name), getattr(shifted, name)]) for name in names})

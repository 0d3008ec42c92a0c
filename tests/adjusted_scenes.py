"""Synthetic surveys whose SfM model is the bundle adjustment of noisy pixels: its cameras, points and lens err."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache
from typing import Literal

import numpy as np

from pipelines.geometry.network import Network
from pipelines.geometry.sparse_model import SparseModel
from tests.bundle_scenes import adjuster, pixels, readjusted, size
from tests.scenes import Layout, Noise, TrueScene, looking_at, make_scene, sparse_model

_STEPS = 3
Flight = Layout | Literal["lines", "circle"]


@dataclass(frozen=True)
class Block:
    """True scene, its exact network in geo, and the matrix from pixel noise to errors of the unknowns."""

    scene: TrueScene
    network: Network
    solve: np.ndarray


@cache
def block(layout: Flight, images: int, points: int = 70, control: int = 8, checks: int = 6) -> Block:
    """Return a block; `control` control points, then `checks` check points, are the scene's ground points."""
    scene = make_scene("orbit", images=images, points=points, gcps=control + checks)
    if layout != "orbit":
        scene = {"grid": _over_a_grid, "lines": _in_lines, "circle": _on_a_circle}[layout](scene)
    owner, image, xy = scene.pixels(scene.point_in_geo)
    seen = np.bincount(owner, minlength=points)[owner] >= 2
    kept = np.unique(owner[seen])
    network = Network(
        cameras={1: scene.camera},
        camera_id=np.ones(images, dtype=np.int64),
        cam_from_world=np.swapaxes(scene.geo_from_cam, 1, 2),
        cam_center_in_world=scene.center_in_geo,
        point_in_world=scene.point_in_geo[kept],
        obs_point=np.searchsorted(kept, owner[seen]),
        obs_image=image[seen],
        obs_xy_px=xy[seen],
    )
    return Block(replace(scene, point_in_geo=scene.point_in_geo[kept]), network, adjuster(network))


def _over_a_grid(scene: TrueScene) -> TrueScene:
    """Return the scene seen from a grid at two heights, every other camera a little oblique."""
    images = len(scene.center_in_geo)
    side = int(np.ceil(np.sqrt(images)))
    east, north = np.meshgrid(np.linspace(-40, 40, side), np.linspace(-40, 40, side))
    height = np.where(np.arange(side * side) % 2, 75.0, 100.0)
    center = np.column_stack([east.ravel(), north.ravel(), height])[:images]
    target = center * [0.6, 0.6, 0.0] + [0.0, 1e-3, 0.0]
    return replace(scene, center_in_geo=center, geo_from_cam=looking_at(center, target))


def _in_lines(scene: TrueScene) -> TrueScene:
    """Return the scene seen from lines of eight photographs, to and fro at two heights, looking inward a little."""
    line, along = np.divmod(np.arange(len(scene.center_in_geo)), 8)
    east = np.where(line % 2, 7 - along, along) * 12.0 - 42.0
    north = (line - line.max() / 2) * 18.0
    center = np.column_stack([east, north, np.where(line % 2, 75.0, 100.0)])
    target = center * [0.6, 0.6, 0.0] + [0.0, 1e-3, 0.0]
    return replace(scene, center_in_geo=center, geo_from_cam=looking_at(center, target))


def _on_a_circle(scene: TrueScene) -> TrueScene:
    """Return the scene seen from one circle, flown once at constant speed."""
    angle = np.linspace(0, 2 * np.pi, len(scene.center_in_geo), endpoint=False)
    center = np.column_stack([88 * np.cos(angle), 88 * np.sin(angle), 60.0 + 8.0 * np.sin(2 * angle)])
    return replace(scene, center_in_geo=center, geo_from_cam=looking_at(center, np.zeros_like(center)))


def adjusted_model(of: Block, noise: Noise, rng: np.random.Generator) -> SparseModel:
    """Return the SfM model of a block in `local`, adjusted to pixels with noise."""
    pixel_noise = rng.normal(0, noise.pixel_px, of.network.obs_xy_px.shape)
    drawn = replace(of.network, obs_xy_px=of.network.obs_xy_px + pixel_noise)
    adjusted = readjusted(drawn, of.solve @ pixel_noise.ravel())
    for _ in range(_STEPS):  # of Gauss–Newton: a weak lens moves far enough for second-order terms to count
        left = drawn.obs_xy_px - pixels(adjusted, np.zeros(size(adjusted)))
        adjusted = readjusted(adjusted, of.solve @ left.ravel())
    exact, local_from_geo = sparse_model(of.scene, noise, rng), of.scene.geo_from_local.inverse()
    rotation = adjusted.cam_from_world @ of.scene.geo_from_local.rotation
    center = local_from_geo.apply(adjusted.cam_center_in_world)
    return replace(
        exact,
        cameras=adjusted.cameras,
        rotation_cam_from_local=rotation,
        translation_cam_from_local=-np.einsum("nij,nj->ni", rotation, center),
        point_in_local=local_from_geo.apply(adjusted.point_in_world),
        point_error_px=np.full(len(adjusted.point_in_world), noise.pixel_px),
        obs_point=adjusted.obs_point,
        obs_image=adjusted.obs_image,
        obs_xy_px=adjusted.obs_xy_px,
    )

"""What is simulated: scene, lens, true motion, and how the sensors are put together."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipelines.core.errors import InputError
from pipelines.core.options import triple
from pipelines.geodesy.enu import Origin
from pipelines.geometry.rotations import exp_so3
from pipelines.simulate.buildings import Spot
from pipelines.simulate.flight import (
    DEFAULT_HEIGHTS_M,
    DEFAULT_RADIUS_M,
    FlightPlan,
    TrueTrajectory,
    make_trajectory,
)
from pipelines.simulate.lens import Lens
from pipelines.simulate.mesh import Material
from pipelines.simulate.options import SimulateOptions
from pipelines.simulate.raycast import MISS, Raycaster
from pipelines.simulate.render import Pose
from pipelines.simulate.scene import Scene, make_scene, with_targets
from pipelines.simulate.sensors import Mounting
from pipelines.simulate.targets import choose, sightings

_CLEARANCE_M = 2.0
_TARGET_PX = 5.0


@dataclass(frozen=True)
class World:
    """Everything that is true.

    Attributes:
        scene: with its targets; spots: where those are; target_m: how wide.
        track: true motion; poses: of the photographs.
    """

    origin: Origin
    scene: Scene
    spots: tuple[Spot, ...]
    target_m: float
    lens: Lens
    trajectory: TrueTrajectory
    poses: tuple[Pose, ...]
    mounting: Mounting


def make_world(config: SimulateOptions, seed: np.random.SeedSequence) -> World:
    """Build the scene, fly over it, and lay out the targets where the flight sees them.

    Raises:
        InputError: the lens folds inside the image.
    """
    scene_seed, flight_seed, target_seed = seed.spawn(3)
    lat, lon, alt = triple(config.origin)
    lens = _lens(config)
    mounting = Mounting(
        antenna_in_body=np.array(triple(config.lever_arm)),
        nominal_from_cam=exp_so3(np.radians(triple(config.boresight))),
        clock_offset_s=config.clock_offset,
    )
    bare = make_scene(config.scene, scene_seed)
    plan = FlightPlan(
        config.flight,
        config.images,
        config.interval,
        config.heights or DEFAULT_HEIGHTS_M[config.flight],
        config.radius or DEFAULT_RADIUS_M[config.flight],
    )
    trajectory = make_trajectory(plan, bare.complex_m, bare.axes, np.random.default_rng(flight_seed))
    centers = trajectory.position(trajectory.photo_s)
    rotations = trajectory.geo_from_nominal_cam(trajectory.photo_s) @ mounting.nominal_from_cam
    poses = tuple(Pose(center, rotation) for center, rotation in zip(centers, rotations, strict=True))
    distance_m = float(np.median(np.linalg.norm(centers, axis=1)))
    width_m = config.target_size or max(0.3, _TARGET_PX * distance_m / lens.focal_px)
    spots: list[Spot] = []
    if config.targets:
        found = sightings(bare.spots, poses, lens, Raycaster(bare.mesh), width_m)
        spots = choose(bare.spots, found.seen, config.targets, np.random.default_rng(target_seed))
    scene = with_targets(bare, spots, width_m)
    origin = Origin(lat_deg=lat, lon_deg=lon, alt_m=alt)
    return World(origin, scene, tuple(spots), width_m, lens, trajectory, poses, mounting)


def _lens(config: SimulateOptions) -> Lens:
    width, height = config.size_px
    # The principal point of a real camera is never quite in the middle.
    center = (0.504 * width, 0.497 * height) if config.lens != "pinhole" else (0.5 * width, 0.5 * height)
    bent, skewed = config.lens != "pinhole", config.lens == "opencv"
    lens = Lens(
        config.lens,
        width,
        height,
        config.focal * width,
        center,
        config.k1 * bent,
        config.k2 * bent,
        config.p1 * skewed,
        config.p2 * skewed,
    )
    lens.directions([(x, y) for x in (0, width / 2, width) for y in (0, height / 2, height)])
    return lens


def check_clearance(world: World, raycaster: Raycaster) -> None:
    """See that no photograph is taken inside of something.

    Raises:
        InputError: a camera is in the ground, in a house, or almost.
    """
    golden = np.pi * (3 - 5**0.5)
    step = np.arange(400)
    z = 1 - (2 * step + 1) / len(step)
    ring = np.sqrt(1 - z * z)
    sphere = np.stack([ring * np.cos(golden * step), ring * np.sin(golden * step), z], axis=1)
    for i, pose in enumerate(world.poses):
        hits = raycaster.first_hits(pose.center, np.concatenate([sphere, [[0.0, 0.0, 1.0]]]))
        nearest = float(np.min(hits.distance[hits.triangle != MISS], initial=np.inf))
        above = int(hits.triangle[-1])
        buried = above != MISS and world.scene.mesh.material[above] == Material.TERRAIN
        if buried or nearest < _CLEARANCE_M:
            where = "in the ground" if buried else f"{nearest:.1f} m from a surface"
            raise InputError(
                f"photograph {i} would be taken {where}: choose another height or radius", field="--height"
            )

"""Simulated world: scene, lens, true motion, and the arrangement of the sensors."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipelines.core.errors import InputError
from pipelines.geodesy.enu import Origin
from pipelines.geometry.rotations import exp_so3
from pipelines.simulate.buildings import TargetSite
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
from pipelines.simulate.scene import SimulatedScene, build_scene, with_targets
from pipelines.simulate.sensors import Mounting
from pipelines.simulate.targets import choose_sites, project_targets

_CLEARANCE_M = 2.0
_TARGET_PX = 5.0


@dataclass(frozen=True)
class World:
    """Truth from which records and photographs are made.

    Attributes:
        origin: of geo, on Earth.
        scene: with its targets.
        sites: of the targets.
        target_m: width of a target.
        lens: of the camera.
        trajectory: true motion of the camera.
        poses: of the photographs.
        mounting: arrangement of camera, antenna and clocks.
    """

    origin: Origin
    scene: SimulatedScene
    sites: tuple[TargetSite, ...]
    target_m: float
    lens: Lens
    trajectory: TrueTrajectory
    poses: tuple[Pose, ...]
    mounting: Mounting


def make_world(options: SimulateOptions, seed: np.random.SeedSequence) -> World:
    """Build the scene, fly over it, and lay out targets at sites that the flight sees.

    Raises:
        InputError: the lens folds inside the image.
    """
    scene_seed, flight_seed, target_seed = seed.spawn(3)
    lat, lon, alt = options.origin
    lens = _lens(options)
    mounting = Mounting(
        antenna_in_body=np.array(options.lever_arm),
        nominal_from_cam=exp_so3(np.radians(options.boresight)),
        clock_offset_s=options.clock_offset,
    )
    bare = build_scene(options.scene, scene_seed)
    plan = FlightPlan(
        options.flight,
        options.images,
        options.interval,
        options.heights or DEFAULT_HEIGHTS_M[options.flight],
        options.radius or DEFAULT_RADIUS_M[options.flight],
    )
    trajectory = make_trajectory(plan, bare.complex_m, bare.axes, np.random.default_rng(flight_seed))
    centers = trajectory.position(trajectory.photo_s)
    rotations = trajectory.geo_from_nominal_cam(trajectory.photo_s) @ mounting.nominal_from_cam
    poses = tuple(Pose(center, rotation) for center, rotation in zip(centers, rotations, strict=True))
    distance_m = float(np.median(np.linalg.norm(centers, axis=1)))
    width_m = options.target_size or max(0.3, _TARGET_PX * distance_m / lens.focal_px)
    sites: list[TargetSite] = []
    if options.targets:
        projections = project_targets(bare.sites, poses, lens, Raycaster(bare.mesh), width_m)
        sites = choose_sites(bare.sites, projections.seen, options.targets, np.random.default_rng(target_seed))
    scene = with_targets(bare, sites, width_m)
    origin = Origin(lat_deg=lat, lon_deg=lon, alt_m=alt)
    return World(origin, scene, tuple(sites), width_m, lens, trajectory, poses, mounting)


def _lens(options: SimulateOptions) -> Lens:
    width, height = options.size_px
    # The principal point of a real camera is never exactly in the middle.
    center = (0.504 * width, 0.497 * height) if options.lens != "pinhole" else (0.5 * width, 0.5 * height)
    bent, skewed = options.lens != "pinhole", options.lens == "opencv"
    lens = Lens(
        options.lens,
        width,
        height,
        options.focal * width,
        center,
        options.k1 * bent,
        options.k2 * bent,
        options.p1 * skewed,
        options.p2 * skewed,
    )
    lens.directions([(x, y) for x in (0, width / 2, width) for y in (0, height / 2, height)])
    return lens


def check_clearance(world: World, raycaster: Raycaster) -> None:
    """Check that no photograph is taken inside terrain or a building.

    Raises:
        InputError: a camera is in the ground, or within 2 m of a surface.
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

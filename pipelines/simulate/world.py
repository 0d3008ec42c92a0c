"""World of a simulated survey: scene, lens, true motion, arrangement of the sensors, sites of survey targets."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import shapely

from pipelines.core.errors import InputError
from pipelines.core.types import BoolArray, FloatArray, IntArray
from pipelines.geodesy.enu import Origin
from pipelines.geometry.rotations import exp_so3
from pipelines.simulate import flight
from pipelines.simulate.lens import BrownLens, Pose
from pipelines.simulate.mesh import MISS, Material, Raycaster
from pipelines.simulate.options import SimulateOptions
from pipelines.simulate.scene import SimulatedScene, SiteKind, TargetSite, build_scene, with_targets

WANTED_RAYS = 6
LEAST_RAYS = 2
_SHARES: dict[SiteKind, float] = {"ground": 0.45, "roof": 0.3, "wall": 0.25}
_APART_M: dict[SiteKind, float] = {"ground": 5.0, "roof": 4.0, "wall": 2.2}
_MARGIN_PX = 4.0
_LEAST_PX = 3.0
_LEAST_COSINE = 0.2
_ROW_STEPS = 3  # of the row that sees a target while the camera moves: each leaves a hundredth of the error


def project_targets(
    sites: Sequence[TargetSite], poses: Sequence[Pose], lens: BrownLens, raycaster: Raycaster, width_m: float
) -> tuple[BoolArray, FloatArray]:
    """Return which of N photographs see P targets of `width_m` (P, N), and their exact places (P, N, 2) in pixels.

    A target out of view, too small or hidden (by ray casting) is not seen; its place is meaningless.
    """
    positions = np.array([site.target_position for site in sites]).reshape(-1, 3)
    normals = np.array([site.normal for site in sites]).reshape(-1, 3)
    seen = np.zeros((len(sites), len(poses)), dtype=bool)
    pixels = np.zeros((len(sites), len(poses), 2))
    limit = np.array([lens.width, lens.height]) - _MARGIN_PX
    for j, pose in enumerate(poses):
        towards = positions - pose.center
        distance = np.linalg.norm(towards, axis=1)
        cosine = -np.einsum("pi,pi->p", towards, normals) / distance
        pixels[:, j] = lens.project(towards @ pose.geo_from_cam)
        for _ in range(_ROW_STEPS if pose.travel.any() else 0):
            share = np.clip(np.nan_to_num(pixels[:, j, 1] / lens.height), 0.0, 1.0)
            pixels[:, j] = lens.project((positions - pose.at_row(share)) @ pose.geo_from_cam)
        inside = ((pixels[:, j] > _MARGIN_PX) & (pixels[:, j] < limit)).all(axis=1)
        size = lens.focal_px * width_m / distance * np.sqrt(np.maximum(cosine, 0.0))
        maybe = np.nonzero(inside & (cosine > _LEAST_COSINE) & (size > _LEAST_PX))[0]
        if len(maybe) == 0:
            continue
        hits = raycaster.first_hits(pose.center, towards[maybe] / distance[maybe, None])
        # The first hit of the ray is the target itself, or the surface close behind it.
        seen[maybe, j] = np.abs(hits.distance - distance[maybe]) < 0.25
    return seen, pixels


def _chosen_sites(
    sites: Sequence[TargetSite], seen: BoolArray, count: int, rng: np.random.Generator
) -> list[TargetSite]:
    """Return up to `count` sites on ground, roofs and walls: well seen (P, N), and apart from each other."""
    rays = seen.sum(axis=1)
    chosen: list[int] = []
    order = rng.permutation(len(sites))
    for kind, share in _SHARES.items():
        wanted = round(share * count)
        of_kind = [i for i in order if sites[i].kind == kind and rays[i] >= WANTED_RAYS]
        chosen += _spaced(sites, of_kind, chosen)[:wanted]
    remaining = [i for i in order if i not in set(chosen) and rays[i] >= LEAST_RAYS]
    remaining.sort(key=lambda i: -min(int(rays[i]), WANTED_RAYS))
    return [sites[i] for i in sorted((chosen + _spaced(sites, remaining, chosen))[:count])]


def _spaced(sites: Sequence[TargetSite], candidates: Sequence[int], others: Sequence[int]) -> list[int]:
    """Return the candidates, in order, that keep their distance from `others` and each other."""
    taken: list[int] = []
    for i in candidates:
        near = [sites[k].position for k in (*others, *taken)]
        gap = np.linalg.norm(np.array(near).reshape(-1, 3) - sites[i].position, axis=1)
        if gap.min(initial=np.inf) >= _APART_M[sites[i].kind]:
            taken.append(i)
    return taken


def choose_control(sites: Sequence[TargetSite], rays: IntArray, count: int) -> list[int]:
    """Return indices of `count` control points, a third of all at the most: on the ground first, spread far."""
    usable = [i for i in range(len(sites)) if rays[i] >= LEAST_RAYS]
    count = min(count, len(usable) // 3)
    good = [i for i in usable if rays[i] >= WANTED_RAYS]
    low = [i for i in good if sites[i].kind == "ground"]
    pool = next(pool for pool in (low, good, usable) if len(pool) >= count)
    if not pool or count == 0:
        return []
    positions = np.array([sites[i].position for i in pool])
    picked = [int(np.argmax(np.linalg.norm(positions - positions.mean(axis=0), axis=1)))]
    gap = np.linalg.norm(positions - positions[picked[0]], axis=1)
    while len(picked) < min(count, len(pool)):
        picked.append(int(np.argmax(gap)))
        gap = np.minimum(gap, np.linalg.norm(positions - positions[picked[-1]], axis=1))
    return sorted(pool[i] for i in picked)


_CLEARANCE_M = 2.0
_TARGET_PX, _TAG_PX = 5.0, 30.0


@dataclass(frozen=True)
class World:
    """Truth from which records and photographs are made, with targets of a width at their sites in the scene."""

    origin: Origin
    scene: SimulatedScene
    sites: tuple[TargetSite, ...]
    number: IntArray  # (P,) by which the targets are named, the same in both epochs
    survey_error: FloatArray  # (P, 3) surveyed minus true places of the targets, the same in both epochs
    target_m: float
    lens: BrownLens
    trajectory: flight.TrueTrajectory
    poses: tuple[Pose, ...]
    mounting: flight.Mounting


def make_world(options: SimulateOptions, seed: np.random.SeedSequence) -> World:
    """Build the scene, fly over it, and lay out targets that the flight sees; an InputError: the lens folds.

    The second epoch has the targets that the first flight sees, but for those where the town has changed.
    """
    scene_seed, flight_seed, target_seed = seed.spawn(3)
    lat, lon, alt = options.origin
    lens = _lens(options)
    mounting = flight.Mounting(
        antenna_in_body=np.array(options.lever_arm),
        nominal_from_cam=exp_so3(np.radians(options.boresight)),
        clock_offset_s=options.clock_offset,
    )
    bare = build_scene(options.scene, scene_seed)
    trajectory, poses = _flown(options, bare, mounting, np.random.default_rng(flight_seed))
    distance_m = float(np.median([np.linalg.norm(pose.center) for pose in poses]))
    width_px = _TARGET_PX if options.target_kind == "quarters" else _TAG_PX
    width_m = options.target_size or max(0.3, width_px * distance_m / lens.focal_px)
    sites: list[TargetSite] = []
    if options.targets:
        seen, _ = project_targets(bare.sites, poses, lens, Raycaster(bare.mesh), width_m)
        sites = _chosen_sites(bare.sites, seen, options.targets, np.random.default_rng(target_seed))
    survey_error = np.random.default_rng(target_seed.spawn(1)[0]).normal(0, options.sigma_survey, (len(sites), 3))
    kept = np.ones(len(sites), dtype=bool)
    if options.epoch == "2":
        bare = build_scene(options.scene, scene_seed, options)
        trajectory, poses = _flown(options, bare, mounting, np.random.default_rng(flight_seed.spawn(1)[0]))
        changed = shapely.union_all([shapely.Polygon(change.outline) for change in bare.changes]).buffer(width_m)
        kept = np.array([not shapely.contains_xy(changed, *site.position[:2]) for site in sites], dtype=bool)
    stays = tuple(site for site, is_kept in zip(sites, kept, strict=True) if is_kept)
    number = np.flatnonzero(kept)
    scene = with_targets(bare, list(stays), width_m, options.target_kind, number)
    origin = Origin(lat_deg=lat, lon_deg=lon, alt_m=alt)
    return World(origin, scene, stays, number, survey_error[kept], width_m, lens, trajectory, poses, mounting)


def _flown(
    options: SimulateOptions, scene: SimulatedScene, mounting: flight.Mounting, rng: np.random.Generator
) -> tuple[flight.TrueTrajectory, tuple[Pose, ...]]:
    plan = flight.FlightPlan(
        options.flight,
        options.images,
        options.interval,
        options.heights or flight.DEFAULT_HEIGHTS_M[options.flight],
        options.radius or flight.DEFAULT_RADIUS_M[options.flight],
    )
    trajectory = flight.make_trajectory(plan, scene.complex_m, scene.axes, rng)
    centers = trajectory.position(trajectory.photo_s)
    rotations = trajectory.geo_from_nominal_cam(trajectory.photo_s) @ mounting.nominal_from_cam
    travels = options.rolling_shutter * trajectory.position(trajectory.photo_s, 1)
    return trajectory, tuple(
        Pose(center, rotation, travel) for center, rotation, travel in zip(centers, rotations, travels, strict=True)
    )


def _lens(options: SimulateOptions) -> BrownLens:
    width, height = options.size_px
    # The principal point of a real camera is never exactly in the middle.
    center = (0.504 * width, 0.497 * height) if options.lens != "pinhole" else (0.5 * width, 0.5 * height)
    bent, skewed = options.lens != "pinhole", options.lens == "opencv"
    radial, tangential = (options.k1 * bent, options.k2 * bent), (options.p1 * skewed, options.p2 * skewed)
    lens = BrownLens(options.lens, width, height, options.focal * width, center, *radial, *tangential)
    lens.directions([(x, y) for x in (0, width / 2, width) for y in (0, height / 2, height)])
    return lens


def check_clearance(world: World, raycaster: Raycaster) -> None:
    """Refuse photographs taken in the ground, or within 2 m of a surface, with an InputError."""
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
                "camera-too-near",
                f"Photograph {i} would be taken {where}.",
                field="--height",
                remedy="Choose another --height or --radius.",
            )

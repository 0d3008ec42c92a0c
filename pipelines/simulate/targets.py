"""Survey targets: choice of their sites, and their projections into the photographs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pipelines.core.types import BoolArray, FloatArray, IntArray
from pipelines.simulate.buildings import SiteKind, TargetSite
from pipelines.simulate.lens import Lens
from pipelines.simulate.raycast import Raycaster
from pipelines.simulate.render import Pose

WANTED_RAYS = 6
LEAST_RAYS = 2
_SHARES: dict[SiteKind, float] = {"ground": 0.45, "roof": 0.3, "wall": 0.25}
_APART_M: dict[SiteKind, float] = {"ground": 5.0, "roof": 4.0, "wall": 2.2}
_MARGIN_PX = 4.0
_LEAST_PX = 3.0
_LEAST_COSINE = 0.2


@dataclass(frozen=True)
class TargetProjections:
    """Projections of P targets into N photographs.

    Attributes:
        seen: (P, N) whether the photograph sees the target.
        pixels: (P, N, 2) exact projections; meaningless where not seen.
    """

    seen: BoolArray
    pixels: FloatArray


def project_targets(
    sites: Sequence[TargetSite], poses: Sequence[Pose], lens: Lens, raycaster: Raycaster, width_m: float
) -> TargetProjections:
    """Project targets of `width_m`; targets out of view, too small or hidden (by ray casting) are not seen."""
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
        inside = ((pixels[:, j] > _MARGIN_PX) & (pixels[:, j] < limit)).all(axis=1)
        size = lens.focal_px * width_m / distance * np.sqrt(np.maximum(cosine, 0.0))
        maybe = np.nonzero(inside & (cosine > _LEAST_COSINE) & (size > _LEAST_PX))[0]
        if len(maybe) == 0:
            continue
        hits = raycaster.first_hits(pose.center, towards[maybe] / distance[maybe, None])
        # The first hit of the ray is the target itself, or the surface close behind it.
        seen[maybe, j] = np.abs(hits.distance - distance[maybe]) < 0.25
    return TargetProjections(seen, pixels)


def choose_sites(
    sites: Sequence[TargetSite], seen: BoolArray, count: int, rng: np.random.Generator
) -> list[TargetSite]:
    """Return up to `count` sites on ground, roofs and walls: well seen (P, N), and apart from each other."""
    rays = seen.sum(axis=1)
    chosen: list[int] = []
    order = rng.permutation(len(sites))
    for kind, share in _SHARES.items():
        wanted = round(share * count)
        own = [i for i in order if sites[i].kind == kind and rays[i] >= WANTED_RAYS]
        chosen += _apart(sites, own, chosen)[:wanted]
    remaining = [i for i in order if i not in set(chosen) and rays[i] >= LEAST_RAYS]
    remaining.sort(key=lambda i: -min(int(rays[i]), WANTED_RAYS))
    return [sites[i] for i in sorted((chosen + _apart(sites, remaining, chosen))[:count])]


def _apart(sites: Sequence[TargetSite], candidates: Sequence[int], others: Sequence[int]) -> list[int]:
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

"""Survey targets: where to lay them out, which photographs see them, and where in the photograph."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pipelines.core.types import BoolArray, FloatArray, IntArray
from pipelines.simulate.buildings import Spot, SpotKind
from pipelines.simulate.lens import Lens
from pipelines.simulate.raycast import Raycaster
from pipelines.simulate.render import Pose

WANTED_RAYS = 6
LEAST_RAYS = 2
_SHARES: dict[SpotKind, float] = {"ground": 0.45, "roof": 0.3, "wall": 0.25}
_APART_M: dict[SpotKind, float] = {"ground": 5.0, "roof": 4.0, "wall": 2.2}
_MARGIN_PX = 4.0
_LEAST_PX = 3.0
_LEAST_COSINE = 0.2


@dataclass(frozen=True)
class Sightings:
    """Which of P places N photographs see.

    Attributes:
        seen: (P, N) bool.
        pixels: (P, N, 2) exact projections; meaningless where not seen.
    """

    seen: BoolArray
    pixels: FloatArray


def sightings(
    spots: Sequence[Spot], poses: Sequence[Pose], lens: Lens, raycaster: Raycaster, width_m: float
) -> Sightings:
    """Project targets of `width_m` and see by ray casting which are in view, large enough and not hidden."""
    positions = np.array([spot.target_position for spot in spots]).reshape(-1, 3)
    normals = np.array([spot.normal for spot in spots]).reshape(-1, 3)
    seen = np.zeros((len(spots), len(poses)), dtype=bool)
    pixels = np.zeros((len(spots), len(poses), 2))
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
        # The first thing on the ray is the target itself, or the surface close behind it.
        seen[maybe, j] = np.abs(hits.distance - distance[maybe]) < 0.25
    return Sightings(seen, pixels)


def choose(spots: Sequence[Spot], seen: BoolArray, count: int, rng: np.random.Generator) -> list[Spot]:
    """Choose up to `count` spots on ground, roofs and walls: well seen (P, N), and apart from each other."""
    rays = seen.sum(axis=1)
    chosen: list[int] = []
    order = rng.permutation(len(spots))
    for kind, share in _SHARES.items():
        wanted = round(share * count)
        own = [i for i in order if spots[i].kind == kind and rays[i] >= WANTED_RAYS]
        chosen += _apart(spots, own, chosen)[:wanted]
    rest = [i for i in order if i not in set(chosen) and rays[i] >= LEAST_RAYS]
    rest.sort(key=lambda i: -min(int(rays[i]), WANTED_RAYS))
    return [spots[i] for i in sorted((chosen + _apart(spots, rest, chosen))[:count])]


def _apart(spots: Sequence[Spot], candidates: Sequence[int], others: Sequence[int]) -> list[int]:
    """Those candidates, in order, that keep their distance from `others` and each other."""
    taken: list[int] = []
    for i in candidates:
        near = [spots[k].position for k in (*others, *taken)]
        gap = np.linalg.norm(np.array(near).reshape(-1, 3) - spots[i].position, axis=1)
        if gap.min(initial=np.inf) >= _APART_M[spots[i].kind]:
            taken.append(i)
    return taken


def choose_control(spots: Sequence[Spot], rays: IntArray, count: int) -> list[int]:
    """Indices of `count` control points, a third of all at the most: on the ground first, spread far."""
    usable = [i for i in range(len(spots)) if rays[i] >= LEAST_RAYS]
    count = min(count, len(usable) // 3)
    good = [i for i in usable if rays[i] >= WANTED_RAYS]
    low = [i for i in good if spots[i].kind == "ground"]
    pool = next(pool for pool in (low, good, usable) if len(pool) >= count)
    if not pool or count == 0:
        return []
    positions = np.array([spots[i].position for i in pool])
    picked = [int(np.argmax(np.linalg.norm(positions - positions.mean(axis=0), axis=1)))]
    gap = np.linalg.norm(positions - positions[picked[0]], axis=1)
    while len(picked) < min(count, len(pool)):
        picked.append(int(np.argmax(gap)))
        gap = np.minimum(gap, np.linalg.norm(positions - positions[picked[-1]], axis=1))
    return sorted(pool[i] for i in picked)

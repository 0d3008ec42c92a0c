"""Matches of two photographs, guided by those of their largest features.

All features compared with all those of the other photograph took a sixth of a large survey's time. Compared with
those alone that are near, more of them are unique: real flights get up to half as many matches again.

1. The largest features of one photograph are compared with those of the other.
2. Such a match tells, with its sizes and directions, where what lies around it is in the other photograph. One that
   its neighbours do not confirm goes.
3. Each feature is sought at the places that the nearest of these matches tell (`near_matches.py`).

Where too few of the largest features match, more of them are compared, until it is clear that the photographs have
nothing in common.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.spatial import cKDTree

from pipelines.core.types import Float32Array, IntArray
from pipelines.sfm.near_matches import Expected, SiftFeatures, matches_near, matches_of_all
from pipelines.splat.kernel_cache import kernel

RATIO = 0.8  # largest, of the distances of the best and the second of all: COLMAP's, as is the next
MOST_DISTANCE = 0.7  # of descriptors of length one
# Among a few candidates nearly each feature is unique, also one whose own counterpart was not found. By these two,
# matches of four flights are as exact as those of all with all, and 10 to 50 % more; by the two above, three times
# as many of the additional ones are wrong.
_NEAR_RATIO, _NEAR_MOST_DISTANCE = 0.7, 0.4

# Of 2000 pairs of seven real flights, all those with matches, when all features were compared, had as many guides
# among so many of the largest features; with eight, guided matches were more than those of all with all.
_LARGEST = ((1000, 0), (2000, 4), (4000, 8))
_FEWEST_GUIDES = 8
_NEAREST = 4  # guides that tell where a feature is
_NEIGHBOURS, _CONFIRMING = 6, 2  # of a guide, and of these, that agree with it
# Radius around a told place: pixels, and a share of the distance to the guide, for its size and direction are rough
# and the ground has relief.
_RADIUS_PX, _RADIUS_SHARE = np.float32(8.0), np.float32(0.25)


@dataclass(frozen=True)
class GuidedFeatures:
    """Features of a photograph, and the largest of them."""

    all: SiftFeatures

    @cached_property
    def largest(self) -> tuple[SiftFeatures, ...]:
        by_size = np.argsort(-(self.all.axis_px**2).sum(axis=1), kind="stable")
        return tuple(self.all.of(by_size[:count]) for count, _ in _LARGEST)


def guided_matches(first: GuidedFeatures, second: GuidedFeatures) -> IntArray:
    """Return the matches (M, 2) of the features of two photographs; none where too few of the largest match."""
    for one, other, (_, fewest) in zip(first.largest, second.largest, _LARGEST, strict=True):
        mine, theirs = _guides(one, other)
        if len(mine) >= _FEWEST_GUIDES:
            told = _told(mine, theirs, first.all, _NEAREST)
            return matches_near(first.all, second.all, told, ratio=_NEAR_RATIO, most_distance=_NEAR_MOST_DISTANCE)
        if len(mine) < fewest:
            break
    return np.zeros((0, 2), dtype=np.int64)


def _guides(first: SiftFeatures, second: SiftFeatures) -> tuple[SiftFeatures, SiftFeatures]:
    """Return features (G,) of two photographs that match, and are confirmed by their neighbours."""
    rows = matches_of_all(first, second, ratio=RATIO, most_distance=MOST_DISTANCE)
    if len(rows) <= _NEIGHBOURS:
        rows = rows[:0]
    mine, theirs = first.of(rows[:, 0]), second.of(rows[:, 1])
    if len(rows):
        told = _told(mine, theirs, mine, _NEIGHBOURS + 1)
        away = np.linalg.norm(told.xy_px - theirs.xy_px[:, None], axis=2)
        confirmed = (away < told.radius_px).sum(axis=1) > _CONFIRMING  # The nearest guide is the match itself.
        mine, theirs = mine.of(confirmed), theirs.of(confirmed)
    return mine, theirs


def _told(one: SiftFeatures, other: SiftFeatures, features: SiftFeatures, nearest: int) -> Expected:
    """Return where features (N,) of the first photograph are in the second, as the nearest guides tell.

    The guides (G,) are `one` in the first photograph, and `other` in the second.
    """
    distance, guide = cKDTree(one.xy_px).query(features.xy_px, k=nearest)
    guides = one.xy_px, one.axis_px, other.xy_px, other.axis_px
    return Expected(*_moved(features.xy_px, features.axis_px, guide, distance.astype(np.float32), *guides))


@kernel(nogil=True, error_model="numpy")
def _moved(  # noqa: PLR0917  (kernels take arrays, not objects)
    xy: Float32Array,  # (N, 2)
    axis: Float32Array,  # (N, 2)
    guide: IntArray,  # (N, K)
    distance: Float32Array,  # (N, K)
    xy_one: Float32Array,  # (G, 2) of the guides in the first photograph
    axis_one: Float32Array,
    xy_other: Float32Array,  # (G, 2) in the second one
    axis_other: Float32Array,
) -> tuple[Float32Array, Float32Array, Float32Array]:
    """Return places, radii and axes (`Expected`) as the similarities of guides move them."""
    place, moved = np.empty((*guide.shape, 2), np.float32), np.empty((*guide.shape, 2), np.float32)
    radius = np.empty(guide.shape, np.float32)
    for i in range(guide.shape[0]):
        for k in range(guide.shape[1]):
            g = guide[i, k]
            a, b, c, d = axis_one[g, 0], axis_one[g, 1], axis_other[g, 0], axis_other[g, 1]
            square = a * a + b * b
            # Scale and turn from one photograph to the other, as a complex number.
            real, imaginary = (a * c + b * d) / square, (a * d - b * c) / square
            x, y = xy[i, 0] - xy_one[g, 0], xy[i, 1] - xy_one[g, 1]
            place[i, k, 0] = xy_other[g, 0] + real * x - imaginary * y
            place[i, k, 1] = xy_other[g, 1] + imaginary * x + real * y
            moved[i, k, 0] = real * axis[i, 0] - imaginary * axis[i, 1]
            moved[i, k, 1] = imaginary * axis[i, 0] + real * axis[i, 1]
            scale = np.sqrt(real * real + imaginary * imaginary)
            radius[i, k] = _RADIUS_PX + _RADIUS_SHARE * scale * distance[i, k]
    return place, radius, moved

"""What was measured on Earth, as tensors: fixes, control points, attitudes, and distances between points."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from typing import TypeVar

import torch
from torch import Tensor

RecordT = TypeVar("RecordT")
_WORTH = 0.1  # of the fixes' information on the scale, that distances between points repeat


@dataclass(frozen=True)
class Fixes:
    """Measured centres of F training cameras.

    Attributes:
        camera: (F,) int64 index into the cameras.
        position_in_geo: (F, 3) float64 metres.
        root_information: (F, 3, 3) float64, W with WᵀW = Σ⁻¹.
        flight: (F,) int64, the flight that each was measured in; None: all in one.
    """

    camera: Tensor
    position_in_geo: Tensor
    root_information: Tensor
    flight: Tensor | None = None


@dataclass(frozen=True)
class ControlMarks:
    """Image marks of J control points, K in all.

    Attributes:
        point: (K,) int64 index into the points.
        camera: (K,) int64 index into the cameras.
        bearing_in_cam: (K, 3) float64 unit vectors.
        sigma_rad: (K,) float64 angular σ of a mark.
        position_in_geo: (J, 3) float64 metres, surveyed.
        root_information: (J, 3, 3) float64 of survey and intersection together, and of the surface where the points
            are found by depth.
        name: of the points (J).
        bearing_by_lens: (K, 3, L) float64, derivative of the bearings by the lens parameters, in the order of
            `geometry.lens.Lenses`; None: the lens that they were read through is taken for exact.
    """

    point: Tensor
    camera: Tensor
    bearing_in_cam: Tensor
    sigma_rad: Tensor
    position_in_geo: Tensor
    root_information: Tensor
    name: tuple[str, ...] = ()
    bearing_by_lens: Tensor | None = None

    def bearings(self, lens: Tensor) -> Tensor:
        """Unit vectors (K, 3) with the lens changed by (L,), to first order; L = 0: as it was."""
        if self.bearing_by_lens is None or not len(lens):
            return self.bearing_in_cam
        return torch.nn.functional.normalize(self.bearing_in_cam + self.bearing_by_lens @ lens, dim=1)


@dataclass(frozen=True)
class DepthMarks:
    """The same K marks, each to be projected onto the rendered surface by itself.

    Attributes:
        camera: (K,) int64 index into the cameras.
        xy: (K, 2) float64, x/z and y/z of the marks' rays.
        position_in_geo: (K, 3) float64 metres, surveyed.
        root_information: (K, 3, 3) float64 of survey, mark and surface together.
        share: (K,) float64, one over the number of marks of the same point.
        views: number of training views, each of which is rendered equally often.
        rows: by camera, its rows among the K.
        xy_by_lens: (K, 2, L) float64, derivative of `xy` by the lens parameters, as in `ControlMarks`.
    """

    camera: Tensor
    xy: Tensor
    position_in_geo: Tensor
    root_information: Tensor
    share: Tensor
    views: int
    rows: dict[int, slice]
    xy_by_lens: Tensor | None = None

    def rays(self, rows: slice, lens: Tensor) -> Tensor:
        """x/z and y/z (K', 2) of some marks with the lens changed by (L,), to first order."""
        if self.xy_by_lens is None or not len(lens):
            return self.xy[rows]
        return self.xy[rows] + self.xy_by_lens[rows] @ lens


@dataclass(frozen=True)
class Attitudes:
    """Recorded rotations of A training cameras.

    Attributes:
        camera: (A,) int64 index into the cameras.
        geo_from_cam: (A, 3, 3) float64, of the nominal camera axes.
        root_information: (A,) float64, 1/σ in 1/rad.
    """

    camera: Tensor
    geo_from_cam: Tensor
    root_information: Tensor


@dataclass(frozen=True)
class Pairs:
    """Distances between P pairs of points that were located on Earth, or of cameras with fixes.

    Attributes:
        distance_in_model: (P,) float64; None: of the cameras below.
        camera: (P, 2) int64 indices into the cameras; None: fixed points of the scene.
        distance_in_geo: (P,) float64 metres.
        root_information: (P,) float64, 1/σ of the measured distance in 1/m.
        share: what each pair counts for, 0 to 1: see `scale_share`.
    """

    distance_in_model: Tensor | None
    camera: Tensor | None
    distance_in_geo: Tensor
    root_information: Tensor
    share: float


@dataclass(frozen=True)
class Measured:
    """All of it; None where there is nothing of a kind, or it is not to be used.

    Attributes:
        depth_marks: given where control points are found through the rendered depth instead of by intersection.
        pairs: for L_rel. They are functions of the fixes, not a measurement of their own.
    """

    fixes: Fixes | None = None
    marks: ControlMarks | None = None
    depth_marks: DepthMarks | None = None
    attitudes: Attitudes | None = None
    pairs: Pairs | None = None

    def moved(self, move: Callable[[Tensor], Tensor]) -> Measured:
        """With every tensor replaced by `move` of it."""
        found = {field.name: getattr(self, field.name) for field in fields(self)}
        return Measured(**{name: None if kind is None else _moved(kind, move) for name, kind in found.items()})


def _moved(record: RecordT, move: Callable[[Tensor], Tensor]) -> RecordT:
    tensors = {
        field.name: move(getattr(record, field.name))
        for field in fields(record)  # type: ignore[arg-type]
        if isinstance(getattr(record, field.name), Tensor)
    }
    return replace(record, **tensors)  # type: ignore[type-var]


def scale_share(information_of_fixes: float, information_of_pairs: float) -> float:
    """What each pair may count for, so that all together say at most a tenth of what the fixes do of the scale.

    Located points are functions of the same few fixes (`georef.alignment`), and carry the lens's errors besides:
    counted as independent, some hundred of them would claim to know the scale many times better than the fixes from
    which they were made. Being nothing new, they shall steady the scale and not decide it.

    Args:
        information_of_fixes: Σ |W (C_i − C̄)|², of ln s.
        information_of_pairs: Σ (distance/σ)², of ln s.
    """
    most = _WORTH * information_of_fixes
    return min(1.0, most / information_of_pairs) if information_of_pairs > 0 else 0.0

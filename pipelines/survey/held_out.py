"""Measured points that a training was not given, by which `evaluate` measures the surface that it has made."""

from dataclasses import dataclass
from typing import ClassVar

from pipelines.core.products import ArrayProduct
from pipelines.core.types import FloatArray, IntArray


@dataclass(frozen=True)
class HeldOutPoints(ArrayProduct):
    """Product of `train` with measured geometry: N points of the squares that were held out.

    Attributes:
        point_in_model, normal_in_model: the points on the planes through their neighbours, and unit normals towards
            the view.
        view: camera of the training view that shows the point most closely.
        before_m: distance of the surface in the photographs' own depth map of that view from the point's plane,
            along the normal; NaN: the map shows none.
        share: of the squares that were held out.
        changed: number of held-out points that the photographs contradict; they are left out.
        unseen: number of those that no training view shows; they are left out.
    """

    FORMS: ClassVar = {
        "point_in_model": ("f", "N", 3),
        "normal_in_model": ("f", "N", 3),
        "view": ("i", "N"),
        "before_m": ("f", "N"),
        "share": ("f",),
        "changed": ("i",),
        "unseen": ("i",),
    }

    point_in_model: FloatArray
    normal_in_model: FloatArray
    view: IntArray
    before_m: FloatArray
    share: FloatArray
    changed: IntArray
    unseen: IntArray

"""Bodies of the requests of a page, checked before anything is done with them."""

import math
from typing import Annotated, Self

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, model_validator

from pipelines.core.products import ImageName
from pipelines.core.types import FloatArray
from pipelines.surface.picking import SurfacePoint
from pipelines.survey.saved_measurements import Kind
from pipelines.view.measuring import WantedBase
from pipelines.view.pictures import Box, Colouring, ViewerCamera, Wanted

_MOST_PX = 4096
Number = Annotated[float, Field(ge=-1e9, le=1e9)]
Triple = tuple[Number, Number, Number]
Index = Annotated[int, Field(ge=0, le=1_000_000)]
Name = Annotated[str, Field(min_length=1, max_length=200)]


class RequestBody(BaseModel):
    """Base of all bodies: no unknown fields, and finite numbers."""

    model_config = ConfigDict(extra="forbid", allow_inf_nan=False, frozen=True)


class CameraRequest(RequestBody):
    """Camera of a page, in the frame of the viewer; `rotation` is camera ← view, in rows."""

    rotation: Annotated[tuple[Number, ...], Field(min_length=9, max_length=9)]
    position: Triple
    fov: Annotated[float, Field(gt=0.001, lt=math.pi - 0.1)]
    width: Annotated[int, Field(ge=8, le=_MOST_PX)]
    height: Annotated[int, Field(ge=8, le=_MOST_PX)]

    @model_validator(mode="after")
    def _is_rotation(self) -> Self:
        rotation = np.array(self.rotation).reshape(3, 3)
        if np.abs(rotation @ rotation.T - np.eye(3)).max() > 1e-3 or np.linalg.det(rotation) < 0:
            raise ValueError("rotation: not a rotation")
        return self

    def camera(self) -> ViewerCamera:
        u, _, v = np.linalg.svd(np.array(self.rotation).reshape(3, 3))
        return ViewerCamera(u @ v, np.array(self.position), self.fov, self.width, self.height)


class PictureRequest(CameraRequest):
    """Picture to draw."""

    photograph: Index | None = None
    share: Annotated[float, Field(ge=0, le=1)] = 1.0
    colouring: Colouring = "photographs"
    background: tuple[Annotated[float, Field(ge=0, le=1)], ...] = Field((0.0, 0.0, 0.0), min_length=3, max_length=3)
    box: Box | None = None
    quality: Annotated[int, Field(ge=10, le=95)] = 80
    moving: bool = False

    def wanted(self) -> Wanted:
        red, green, blue = self.background
        return Wanted(self.photograph, self.share, self.colouring, (red, green, blue), self.box, self.moving)


class PickRequest(CameraRequest):
    """Pixel of a page under which to measure."""

    x: Number
    y: Number


class Place(RequestBody):
    """Measured point, as an answer of the server gave it."""

    position_in_geo: Triple
    cov_of_surface: tuple[Triple, Triple, Triple]
    cameras: Annotated[tuple[Index, ...], Field(min_length=1, max_length=10_000)]

    def point(self) -> SurfacePoint:
        cov = np.array(self.cov_of_surface)
        return SurfacePoint(np.array(self.position_in_geo), (cov + cov.T) / 2, np.array(self.cameras, np.int64))


_LEAST: dict[Kind, int] = {"point": 1, "distance": 2, "polyline": 2, "area": 3, "volume": 3, "profile": 2}


class MeasureRequest(RequestBody):
    """Measurement to make."""

    kind: Kind
    points: Annotated[tuple[Place, ...], Field(min_length=1, max_length=1000)]
    base: WantedBase = WantedBase()

    @model_validator(mode="after")
    def _enough(self) -> Self:
        if len(self.points) < _LEAST[self.kind]:
            raise ValueError(f"points: a {self.kind} needs {_LEAST[self.kind]}")
        if self.kind == "distance" and len(self.points) > 2:
            raise ValueError("points: a distance has two")
        return self


class SaveRequest(RequestBody):
    """Finished measurement to save, by the number of its job."""

    job: Index
    name: Name


class NamedRequest(RequestBody):
    """Name of a saved measurement, or of a point."""

    name: Name


class MarkRequest(RequestBody):
    """Mark of a point to set; without a place, to remove."""

    point: Name
    image: ImageName
    place_px: tuple[Number, Number] | None


class PointRequest(RequestBody):
    """Point to make, or to change; without coordinates, it is not surveyed."""

    name: Name
    xyz: Triple | None = None
    is_check: bool = False


class ProposalRequest(RequestBody):
    """Point for which to search marks."""

    point: Name


class SeenRequest(RequestBody):
    """Place in `geo` whose photographs are asked for."""

    position_in_geo: Triple

    def position(self) -> FloatArray:
        return np.array(self.position_in_geo)

"""Typed products: what the stages hand to each other, and how each is stored. What `ingest` makes: `survey.py`.

JSON products are pydantic models (validated on load: a product can be replaced by hand), arrays are NPZ
without pickle. Frames and units are those of docs/conventions.md: `geo` is East-North-Up metres at the survey's
origin, `local` the SfM model's frame, `model` the metric, origin-shifted frame in which the Gaussians live.
"""

from __future__ import annotations

import json
import zipfile
import zlib
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

import numpy as np
from numpy.typing import NDArray
from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationError

from pipelines.errors import InputError
from pipelines.validators import covariance, image_name, unit_quaternion

FloatArray = NDArray[np.float64]
Vector3 = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]
Matrix3 = tuple[Vector3, Vector3, Vector3]
Matrix34 = tuple[
    tuple[float, float, float, float], tuple[float, float, float, float], tuple[float, float, float, float]
]

# Products may be written by hand: larger than any survey's, and they are not even read.
_MAX_JSON_BYTES = 1 << 30

ImageName = Annotated[str, AfterValidator(image_name)]
Rotation = Annotated[Quaternion, AfterValidator(unit_quaternion)]
Covariance3 = Annotated[Matrix3, AfterValidator(covariance)]
Row7 = tuple[float, float, float, float, float, float, float]


class Product(BaseModel):
    """Base of the JSON products: immutable, no unknown keys, no NaN."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


class SimilarityRecord(Product):
    """A similarity `p_to = scale · R(quat_xyzw) p_from + translation` with its uncertainty.

    `covariance` is 7×7 over (δ ln s, δω [rad], δt [m]) of a perturbation applied in the target frame about
    `pivot`: `p' = pivot + δt + e^{δ ln s} Exp(δω) (p − pivot)`.
    """

    from_frame: str
    to_frame: str
    scale: float = Field(gt=0)
    quat_xyzw: Rotation
    translation: Vector3
    pivot: Vector3 = (0.0, 0.0, 0.0)
    covariance: Annotated[tuple[Row7, ...], Field(min_length=7, max_length=7)]


class ResidualStats(Product):
    """Residuals of a fit in metres. Not an accuracy."""

    count: int
    mean_h_m: float | None
    rmse_e_m: float | None
    rmse_n_m: float | None
    rmse_h_m: float | None
    rmse_v_m: float | None
    rmse_3d_m: float | None
    max_3d_m: float | None


class AttitudeRecord(Product):
    """Rotation `to ← from` of a similarity as recorded attitudes have it: covariance in rad² along target axes."""

    quat_xyzw: Rotation
    cov_rad2: Covariance3


class InitialSimilarity(Product):
    """Product of `init-sim3`: `geo_from_local`, how it was found and how well it is determined."""

    format_version: Literal[1] = 1
    geo_from_local: SimilarityRecord
    method: Literal["robust", "paper", "adjusted"]
    correspondences: dict[str, int]
    inliers: dict[str, int]
    gnss_outliers: tuple[str, ...] = ()
    residuals: dict[str, ResidualStats]
    condition_number: float
    layout: Literal["volume", "plane", "line"]
    attitude_used: bool
    attitude: AttitudeRecord | None = None


class TrainedCamera(Product):
    """A camera after training, as `cam_from_model`. A test camera has moved only with its neighbours.

    `exposure` is the gain matrix and offset (A | b) with which the photograph shows a colour c: A c + b.
    """

    name: ImageName
    split: Literal["train", "test"]
    quat_xyzw: Rotation
    translation: Vector3
    exposure: Matrix34 | None = None


class TrainedLens(Product):
    """The lens of a camera of the SfM model after training: COLMAP's parameters of COLMAP's camera model."""

    camera_id: int
    model: str
    params: tuple[float, ...]


class EstimatedError(Product):
    """A constant error of the measurements that training estimated, with its σ, by axis.

    `bias`: fix minus truth, east, north, up, in m; `flight` counts from 0 in the order of time. `lever-arm`:
    antenna seen from the camera beyond what the survey has applied, camera axes, in m. `boresight`: rotation vector
    from the true to the nominal camera axes, in degrees. `observed`: σ is at most half of that of the prior.
    """

    name: Literal["bias", "lever-arm", "boresight"]
    flight: int | None = None
    unit: Literal["m", "deg"]
    value: Vector3
    sigma: Vector3
    observed: tuple[bool, bool, bool]


class TrainedModel(Product):
    """Product of `train` beside the Gaussians: frames, cameras and what was optimised.

    `lenses`: of the cameras of the SfM model; one that is not among them is as SfM found it.
    """

    format_version: Literal[1] = 1
    geo_from_model: SimilarityRecord
    model_from_local: SimilarityRecord
    max_image_size: int = Field(gt=0)
    cameras: tuple[TrainedCamera, ...]
    lenses: tuple[TrainedLens, ...] = ()
    background: Vector3
    sh_degree: int
    iterations: int
    gaussians: int
    backend: Literal["cpu", "cuda"]
    gnss_outliers: tuple[str, ...] = ()
    control_outliers: tuple[str, ...] = ()
    estimated_errors: tuple[EstimatedError, ...] = ()


ProductT = TypeVar("ProductT", bound=BaseModel)


def save_json(product: BaseModel, path: Path) -> None:
    """Write a JSON product, indented, UTF-8."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(product.model_dump_json(indent=1) + "\n", encoding="utf-8")


def load_json(product_type: type[ProductT], path: Path) -> ProductT:
    """Read and validate a JSON product.

    Raises:
        InputError: unreadable, not JSON, or not of that form; names file and field.
    """
    try:
        if path.stat().st_size > _MAX_JSON_BYTES:
            raise InputError("is too large for a product", path=path)
        return product_type.model_validate_json(path.read_text(encoding="utf-8"))
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(str(part) for part in first["loc"])
        raise InputError(first["msg"], path=path, field=where or None) from error
    except UnicodeDecodeError as error:
        raise InputError("not a UTF-8 text file", path=path) from error
    except OSError as error:
        raise InputError(f"cannot be read: {error.strerror}", path=path) from error


def dump_json(document: Any) -> str:
    """JSON text of a plain document: no NaN, stable order."""
    return json.dumps(document, indent=1, allow_nan=False)


@dataclass(frozen=True)
class GeolocatedPoints:
    """Product of `geolocate`: N SfM points intersected in the geo frame.

    Attributes:
        point_id: (N,) int64, ids in the COLMAP model.
        position_in_geo: (N, 3) float64, metres; NaN where rays did not intersect.
        cov_in_geo: (N, 3, 3) float64, m².
        ray_count: (N,) int32, rays that were used.
        max_angle_deg: (N,) float64, largest angle between two of its rays.
        condition: (N,) float64, condition number of the normal matrix.
        inlier: (N,) bool.
        rotation_source: where the rays' rotations came from: "recorded" or "sfm".
    """

    point_id: NDArray[np.int64]
    position_in_geo: FloatArray
    cov_in_geo: FloatArray
    ray_count: NDArray[np.int32]
    max_angle_deg: FloatArray
    condition: FloatArray
    inlier: NDArray[np.bool_]
    rotation_source: str

    def save(self, path: Path) -> None:
        """Write as NPZ."""
        save_npz(path, {field.name: getattr(self, field.name) for field in fields(self)})

    @classmethod
    def load(cls, path: Path) -> GeolocatedPoints:
        """Read from NPZ.

        Raises:
            InputError: not an NPZ file of that form.
        """
        arrays = load_npz(path, tuple(field.name for field in fields(cls)))
        for name, (kind, shape) in _POINT_ARRAYS.items():
            array = arrays[name]
            if array.dtype.kind not in kind or array.shape != (len(arrays["point_id"].ravel()), *shape):
                raise InputError(f"has the form {array.shape} {array.dtype}", path=path, field=name)
        source = str(arrays.pop("rotation_source"))
        return cls(**arrays, rotation_source=source)


# Kind of number, and shape of one point's entry.
_POINT_ARRAYS: dict[str, tuple[str, tuple[int, ...]]] = {
    "point_id": ("i", ()),
    "position_in_geo": ("f", (3,)),
    "cov_in_geo": ("f", (3, 3)),
    "ray_count": ("i", ()),
    "max_angle_deg": ("f", ()),
    "condition": ("f", ()),
    "inlier": ("b", ()),
}


def save_npz(path: Path, arrays: dict[str, Any]) -> None:
    """Write arrays as an NPZ file."""
    path.parent.mkdir(parents=True, exist_ok=True)
    np.savez(path, **{name: np.asarray(array) for name, array in arrays.items()})  # type: ignore[arg-type]


def load_npz(path: Path, names: tuple[str, ...]) -> dict[str, NDArray[Any]]:
    """Read the named arrays of an NPZ file, without pickle.

    Raises:
        InputError: unreadable, or an array is missing.
    """
    try:
        with np.load(path, allow_pickle=False) as archive:
            missing = [name for name in names if name not in archive]
            if missing:
                raise InputError(f"array {missing[0]!r} is missing", path=path)
            return {name: archive[name] for name in names}
    except (OSError, ValueError, EOFError, MemoryError, zipfile.BadZipFile, zlib.error) as error:
        raise InputError(f"not a readable NPZ file: {error}", path=path) from error

"""`truth.json`: the truth that a simulated survey hides from the pipeline."""

from typing import Literal

from pipelines.core.products import Product
from pipelines.core.types import Matrix3, Vector3
from pipelines.geodesy.enu import Origin


class TrueLens(Product):
    """Lens as a COLMAP camera; the centre of the top-left pixel is (0.5, 0.5)."""

    model: str
    width: int
    height: int
    params: tuple[float, ...]


class TrueMark(Product):
    """Exact projection of a target, and the mark with noise in the files."""

    image: str
    x_px: float
    y_px: float
    written_x_px: float
    written_y_px: float


class TrueTarget(Product):
    """Survey target with its exact centre in geo.

    Attributes:
        number: of its tag, where targets are tags.
        corners_in_geo: of its face, of a tag without the white margin, clockwise from the upper left one.
    """

    name: str
    number: int
    role: Literal["control", "check"]
    surface: Literal["ground", "roof", "wall"]
    position_in_geo: Vector3
    corners_in_geo: tuple[Vector3, Vector3, Vector3, Vector3]
    marks: tuple[TrueMark, ...]


class TrueNavigation(Product):
    """Errors of the navigation.

    The bias is amplitude · sin(2π t / period + phase), t in seconds of the camera's clock since the first
    photograph.

    Attributes:
        common_error_m: systematic error of all fixes, east, north, up.
        wrong_images: photographs around which the fixes are wrong.
        nominal_from_cam: boresight: true camera axes → axes that mounting and attitude suggest.
        cam_from_body: nominal mounting, the body forward-right-down.
        clock_offset_s: navigation clock minus camera clock.
    """

    receiver: str
    sigma_h_m: float
    sigma_v_m: float
    bias_amplitude_m: Vector3
    bias_phase_rad: Vector3
    bias_period_s: float
    common_error_m: Vector3
    outlier_m: float
    wrong_images: tuple[str, ...]
    sigma_attitude_deg: float
    antenna_in_body_m: Vector3
    nominal_from_cam: Matrix3
    cam_from_body: Matrix3
    clock_offset_s: float


class TrueLidar(Product):
    """Errors of the LiDAR flight, and what has changed since.

    Attributes:
        sigma_m: white noise of the ranges.
        drift_m: RMS of the strips' slow drift per axis.
        arm_in_body_m: part of the scanner's lever arm that the cloud lacks.
        change: building removed or added since.
        returns_of_change: number of points on it.
        changed_footprint: its corners in geo, east and north.
    """

    sigma_m: float
    drift_m: float
    shift_in_geo_m: Vector3
    arm_in_body_m: Vector3
    change: Literal["none", "removed", "added"]
    returns: int
    returns_of_change: int
    changed_footprint: tuple[tuple[float, float], ...]


class TrueRegion(Product):
    """Region of the town that has changed since the first flight.

    Attributes:
        kind: excavation, heap, new or demolished.
        outline: its corners in geo, east and north.
        cut_m3, fill_m3: between the surfaces of both epochs inside it, seen from above.
    """

    kind: str
    outline: tuple[tuple[float, float], ...]
    cut_m3: float
    fill_m3: float


class TrueChange(Product):
    """Change since the first flight, beside the heights of both epochs in `heights.npz`.

    `corner` is the south-western one of their first cell, in geo; rows run north, columns east.
    """

    corner: tuple[float, float]
    cell_m: float
    regions: tuple[TrueRegion, ...]


class Truth(Product):
    """Truth of a survey. Lists run parallel to `images`; the geo frame is East-North-Up at `origin`.

    Attributes:
        centers: camera centres in geo, as the middle row is read.
        travels: their motion while all rows are read.
        cam_from_enu: rotations geo → camera.
        stamp_ns: camera clock.
        fix_errors: recorded minus true position of the antenna at the same stamp of the navigation clock.
        sun_in_geo: towards the sun.
        lidar: truth of the LiDAR flight; None: there is none.
        change: change since the first flight; None: this is the first.
    """

    format_version: Literal[1] = 1
    scene: str
    flight: str
    seed: int
    origin: Origin
    lens: TrueLens
    images: tuple[str, ...]
    stamp_ns: tuple[int, ...]
    centers: tuple[Vector3, ...]
    travels: tuple[Vector3, ...] = ()
    cam_from_enu: tuple[Matrix3, ...]
    fix_errors: tuple[Vector3, ...]
    navigation: TrueNavigation
    target_kind: Literal["quarters", "aruco", "apriltag"] = "quarters"
    targets: tuple[TrueTarget, ...]
    sigma_mark_px: float
    sigma_survey_m: float
    sun_in_geo: Vector3
    lidar: TrueLidar | None = None
    change: TrueChange | None = None

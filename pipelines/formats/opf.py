"""Projects of the Open Photogrammetry Format 1.0 (Pix4D/opf-spec): solved cameras, tie points and control points.

A project (`.opf`) lists JSON files by format. Camera axes are x right, y up, z backward, and R_x(ω) R_y(φ) R_z(κ)
turns them into the processing CRS. Principal points count from the corner of the top-left pixel. Perspective lenses
are OpenCV's (R1 R2 T1 T2 R3); a fisheye's radius is a polynomial of 2θ/π, and an affine matrix leads to pixels.
Read without Pix4D's `pyopf`, which maps into memory whatever file a project names.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path, PurePosixPath
from typing import Literal, TypeVar
from urllib.parse import unquote, urlsplit

import numpy as np
from pydantic import BaseModel, Field

from pipelines.core.errors import InputError
from pipelines.core.products import Remark, load_json
from pipelines.core.types import FloatArray, Vector3
from pipelines.core.validators import stays_inside
from pipelines.formats.ground_points import GroundPoints, ListedMark, ListedPoint, without_repeats
from pipelines.formats.opf_tracks import read_tracks
from pipelines.formats.solved_cameras import (
    Foreign,
    PhotoSize,
    SolvedCameras,
    SolvedPhotograph,
    crs_name,
    not_placed,
    solved_cameras,
)
from pipelines.geometry.cameras import Camera
from pipelines.geometry.lens_fit import FISHEYE, Brown, ForeignLens, brown_lens
from pipelines.geometry.rotations import map_from_cam

PROGRAM = "OPF"
PROJECT = "application/opf-project+json"
_CAMERA_LIST = "application/opf-camera-list+json"
_INPUT = "application/opf-input-cameras+json"
_POINTS = "application/opf-input-control-points+json"
_CALIBRATED = "application/opf-calibrated-cameras+json"
_REFERENCE = "application/opf-scene-reference-frame+json"
_GLTF = "model/gltf+json"
ModelT = TypeVar("ModelT", bound=BaseModel)


class _Resource(Foreign):
    uri: str
    format: str


class _Item(Foreign):
    type: str
    resources: list[_Resource]


class _Project(Foreign):
    format: Literal["application/opf-project+json"]
    version: str
    items: list[_Item]


class _ListedCamera(Foreign):
    id: int
    uri: str


class _CameraList(Foreign):
    cameras: list[_ListedCamera]


class _InputSensor(Foreign):
    id: int
    image_size_px: tuple[float, float]
    shutter_type: str = "global"


class _InputCameras(Foreign):
    sensors: list[_InputSensor]


class _Internals(Foreign):
    type: str
    principal_point_px: tuple[float, float] = (0.0, 0.0)
    focal_length_px: float | None = None
    radial_distortion: Vector3 = (0.0, 0.0, 0.0)
    tangential_distortion: tuple[float, float] = (0.0, 0.0)
    affine: tuple[float, float, float, float] | None = None
    polynomial: list[float] = Field([], max_length=20)


class _Sensor(Foreign):
    id: int
    internals: _Internals


class _Camera(Foreign):
    id: int
    sensor_id: int
    position: Vector3
    orientation_deg: Vector3
    rolling_shutter: Vector3 | None = None


class _Calibrated(Foreign):
    sensors: list[_Sensor]
    cameras: list[_Camera]


class _Crs(Foreign):
    definition: str = ""
    geoid_height: float | None = None


class _Geolocation(Foreign):
    crs: _Crs
    coordinates: Vector3  # in the order of the axes of the CRS
    sigmas: Vector3


class _Mark(Foreign):
    camera_id: int
    position_px: tuple[float, float]


class _Point(Foreign):
    id: str = Field(min_length=1)
    geolocation: _Geolocation
    marks: list[_Mark]
    is_checkpoint: bool = False


class _InputPoints(Foreign):
    gcps: list[_Point] = Field(default_factory=list)


class _Reference(Foreign):
    crs: _Crs


def read_opf(path: Path, photo_size: PhotoSize) -> SolvedCameras:
    r"""Read the calibrated cameras of a project, with the tie points of their calibration.

    Raises:
        InputError: unreadable, not of OPF 1.0, files that are missing or outside of the project's folder, no
            calibrated cameras, or what `solved_cameras` refuses.

    Examples:
        >>> from pipelines.formats.colmap import read_sparse
        >>> from pipelines.formats.opf_writer import OpfFrame, OpfPhotograph, OpfScene, write_opf
        >>> _ = Path("cameras.txt").write_text("1 PINHOLE 400 300 350 350 200 150\n")
        >>> _ = Path("images.txt").write_text("1 1 0 0 0 0 0 5 1 a.jpg\n\n")
        >>> Path("points3D.txt").touch()
        >>> frame = OpfFrame("EPSG:4979", shift=np.zeros(3))
        >>> _ = write_opf(Path(), OpfScene("flight", frame, read_sparse(Path()), [OpfPhotograph("a.jpg")], []))
        >>> solved = read_opf(Path("project.opf"), lambda name: (400, 300))
        >>> solved.model.image_name, solved.model.focal_px.tolist()
        (('a.jpg',), [350.0])
    """
    project = _project(path)
    calibration, item, remarks = _calibration(project, path)
    names = _photographs(project, path)
    sizes = {sensor.id: sensor for given in _all(project, _INPUT, _InputCameras, path) for sensor in given.sensors}
    photographs: list[SolvedPhotograph] = []
    photograph_of: dict[int, int] = {}
    for camera in calibration.cameras:
        if camera.id not in names:
            continue
        photograph_of[camera.id] = len(photographs)
        rotation, center = map_from_cam(camera.orientation_deg), np.array(camera.position)
        photographs.append(SolvedPhotograph(names[camera.id], str(camera.sensor_id), rotation, center))
    lenses = {str(sensor.id): _lens(sensor, sizes, path) for sensor in calibration.sensors}
    if unlisted := [camera.id for camera in calibration.cameras if camera.id not in names]:
        sentence = (
            f"{len(unlisted)} of {len(calibration.cameras)} calibrated cameras are left out: the camera list has "
            f"no file for them (such as {unlisted[0]})."
        )
        remarks.append(Remark(code="cameras-without-file", sentence=sentence))
    rolling = [camera for camera in calibration.cameras if any(camera.rolling_shutter or ())]
    if rolling:
        sentence = f"The rolling shutter of {len(rolling)} cameras is solved: poses are taken, the motion is not."
        remarks.append(Remark(code="rolling-shutter-not-taken", sentence=sentence))
    for frame in _all(project, _REFERENCE, _Reference, path):
        remarks.append(not_placed(PROGRAM, crs_name(frame.crs.definition)))
        break
    tracks = next((_beside(resource.uri, path) for resource in item.resources if resource.format == _GLTF), None)
    ties = None if tracks is None else read_tracks(tracks, photograph_of, _beside)
    return solved_cameras(path, PROGRAM, photographs, lenses, photo_size, ties=ties, remarks=remarks)


def has_tracks(path: Path) -> bool:
    """Return whether a project names a file of tie points."""
    return any(
        resource.format == _GLTF for item in _items(_project(path), "calibration") for resource in item.resources
    )


def read_opf_points(path: Path) -> GroundPoints:
    r"""Read the control points that were given to a project, with their marks; manual tie points are left out.

    Raises:
        InputError: unreadable, not of OPF 1.0, no control point, several CRSs, a height above a geoid of which only
            its own height is stated, or one point at two places.

    Examples:
        >>> from pipelines.formats.colmap import read_sparse
        >>> from pipelines.formats.opf_writer import OpfFrame, OpfPhotograph, OpfPoint, OpfScene, write_opf
        >>> _ = Path("cameras.txt").write_text("1 PINHOLE 400 300 350 350 200 150\n")
        >>> _ = Path("images.txt").write_text("1 1 0 0 0 0 0 5 1 a.jpg\n\n")
        >>> Path("points3D.txt").touch()
        >>> frame, photographs = OpfFrame("EPSG:4979", shift=np.zeros(3), swap_xy=True), [OpfPhotograph("a.jpg")]
        >>> xyz, sigma, marks = np.array([7.1, 46.8, 498.5]), np.full(3, 0.02), (("a.jpg", 210.5, 133.0, 0.5),)
        >>> points = [OpfPoint("P1", is_check=False, xyz=xyz, sigma=sigma, marks=marks)]
        >>> _ = write_opf(Path(), OpfScene("flight", frame, read_sparse(Path()), photographs, points))
        >>> found = read_opf_points(Path("project.opf"))
        >>> found.points[0].xyz, found.in_order_of_crs, found.marks[0].x_px
        ((46.8, 7.1, 498.5), True, 210.5)
    """
    project = _project(path)
    names = _photographs(project, path)
    control = [point for given in _all(project, _POINTS, _InputPoints, path) for point in given.gcps]
    if not control:
        raise InputError("no-control-points", "The project has no control points.", path=path, field="gcps")
    points, marks = [], []
    definitions = {point.geolocation.crs.definition for point in control}
    if len(definitions) > 1:
        message = f"The control points are in {len(definitions)} CRSs."
        remedy = "Export those of one."
        raise InputError("several-crs", message, path=path, field="crs", remedy=remedy)
    for point in control:
        geolocation = point.geolocation
        if geolocation.crs.geoid_height is not None:
            message = (
                f"The heights of {point.id} are above a geoid of which one height alone is stated, "
                f"{geolocation.crs.geoid_height:g}."
            )
            remedy = "Export the project with a geoid model, or list the points otherwise."
            raise InputError("geoid-height", message, path=path, field="geoid_height", remedy=remedy)
        sigma_h_m, sigma_v_m = max(geolocation.sigmas[:2]), geolocation.sigmas[2]
        points.append(
            ListedPoint(
                line=1,
                name=point.id,
                xyz=geolocation.coordinates,
                sigma_h_m=sigma_h_m if sigma_h_m > 0 else None,
                sigma_v_m=sigma_v_m if sigma_v_m > 0 else None,
                is_check=point.is_checkpoint,
            )
        )
        for mark in point.marks:
            image = PurePosixPath(names.get(mark.camera_id, f"camera {mark.camera_id}").replace("\\", "/"))
            inside = image.name if image.is_absolute() or ".." in image.parts else str(image)
            marks.append(ListedMark(1, point.id, inside, *mark.position_px))
    return GroundPoints(
        path=path,
        kind="OPF's control points",
        points=without_repeats(points, path),
        marks=tuple(marks),
        crs_text=control[0].geolocation.crs.definition,
        in_order_of_crs=True,
    )


def _photographs(project: _Project, path: Path) -> dict[int, str]:
    """Return the names of the photographs by UID of their camera."""
    lists = _all(project, _CAMERA_LIST, _CameraList, path)
    return {camera.id: _name(camera.uri) for listed in lists for camera in listed.cameras}


def _project(path: Path) -> _Project:
    project = load_json(_Project, path)
    if not re.fullmatch(r"1\.\d{1,4}", project.version):  # another minor version breaks nothing, a draft may
        message = f"The project is of version {project.version[:20]!r} of OPF, and 1.0 to 1.9 are read."
        remedy = "Export it again."
        raise InputError("opf-version", message, path=path, field="version", remedy=remedy)
    return project


def _items(project: _Project, kind: str) -> list[_Item]:
    return [item for item in project.items if item.type == kind]


def _calibration(project: _Project, path: Path) -> tuple[_Calibrated, _Item, list[Remark]]:
    """Return the calibration of most cameras, its item, and that there are others."""
    found = [
        (load_json(_Calibrated, _beside(resource.uri, path)), item)
        for item in _items(project, "calibration")
        for resource in item.resources
        if resource.format == _CALIBRATED
    ]
    if not found:
        message = "The project has no calibrated cameras: calibrate it, and export it again."
        raise InputError("no-solved-cameras", message, path=path, field="items")
    best, item = max(found, key=lambda entry: len(entry[0].cameras))
    if len(found) == 1:
        return best, item, []
    sentence = f"Of {len(found)} calibrations that of {len(best.cameras)} cameras, the most, is taken."
    return best, item, [Remark(code="several-models", sentence=sentence)]


def _all(project: _Project, kind: str, model: type[ModelT], path: Path) -> Iterator[ModelT]:
    """Yield what the resources of a format hold."""
    for item in project.items:
        for resource in item.resources:
            if resource.format == kind:
                yield load_json(model, _beside(resource.uri, path))


def _beside(uri: str, path: Path) -> Path:
    """Return the file that a relative URI in a file means, inside the folder of that file."""
    try:
        parts = urlsplit(uri)
        name = unquote(parts.path).removeprefix("./")
    except ValueError:
        parts, name = urlsplit("x:"), ""
    if parts.scheme or parts.netloc or not stays_inside(name):
        message = f"The URI {uri[:80]!r} leads out of the folder of the project."
        remedy = "Export it with its files."
        raise InputError("file-outside-folder", message, path=path, field="uri", remedy=remedy)
    return path.parent / name


def _name(uri: str) -> str:
    """Return the path of a photograph in a URI, which may be one of another machine."""
    try:
        parts = urlsplit(uri)
    except ValueError:
        return uri
    return unquote(parts.path) if parts.scheme in ("", "file") else uri


def _lens(sensor: _Sensor, sizes: dict[int, _InputSensor], path: Path) -> ForeignLens:
    if sensor.id not in sizes:
        message = f"The input cameras have no sensor {sensor.id}, which states the size of its pictures."
        raise InputError("lens-missing", message, path=path, field="input_cameras")
    width, height = sizes[sensor.id].image_size_px
    internals = sensor.internals
    size = (round(width), round(height))
    if internals.type == "perspective" and internals.focal_length_px is not None and internals.focal_length_px > 0:
        focal = (internals.focal_length_px, internals.focal_length_px)
        return brown_lens(
            Brown(
                size,
                focal,
                internals.principal_point_px,
                radial=(*internals.radial_distortion, 0.0),
                tangential=internals.tangential_distortion,
            )
        )
    if internals.type == "fisheye" and internals.affine is not None and len(internals.polynomial) > 1:
        return _fisheye(size, internals, path)
    message = f"The lens of sensor {sensor.id} ({internals.type[:40]!r}) has no like among COLMAP's models."
    raise InputError("lens-not-convertible", message, path=path, field="internals")


def _fisheye(size: tuple[int, int], internals: _Internals, path: Path) -> ForeignLens:
    """Return the lens of Pix4D's fisheye: ρ(2θ/π) along the ray's direction, turned into pixels by a matrix."""
    assert internals.affine is not None
    affine = np.array(internals.affine).reshape(2, 2)
    center, polynomial = np.array(internals.principal_point_px), np.array(internals.polynomial)
    focal = np.diag(affine) * polynomial[1] * 2 / np.pi
    if not (focal > 0).all():
        message = "A fisheye has no focal length above zero."
        raise InputError("focal-length-impossible", message, path=path, field="affine")

    def pixels_of(ray: FloatArray) -> FloatArray:
        radius = np.hypot(*ray.T)
        bent = np.polynomial.polynomial.polyval(np.arctan(radius) * 2 / np.pi, polynomial)
        along = (
            ray * np.where(radius > 0, bent / np.where(radius > 0, radius, 1.0), polynomial[1] * 2 / np.pi)[:, None]
        )
        return np.asarray(along @ affine.T + center)

    cubic = polynomial[3] / polynomial[1] * (2 / np.pi) ** 2 if len(polynomial) > 3 else 0.0
    start = Camera(FISHEYE, *size, np.array([*focal, *center, cubic, 0.0, 0.0, 0.0]))
    return ForeignLens(start, pixels_of)

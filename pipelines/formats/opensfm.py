"""Reconstructions of OpenSfM and ODM: `reconstruction.json`, and ODM's `shots.geojson` with `cameras.json`.

`reconstruction.json` is a list of models with cameras, shots and points (opensfm.org, "Dataset structure"). A shot
has rotation (axis times angle) and translation world → camera (x right, y down, z forward). Focal lengths, offsets
of the principal point and image coordinates are shares of the longer side, counted from the middle of the image.
`tracks.csv` beside it lists which photograph observes which point, also the observations that OpenSfM has
rejected: those further from their point than its own limit are left out.

In ODM's `odm_report/shots.geojson`, `translation` is the camera's position in the map of the project, and
`cameras.json` in the project's folder has the lenses.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TypeVar

import numpy as np
from pydantic import BaseModel, Field, RootModel

from pipelines.core.errors import InputError
from pipelines.core.files import file_size, reading
from pipelines.core.products import Remark, load_json
from pipelines.core.types import FloatArray, IntArray, Vector3
from pipelines.formats.solved_cameras import (
    LONGEST_SIDE_PX,
    Foreign,
    PhotoSize,
    SolvedCameras,
    SolvedPhotograph,
    TiePoints,
    not_placed,
    solved_cameras,
    without_far_observations,
)
from pipelines.geometry.lens_fit import Brown, ForeignLens, brown_lens, fisheye_lens
from pipelines.geometry.rotations import exp_so3

OPENSFM, ODM = "OpenSfM", "OpenDroneMap"
TRACKS, CAMERAS = "tracks.csv", "cameras.json"
_OUTLIER = 0.006  # OpenSfM's bundle_outlier_fixed_threshold, of the longer side
_MOST_TRACKS_BYTES = 8 << 30
_TRACK_CELLS = 5
ModelT = TypeVar("ModelT", bound=BaseModel)


class _Camera(Foreign):
    projection_type: str
    width: int = Field(gt=0, le=LONGEST_SIDE_PX)
    height: int = Field(gt=0, le=LONGEST_SIDE_PX)
    focal: float | None = None
    focal_x: float | None = None
    focal_y: float | None = None
    c_x: float = 0.0
    c_y: float = 0.0
    k1: float = 0.0
    k2: float = 0.0
    k3: float = 0.0
    k4: float = 0.0
    p1: float = 0.0
    p2: float = 0.0


class _Shot(Foreign):
    rotation: Vector3
    translation: Vector3
    camera: str


class _Point(Foreign):
    coordinates: Vector3
    color: Vector3 = (0.0, 0.0, 0.0)


class _Place(Foreign):
    latitude: float
    longitude: float


class _Reconstruction(Foreign):
    cameras: dict[str, _Camera]
    shots: dict[str, _Shot]
    points: dict[str, _Point] = Field(default_factory=dict)
    reference_lla: _Place | None = None


class _Reconstructions(RootModel[list[_Reconstruction]]):
    pass


class _Cameras(RootModel[dict[str, _Camera]]):
    pass


class _Properties(Foreign):
    filename: str
    rotation: Vector3
    translation: Vector3
    camera: str | None = None
    width: int | None = None
    height: int | None = None


class _Feature(Foreign):
    properties: _Properties


class _Shots(Foreign):
    features: list[_Feature]


def read_reconstruction(path: Path, photo_size: PhotoSize) -> SolvedCameras:
    """Read the largest model of a `reconstruction.json`, with its tie points if `tracks.csv` is beside it.

    Raises:
        InputError: unreadable, not of OpenSfM, an unknown projection, or what `solved_cameras` refuses.

    Examples:
        >>> import json
        >>> lens = {"projection_type": "perspective", "width": 400, "height": 300, "focal": 0.875, "k1": 0}
        >>> shot = {"camera": "v1", "rotation": [0, 0, 0], "translation": [0, 0, 5]}
        >>> document = [{"cameras": {"v1": lens}, "shots": {"a.jpg": shot}, "points": {}}]
        >>> _ = Path("reconstruction.json").write_text(json.dumps(document))
        >>> solved = read_reconstruction(Path("reconstruction.json"), lambda name: (400, 300))
        >>> solved.model.image_name, solved.model.focal_px.tolist()
        (('a.jpg',), [350.0])
    """
    models = load_json(_Reconstructions, path).root
    if not models:
        raise InputError("no-solved-cameras", f"{OPENSFM} has solved no camera in this file.", path=path)
    model = max(models, key=lambda each: len(each.shots))
    remarks = []
    if len(models) > 1:
        sentence = (
            f"The file has {len(models)} models without a common frame: the largest, of {len(model.shots)} "
            "photographs, is taken."
        )
        remarks.append(Remark(code="several-models", sentence=sentence))
    photographs = []
    for name, shot in model.shots.items():
        world_from_cam = exp_so3(shot.rotation).T
        center = -world_from_cam @ np.array(shot.translation)
        photographs.append(SolvedPhotograph(name, shot.camera, world_from_cam, center))
    if model.reference_lla is not None:
        place = f"about {model.reference_lla.latitude:.4f}° N, {model.reference_lla.longitude:.4f}° E"
        remarks.append(not_placed(OPENSFM, place))
    lenses = _lenses(model.cameras, {shot.camera for shot in model.shots.values()}, path)
    ties = _tie_points(model, photographs, path.with_name(TRACKS))
    solved = solved_cameras(path, OPENSFM, photographs, lenses, photo_size, ties=ties, remarks=remarks)
    return without_far_observations(solved, _OUTLIER)


def read_shots(path: Path, photo_size: PhotoSize) -> SolvedCameras:
    """Read ODM's `shots.geojson`, and the lenses from its `cameras.json` beside it or in the folder above.

    Raises:
        InputError: unreadable, not of ODM, no `cameras.json`, several cameras of one size among which nothing
            decides, an unknown projection, or what `solved_cameras` refuses.

    Examples:
        >>> import json
        >>> lens = {"projection_type": "perspective", "width": 400, "height": 300, "focal": 0.875, "k1": 0}
        >>> _ = Path("cameras.json").write_text(json.dumps({"v1": lens}))
        >>> shot = {"filename": "a.jpg", "camera": "v1", "width": 400, "height": 300}
        >>> shot |= {"rotation": [0, 0, 0], "translation": [500010, 5180020, 550]}
        >>> _ = Path("shots.geojson").write_text(json.dumps({"features": [{"properties": shot}]}))
        >>> solved = read_shots(Path("shots.geojson"), lambda name: (400, 300))
        >>> solved.model.image_name, solved.model.focal_px.tolist()
        (('a.jpg',), [350.0])
    """
    shots = [feature.properties for feature in load_json(_Shots, path).features]
    places = (path.with_name(CAMERAS), path.parent.parent / CAMERAS)
    file = next((place for place in places if place.is_file()), None)
    if file is None:
        message = f"The lenses are missing: put ODM's {CAMERAS} of the same project beside it."
        raise InputError("lens-missing", message, path=path, field=CAMERAS)
    cameras = load_json(_Cameras, file).root
    photographs = []
    for shot in shots:
        world_from_cam = exp_so3(shot.rotation).T
        photographs.append(
            SolvedPhotograph(
                shot.filename, _camera_of(shot, cameras, path), world_from_cam, np.array(shot.translation)
            )
        )
    lenses = _lenses(cameras, {photograph.lens for photograph in photographs}, file)
    remarks = [not_placed(ODM, "a map")]
    return solved_cameras(path, ODM, photographs, lenses, photo_size, remarks=remarks)


def _camera_of(shot: _Properties, cameras: Mapping[str, _Camera], path: Path) -> str:
    """Return the key of a shot's camera: the one it names, or the only one of its size."""
    named = [key for key in cameras if shot.camera is not None and _plain(key) == _plain(shot.camera)]
    if len(named) == 1:
        return named[0]
    fit = [
        key
        for key, camera in cameras.items()
        if len(cameras) == 1 or (camera.width, camera.height) == (shot.width, shot.height)
    ]
    if len(fit) != 1:
        message = f"{len(fit)} cameras of {CAMERAS} may be that of the photograph {shot.filename!r}; one is needed."
        raise InputError("lens-missing", message, path=path, field="camera")
    return fit[0]


def _plain(key: str) -> str:
    """Return the name of a camera as ODM's `cameras.json` has it: without the version of the name before it."""
    return key.removeprefix("v2 ")


def _lenses(cameras: Mapping[str, _Camera], used: set[str], path: Path) -> dict[str, ForeignLens]:
    return {key: _lens(key, camera, path) for key, camera in cameras.items() if key in used}


def _lens(key: str, camera: _Camera, path: Path) -> ForeignLens:
    width, height, kind = camera.width, camera.height, camera.projection_type
    side = max(width, height)
    focal = camera.focal if camera.focal is not None else camera.focal_x
    other = camera.focal_y if camera.focal is None and camera.focal_y is not None else focal
    if focal is None or other is None or not min(focal, other) > 0:
        message = f"The camera {key[:80]!r} has no focal length."
        raise InputError("focal-length-impossible", message, path=path, field="cameras")
    radial = (camera.k1, camera.k2, camera.k3, camera.k4)
    brown = Brown(
        (width, height),
        (focal * side, other * side),
        (width / 2 + camera.c_x * side, height / 2 + camera.c_y * side),
        radial=radial,
        tangential=(camera.p1, camera.p2),
    )
    if kind in ("perspective", "brown", "radial", "simple_radial"):
        return brown_lens(brown)
    if kind in ("fisheye", "fisheye_opencv"):
        return fisheye_lens(brown)
    message = f"The projection {kind[:40]!r} of the camera {key[:80]!r} has no like among COLMAP's models."
    raise InputError("lens-not-convertible", message, path=path, field="projection_type")


def _tie_points(model: _Reconstruction, photographs: Sequence[SolvedPhotograph], tracks: Path) -> TiePoints | None:
    """Return the points that `tracks.csv` says are observed; None: there is no such file, or no point."""
    if not tracks.exists() or not model.points:
        return None
    row_of = {key: row for row, key in enumerate(model.points)}
    photograph_of = {photograph.name: row for row, photograph in enumerate(photographs)}
    cameras = [model.cameras.get(photograph.lens) for photograph in photographs]
    # Pixels are shares of the longer side, from the middle.
    scale = np.array([[max(c.width, c.height), c.width / 2, c.height / 2] if c else [np.nan] * 3 for c in cameras])
    points, owners, shares = _observations(tracks, row_of, photograph_of)
    pixels = shares * scale[owners, :1] + scale[owners, 1:]
    rgb = np.clip(np.array([point.color for point in model.points.values()]), 0, 255).astype(np.uint8)
    position = np.array([point.coordinates for point in model.points.values()])
    return TiePoints(position, rgb, points, owners, pixels)


def _observations(
    tracks: Path, row_of: Mapping[str, int], photograph_of: Mapping[str, int]
) -> tuple[IntArray, IntArray, FloatArray]:
    """Return point, photograph and image coordinates (M, 2) of the observations of known points."""
    file_size(tracks, limit_bytes=_MOST_TRACKS_BYTES, kind="file of tracks")
    points, owners, shares = [], [], []
    with reading(tracks), tracks.open("rb") as stream:
        for number, data in enumerate(stream, start=1):
            cells = data.decode("utf-8", "replace").rstrip("\r\n").split("\t")
            if len(cells) < _TRACK_CELLS:
                if number == 1 or not data.strip():  # OPENSFM_TRACKS_VERSION_v2
                    continue
                message = f"The line has {len(cells)} cells; photograph, track, feature, x and y are needed."
                raise InputError("cells-missing", message, path=tracks, line=number)
            point, owner = row_of.get(cells[1]), photograph_of.get(cells[0])
            if point is None or owner is None:
                continue
            try:
                shares.append((float(cells[3]), float(cells[4])))
            except ValueError as error:
                message = f"{cells[3][:20]!r}, {cells[4][:20]!r} are no image coordinates"
                raise InputError("not-a-number", message, path=tracks, line=number, field="x y") from error
            points.append(point)
            owners.append(owner)
    return np.array(points, dtype=np.int64), np.array(owners, dtype=np.int64), np.array(shares).reshape(-1, 2)

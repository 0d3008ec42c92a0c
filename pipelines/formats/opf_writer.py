"""Writing of OPF 1.0 projects (Pix4D/opf-spec): solved cameras, tie points, control points with marks, the surface.

A project is one folder. `project.opf` lists its files; photographs are listed by their names, relative to it. Poses
and points are in the processing CRS: metres in the directions of a map's axes, shifted to the scene. Conventions
are those of `opf`, which reads such projects.

OPF has an item for point clouds and none for Gaussians. Those are an extension, as the specification names it: an
item `ext_georefgs_gaussian_splats` with a resource `application/ext-georefgs-gaussian-splats+ply`, a 3DGS PLY whose
frame is the processing CRS. Programs that do not know an extension leave it out.
"""

from __future__ import annotations

import hashlib
import uuid
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from urllib.parse import quote

import numpy as np

from pipelines import __version__
from pipelines.core.files import replace_text
from pipelines.core.json_values import Json
from pipelines.core.products import dump_json
from pipelines.core.types import FloatArray
from pipelines.formats.camera_files import lens_of
from pipelines.formats.opf_gltf import ArrayFile, write_points
from pipelines.formats.opf_tracks import MATCHES
from pipelines.geometry.cameras import Camera, distort, parameters_in, undistort
from pipelines.geometry.rotations import omega_phi_kappa_deg
from pipelines.geometry.sparse_model import SparseModel

PROJECT_FILE = "project.opf"
POINT_CLOUD, SPLATS = "point_cloud", "ext_georefgs_gaussian_splats"  # types of items
SPLATS_FORMAT = "application/ext-georefgs-gaussian-splats+ply"
_SAMPLES = 25  # rays along each side of the image, by which a lens is fitted
_UNKNOWN_TIME = "1970-01-01T00:00:00"  # OPF demands one; without a zone it is not known
_BANDS = (("R", 0.2126), ("G", 0.7152), ("B", 0.0722))  # with their weights in a grey image
_NAMESPACE = uuid.UUID("6f1e2a52-7a55-5c0e-9f5e-0e6f1c1d7a10")
_COVARIANCE = "GEOREFGS_covariance"


@dataclass(frozen=True)
class OpfFrame:
    """Scene reference frame: p_processing = (scale · p, x and y swapped if asked) + shift.

    Attributes:
        definition: of the CRS, as WKT2 with three axes.
        scale: metres in a unit of the three axes, in the order of the CRS.
        swap_xy: the CRS has the northing first.
    """

    definition: str
    shift: FloatArray
    scale: FloatArray = field(default_factory=lambda: np.ones(3))
    swap_xy: bool = False

    def coordinates(self, xyz: FloatArray) -> list[float]:
        """Return coordinates (3,), easting first, in the order of the axes of the CRS."""
        x, y, z = xyz.tolist()
        return [y, x, z] if self.swap_xy else [x, y, z]

    def processing(self, xyz: FloatArray) -> FloatArray:
        """Return points (N, 3) of the processing CRS, of coordinates (N, 3) in the CRS, easting first."""
        scale = self.scale[[1, 0, 2]] if self.swap_xy else self.scale
        return np.asarray(xyz * scale + self.shift)


@dataclass(frozen=True)
class OpfPhotograph:
    """Measurements of a photograph: seconds since 1970, coordinates in the CRS, easting first, with σ."""

    name: str
    time_s: float | None = None
    xyz: FloatArray | None = None
    sigma: FloatArray | None = None


@dataclass(frozen=True)
class OpfPoint:
    """Control or check point: coordinates in the CRS, easting first, with σ, and its marks in photographs.

    A mark is the name of its photograph, its pixel and its σ in pixels.
    """

    name: str
    is_check: bool
    xyz: FloatArray
    sigma: FloatArray
    marks: tuple[tuple[str, float, float, float], ...]


@dataclass(frozen=True)
class OpfScene:
    """Content of a project.

    Attributes:
        model: cameras and tie points in the processing CRS.
        photographs: what was measured of each photograph of the model, in its order.
        rolling: keys of cameras with a rolling shutter.
        covariances: (n, 6, 6) of (δθ [rad], δc [m]) along the axes of the processing CRS; None: not known.
        made: resources of what was made of the calibration and lies in the folder, by type of their item.
    """

    name: str
    frame: OpfFrame
    model: SparseModel
    photographs: Sequence[OpfPhotograph]
    points: Sequence[OpfPoint]
    rolling: frozenset[int] = frozenset()
    covariances: FloatArray | None = None
    made: Mapping[str, Sequence[Json]] = field(default_factory=dict)


def write_opf(folder: Path, scene: OpfScene) -> float:
    """Write a project into a folder, and return the largest error in pixels of a lens that OPF cannot hold."""
    lenses = {key: internals_of(camera) for key, camera in scene.model.cameras.items()}
    uids = [uid_of(name) for name in scene.model.image_name]
    files = {
        "camera_list": ("camera-list", _camera_list(scene, uids)),
        "input_cameras": ("input-cameras", _input_cameras(scene, uids, lenses)),
        "scene_reference_frame": ("scene-reference-frame", _frame(scene.frame)),
        "input_control_points": ("input-control-points", _control_points(scene)),
        "calibration": ("calibrated-cameras", _calibrated(scene, uids, lenses)),
    }
    items: dict[str, Json] = {}
    for kind, (name, content) in files.items():
        form = f"application/opf-{name}+json"
        file = f"{name.replace('-', '_')}.json"
        _write(folder / file, {"format": form, "version": "1.0", **content})
        items[kind] = _item(scene.name, kind, [{"uri": file, "format": form}])
    items["calibration"]["resources"] += _write_tracks(folder, scene.model, uids)
    for kind, resources in scene.made.items():
        items[kind] = _item(scene.name, kind, resources)
    for kind, sources in {
        "input_cameras": ("camera_list",),
        "input_control_points": ("camera_list",),
        "calibration": ("input_cameras", "scene_reference_frame", "input_control_points"),
        **dict.fromkeys(scene.made, ("scene_reference_frame", "calibration")),
    }.items():
        items[kind]["sources"] = [{"id": items[source]["id"], "type": source} for source in sources]
    project = {
        "format": "application/opf-project+json",
        "version": "1.0",
        "name": scene.name,
        "description": "Cameras, tie points, control points and what was made of them",
        "generator": {"name": "GeoRefGS", "version": __version__},
        "id": str(uuid.uuid5(_NAMESPACE, scene.name)),
        "items": list(items.values()),
    }
    _write(folder / PROJECT_FILE, project)
    return max((error for _, error in lenses.values()), default=0.0)


def _item(project: str, kind: str, resources: Sequence[Json]) -> Json:
    identity = str(uuid.uuid5(_NAMESPACE, f"{project}/{kind}"))
    return {"id": identity, "type": kind, "resources": list(resources), "sources": []}


def uid_of(name: str) -> int:
    """Return the UID of a photograph's camera: unsigned, of 64 bits, the same in every export."""
    return int.from_bytes(hashlib.sha256(name.encode()).digest()[:8], "little")


def internals_of(camera: Camera) -> tuple[Json, float]:
    """Return OPF's parameters of a lens, and their largest error in pixels.

    OPF's perspective lens has one focal length and a polynomial up to r⁶. Another lens is replaced by the one that
    least squares fits to it. A fisheye's angle up to θ⁹ is OPF's polynomial exactly.
    """
    if camera.model.endswith("FISHEYE"):
        return _fisheye(camera)
    full = parameters_in(camera, "FULL_OPENCV")
    if full is not None and full[0] == full[1] and not full[9:].any():
        focal, _, cx, cy, k1, k2, p1, p2, k3 = full[:9].tolist()
        return _perspective(focal, (cx, cy), (k1, k2, k3), (p1, p2)), 0.0
    x, y = (np.linspace(0.0, side, _SAMPLES) for side in (camera.width, camera.height))
    rays = undistort(camera, np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2))
    rays = rays[np.isfinite(rays).all(axis=1)]
    target = distort(camera, rays)
    x, y = rays.T
    r2, nothing, one = x * x + y * y, np.zeros_like(x), np.ones_like(x)
    # Pixels are linear in f, f k1, f k2, f k3, f p1, f p2, cx, cy.
    by_x = np.stack([x, x * r2, x * r2**2, x * r2**3, 2 * x * y, r2 + 2 * x * x, one, nothing], axis=-1)
    by_y = np.stack([y, y * r2, y * r2**2, y * r2**3, r2 + 2 * y * y, 2 * x * y, nothing, one], axis=-1)
    design = np.concatenate([by_x, by_y])
    solution = np.linalg.lstsq(design, target.T.ravel(), rcond=None)[0]
    error = (design @ solution - target.T.ravel()).reshape(2, -1)
    f, k1, k2, k3, p1, p2, cx, cy = (solution / np.array([1, *[solution[0]] * 5, 1, 1])).tolist()
    return _perspective(f, (cx, cy), (k1, k2, k3), (p1, p2)), float(np.hypot(*error).max())


def _fisheye(camera: Camera) -> tuple[Json, float]:
    """Return the fisheye nearest to a camera, as a polynomial of 2θ/π, and its largest error in pixels."""
    lens = lens_of(camera)
    fx, fy, cx, cy, *terms = (
        lens.intrinsics[name] for name in ("fl_x", "fl_y", "cx", "cy", "k1", "k2", "k3", "k4")
    )
    half, powers = np.pi / 2, [0.0, 1.0]
    for order, term in enumerate(terms, start=1):
        powers += [0.0, term * half ** (2 * order)]
    return {
        "type": "fisheye",
        "principal_point_px": [cx, cy],
        "affine": [fx * half, 0.0, 0.0, fy * half],
        "is_symmetric_affine": fx == fy,
        "polynomial": powers,
        "is_p0_zero": True,
    }, lens.error_px


def _perspective(
    focal: float, center: tuple[float, float], radial: tuple[float, ...], tangential: tuple[float, float]
) -> Json:
    return {
        "type": "perspective",
        "principal_point_px": list(center),
        "focal_length_px": focal,
        "radial_distortion": list(radial),
        "tangential_distortion": list(tangential),
    }


def _camera_list(scene: OpfScene, uids: Sequence[int]) -> Json:
    return {
        "cameras": [{"id": uid, "uri": quote(name)} for uid, name in zip(uids, scene.model.image_name, strict=True)]
    }


def _input_cameras(scene: OpfScene, uids: Sequence[int], lenses: Mapping[int, tuple[Json, float]]) -> Json:
    model = scene.model
    sensors = [
        {
            "id": key,
            "name": f"camera {key}",
            "bands": [{"name": name, "weight": weight} for name, weight in _BANDS],
            "image_size_px": [camera.width, camera.height],
            "pixel_size_um": 1.0,  # OPF demands one; lengths are in pixels
            "internals": lenses[key][0],
            "shutter_type": "rolling" if key in scene.rolling else "global",
        }
        for key, camera in model.cameras.items()
    ]  # fmt: skip
    captures = []
    for uid, key, shot in zip(uids, model.image_camera_id.tolist(), scene.photographs, strict=True):
        capture: Json = {
            "id": uid,
            "cameras": [
                {
                    "id": uid,
                    "sensor_id": key,
                    "model_source": "user",
                    "pixel_type": "uint8",
                    "pixel_range": {"min": 0, "max": 255},
                }
            ],
            "reference_camera_id": uid,
            "rig_model_source": "not_applicable",
            "time": _time(shot.time_s),
        }
        if shot.xyz is not None and shot.sigma is not None:
            capture["geolocation"] = _geolocation(scene.frame, shot.xyz, shot.sigma)
        captures.append(capture)
    return {"sensors": sensors, "captures": captures}


def _time(seconds: float | None) -> str:
    try:
        return _UNKNOWN_TIME if seconds is None else datetime.fromtimestamp(seconds, UTC).isoformat()
    except (OverflowError, ValueError, OSError):  # a clock beyond the calendar
        return _UNKNOWN_TIME


def _geolocation(frame: OpfFrame, xyz: FloatArray, sigma: FloatArray) -> Json:
    return {
        "crs": {"definition": frame.definition},
        "coordinates": frame.coordinates(xyz),
        "sigmas": frame.coordinates(sigma),
    }


def _frame(frame: OpfFrame) -> Json:
    moved = {"scale": frame.scale.tolist(), "shift": frame.shift.tolist(), "swap_xy": frame.swap_xy}
    return {"crs": {"definition": frame.definition}, "base_to_canonical": moved}


def _control_points(scene: OpfScene) -> Json:
    gcps = [
        {
            "id": point.name,
            "geolocation": _geolocation(scene.frame, point.xyz, point.sigma),
            "is_checkpoint": point.is_check,
            "marks": [
                {"camera_id": uid_of(image), "position_px": [x, y], "accuracy": sigma_px}
                for image, x, y, sigma_px in point.marks
            ],
        }
        for point in scene.points
    ]
    return {"gcps": gcps, "mtps": []}


def _calibrated(scene: OpfScene, uids: Sequence[int], lenses: Mapping[int, tuple[Json, float]]) -> Json:
    model = scene.model
    angles = omega_phi_kappa_deg(np.swapaxes(model.rotation_cam_from_local, 1, 2)).tolist()
    cameras: list[Json] = [
        {"id": uid, "sensor_id": key, "position": center, "orientation_deg": angle}
        for uid, key, center, angle in zip(
            uids, model.image_camera_id.tolist(), model.cam_center_in_local.tolist(), angles, strict=True
        )
    ]
    if scene.covariances is not None:  # OPF has no field for it
        rows, columns = np.triu_indices(6)
        for camera, covariance in zip(cameras, scene.covariances, strict=True):
            camera["extensions"] = {_COVARIANCE: {"rotation_rad_position_m": covariance[rows, columns].tolist()}}
    return {"sensors": [{"id": key, "internals": lens} for key, (lens, _) in lenses.items()], "cameras": cameras}


def _write_tracks(folder: Path, model: SparseModel, uids: Sequence[int]) -> list[Json]:
    """Write the tie points with their observations, and return their resources."""
    order = np.argsort(model.obs_point, kind="stable")
    image, pixels = model.obs_image[order], model.obs_xy_px[order]
    count = np.bincount(model.obs_point, minlength=len(model.point_id))
    offset = np.cumsum(count) - count
    # Offset in 40 bits, then count in 24.
    ranges = np.stack([offset & 0xFFFFFFFF, offset >> 32 | count << 8], axis=-1)
    colours = np.column_stack([model.point_rgb, np.full(len(count), 255, np.uint8)])
    positions = model.point_in_local.astype("<f4")
    if not len(count):
        return []
    values = {
        "positions": positions,
        "colors": colours.astype("u1"),
        "match_camera_ids": image.astype("<u4"),
        "match_ranges": ranges.astype("<u4"),
        "match_pixels": pixels.astype("<f4"),
        "match_features": np.zeros((len(image), 2), "<u4"),
        "match_scales": np.ones(len(image), "<f4"),
    }
    arrays = [ArrayFile.of(folder, name, array) for name, array in values.items()]
    arrays[0].more = {"min": positions.min(axis=0).tolist(), "max": positions.max(axis=0).tolist()}
    arrays[1].more = {"normalized": True}
    matches = {
        "cameraUids": list(uids),
        "cameraIds": 2,
        "pointIndexRanges": 3,
        "imagePoints": {"pixelCoordinates": 4, "featureIds": 5, "scales": 6},
    }
    return write_points(folder, "tracks", arrays, {"POSITION": 0, "COLOR_0": 1}, {MATCHES: matches})


def _write(path: Path, document: Json) -> None:
    replace_text(path, dump_json(document) + "\n")

"""Table of the files that WebODM looks for, and what makes them of a workspace.

`FILES` are copied as they are. What has another form in OpenDroneMap is written by `WRITERS`, from the exported
cameras, the survey and the figures of the run. Each file appears when it is complete.
"""

from __future__ import annotations

import csv
import json
import os
import shutil
import struct
import warnings
from collections.abc import Callable, Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
from pyproj import CRS
from scipy.spatial.transform import Rotation

from pipelines.core.types import FloatArray
from pipelines.geodesy.crs import PointCrs, parse_crs
from pipelines.geodesy.enu import lla_from_ecef
from pipelines.geodesy.vertical import parse_vertical
from pipelines.report.chromium import find_chromium

# Group that is delivered, product in the workspace, file in the task's folder. Sidecars follow their files.
FILES = (
    ("raster", "raster/orthophoto.tif", "odm_orthophoto/odm_orthophoto.tif"),
    ("dsm", "raster/dsm.tif", "odm_dem/dsm.tif"),
    ("dtm", "raster/dtm.tif", "odm_dem/dtm.tif"),
    ("cloud", "cloud/cloud.laz", "odm_georeferencing/odm_georeferenced_model.laz"),
    ("tiles", "tiles", "3d_tiles/model"),
    ("report", "report/report.html", "odm_report/report.html"),
    ("report", "report/report.pdf", "odm_report/report.pdf"),
    ("splat", "export/splat.ply", "georef/splat.ply"),
    ("spz", "spz/splat.spz", "georef/splat.spz"),
    ("raster", "raster/sigma_h.tif", "georef/sigma_h.tif"),
    ("raster", "raster/sigma_v.tif", "georef/sigma_v.tif"),
    ("raster", "raster/measured.tif", "georef/measured.tif"),
    # Of these, all.zip has the folders odm_georeferencing, odm_texturing and odm_report, and no other of ours.
    ("splat", "export/splat.ply", "odm_georeferencing/splat.ply"),
    ("spz", "spz/splat.spz", "odm_georeferencing/splat.spz"),
)
SIDECAR = ".georef.json"


def lay_out(project: Path, result: Mapping[str, Any], wanted: set[str], say: Callable[[str, str], None]) -> None:
    """Put the files of a finished run where WebODM looks for them, and remove those that are not wanted."""
    values = {stage["stage"]: stage["values"] for stage in result["stages"]}
    for _, _, target in FILES:
        _remove(project / target)
        _remove(project / f"{target}{SIDECAR}")
    for group, source, target in FILES:
        product = project / "workspace" / source
        if group in wanted and product.exists():
            _put(product, project / target)
            if (sidecar := Path(f"{product}{SIDECAR}")).exists():
                _put(sidecar, project / f"{target}{SIDECAR}")
    if "report" in wanted and not (project / "odm_report/report.pdf").exists():
        say("warning", "There is no report.pdf: install Chromium. odm_report/report.html is the same report.")
    survey = _read(project / "workspace/ingest/survey.json")
    scene = Scene(project / "workspace", survey, values) if "cameras" in wanted else None
    for group, target, writer in WRITERS:
        content = writer(scene) if scene is not None and group in wanted else None
        if content is None:
            _remove(project / target)
        else:
            write(project / target, content)
    write(project / "images.json", images(survey))


def write(path: Path, content: str | bytes | dict[str, Any] | list[Any]) -> None:
    """Write a file, of JSON unless it is text or bytes, which appears when it is complete."""
    if isinstance(content, dict | list):
        content = json.dumps(content, indent=1)
    path.parent.mkdir(parents=True, exist_ok=True)
    draft = path.with_name(f"{path.name}.partial")
    draft.write_bytes(content.encode() if isinstance(content, str) else content)
    draft.replace(path)


def can_print() -> bool:
    """Return whether this machine can print the report as PDF."""
    return find_chromium() is not None


class Scene:
    """Cameras in the CRS of the rasters and the cloud, the survey, and the figures of a run."""

    def __init__(self, workspace: Path, survey: Mapping[str, Any], values: Mapping[str, Mapping[str, Any]]) -> None:
        self.workspace, self.survey, self.values = workspace, survey, values
        with (workspace / "cameras/cameras.csv").open(encoding="utf-8", newline="") as file:
            self.cameras = list(csv.DictReader(file))
        self.frames = {
            frame["file_path"]: frame for frame in _read(workspace / "cameras/transforms.json")["frames"]
        }
        sidecar = _read(workspace / f"cameras/cameras.csv{SIDECAR}")
        self.crs: PointCrs | None = None  # of a survey without a place on Earth
        if survey["origin"] is not None:
            self.crs = parse_crs(sidecar["crs"], vertical=parse_vertical(sidecar["verticalDatum"]["name"]))

    def positions(self) -> FloatArray:
        """Return the positions (N, 3) of the cameras in the CRS."""
        return np.array([[float(camera[axis]) for axis in "xyz"] for camera in self.cameras])


def coords(scene: Scene) -> str | None:
    """Return coords.txt: the UTM zone, whole metres of the middle, positions from there."""
    if scene.crs is None:
        return None
    positions = scene.positions()
    east, north = (int(value) for value in positions[:, :2].mean(axis=0))
    lines = [f"WGS84 UTM {CRS(scene.crs.name).utm_zone}", f"{east} {north}"]
    return "\n".join([*lines, *(f"{x - east:.4f} {y - north:.4f} {z:.4f}" for x, y, z in positions)]) + "\n"


def proj(scene: Scene) -> str | None:
    """Return proj.txt: the CRS of the coordinates as a string of PROJ."""
    if scene.crs is None:
        return None
    with warnings.catch_warnings():  # which the string cannot say of datums
        warnings.simplefilter("ignore", UserWarning)
        return f"{CRS(scene.crs.name).to_proj4()}\n"


def cameras(scene: Scene) -> dict[str, Any]:
    """Return cameras.json: each lens by OpenDroneMap's name, in shares of the longer side."""
    return {_camera_name(frame): _lens(frame) for frame in scene.frames.values()}


def shots(scene: Scene) -> dict[str, Any] | None:
    """Return shots.geojson: places of the photographs, with the rotation from the axes of the CRS to the camera's.

    Heights of the geometry are ellipsoidal; the translation is in the CRS of rasters and cloud.
    """
    if scene.crs is None:
        return None
    positions = scene.positions()
    times = {image["name"]: image["timestamp_s"] for image in scene.survey["images"]}
    features = []
    for camera, position, lla in zip(scene.cameras, positions, scene.crs.lla_from_xyz(positions), strict=True):
        frame = scene.frames.get(camera["name"])
        if frame is None:  # a camera of another model than transforms.json has
            continue
        angles = [float(camera[f"{name}_deg"]) for name in ("omega", "phi", "kappa")]
        # Image axes of omega, phi and kappa are right, up, backward; OpenDroneMap's right, down, forward.
        grid_from_cam = Rotation.from_euler("XYZ", angles, degrees=True) * Rotation.from_euler(
            "x", 180, degrees=True
        )
        lens = _lens(frame)
        properties = {
            "filename": camera["name"],
            "camera": _camera_name(frame),
            "focal": lens["focal_x"],
            "width": lens["width"],
            "height": lens["height"],
            "capture_time": times.get(camera["name"]) or 0,
            "translation": position.tolist(),
            "rotation": grid_from_cam.inv().as_rotvec().tolist(),
        }
        point = {"type": "Point", "coordinates": [lla[1], lla[0], lla[2]]}
        features.append({"type": "Feature", "properties": properties, "geometry": point})
    return {"type": "FeatureCollection", "features": features}


def stats(scene: Scene) -> dict[str, Any]:
    """Return stats.json: the figures that WebODM shows of a task, and the accuracy of the result."""
    survey, values = scene.survey, scene.values
    times = sorted(image["timestamp_s"] for image in survey["images"] if image["timestamp_s"])
    days = [datetime.fromtimestamp(time, UTC).strftime("%d/%m/%Y at %H:%M:%S") for time in times[:1] + times[-1:]]
    report = _read(scene.workspace / "evaluate/report.json")
    residuals = [
        float(np.hypot(np.hypot(point["de_m"], point["dn_m"]), point["du_m"]))
        for point in (report["fit"].get("gcp") or {}).get("points", [])
    ]
    document = {
        "processing_statistics": {"area": (report.get("area_ha") or 0.0) * 1e4, "start_date": "", "end_date": ""},
        "odm_processing_statistics": {"average_gsd": values["export-raster"]["gsd_photographs_m"] * 100.0},
        "reconstruction_statistics": {
            "reconstructed_points_count": values["sfm"]["points"],
            "reconstructed_shots_count": values["sfm"]["registered"],
            "initial_shots_count": values["ingest"]["images"],
            "has_gps": values["ingest"]["fixes"] > 0,
            "has_gcp": bool(residuals),
        },
        "georef": {"accuracy": report.get("headline"), "cautions": report.get("cautions", [])},
    }
    if days:
        document["processing_statistics"] |= {"start_date": days[0], "end_date": days[-1]}
    if residuals:
        document["gcp_errors"] = {"average_error": float(np.mean(residuals))}
    if "export-cloud" in values:
        count = values["export-cloud"]["points"]
        document["point_cloud_statistics"] = {
            "dense": True,
            "stats": {"statistic": [{"name": "X", "count": count}]},
        }
    return document


def images(survey: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Return images.json: what is known of each photograph."""
    lenses = {camera["camera_id"]: camera for camera in survey["cameras"]}
    return [
        {
            "filename": image["name"],
            "width": lenses[image["camera_id"]]["width"],
            "height": lenses[image["camera_id"]]["height"],
            "camera_model": lenses[image["camera_id"]]["make_model"],
            "utc_time": None if image["timestamp_s"] is None else image["timestamp_s"] * 1000.0,
        }
        for image in survey["images"]
    ]


def textured_model(scene: Scene) -> bytes | None:
    """Return the mesh (GLB) in the CRS of the cloud, z up, from the whole metres of its middle (`CESIUM_RTC`).

    The mesh is in a level frame at the middle of the scene. One affine map takes it into the CRS: it is exact at
    the middle, and one kilometre from there, where the Earth has curved away, 8 cm too low.
    """
    source = scene.workspace / "mesh/mesh.glb"
    if scene.crs is None or not source.exists():
        return None
    ecef_from_file = np.array(_read(Path(f"{source}{SIDECAR}"))["ecefFromFile"])
    reach_m = 100.0
    corners = np.vstack([np.zeros(3), reach_m * np.eye(3)]) @ ecef_from_file[:3, :3].T + ecef_from_file[:3, 3]
    placed = scene.crs.xyz_from_lla(lla_from_ecef(corners))
    center = np.array([*np.floor(placed[0, :2]), 0.0])
    grid_from_file = np.eye(4)
    grid_from_file[:3, :3] = (placed[1:] - placed[0]).T / reach_m
    grid_from_file[:3, 3] = placed[0] - center
    # The file's own root turns z up into y up; its inverse comes first.
    z_up_from_y_up = np.array([[1.0, 0, 0, 0], [0, 0, -1.0, 0], [0, 1.0, 0, 0], [0, 0, 0, 1.0]])
    document, rest = _glb_parts(source.read_bytes())
    root = {
        "children": document["scenes"][document["scene"]]["nodes"],
        "matrix": (grid_from_file @ z_up_from_y_up).T.ravel().tolist(),
    }
    document["scenes"][document["scene"]]["nodes"] = [len(document["nodes"])]
    document["nodes"].append(root)
    document["extensionsUsed"] = [*document.get("extensionsUsed", []), "CESIUM_RTC"]
    document.setdefault("extensions", {})["CESIUM_RTC"] = {"center": center.tolist()}
    document["asset"].pop("extras", None)  # the sidecar of the file as it was
    text = json.dumps(document, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    head = struct.pack("<4sIII4s", b"glTF", 2, 20 + len(text) + len(rest), len(text), b"JSON")
    return head + text + rest


def _glb_parts(data: bytes) -> tuple[dict[str, Any], bytes]:
    """Return the document of a GLB that `georef` has written, and the chunk that follows it."""
    (length,) = struct.unpack_from("<I", data, 12)
    return json.loads(data[20 : 20 + length]), data[20 + length :]


WRITERS: tuple[tuple[str, str, Callable[[Scene], Any]], ...] = (
    ("cameras", "odm_georeferencing/coords.txt", coords),
    ("cameras", "odm_georeferencing/proj.txt", proj),
    ("cameras", "cameras.json", cameras),
    ("cameras", "odm_report/shots.geojson", shots),
    ("cameras", "odm_report/stats.json", stats),
    ("mesh", "odm_texturing/odm_textured_model_geo.glb", textured_model),
)


def _lens(frame: Mapping[str, Any]) -> dict[str, Any]:
    longer = max(frame["w"], frame["h"])
    return {
        "projection_type": "brown",
        "width": frame["w"],
        "height": frame["h"],
        "focal_x": frame["fl_x"] / longer,
        "focal_y": frame["fl_y"] / longer,
        "c_x": (frame["cx"] - frame["w"] / 2.0) / longer,
        "c_y": (frame["cy"] - frame["h"] / 2.0) / longer,
        **{name: frame.get(name, 0.0) for name in ("k1", "k2", "p1", "p2", "k3")},
    }


def _camera_name(frame: Mapping[str, Any]) -> str:
    lens = _lens(frame)
    return f"v2 georef {lens['width']} {lens['height']} brown {lens['focal_x']:.4f}"


def _read(path: Path) -> Any:
    return json.loads(path.read_text(encoding="utf-8"))


def _put(source: Path, target: Path) -> None:
    """Put a file or folder at a place, complete or not at all: by another name of the same file, else as a copy."""
    target.parent.mkdir(parents=True, exist_ok=True)
    draft = target.with_name(f"{target.name}.partial")
    _remove(draft)
    if source.is_dir():
        left_out = shutil.ignore_patterns("manifest.json")
        shutil.copytree(source, draft, copy_function=_link_or_copy, ignore=left_out)
    else:
        _link_or_copy(str(source), str(draft))
    draft.replace(target)


def _link_or_copy(source: str, target: str) -> str:
    try:
        os.link(source, target)
    except OSError:  # a file system without links
        shutil.copyfile(source, target)
    return target


def _remove(path: Path) -> None:
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)

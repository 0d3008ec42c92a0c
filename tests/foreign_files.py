"""Solved cameras as other programs write them, from a model whose truth is known: formulas as in their manuals."""

from __future__ import annotations

import json
import struct
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from pipelines.formats.camera_files import Frame, lens_of, write_transforms
from pipelines.geometry.cameras import parameters_in
from pipelines.geometry.sparse_model import SparseModel

GL = np.diag([1.0, -1.0, -1.0])  # turns axes right, down, forward into right, up, backward


def _brown(model: SparseModel) -> tuple[float, ...]:
    """fx fy cx cy k1 k2 p1 p2 k3 of the only camera."""
    full = parameters_in(model.cameras[1], "FULL_OPENCV")
    assert full is not None
    return tuple(full.tolist()[:9])


def _size(model: SparseModel) -> tuple[int, int]:
    return model.cameras[1].width, model.cameras[1].height


def _numbers(values: Any) -> str:
    return " ".join(f"{value:.17g}" for value in np.asarray(values).ravel())


def metashape(model: SparseModel, path: Path, *, off: Sequence[int] = (), extra: str = "") -> Path:
    """Agisoft XML of one chunk; cameras `off` are disabled, and one more is not aligned."""
    (fx, fy, cx, cy, k1, k2, p1, p2, k3), (width, height) = _brown(model), _size(model)
    values = {"f": fy, "cx": cx - width / 2, "cy": cy - height / 2, "b1": fx - fy}
    values |= {"k1": k1, "k2": k2, "k3": k3}
    lens = "".join(f"<{key}>{value:.17g}</{key}>" for key, value in {**values, "p1": p2, "p2": p1}.items())
    rows = []
    for index, name in enumerate(model.image_name):
        matrix = np.eye(4)
        matrix[:3, :3], matrix[:3, 3] = model.rotation_cam_from_local[index].T, model.cam_center_in_local[index]
        on = "false" if index in off else "true"
        rows.append(
            f'<camera id="{index}" sensor_id="0" component_id="0" label="{name}" enabled="{on}">'
            f"<transform>{_numbers(matrix)}</transform><orientation>1</orientation></camera>"
        )
    path.write_text(
        '<?xml version="1.0" encoding="UTF-8"?><document version="2.0.0"><chunk label="Chunk 1">'
        f'<sensors><sensor id="0" label="X" type="frame"><resolution width="{width}" height="{height}"/>'
        f'<property name="rolling_shutter" value="true"/><calibration type="frame" class="adjusted">'
        f'<resolution width="{width}" height="{height}"/>{lens}</calibration></sensor></sensors>'
        '<components next_id="1"><component id="0"><transform><rotation>1 0 0 0 1 0 0 0 1</rotation>'
        "<translation>4e6 5e5 4.5e6</translation><scale>7</scale></transform></component></components>"
        f'<cameras next_id="9"><group id="0" label="G">{"".join(rows)}</group>'
        f'<camera id="99" sensor_id="0" label="lost.jpg"/>{extra}</cameras>'
        '<reference>GEOGCS["WGS 84"]</reference></chunk></document>',
        encoding="utf-8",
    )
    return path


def opensfm_camera(model: SparseModel) -> dict[str, Any]:
    (fx, fy, cx, cy, k1, k2, p1, p2, k3), (width, height) = _brown(model), _size(model)
    side = max(width, height)
    middle = {"c_x": (cx - width / 2) / side, "c_y": (cy - height / 2) / side}
    lens = {"k1": k1, "k2": k2, "p1": p1, "p2": p2, "k3": k3}
    focal = {"focal_x": fx / side, "focal_y": fy / side}
    return {"projection_type": "brown", "width": width, "height": height, **focal, **middle, **lens}


def opensfm(model: SparseModel, path: Path, rejected: int = -1) -> Path:
    """OpenSfM's `reconstruction.json`, and `tracks.csv` beside it; one `rejected` by OpenSfM is far off."""
    width, height = _size(model)
    shots = {
        name: {
            "rotation": Rotation.from_matrix(turn).as_rotvec().tolist(),
            "translation": move.tolist(),
            "camera": "v2 x",
        }
        for name, turn, move in zip(
            model.image_name, model.rotation_cam_from_local, model.translation_cam_from_local, strict=True
        )
    }
    points = {
        str(key): {"color": [10.0, 20.0, 30.0], "coordinates": xyz.tolist()}
        for key, xyz in zip(model.point_id, model.point_in_local, strict=True)
    }
    place = {"latitude": 46.0, "longitude": 7.75, "altitude": 0.0}
    document = {
        "cameras": {"v2 x": opensfm_camera(model)},
        "shots": shots,
        "points": points,
        "reference_lla": place,
    }
    small = {"cameras": {}, "shots": {}, "points": {}}
    path.write_text(json.dumps([small, document]), encoding="utf-8")
    shares = (model.obs_xy_px - [width / 2, height / 2]) / max(width, height)
    if rejected >= 0:
        shares[rejected] += 0.05
    lines = ["OPENSFM_TRACKS_VERSION_v2"]
    for point, image, (x, y) in zip(model.obs_point, model.obs_image, shares, strict=True):
        lines.append(
            f"{model.image_name[image]}\t{model.point_id[point]}\t7\t{x:.12g}\t{y:.12g}\t0.001\t1\t2\t3\t-1\t-1"
        )
    path.with_name("tracks.csv").write_text("\n".join(lines) + "\n", encoding="utf-8")
    return path


def odm(model: SparseModel, folder: Path) -> Path:
    """ODM's project folder with `odm_report/shots.geojson` and `cameras.json`."""
    features = [
        {
            "type": "Feature",
            "properties": {
                "filename": name,
                "width": _size(model)[0],
                "height": _size(model)[1],
                "translation": (center + np.array([5e5, 5e6, 0.0])).tolist(),
                "rotation": Rotation.from_matrix(turn).as_rotvec().tolist(),
            },
            "geometry": {"type": "Point", "coordinates": [7.0, 46.0, 500.0]},
        }
        for name, center, turn in zip(
            model.image_name, model.cam_center_in_local, model.rotation_cam_from_local, strict=True
        )
    ]
    (folder / "odm_report").mkdir(parents=True)
    (folder / "cameras.json").write_text(json.dumps({"v2 x": opensfm_camera(model)}), encoding="utf-8")
    shots = {"type": "FeatureCollection", "features": features}
    (folder / "odm_report/shots.geojson").write_text(json.dumps(shots), encoding="utf-8")
    return folder


def nerfstudio(model: SparseModel, path: Path) -> Path:
    """`transforms.json` as `georef export-cameras` writes it."""
    camera = model.cameras[1]
    frames = [
        Frame(name, "train", camera, turn.T, center)
        for name, turn, center in zip(
            model.image_name, model.rotation_cam_from_local, model.cam_center_in_local, strict=True
        )
    ]
    write_transforms(path, frames, [lens_of(camera)] * len(frames), "points.ply")
    return path


def realityscan(model: SparseModel, path: Path) -> Path:
    """RealityScan's table of internal and external camera parameters, which has one focal length."""
    (fx, fy, cx, cy, k1, k2, p1, p2, k3), (width, height) = _brown(model), _size(model)
    assert fx == fy
    side = max(width, height)
    lens = (fx * 36 / side, (cx - width / 2) / side, (cy - height / 2) / side, k1, k2, k3, 0.0, p1, p2)
    lines = ["#name,x,y,alt,heading,pitch,roll,f,px,py,k1,k2,k3,k4,t1,t2"]
    for name, turn, center in zip(
        model.image_name, model.rotation_cam_from_local, model.cam_center_in_local, strict=True
    ):
        z, x, y = Rotation.from_matrix(turn.T @ GL).as_euler("ZXY", degrees=True)
        lines.append(",".join([name, *(f"{value:.17g}" for value in (*center, -z, x, y, *lens))]))
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return path


def opf(model: SparseModel, folder: Path, *, uri: str = "tracks.gltf") -> Path:
    """OPF project with calibrated cameras and tie points; its glTF has a node that turns z-up into y-up."""
    (fx, fy, cx, cy, k1, k2, p1, p2, k3), (width, height) = _brown(model), _size(model)
    assert fx == fy
    folder.mkdir(parents=True, exist_ok=True)
    uid = [(1 << 63) + index for index in range(len(model.image_name))]
    internals = {
        "type": "perspective",
        "principal_point_px": [cx, cy],
        "focal_length_px": fx,
        "radial_distortion": [k1, k2, k3],
        "tangential_distortion": [p1, p2],
    }
    angles = Rotation.from_matrix(np.swapaxes(model.rotation_cam_from_local, 1, 2) @ GL).as_euler(
        "XYZ", degrees=True
    )
    cameras = [
        {"id": uid[index], "sensor_id": 5, "position": center.tolist(), "orientation_deg": angle.tolist()}
        for index, (center, angle) in enumerate(zip(model.cam_center_in_local, angles, strict=True))
    ]
    sensor = {
        "id": 5,
        "name": "X",
        "bands": [{"name": "Gray", "weight": 1.0}],
        "image_size_px": [width, height],
        "pixel_size_um": 2.4,
        "internals": internals,
        "shutter_type": "global",
    }
    listed = [{"id": key, "uri": f"images/{name}"} for key, name in zip(uid, model.image_name, strict=True)]
    files = {
        "camera_list": ("camera-list", {"cameras": listed}),
        "input_cameras": ("input-cameras", {"sensors": [sensor], "captures": []}),
        "scene_reference_frame": (
            "scene-reference-frame",
            {
                "crs": {"definition": "EPSG:32632"},
                "base_to_canonical": {"shift": [0.0, 0.0, 0.0], "scale": [1.0, 1.0, 1.0], "swap_xy": False},
            },
        ),
        "input_control_points": ("input-control-points", {"gcps": [_control_point(uid)], "mtps": []}),
        "calibration": ("calibrated-cameras", {"sensors": [{"id": 5, "internals": internals}], "cameras": cameras}),
    }
    items = []
    for number, (kind, (name, content)) in enumerate(files.items()):
        form = f"application/opf-{name}+json"
        (folder / f"{name}.json").write_text(json.dumps({"format": form, "version": "1.0", **content}))
        resources = [{"uri": f"{name}.json", "format": form}]
        if kind == "calibration":
            resources.append({"uri": uri, "format": "model/gltf+json"})
        item_id = f"00000000-0000-4000-8000-00000000000{number}"
        items.append({"id": item_id, "type": kind, "resources": resources, "sources": []})
    project = {"format": "application/opf-project+json", "version": "1.0", "name": "n", "description": "d"}
    project |= {"id": "00000000-0000-4000-8000-0000000000ff", "items": items}
    (folder / "project.opf").write_text(json.dumps(project))
    _gltf(model, folder, uid)
    return folder / "project.opf"


def _control_point(uid: Sequence[int]) -> dict[str, Any]:
    marks = [{"camera_id": key, "position_px": [100.5, 200.5], "accuracy": 1.0} for key in uid[:2]]
    place = {"crs": {"definition": "EPSG:4979"}, "coordinates": [46.0, 7.75, 1600.0], "sigmas": [0.02, 0.02, 0.03]}
    return {"id": "G1", "geolocation": place, "marks": marks, "is_checkpoint": False}


def _gltf(model: SparseModel, folder: Path, uid: Sequence[int]) -> None:
    count = np.bincount(model.obs_point, minlength=len(model.point_id))
    ranges = b"".join(
        int(offset).to_bytes(5, "little") + int(number).to_bytes(3, "little")
        for offset, number in zip(np.cumsum(count) - count, count, strict=True)
    )
    data = {
        "positions": (model.point_in_local.astype("<f4").tobytes(), 5126, "VEC3", len(count)),
        "cameras": (model.obs_image.astype("<u4").tobytes(), 5125, "SCALAR", len(model.obs_image)),
        "ranges": (ranges, 5125, "VEC2", len(count)),
        "pixels": (model.obs_xy_px.astype("<f4").tobytes(), 5126, "VEC2", len(model.obs_image)),
        "features": (bytes(8 * len(model.obs_image)), 5125, "VEC2", len(model.obs_image)),
        "scales": (bytes(4 * len(model.obs_image)), 5126, "SCALAR", len(model.obs_image)),
    }
    for name, (content, *_) in data.items():
        (folder / f"{name}.bin").write_bytes(content)
    views = [{"buffer": number, "byteLength": len(entry[0])} for number, entry in enumerate(data.values())]
    accessors = [
        {"bufferView": number, "componentType": kind, "type": form, "count": length}
        for number, (_, kind, form, length) in enumerate(data.values())
    ]
    low, high = model.point_in_local.min(axis=0), model.point_in_local.max(axis=0)
    accessors[0] |= {"min": low.tolist(), "max": high.tolist()}
    image_points = {"pixelCoordinates": 3, "featureIds": 4, "scales": 5}
    matches = {"cameraUids": list(uid), "cameraIds": 1, "pointIndexRanges": 2, "imagePoints": image_points}
    primitive = {"attributes": {"POSITION": 0}, "mode": 0, "extensions": {"OPF_mesh_primitive_matches": matches}}
    y_up = [1.0, 0, 0, 0, 0, 0, -1.0, 0, 0, 1.0, 0, 0, 0, 0, 0, 1.0]  # column by column
    document = {
        "asset": {"version": "2.0", "extensions": {"OPF_asset_version": {"version": "1.0"}}},
        "buffers": [{"uri": f"{name}.bin", "byteLength": len(entry[0])} for name, entry in data.items()],
        "bufferViews": views,
        "accessors": accessors,
        "meshes": [{"primitives": [primitive]}],
        "nodes": [{"mesh": 0, "matrix": y_up}],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "extensionsUsed": ["OPF_asset_version", "OPF_mesh_primitive_matches"],
    }
    (folder / "tracks.gltf").write_text(json.dumps(document))


def forged_range(folder: Path, count: int) -> None:
    """Let the first point of an OPF project claim so many matches."""
    file = folder / "ranges.bin"
    data = bytearray(file.read_bytes())
    struct.pack_into("<I", data, 4, count << 8)
    file.write_bytes(data)

"""`georef` with fake stages for the engine of WebODM: cameras, mesh and survey have real forms and known places."""

from __future__ import annotations

import json
import struct
import sys
import time
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from georef_cli import estimate
from pipelines.core.errors import ResourceError
from pipelines.core.options import StageOptions
from pipelines.core.stages import BY_NAME
from pipelines.core.workspace import StageRun, Summary
from pipelines.geodesy.enu import Origin, ecef_from_enu, ecef_from_enu_rotation
from tests import fakes

ORIGIN = Origin(lat_deg=46.02, lon_deg=7.75, alt_m=1620.0)  # of the frame of mesh and splat; UTM zone 32 north
EASTING, NORTHING = 403_245.0, 5_097_030.0  # near it, in EPSG:32632
CORNERS = np.array([[0.0, 0.0, 0.0], [30.0, 0.0, 5.0], [0.0, 40.0, 10.0], [300.0, 300.0, 0.0]])  # of the mesh
OMEGA_DEG = {"down.jpg": 0.0, "north.jpg": 30.0}  # photographs, the second of which looks north
POINTS, GSD_M = 1234, 0.05


def install(folder: Path) -> None:
    """Put the stages where the runner looks for them; files in a folder make them slow or let them fail."""

    def ingest(stage: StageRun, options: StageOptions) -> Summary:
        done = fakes.fake_run(BY_NAME["ingest"])(stage, options)
        lens = {"camera_id": 1, "width": 400, "height": 300, "make_model": "Make Model"}
        images = [{"name": name, "camera_id": 1, "timestamp_s": 1.7e9} for name in OMEGA_DEG]
        survey = {"origin": {}, "cameras": [lens], "images": images, "read": done.values["text"]}
        _write(stage.out / "survey.json", json.dumps(survey))
        return Summary("two photographs", {"images": 2, "fixes": 2})

    def sfm(stage: StageRun, options: StageOptions) -> Summary:
        if (folder / "no-memory").exists():
            raise ResourceError("too-large", "the photographs do not fit into the memory")
        fakes.fake_run(BY_NAME["sfm"])(stage, options)
        return Summary("registered", {"points": 10, "registered": 2})

    def train(stage: StageRun, options: StageOptions) -> Summary:
        with stage.progress.task("train", 1000) as task:
            for _ in range(1000 if (folder / "slow").exists() else 0):
                task.advance()
                time.sleep(0.05)
        return fakes.fake_run(BY_NAME["train"])(stage, options)

    def raster(stage: StageRun, options: StageOptions) -> Summary:
        fakes.fake_run(BY_NAME["export-raster"])(stage, options)
        if options.model_dump()["terrain"]:
            _write(stage.out / "dtm.tif", "terrain")
        return Summary("rasters", {"gsd_photographs_m": GSD_M})

    def cloud(stage: StageRun, options: StageOptions) -> Summary:
        fakes.fake_run(BY_NAME["export-cloud"])(stage, options)
        return Summary("cloud", {"points": POINTS})

    def mesh(stage: StageRun, options: StageOptions) -> Summary:
        done = fakes.fake_run(BY_NAME["export-mesh"])(stage, options)
        (stage.out / "mesh.glb").write_bytes(_glb())
        ecef_from_file = np.eye(4)
        ecef_from_file[:3, :3] = ecef_from_enu_rotation([46.02, 7.75, 1620.0])
        ecef_from_file[:3, 3] = ecef_from_enu(np.zeros((1, 3)), ORIGIN)[0]
        _write(stage.out / "mesh.glb.georef.json", json.dumps({"ecefFromFile": ecef_from_file.tolist()}))
        return done

    def cameras(stage: StageRun, options: StageOptions) -> Summary:
        done = fakes.fake_run(BY_NAME["export-cameras"])(stage, options)
        rows = [
            f"{name},train,{EASTING + 10 * index},{NORTHING},1680.0,{omega},0.0,0.0"
            for index, (name, omega) in enumerate(OMEGA_DEG.items())
        ]
        head = "name,split,x,y,z,omega_deg,phi_deg,kappa_deg"
        _write(stage.out / "cameras.csv", "\n".join([head, *rows]))
        sidecar = {"crs": "EPSG:32632", "verticalDatum": {"name": "ellipsoidal"}}
        _write(stage.out / "cameras.csv.georef.json", json.dumps(sidecar))
        lens = {"w": 400, "h": 300, "fl_x": 320.0, "fl_y": 322.0, "cx": 204.0, "cy": 148.0, "k1": -0.1}
        frames = [{"file_path": name, **lens} for name in OMEGA_DEG]
        _write(stage.out / "transforms.json", json.dumps({"frames": frames}))
        return done

    # Fake stages use no kernels and take no time: what compiles and estimates would take seconds to load.
    sys.modules["pipelines.train.compilation"] = no_compilation()
    estimate.announced_estimate = lambda *_, **__: None  # type: ignore[assignment]
    fakes.install(
        ingest=ingest,
        sfm=sfm,
        train=train,
        export_raster=raster,
        export_cloud=cloud,
        export_mesh=mesh,
        export_cameras=cameras,
    )


def no_compilation() -> ModuleType:
    """A module in place of that which compiles kernels."""
    module = ModuleType("pipelines.train.compilation")
    module.start_compilation = lambda: None  # type: ignore[attr-defined]
    return module


def _write(path: Path, text: str) -> None:
    path.write_text(text, encoding="utf-8")


def _glb() -> bytes:
    """The corners as points of a GLB, z up turned into y up by the root, as `georef export-mesh` does."""
    data = CORNERS.astype("<f4").tobytes()
    y_up_from_z_up = [1.0, 0, 0, 0, 0, 0, -1.0, 0, 0, 1.0, 0, 0, 0, 0, 0, 1.0]
    document: dict[str, Any] = {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "matrix": y_up_from_z_up}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "mode": 0}]}],
        "accessors": [{"bufferView": 0, "componentType": 5126, "count": len(CORNERS), "type": "VEC3"}],
        "bufferViews": [{"buffer": 0, "byteLength": len(data)}],
        "buffers": [{"byteLength": len(data)}],
    }
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(data), b"BIN\0") + data
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks

"""PSNR of test photographs in CesiumJS, of tiles with SPZ and of plain ones: `tiles_in_cesium.py WORKSPACE`.

Needs a trained workspace, Chromium and npm. A photograph without lens distortion is moved so that its principal
point is in the middle, where Cesium's cameras have it. The workspace's own tiles and cameras are exported anew.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
from pathlib import Path

import cv2
import numpy as np
import pycolmap
import torch

from pipelines.core.products import load_json
from pipelines.formats.georef_sidecar import GeorefSidecar
from pipelines.geometry.cameras import Pinhole
from pipelines.geometry.similarity import Similarity
from pipelines.splat.metrics import psnr
from tests.browser.chromium import Viewer, chromium, served

_RIM_PX = 8  # which lacks pixels of the moved photograph


def main() -> None:
    """Print a line a photograph."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("workspace", type=Path)
    parser.add_argument("--most", type=int, default=4, help="test photographs that are looked at")
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        scratch = Path(folder)
        _georef("export-cameras", args.workspace, "--undistorted", "--to", scratch / "cameras")
        tiles = {kind: scratch / kind for kind in ("none", "spz")}
        for kind, to in tiles.items():
            _georef("export-tiles", args.workspace, "--cesium", "Cesium/", "--compression", kind, "--to", to)
        _compare(scratch / "cameras", tiles, args.most)


def _compare(cameras: Path, tiles: dict[str, Path], most: int) -> None:
    tested = json.loads((cameras / "transforms.json").read_text("utf-8"))["val_filenames"]
    stems = [Path(name).stem for name in tested]
    model = pycolmap.Reconstruction(cameras / "undistorted/sparse/0")
    images = [image for image in model.images.values() if Path(image.name).stem in stems][:most]
    ecef_from_file = load_json(GeorefSidecar, cameras / "undistorted.georef.json").ecef_from_file()
    shown: dict[tuple[str, str], np.ndarray] = {}
    with chromium() as browser:
        for kind, folder in tiles.items():
            with served(folder) as root:
                viewer = Viewer(browser.new_page())
                viewer.open(root)
                viewer.hide_labels()
                for image in images:
                    pose = image.cam_from_world()
                    cam_from_file = Similarity(1.0, pose.rotation.matrix(), np.asarray(pose.translation))
                    lens = model.cameras[image.camera_id]
                    pinhole = Pinhole(*_even(lens), *[lens.focal_length_x] * 2, *(side / 2 for side in _even(lens)))
                    viewer.stand(ecef_from_file @ cam_from_file.inverse(), pinhole)
                    shown[kind, image.name] = viewer.picture()
                viewer.page.close()
    for image in images:
        lens = model.cameras[image.camera_id]
        width, height = _even(lens)
        file = cv2.imread(str(cameras / "undistorted/images" / image.name))
        assert file is not None
        moved = np.array([[1, 0, width / 2 - lens.principal_point_x], [0, 1, height / 2 - lens.principal_point_y]])
        photograph = cv2.warpAffine(file, moved, (width, height))[..., ::-1] / 255.0
        inner = (slice(_RIM_PX, -_RIM_PX), slice(_RIM_PX, -_RIM_PX))
        target = torch.from_numpy(photograph[inner].copy())
        spz, plain = (
            psnr(torch.from_numpy(shown[kind, image.name][inner].copy()), target, target.sum(dim=-1) > 0)
            for kind in ("spz", "none")
        )
        print(f"{image.name}: SPZ {spz:.2f} dB, plain {plain:.2f} dB")


def _even(lens: pycolmap.Camera) -> tuple[int, int]:
    return lens.width // 2 * 2, lens.height // 2 * 2


def _georef(*words: object) -> None:
    subprocess.run(
        [sys.executable, "-m", "georef_cli", *map(str, words), "--force"], check=True, stdout=subprocess.DEVNULL
    )


if __name__ == "__main__":
    main()

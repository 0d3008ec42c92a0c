"""Lenses in nerfstudio's terms: the same pixels for the same rays, or the stated error."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from pipelines.formats.camera_files import Frame, lens_of, write_transforms
from pipelines.geometry.cameras import FISHEYE_MODELS, MODELS, RATIONAL_MODELS, Camera, distort

FX, FY, CX, CY = 900.0, 905.0, 602.0, 447.0
PARAMETERS = {
    "SIMPLE_PINHOLE": [FX, CX, CY],
    "PINHOLE": [FX, FY, CX, CY],
    "SIMPLE_RADIAL": [FX, CX, CY, -0.06],
    "RADIAL": [FX, CX, CY, -0.06, 0.02],
    "OPENCV": [FX, FY, CX, CY, -0.06, 0.02, 1e-3, -5e-4],
    "FULL_OPENCV": [FX, FY, CX, CY, -0.06, 0.02, 1e-3, -5e-4, 0.004, 0.01, -0.004, 0.001],
    "SIMPLE_FISHEYE": [FX, CX, CY],
    "FISHEYE": [FX, FY, CX, CY],
    "SIMPLE_RADIAL_FISHEYE": [FX, CX, CY, -0.02],
    "RADIAL_FISHEYE": [FX, CX, CY, -0.02, 0.003],
    "OPENCV_FISHEYE": [FX, FY, CX, CY, -0.02, 0.003, -1e-3, 2e-4],
    "THIN_PRISM_FISHEYE": [FX, FY, CX, CY, -0.02, 0.003, 1e-4, -1e-4, 0.0, 0.0, 1e-4, 0.0],
    "RAD_TAN_THIN_PRISM_FISHEYE": [FX, FY, CX, CY, -0.02, 0.003, 0, 0, 0, 0, 1e-4, -1e-4, 0, 0, 1e-4, 0],
    "FOV": [FX, FY, CX, CY, 0.2],
    "SIMPLE_DIVISION": [FX, CX, CY, -0.05],
    "DIVISION": [FX, FY, CX, CY, -0.05],
    "EUCM": [FX, FY, CX, CY, 0.1, 1.1],
}
EXACT = {*RATIONAL_MODELS, *FISHEYE_MODELS} - {"FULL_OPENCV"}


def nerfstudio_pixels(intrinsics: dict[str, float], model: str, ray: np.ndarray) -> np.ndarray:
    """OpenCV's formulas, as nerfstudio's undistortion states them."""
    x, y = ray.T
    if model == "OPENCV_FISHEYE":
        radius = np.hypot(x, y)
        t = np.arctan(radius)
        bent = t * (1 + sum(intrinsics[f"k{i}"] * t ** (2 * i) for i in (1, 2, 3, 4)))
        u, v = x * bent / radius, y * bent / radius
    else:
        r2 = x * x + y * y
        radial = 1 + intrinsics["k1"] * r2 + intrinsics["k2"] * r2**2 + intrinsics["k3"] * r2**3
        p1, p2 = intrinsics["p1"], intrinsics["p2"]
        u = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
        v = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
    return np.column_stack([intrinsics["fl_x"] * u + intrinsics["cx"], intrinsics["fl_y"] * v + intrinsics["cy"]])


@pytest.mark.parametrize("model", MODELS)
def test_rays_meet_the_same_pixels(model: str) -> None:
    camera = Camera(model, 1200, 900, np.array(PARAMETERS[model]))
    lens = lens_of(camera)
    ray = np.random.default_rng(0).uniform([-0.6, -0.45], [0.6, 0.45], (200, 2))
    off = nerfstudio_pixels(lens.intrinsics, lens.model, ray) - distort(camera, ray)
    assert lens.model == ("OPENCV_FISHEYE" if model.endswith("FISHEYE") else "OPENCV")
    if model in EXACT:
        assert lens.error_px == 0.0
        np.testing.assert_allclose(off, 0.0, atol=1e-9)
    else:  # the nearest lens, whose largest error is that of a grid that ends at the image's border
        assert 0 < np.hypot(*off.T).max() <= 1.01 * lens.error_px < 0.3


def test_full_model_without_rational_terms_is_exact() -> None:
    camera = Camera("FULL_OPENCV", 1200, 900, np.array([*PARAMETERS["FULL_OPENCV"][:9], 0, 0, 0]))
    assert lens_of(camera).error_px == 0.0
    assert lens_of(camera).intrinsics["k3"] == 0.004


def test_two_camera_models_do_not_fit_into_one_file(tmp_path: Path) -> None:
    cameras = [Camera(model, 1200, 900, np.array(PARAMETERS[model])) for model in ("OPENCV", "OPENCV_FISHEYE")]
    frames = [Frame("a.jpg", "train", camera, np.eye(3), np.zeros(3)) for camera in cameras]
    with pytest.raises(ValueError, match="one camera model"):
        write_transforms(tmp_path / "transforms.json", frames, [lens_of(camera) for camera in cameras], "a.ply")


def test_photographs_are_listed_by_split_where_there_are_test_views(tmp_path: Path) -> None:
    """nerfstudio demands a list of each split, or none; with an empty one it has nothing to evaluate."""
    camera = Camera("PINHOLE", 1200, 900, np.array(PARAMETERS["PINHOLE"]))
    for splits, expected in {
        ("train", "test", "train"): {"train": ["0.jpg", "2.jpg"], "val": ["1.jpg"], "test": ["1.jpg"]},
        ("train", "train"): {},
    }.items():
        frames = [Frame(f"{n}.jpg", split, camera, np.eye(3), np.zeros(3)) for n, split in enumerate(splits)]
        write_transforms(tmp_path / "transforms.json", frames, [lens_of(camera)] * len(frames), "points.ply")
        document = json.loads((tmp_path / "transforms.json").read_text(encoding="utf-8"))
        assert document["ply_file_path"] == "points.ply"
        lists = {name.removesuffix("_filenames"): names for name, names in document.items() if "_filenames" in name}
        assert lists == expected

"""Depth maps of the photographs of a town: placed by the photographs' cameras, and used as LiDAR is."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any, cast

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pipelines.core.errors import InputError
from pipelines.formats.depth_image import read_depth_image
from pipelines.geometry.cameras import Camera, Pinhole
from pipelines.geometry.similarity import Similarity
from pipelines.geometry.sparse_model import SparseModel
from pipelines.surface.lidar_cloud import LidarCloud, planes_of
from pipelines.surface.measured_cloud import Thinning, read_thinned
from pipelines.surface.photo_depths import Along, DepthStatement, PhotoDepths, holds_depth_maps
from pipelines.surface.registration import registration
from pipelines.survey.scene import SparseScene
from pipelines.train.lidar_surface import TrustedLidar, verdict
from pipelines.train.options import LidarOptions
from tests.geometry_files import write_exr
from tests.refusals import codes, numbers, refused
from tests.survey.test_measured_cloud import ORIGIN
from tests.towns import (
    EXTRA,
    FOCAL_PX,
    PIXEL_M,
    SIGMA_M,
    SIZE,
    SPACING_M,
    TOWN,
    WITH_EXTRA,
    Town,
    surface_of,
    views_of,
)

VIEWS = views_of(TOWN)
# Photographs of twice the size of the depth maps of stereo, through a lens with distortion.
LENS = np.array([-0.08, 0.02, 5e-4, -3e-4])
CAMERA = Camera("OPENCV", 2 * SIZE[0], 2 * SIZE[1], np.array([160.0, 160.0, 97.0, 71.0, *LENS]))
NAMES = tuple(f"flight/IMG_{number:02d}.JPG" for number in range(12))
SHIFT = np.array([7.0, -3.0, 2.0])


def scene_of(names: tuple[str, ...] = NAMES) -> SparseScene:
    """Twelve cameras over the town, the last one of a test photograph; `geo` lies beside `model`."""
    turn, count = VIEWS.cam_from_world, len(names)
    none = np.zeros(0, np.int64)
    sparse = SparseModel(
        {1: CAMERA}, np.arange(count), names, np.ones(count, np.int64), turn,
        -np.einsum("nij,nj->ni", turn, VIEWS.center_in_world),
        none, np.zeros((0, 3)), np.zeros((0, 3), np.uint8), np.zeros(0), none, none, np.zeros((0, 2)),
    )  # fmt: skip
    return SparseScene(
        sparse, Similarity(), Similarity(translation=SHIFT), np.arange(count - 1), np.array([count - 1])
    )


class StereoMaps:
    """Depth maps of stereo: those of the town, half a percent too deep, and with noise."""

    def depth(self, index: int) -> np.ndarray:
        exact = VIEWS.depth_m.reshape(12, SIZE[1], SIZE[0])[index]
        return (1.005 + np.random.default_rng(index).normal(0, 0.002, exact.shape).astype(np.float32)) * exact

    def camera(self, index: int) -> Pinhole:
        return Pinhole(*SIZE, FOCAL_PX, FOCAL_PX, SIZE[0] / 2, SIZE[1] / 2)


@cache
def measured(town: Town, view: int, size: tuple[int, int], along: Along, *, with_lens: bool) -> np.ndarray:
    """The depth map (H, W) of a view in metres with noise of 2 cm, 0 where it looks into the sky."""
    x, y = np.meshgrid(np.arange(size[0]) + 0.5, np.arange(size[1]) + 0.5)
    pixel = np.stack([x, y], axis=-1).reshape(-1, 2)
    if not with_lens:
        slope = (pixel - [50.0, 36.0]) / 70.0
    else:
        matrix = np.array([[160.0, 0, 97.0], [0, 160.0, 71.0], [0, 0, 1]])
        full = pixel * [CAMERA.width / size[0], CAMERA.height / size[1]]
        criteria = (cv2.TERM_CRITERIA_MAX_ITER, 20, 0.0)
        slope = cv2.undistortPoints(full[:, None], matrix, LENS, criteria=criteria)[:, 0]
    ray = np.column_stack([slope, np.ones(len(slope))])
    depth = town.distance(VIEWS.center_in_world[view], ray @ VIEWS.cam_from_world[view])
    if along == "ray":
        depth = depth * np.linalg.norm(ray, axis=1)
    depth = depth + np.random.default_rng(view).normal(0, SIGMA_M, len(depth))
    return np.where(np.isfinite(depth), depth, 0.0).reshape(size[1], size[0])


def write_maps(folder: Path, kind: str, town: Town = TOWN, *, along: Along = "axis", ending: str = "") -> float:
    """Write the depth maps of all views, and return their unit in metres."""
    size = {"png": (2 * SIZE[0], 2 * SIZE[1]), "exr": SIZE, "tif": (144, 108), "pinhole": SIZE}[kind]
    for view, name in enumerate(NAMES):
        path = folder / Path(name).with_suffix("")
        path = path.with_name(path.name + ending)
        path.parent.mkdir(parents=True, exist_ok=True)
        depth = measured(town, view, size, along, with_lens=kind != "pinhole")
        if kind == "exr":
            write_exr(path.with_suffix(".exr"), {"Z": np.where(depth > 0, depth, np.inf).astype(np.float32)})
        elif kind == "tif":
            cv2.imwrite(str(path.with_suffix(".tif")), (1000 * depth).astype(np.float32))
        else:
            cv2.imwrite(f"{path}.png", np.rint(depth / 0.002).astype(np.uint16))
    return {"exr": 1.0, "tif": 0.001}.get(kind, 0.002)


def checked(folder: Path, stated: DepthStatement, scene: SparseScene | None = None) -> PhotoDepths:
    files = PhotoDepths(folder, scene or scene_of(), stated)
    files.check(cast(Any, StereoMaps()))
    return files


def cloud_of(files: PhotoDepths) -> LidarCloud:
    box = np.array([24.0, 24.0, 100.0])
    found = read_thinned(files, ORIGIN, Thinning(SPACING_M, 3_000_000, SHIFT - box, SHIFT + box))
    places = files.stations_in_geo[found.station]
    planes = planes_of(found.position_in_geo - SHIFT, found.classification, found.voxel_m, found.weight)
    return replace(planes, scanner_in_model=places - SHIFT)


@pytest.mark.parametrize(("kind", "along"), [("png", "axis"), ("exr", "ray"), ("tif", "axis"), ("pinhole", "ray")])
def test_depth_maps_of_photographs_lie_on_the_town(tmp_path: Path, kind: str, along: Along) -> None:
    unit = write_maps(tmp_path, kind, along=along, ending="_depth" if kind == "tif" else "")
    camera = (70.0, 70.0, 50.0, 36.0) if kind == "pinhole" else None
    files = checked(tmp_path, DepthStatement(unit, None, camera))
    assert files.along == along and codes(files.assumptions) == ["depth-along-assumed"] and files.held_out == [11]
    for chunk in files.chunks(ORIGIN):
        place = chunk.position_in_geo - SHIFT
        eye = VIEWS.center_in_world[chunk.station[0]]
        # The town is met where the point lies, but for the noise along the ray: five σ.
        off = (TOWN.distance(eye, place - eye) - 1) * np.linalg.norm(place - eye, axis=1)
        assert len(place) > 2000 and np.quantile(np.abs(off), 0.999) < 5 * SIGMA_M
        assert abs(np.median(off)) < 0.003
    assert files.tally.read == sum(
        len(chunk) for chunk in PhotoDepths(tmp_path, scene_of(), files.stated).chunks(ORIGIN)
    )


@pytest.mark.parametrize("kind", ["png", "exr"])
def test_depth_maps_are_registered_judged_and_followed_as_lidar_is(tmp_path: Path, kind: str) -> None:
    unit = write_maps(tmp_path, kind, WITH_EXTRA)  # a building that is gone since
    cloud = cloud_of(checked(tmp_path, DepthStatement(unit)))
    assert (np.abs(registration(cloud, VIEWS, 0).shift_m) < 0.01).all()
    judged = verdict(cloud, VIEWS, surface_of(TOWN), sigma_m=SIGMA_M, pixel_m=PIXEL_M)
    position = cloud.position_in_model
    inside = ((position > EXTRA[0] - 0.1) & (position < EXTRA[1] + 0.1)).all(axis=1) & (position[:, 2] > 1.0)
    assert inside.sum() > 200 and judged.rejected[inside].mean() >= 0.9
    assert judged.areas[0].kind == "removed"
    np.testing.assert_allclose(judged.areas[0].center_in_model[:2], (EXTRA[0] + EXTRA[1])[:2] / 2, atol=2)
    away = (np.abs(position[:, :2] - (EXTRA[0] + EXTRA[1])[:2] / 2) > 10).any(axis=1)
    assert judged.rejected[away].mean() < 0.01
    # Stereo 0.1 m in front of a wall is brought onto it.
    wall = np.column_stack([np.full(60, -1.9), np.linspace(-8, 0, 60), np.linspace(2, 7, 60)])
    moved, _, confidence = TrustedLidar(cloud, judged.confidence, PIXEL_M).onto(wall)
    assert (confidence > 0).mean() > 0.8 and np.median(np.abs(moved[:, 0] + 2.0)) < 0.02


@pytest.mark.parametrize("factor", [10.0, 0.3048, 1.05])
def test_a_wrong_unit_is_refused_with_what_fits(tmp_path: Path, factor: float) -> None:
    unit = write_maps(tmp_path, "png")
    with refused("depth-unit-differs", InputError) as error:
        checked(tmp_path, DepthStatement(unit * factor))
    found = [value for value in numbers(error.value.message) if abs(value / (1.005 * unit) - 1) < 0.01]
    assert found  # stereo is half a percent too deep here


def test_a_wrong_direction_is_refused_and_a_right_one_is_no_assumption(tmp_path: Path) -> None:
    unit = write_maps(tmp_path, "png", along="ray")
    with refused("depth-along-differs", InputError):
        checked(tmp_path, DepthStatement(unit, "axis"))
    assert not checked(tmp_path, DepthStatement(unit, "ray")).assumptions


def test_names_decide_to_which_photograph_a_map_belongs(tmp_path: Path) -> None:
    unit = write_maps(tmp_path / "maps", "exr")
    stated, folder = DepthStatement(unit), tmp_path / "maps" / "flight"
    flat = PhotoDepths(folder, scene_of(), stated)  # without the folder of the photographs
    assert flat.path_of == {number: folder / f"IMG_{number:02d}.exr" for number in range(12)}
    (folder / "IMG_00.exr").rename(folder / "IMG_00.JPG.exr")
    (folder / "IMG_01.exr").rename(folder / "other.exr")
    found = PhotoDepths(folder, scene_of(), stated)
    assert sorted(found.path_of) == [0, *range(2, 12)] and codes(found.assumptions) == ["depth-unmatched"]
    (folder / "img_00.exr").write_bytes((folder / "other.exr").read_bytes())
    with refused("depth-names", InputError):
        PhotoDepths(folder, scene_of(), stated)
    same = tuple(f"{part}/IMG.JPG" for part in "abcdefghijkl")
    (tmp_path / "one").mkdir()
    (folder / "other.exr").rename(tmp_path / "one" / "IMG.exr")
    with refused("depth-names", InputError):
        PhotoDepths(tmp_path / "one", scene_of(same), stated)
    with refused("depth-names", InputError):
        PhotoDepths(tmp_path / "one", scene_of(), stated)


def test_maps_of_another_camera_need_it(tmp_path: Path) -> None:
    write_maps(tmp_path, "png")
    for path in tmp_path.rglob("*.png"):
        cv2.imwrite(str(path), cv2.imread(str(path), cv2.IMREAD_UNCHANGED)[:, 20:])
    with refused("depth-size", InputError) as error:
        checked(tmp_path, DepthStatement(0.002))
    assert error.value.field == "--depth-camera"


def test_pictures_of_depths_are_refused(tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "a.png"), np.full((8, 8), 50, np.uint8))
    cv2.imwrite(str(tmp_path / "b.png"), np.full((8, 8, 3), 5000, np.uint16))
    write_exr(
        tmp_path / "c.exr", {name: np.full((8, 8), 9 * place, np.float32) for place, name in enumerate("BGR")}
    )
    write_exr(tmp_path / "d.exr", {name: np.ones((8, 8), np.float32) for name in ("U", "W")})
    for name, code in zip(("a.png", "b.png", "c.exr", "d.exr"), 2 * ["samples"] + 2 * ["channels"], strict=True):
        with refused(f"depth-{code}", InputError) as error:
            read_depth_image(tmp_path / name)
        assert error.value.path == tmp_path / name
    assert holds_depth_maps(tmp_path)
    for name in ("m.obj", "tile.laz"):  # pictures beside these are textures and previews
        (tmp_path / name).write_bytes(b"1")
        assert not holds_depth_maps(tmp_path)
        (tmp_path / name).unlink()


def test_values_that_are_no_depth_are_unknown_and_coarse_ones_are_named(tmp_path: Path) -> None:
    values = np.array([[0.0, -1.0, np.nan, np.inf], [1e10, 2.0, 2.5, 3.0]])
    write_exr(tmp_path / "a.exr", {"Z": values.astype(np.float32), "A": np.ones((2, 4), np.float32)})
    np.testing.assert_array_equal(
        read_depth_image(tmp_path / "a.exr").value, np.where((values > 1) & (values < 9), values, np.nan)
    )
    write_exr(tmp_path / "b.exr", {"Z": np.ones((2, 4), np.float16)})
    assert read_depth_image(tmp_path / "b.exr").is_half
    cv2.imwrite(str(tmp_path / "c.png"), np.array([[0, 65535, 7]], np.uint16))
    np.testing.assert_array_equal(read_depth_image(tmp_path / "c.png").value, [[np.nan, np.nan, 7]])
    write_maps(tmp_path / "maps", "png")
    assert "depth-resolution" in codes(checked(tmp_path / "maps", DepthStatement(0.002, sigma_m=1e-4)).assumptions)


def test_options_of_one_kind_are_refused_for_the_other(tmp_path: Path) -> None:
    with refused("option-of-another-kind", InputError):
        LidarOptions(lidar=tmp_path, lidar_crs="EPSG:32632", depth_unit=0.001).require_kind(depths=True)
    with refused("option-of-another-kind", InputError):
        LidarOptions(lidar=tmp_path, depth_unit=0.001).require_kind(depths=False)
    with refused("depth-unit-unknown", InputError):
        LidarOptions(lidar=tmp_path).require_kind(depths=True)
    texts = {"m": 1.0, "mm": 0.001, "ft": 0.3048, "0.0002": 0.0002}
    for text, unit in texts.items():
        assert LidarOptions.model_validate({"lidar": tmp_path, "depth_unit": text}).depth_unit == unit


@settings(max_examples=40, deadline=None)
@given(
    kind=st.sampled_from(["png", "exr", "tif"]),
    edits=st.lists(st.tuples(st.floats(0, 1), st.integers(0, 255)), max_size=6),
    cut=st.floats(0.05, 1),
)
def test_any_bytes_give_depths_or_an_input_error(
    tmp_path_factory: pytest.TempPathFactory, kind: str, edits: list[tuple[float, int]], cut: float
) -> None:
    path, values = tmp_path_factory.mktemp("hostile") / f"c.{kind}", np.full((12, 16), 7.0)
    if kind == "exr":
        write_exr(path, {"Z": values.astype(np.float32)})
    else:
        cv2.imwrite(str(path), values.astype(np.uint16 if kind == "png" else np.float32))
    data = bytearray(path.read_bytes())
    for where, value in edits:
        data[int(where * (len(data) - 1))] = value
    path.write_bytes(data[: max(int(cut * len(data)), 1)])
    try:
        read_depth_image(path)
    except InputError as error:
        assert error.path == path


def test_half_an_exr_is_damaged_and_nothing_is_printed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The library reads what is there, prints of the rest, and leaves it as it finds the memory."""
    path = tmp_path / "a.exr"
    write_exr(path, {"Z": np.random.default_rng(0).uniform(1, 9, (64, 64)).astype(np.float32)})
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    with pytest.raises(InputError, match="damaged") as raised:
        read_depth_image(path)
    assert raised.value.path == path
    assert capsys.readouterr().out == ""

"""E57 scans and meshes in the survey's frame: written by other programs' libraries, found in their place."""

from __future__ import annotations

import struct
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from pyproj import CRS

from pipelines.core.errors import InputError
from pipelines.formats.e57 import open_e57
from pipelines.formats.georef_sidecar import GeorefSidecar, write_sidecar
from pipelines.formats.mesh_glb import read_glb_mesh
from pipelines.formats.triangle_mesh import read_obj, read_ply_mesh
from pipelines.geodesy.enu import ecef_from_enu, ecef_from_enu_rotation, ecef_from_lla, lla_of
from pipelines.geodesy.vertical import VerticalDatum
from pipelines.geometry.rotations import quat_xyzw_from_matrix
from pipelines.surface import measured_cloud
from pipelines.surface.lidar_cloud import LidarCloud, planes_of
from pipelines.surface.measured_cloud import CloudReader, Thinning, read_thinned
from pipelines.surface.registration import registration
from pipelines.survey.options import CloudCrs, UpAxis
from pipelines.train.lidar_surface import TrustedLidar, verdict
from tests.geometry_files import ScanFile, distance_to, mesh_of, write_e57
from tests.refusals import codes, numbers, refused
from tests.survey.test_measured_cloud import ORIGIN, UTM, all_points, in_crs, town
from tests.towns import EXTRA, PIXEL_M, SIGMA_M, SPACING_M, TOWN, WITH_EXTRA, Town, scanned, surface_of, views_of

TURN = (np.cos(0.4), 0.0, 0.1 * np.sin(0.4), np.sqrt(0.99) * np.sin(0.4))
FLAT = trimesh.Trimesh([[0, 0, 0], [3, 0, 0], [3, 2, 0], [0, 2, 0.4]], [[0, 1, 2], [0, 2, 3]], process=False)


@pytest.mark.parametrize("kind", ["double", "single", "scaled", "spherical"])
def test_scans_of_an_e57_return_to_their_place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kind: str) -> None:
    monkeypatch.setattr(measured_cloud, "_CHUNK", 64)  # several chunks
    points = town(300)
    xyz = in_crs(points)
    middle = np.round(xyz.mean(axis=0))
    invalid = np.arange(120) % 3 == 0
    scans = [
        ScanFile(xyz[:120], TURN, middle + np.array([5.0, -9.0, 2.0]), np.where(invalid, 2, 0)),
        ScanFile(xyz[120:], (1.0, 0.0, 0.0, 0.0), middle, colour=True),
    ]
    write_e57(tmp_path / "c.e57", scans, kind=kind, crs=CRS(UTM).to_wkt())
    files = CloudReader(tmp_path / "c.e57", CloudCrs())
    found = np.concatenate([chunk.position_in_geo for chunk in files.chunks(ORIGIN)])
    kept = np.concatenate([points[:120][~invalid], points[120:]])
    # Half a step of 0.1 mm along each axis; a float of 32 bits rounds 250 m to 15 µm.
    np.testing.assert_allclose(found, kept, rtol=0, atol=1e-4)
    assert files.count == 300 and files.tally.withheld == invalid.sum()


def test_an_e57_without_a_crs_needs_one_and_points_at_the_scanner_are_none(tmp_path: Path) -> None:
    points = town(20)
    xyz = in_crs(points)
    middle = np.round(xyz[0])
    scan = ScanFile(np.vstack([xyz, middle[None]]), None)  # no pose
    write_e57(tmp_path / "c.e57", [scan])
    with refused("crs-unknown", InputError):
        CloudReader(tmp_path / "c.e57", CloudCrs())
    write_e57(tmp_path / "local.e57", [ScanFile(np.vstack([xyz - middle, np.zeros((1, 3))]))])
    stated = CloudCrs(crs=UTM, offset=tuple(middle))
    np.testing.assert_allclose(all_points(tmp_path / "local.e57", stated), points, rtol=0, atol=1e-6)


def test_single_precision_of_large_coordinates_in_an_e57_is_refused(tmp_path: Path) -> None:
    write_e57(tmp_path / "c.e57", [ScanFile(in_crs(town(5)))], kind="single", crs=UTM)
    with refused("single-precision", InputError):
        all_points(tmp_path / "c.e57")


def promised(path: Path, old: bytes, new: bytes) -> None:
    data = path.read_bytes()
    assert len(old) == len(new) and old in data
    path.write_bytes(data.replace(old, new))


def test_an_e57_that_promises_too_much_is_refused(tmp_path: Path) -> None:
    write_e57(tmp_path / "c.e57", [ScanFile(in_crs(town(100)))], crs=UTM)
    promised(tmp_path / "c.e57", b'recordCount="100"', b'recordCount="9e9"')
    with refused("size-differs", InputError):
        open_e57(tmp_path / "c.e57")
    promised(tmp_path / "c.e57", b'recordCount="9e9"', b'recordCount="999"')
    with refused("size-differs", InputError):
        open_e57(tmp_path / "c.e57")
    promised(tmp_path / "c.e57", b'recordCount="999"', b'recordCount="101"')
    with refused("file-damaged", InputError):  # the checksum of its page
        all_points(tmp_path / "c.e57")


Place = Callable[[Path, np.ndarray], None]
MESHES = ("ply", "ascii.ply", "obj", "glb")


def write_mesh(path: Path, mesh: trimesh.Trimesh) -> Path:
    if path.name.endswith("ascii.ply"):
        mesh.export(path, encoding="ascii")
    elif path.suffix == ".glb":
        # glTF is y-up; a node of a scene turns and shifts, as modelling programs write it.
        scene, half = trimesh.Scene(), np.array([10.0, 3.0, -2.0])
        part = mesh.copy()
        part.vertices = part.vertices[:, [0, 2, 1]] * [1, 1, -1] - half
        matrix = trimesh.transformations.rotation_matrix(0.7, [0, 1, 0])
        part.apply_transform(np.linalg.inv(matrix))
        scene.add_geometry(part, transform=trimesh.transformations.translation_matrix(half) @ matrix)
        scene.export(path)
    else:
        mesh.export(path)
    return path


@pytest.mark.parametrize("kind", MESHES)
def test_points_on_a_mesh_lie_on_its_triangles_as_dense_as_asked(tmp_path: Path, kind: str) -> None:
    mesh, shift = mesh_of(TOWN), in_crs(np.zeros((1, 3)))[0].round()
    path = write_mesh(tmp_path / f"m.{kind}", mesh)
    files = CloudReader(path, CloudCrs(crs=UTM, offset=tuple(shift)))
    cloud = read_thinned(files, ORIGIN, Thinning(0.5))
    xyz = in_crs(cloud.position_in_geo) - shift
    # 0.1 mm are what UTM's scale does to the planes of the boxes, and single precision to vertices.
    assert distance_to(mesh, xyz[::7]).max() < 2e-4
    # Voxels of 0.5 m: one for each square of that side, and at most the four that a plane cuts there.
    assert 0.9 * mesh.area / 0.25 <= len(cloud) <= 4 * mesh.area / 0.25
    assert cloud.weight.sum() == files.tally.read == pytest.approx(mesh.area / 0.25**2, rel=2e-3)
    assert ("lidar-axes" in codes(files.assumptions)) == (kind == "obj")


def test_a_box_cuts_a_mesh_before_it_is_sampled(tmp_path: Path) -> None:
    wide = trimesh.Trimesh(1e3 * FLAT.vertices + 4e3, FLAT.faces, process=False)
    shift = in_crs(np.zeros((1, 3)))[0].round()
    path = write_mesh(tmp_path / "m.obj", trimesh.util.concatenate([FLAT, wide]))
    files = CloudReader(path, CloudCrs(crs=UTM, offset=tuple(shift)))
    cloud = read_thinned(files, ORIGIN, Thinning(0.1, 10_000, np.full(3, -50.0), np.full(3, 50.0)))
    assert files.tally.read == pytest.approx(FLAT.area / 0.05**2, rel=1e-2) and len(cloud) > 500


def test_faces_of_all_kinds_become_triangles(tmp_path: Path) -> None:
    v = "v 0 0 0\nv 2 0 0 0.5 0.5 0.5\nv 2 2 0\nv 0 2 0\nvt 0 0\nvn 0 0 1\n"
    for number, faces in enumerate((
        "f 1/1/1 2/1/1 3/1/1 4/1/1\n", "f -4//-1 -3//-1 -2//-1 -1//-1\n", "f 1 2 3\nf 1 3 4\n", "f 1 2 \\\n 3 4\n",
    )):  # fmt: skip
        path = tmp_path / f"{number}.obj"
        path.write_text(f"# a comment\no part\n{v}{faces}")
        mesh = read_obj(path)
        np.testing.assert_array_equal(mesh.faces, [[0, 1, 2], [0, 2, 3]])
    head = "element vertex 4\nproperty double x\nproperty double y\nproperty double z\nelement face 2\n"
    head += "property list uchar int vertex_indices\nproperty list uchar float texcoord\nproperty uchar flag\n"
    corners = np.array([[0, 0, 0], [2, 0, 0], [2, 2, 0], [0, 2, 0]], dtype=float)
    for order, form in (("<", "binary_little_endian"), (">", "binary_big_endian")):
        body = corners.astype(f"{order}f8").tobytes()
        body += struct.pack(f"{order}B4iB2fB", 4, 0, 1, 2, 3, 2, 0.5, 0.5, 1)
        body += struct.pack(f"{order}B3iBB", 3, 0, 1, 3, 0, 1)
        (tmp_path / f"{form}.ply").write_bytes(f"ply\nformat {form} 1.0\n{head}end_header\n".encode() + body)
        mesh = read_ply_mesh(tmp_path / f"{form}.ply")
        np.testing.assert_array_equal(mesh.faces, [[0, 1, 2], [0, 2, 3], [0, 1, 3]])
        np.testing.assert_array_equal(mesh.vertices, corners)


def place_odm(folder: Path, shift: np.ndarray) -> None:
    (folder / "coords.txt").write_text(f"WGS84 UTM 32N\n{shift[0]:.0f} {shift[1]:.0f}\n")


def place_odm_tree(folder: Path, shift: np.ndarray) -> None:
    (folder.parent / "odm_georeferencing").mkdir()
    place_odm(folder.parent / "odm_georeferencing", shift)


def place_pix4d(folder: Path, shift: np.ndarray) -> None:
    (folder / "block_offset.xyz").write_text(" ".join(f"{value:.3f}" for value in shift))
    (folder / "block_wkt.prj").write_text(CRS(UTM).to_wkt("WKT1_ESRI"))


def place_metadata(folder: Path, shift: np.ndarray) -> None:
    text = ",".join(f"{value:.3f}" for value in shift)
    (folder / "metadata.xml").write_text(
        f'<?xml version="1.0"?><ModelMetadata version="1"><SRS>{UTM}</SRS><SRSOrigin>{text}</SRSOrigin>'
        "</ModelMetadata>"
    )


@pytest.mark.parametrize("place", [place_odm, place_odm_tree, place_pix4d, place_metadata])
@pytest.mark.parametrize("whole", [False, True])
def test_files_beside_a_mesh_place_it(tmp_path: Path, place: Place, whole: bool) -> None:
    """Whether the vertices count from the offset, or contain it already."""
    folder = tmp_path / "mesh"
    folder.mkdir()
    shift = in_crs(np.zeros((1, 3)))[0].round()
    local = FLAT.copy()
    local.vertices = local.vertices + ([0, 0, shift[2]] if "odm" in place.__name__ else 0.0)
    given_mesh = local.copy()
    if whole:
        full = np.array([*shift[:2], 0.0 if "odm" in place.__name__ else shift[2]])
        given_mesh.vertices = given_mesh.vertices + full
    path = folder / "m.obj"
    lines = [f"v {x:.4f} {y:.4f} {z:.4f}" for x, y, z in given_mesh.vertices]
    path.write_text("\n".join([*lines, *(f"f {a} {b} {c}" for a, b, c in given_mesh.faces + 1)]))
    place(folder, shift)
    files = CloudReader(path, CloudCrs())
    xyz = in_crs(np.concatenate([chunk.position_in_geo for chunk in files.chunks(ORIGIN)])) - shift
    np.testing.assert_allclose(xyz.min(axis=0), [0, 0, 0], atol=0.03)
    np.testing.assert_allclose(xyz.max(axis=0), [3, 2, 0.4], atol=0.03)
    expected = "lidar-offset-included" if whole else "lidar-offset-added"
    assert expected in codes(files.assumptions)


def test_a_tangent_frame_and_our_sidecar_place_a_mesh(tmp_path: Path) -> None:
    ground = ORIGIN.model_copy(update={"alt_m": 0.0})
    (tmp_path / "enu").mkdir()
    write_mesh(tmp_path / "enu" / "m.obj", FLAT)
    (tmp_path / "enu" / "metadata.xml").write_text(
        f"<ModelMetadata><SRS>ENU:{ORIGIN.lat_deg},{ORIGIN.lon_deg}</SRS><SRSOrigin>0,0,{ORIGIN.alt_m}</SRSOrigin>"
        "</ModelMetadata>"
    )
    rotation = ecef_from_enu_rotation(lla_of(ORIGIN))
    sidecar = GeorefSidecar(
        origin=tuple(ecef_from_lla(lla_of(ORIGIN))), rotation=tuple(quat_xyzw_from_matrix(rotation)), scale=1.0,
        origin_lla=tuple(lla_of(ORIGIN)), vertical_datum=VerticalDatum(name="ellipsoidal", stated=True), crs_wkt="",
        covariance=None, accuracy=None, georeference_sigma=None,
    )  # fmt: skip
    for name in ("m.ply", "m.glb"):
        write_sidecar(sidecar, write_mesh(tmp_path / name, FLAT))
    for path in (tmp_path / "enu" / "m.obj", tmp_path / "m.ply", tmp_path / "m.glb"):
        files = CloudReader(path, CloudCrs())
        found = np.concatenate([chunk.position_in_geo for chunk in files.chunks(ORIGIN)])
        assert distance_to(FLAT, found[::97]).max() < 1e-4
        np.testing.assert_allclose(found.max(axis=0), [3, 2, 0.4], atol=0.03)
    np.testing.assert_allclose(
        ecef_from_enu([[0, 0, ORIGIN.alt_m]], ground)[0], ecef_from_lla(lla_of(ORIGIN)), atol=1e-6
    )


def with_document(path: Path, member: bytes, before: bytes = b'"asset"') -> None:
    """Put a member into the document of a glb."""
    data = path.read_bytes()
    (size,) = struct.unpack_from("<I", data, 12)
    text = data[20 : 20 + size].replace(before, member + b"," + before, 1)
    text += b" " * (-len(text) % 4)
    head = struct.pack("<IIIII", *struct.unpack_from("<II", data), 0, len(text), 0x4E4F534A)
    path.write_bytes(head + text + data[20 + size :])


@pytest.mark.parametrize("geocentric", [False, True])
def test_a_glb_counts_from_the_centre_that_it_states(tmp_path: Path, geocentric: bool) -> None:
    """As ODM writes it, on a map and z-up, and as 3D Tiles have it, Earth-centred and y-up."""
    shift = in_crs(np.zeros((1, 3)))[0].round()
    center = ecef_from_lla(lla_of(ORIGIN)).round(3) if geocentric else np.array([*shift[:2], 0.0])
    mesh = FLAT.copy()
    if geocentric:
        ecef = ecef_from_enu(FLAT.vertices, ORIGIN) - center
        mesh.vertices = ecef[:, [0, 2, 1]] * [1, 1, -1]
    else:
        mesh.vertices = mesh.vertices + np.array([0, 0, shift[2]])
    mesh.export(tmp_path / "m.glb")
    text = ",".join(f"{value:.3f}" for value in center)
    with_document(tmp_path / "m.glb", f'"extensions":{{"CESIUM_RTC":{{"center":[{text}]}}}}'.encode())
    files = CloudReader(tmp_path / "m.glb", CloudCrs(crs=None if geocentric else UTM))
    found = np.concatenate([chunk.position_in_geo for chunk in files.chunks(ORIGIN)])
    xyz = found if geocentric else in_crs(found) - shift
    assert distance_to(FLAT, xyz[::97]).max() < 2e-4
    np.testing.assert_allclose(xyz.max(axis=0), [3, 2, 0.4], atol=0.03)


@pytest.mark.parametrize(("kind", "up"), [("obj", "y"), ("ply", "y"), ("glb", "z")])
def test_the_user_states_the_axis_of_a_mesh_that_is_up(tmp_path: Path, kind: str, up: UpAxis) -> None:
    """As Blender exports an OBJ, and as programs for maps write a GLB."""
    shift, mesh = in_crs(np.zeros((1, 3)))[0].round(), FLAT.copy()
    if up == "y":
        mesh.vertices = mesh.vertices[:, [0, 2, 1]] * [1, 1, -1]
    mesh.export(tmp_path / f"m.{kind}")
    files = CloudReader(tmp_path / f"m.{kind}", CloudCrs(crs=UTM, offset=tuple(shift), up=up))
    xyz = in_crs(np.concatenate([chunk.position_in_geo for chunk in files.chunks(ORIGIN)])) - shift
    assert distance_to(FLAT, xyz[::97]).max() < 2e-4 and "lidar-axes" not in codes(files.assumptions)
    np.testing.assert_allclose(xyz.max(axis=0), [3, 2, 0.4], atol=0.03)


def test_files_beside_a_mesh_that_contradict_each_other_are_refused(tmp_path: Path) -> None:
    shift = in_crs(np.zeros((1, 3)))[0].round()
    path = write_mesh(tmp_path / "m.obj", FLAT)
    place_pix4d(tmp_path, shift)
    place_metadata(tmp_path, shift + np.array([100.0, 0.0, 0.0]))
    with refused("mesh-offsets-differ", InputError) as error:
        CloudReader(path, CloudCrs())
    assert {shift[0], shift[0] + 100} <= set(numbers(error.value.message))
    stated = CloudCrs(offset=tuple(shift))  # the user decides
    found = in_crs(all_points(path, stated)) - shift
    np.testing.assert_allclose(found.max(axis=0), [3, 2, 0.4], atol=0.03)


def test_a_mesh_without_a_place_needs_a_crs(tmp_path: Path) -> None:
    with refused("crs-unknown", InputError):
        CloudReader(write_mesh(tmp_path / "m.glb", FLAT), CloudCrs())
    for text, code in (
        ("v 1 2\nf 1 1 1\n", "obj-line"),
        ("v 1 2 3\n", "mesh-empty"),
        ("v 1 2 3\nf 1 2 3\n", "mesh-corner"),
    ):
        (tmp_path / "m.obj").write_text(text)
        with refused(code, InputError) as error:
            read_obj(tmp_path / "m.obj")
        assert error.value.path == tmp_path / "m.obj"


def test_a_compressed_glb_and_one_with_its_data_elsewhere_are_refused(tmp_path: Path) -> None:
    for member, before, code in (
        (b'"extensionsUsed":["KHR_draco_mesh_compression"]', b'"asset"', "glb-extension"),
        (b'"uri":"a.bin"', b'"byteLength"', "glb-external"),
    ):
        path = write_mesh(tmp_path / "m.glb", FLAT)
        with_document(path, member, before)
        with refused(code, InputError):
            read_glb_mesh(path)


@settings(max_examples=60, deadline=None)
@given(
    kind=st.sampled_from(["e57", *MESHES]),
    edits=st.lists(st.tuples(st.floats(0, 1), st.integers(0, 255)), max_size=6),
    cut=st.floats(0.05, 1),
)
def test_any_bytes_give_geometry_or_an_input_error(
    tmp_path_factory: pytest.TempPathFactory, kind: str, edits: list[tuple[float, int]], cut: float
) -> None:
    path = tmp_path_factory.mktemp("hostile") / f"c.{kind}"
    if kind == "e57":
        write_e57(path, [ScanFile(in_crs(town(40)))], crs=UTM)
    else:
        write_mesh(path, FLAT)
    data = bytearray(path.read_bytes())
    for where, value in edits:
        data[int(where * (len(data) - 1))] = value
    path.write_bytes(data[: max(int(cut * len(data)), 1)])
    readers = {"e57": lambda p: list(open_e57(p).chunks(16)), "obj": read_obj, "glb": read_glb_mesh}
    try:
        readers.get(kind, read_ply_mesh)(path)
    except InputError as error:
        assert error.path == path


def cloud_of(path: Path, shift: np.ndarray) -> LidarCloud:
    """The cloud of a file in the frame of the town, with the planes of its points."""
    files = CloudReader(path, CloudCrs(crs=UTM, offset=tuple(shift)))
    box = np.array([24.0, 24.0, 100.0])
    cloud = read_thinned(files, ORIGIN, Thinning(SPACING_M, 3_000_000, -box, box))
    return planes_of(cloud.position_in_geo, cloud.classification, cloud.voxel_m, cloud.weight)


def measured_town(kind: str, path: Path, then: Town, offset: np.ndarray) -> LidarCloud:
    """The cloud of a town that was scanned or modelled, and moved by an offset."""
    shift = in_crs(np.zeros((1, 3)))[0].round()
    if kind == "e57":
        points = in_crs(np.concatenate([scanned(then, seed=seed).position_in_model for seed in range(3)]) + offset)
        half = len(points) // 2
        center = shift + np.array([3.0, 4.0, 30.0])
        write_e57(
            path / "t.e57", [ScanFile(points[:half] - shift, TURN, center - shift), ScanFile(points[half:] - shift)]
        )
        return cloud_of(path / "t.e57", shift)
    mesh = mesh_of(then).subdivide_to_size(1.0)
    offset = offset + np.random.default_rng(0).normal(0, SIGMA_M, mesh.vertices.shape)
    mesh.vertices = in_crs(mesh.vertices + offset) - shift
    return cloud_of(write_mesh(path / f"t.{kind}", mesh), shift)


@pytest.mark.parametrize("kind", ["e57", "glb"])
def test_scans_and_meshes_are_registered_judged_and_followed_as_lidar_is(tmp_path: Path, kind: str) -> None:
    offset = np.array([0.06, -0.08, 0.10])
    found = registration(measured_town(kind, tmp_path, TOWN, offset), views_of(TOWN), 0)
    np.testing.assert_allclose(found.shift_m, offset, atol=0.01)
    # A building that is gone since: named, and not followed.
    cloud = measured_town(kind, tmp_path, WITH_EXTRA, np.zeros(3))
    judged = verdict(cloud, views_of(TOWN), surface_of(TOWN), sigma_m=SIGMA_M, pixel_m=PIXEL_M)
    position = cloud.position_in_model
    inside = ((position > EXTRA[0] - 0.1) & (position < EXTRA[1] + 0.1)).all(axis=1) & (position[:, 2] > 1.0)
    assert judged.rejected[inside].mean() >= 0.9 and judged.areas[0].kind == "removed"
    np.testing.assert_allclose(judged.areas[0].center_in_model[:2], (EXTRA[0] + EXTRA[1])[:2] / 2, atol=2)
    away = (np.abs(position[:, :2] - (EXTRA[0] + EXTRA[1])[:2] / 2) > 10).any(axis=1)
    assert judged.rejected[away].mean() < 0.01
    # Stereo 0.1 m in front of a wall is brought onto it.
    wall = np.column_stack([np.full(60, -1.9), np.linspace(-8, 0, 60), np.linspace(2, 7, 60)])
    moved, _, confidence = TrustedLidar(cloud, judged.confidence, PIXEL_M).onto(wall)
    assert (confidence > 0).mean() > 0.9 and np.median(np.abs(moved[:, 0] + 2.0)) < 0.02

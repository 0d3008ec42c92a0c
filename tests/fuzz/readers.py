"""Every reader with small, valid files: `prepare` makes a folder of them, `read` reads that folder."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeVar

import cv2
import laspy
import numpy as np
import trimesh
from plyfile import PlyData, PlyElement
from pydantic import BaseModel
from pyproj import CRS
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import CompressionMode, StoragePlugin
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from pipelines.core.errors import GeorefError
from pipelines.core.options import load_toml, remember, resolve
from pipelines.core.products import Remark, load_json, save_json, save_npz
from pipelines.core.runner import run_stage
from pipelines.core.stages import BY_NAME, POINTS, SPARSE
from pipelines.core.staleness import status
from pipelines.core.workspace import Manifest, Workspace
from pipelines.formats.bag import COMPRESSED, IMAGE, BadImageError, ImageWriter, UndecodableError, open_bag
from pipelines.formats.colmap import pycolmap_module, read_sparse
from pipelines.formats.depth_image import read_depth_image
from pipelines.formats.e57 import open_e57
from pipelines.formats.exif import read_tags
from pipelines.formats.georef_sidecar import GeorefSidecar, sidecar_path, write_sidecar
from pipelines.formats.gnss_logs import read_mrk, read_pos, read_subtitles
from pipelines.formats.gopro_telemetry import read_telemetry
from pipelines.formats.ground_points import (
    read_distances,
    read_geo,
    read_ground_points,
    read_marks,
    read_point_list,
    read_point_table,
)
from pipelines.formats.image_file import inspect_image, read_bytes
from pipelines.formats.metashape import read_cameras, read_markers, read_markers_xml
from pipelines.formats.opf import read_opf_points
from pipelines.formats.splat_ply import SplatArrays, read_splat_ply, write_splat_ply
from pipelines.formats.spz import spz_georeference, write_spz
from pipelines.formats.spz_extensions import SpzGeoreference
from pipelines.formats.trajectory_csv import read_trajectory
from pipelines.geodesy.crs import parse_crs
from pipelines.geodesy.enu import Origin
from pipelines.geodesy.vertical import VerticalDatum
from pipelines.geometry.similarity import Similarity
from pipelines.geometry.sparse_model import SparseModel
from pipelines.ingest.bag_inspection import inspect_bag
from pipelines.sfm.foreign_cameras import foreign_file
from pipelines.surface.measured_cloud import CloudReader
from pipelines.survey.navigation import NavigationTrack, RigCalibration, RigEstimate
from pipelines.survey.options import CloudCrs
from pipelines.survey.report import EvaluationReport
from pipelines.survey.solution import GeolocatedPoints, TrainedModel
from pipelines.survey.survey import Survey
from pipelines.train.trainer import load_checkpoint
from tests import bags, foreign_files, gopro
from tests.formats.test_surveyors_tables import DEGREES, MRK, POS_HEAD, REFERENCE, SIGMAS, TAIL, XML
from tests.geometry_files import ScanFile, write_e57, write_exr
from tests.oracles import read_spz
from tests.photos import Exif, dji_xmp, gps_entries, jpeg
from tests.reports import check_points_with, report_with
from tests.scenes import Noise, initial, make_scene, material, sparse_model, trained_model, write_workspace

LIMIT = 200  # messages that are decoded
ProductT = TypeVar("ProductT", bound=BaseModel)


@dataclass(frozen=True)
class Reader:
    """A reader with its files.

    Attributes:
        prepare: writes valid files into an empty folder.
        read: reads the folder; raises nothing but `GeorefError`.
        files: pattern of the files to mutate.
        slow: whether a case takes a tenth of a second or more.
    """

    prepare: Callable[[Path], None]
    read: Callable[[Path], object]
    files: str = "*"
    slow: bool = False


def _photographs(folder: Path) -> None:
    exif = Exif(gps=gps_entries(46.0, 7.0), photo=[(0x9003, 2, "2024:05:01 12:00:00"), (0x920A, 5, [(24, 1)])])
    (folder / "a.jpg").write_bytes(jpeg(size=(16, 12), exif=exif, xmp=dji_xmp(RtkFlag="50", RtkStdLon="0.01")))
    pixels = np.zeros((12, 16, 3), np.uint8)
    for suffix in (".png", ".tif"):
        (folder / f"a{suffix}").write_bytes(cv2.imencode(suffix, pixels)[1].tobytes())
    (folder / "b.tif").write_bytes(exif.tiff())


def _read_photographs(folder: Path) -> None:
    for path in folder.iterdir():
        data = _attempt(lambda path=path: read_bytes(path))
        if data is not None:
            read_tags(data)
            _attempt(lambda data=data, path=path: inspect_image(data, path))


def _solved(writer: Callable[[SparseModel, Path], Path], name: str) -> Reader:
    """Return the reader of the cameras that another program has solved."""

    def prepare(folder: Path) -> None:
        scene = make_scene(images=3, points=8)
        lens = scene.camera.params.copy()
        lens[1] = lens[0]  # some programs have one focal length
        one = replace(scene, camera=replace(scene.camera, params=lens))
        writer(sparse_model(one, Noise(), np.random.default_rng(0)), folder / name)

    def read(folder: Path) -> None:
        found = foreign_file(folder / name)
        if found is not None:
            found.read(found.path, lambda _: (1200, 900))
            if found.path.suffix == ".opf":
                read_opf_points(found.path)

    return Reader(prepare, read, "**/*")


def _trajectories(folder: Path) -> None:
    (folder / "a.csv").write_text(
        "image,timestamp,latitude,longitude,altitude,yaw,pitch,roll,sigma_e,sigma_n,sigma_u\n"
        + "".join(f"a{i}.jpg,2024-05-01T12:00:0{i}Z,46.{i},7.{i},500,1{i},-90,0,0.1,0.1,0.2\n" for i in range(5))
    )
    (folder / "b.csv").write_text(
        "timestamp;x;y;z;qx;qy;qz;qw\n" + "".join(f"17000000{i},5;4000{i},5;50{i};9;1;0;0;0\n" for i in range(5))
    )


def _ground_points(folder: Path) -> None:
    rows = "".join(f"4000{i}.25 510000{i}.5 50{i} {10 * i} 20 a{i}.jpg P{i // 2}\n" for i in range(6))
    (folder / "gcp_list.txt").write_text("WGS84 UTM 32N\n# comment\n" + rows)


def _read_ground_points(folder: Path) -> None:
    points = read_ground_points(folder / "gcp_list.txt")
    xyz = [point.xyz for point in points.points]
    parse_crs(points.crs_text, path=points.path, line=1).lla_from_xyz(xyz, path=points.path)


def _write(**texts: str) -> Callable[[Path], None]:
    """Return what writes texts into files of a folder, by name."""

    def prepare(folder: Path) -> None:
        for name, text in texts.items():
            (folder / name).write_text(text)

    return prepare


def _each(*read: Callable[[Path], object]) -> Callable[[Path], object]:
    """Return what reads each file of a folder in each of several ways."""
    return lambda folder: [_attempt(lambda p=p, r=r: r(p)) for p in folder.iterdir() for r in read]


def _geo(folder: Path) -> None:
    rows = "".join(f"a{i}.jpg 7.{i} 46.{i} 500 {i} 1 2 0.1 0.2\n" for i in range(6))
    (folder / "geo.txt").write_text("EPSG:4326\n" + rows)


def _crs(folder: Path) -> None:
    bound = CRS("+proj=longlat +ellps=intl +nadgrids=@grid.gsb +type=crs")
    for number, text in enumerate((
        "+proj=utm +zone=32 +ellps=intl +towgs84=1,2,3,0,0,0,0 +units=m +vunits=m", "EPSG:32632+5773",
        CRS("EPSG:2056").to_wkt(), CRS("EPSG:2056").to_json(), bound.to_wkt(), CRS("EPSG:7415").to_wkt("WKT1_GDAL"),
        "+proj=omerc +lat_0=4 +lonc=115 +alpha=53 +k=0.99984 +x_0=590476 +y_0=442857 +gamma=53.1 +ellps=evrstSS",
    )):  # fmt: skip
        (folder / f"{number}.txt").write_text(text)


def _read_crs(folder: Path) -> None:
    """Read the texts that differ from the valid ones only: PROJ takes its time."""
    for path in folder.iterdir():
        text = path.read_bytes().decode("utf-8", "replace")
        if text not in _KNOWN:
            crs = _attempt(lambda text=text: parse_crs(text))
            if crs is not None:
                _attempt(lambda crs=crs: (crs.units, crs.wkt, crs.lla_from_xyz([[4e5, 5.1e6, 500.0]])))
                _attempt(lambda crs=crs: crs.xyz_from_lla([[46.0, 7.0, 500.0]]))


_KNOWN: set[str] = set()


def _sparse(folder: Path) -> None:
    _, model, survey = material(images=4, points=30)
    write_workspace(folder / "ws", survey, model)
    for path in (folder / "ws" / SPARSE).iterdir():
        path.rename(folder / path.name)
    shutil.rmtree(folder / "ws")


def _sparse_text(folder: Path) -> None:
    _sparse(folder)
    model = pycolmap_module().Reconstruction(str(folder))
    for path in folder.iterdir():
        path.unlink()
    model.write_text(str(folder))


def _bag(storage: StoragePlugin, compression: CompressionMode | None = None) -> Callable[[Path], None]:
    def prepare(folder: Path) -> None:
        flight = bags.Flight(count=2)
        messages = [
            *bags.usual(flight)[:12],
            *bags.images(flight),
            *bags.raw_images(flight, "rgb8", lambda rgb: rgb),
        ]
        bags.write(folder / "bag", messages, bags.Form(storage, compression))

    return prepare


def _bag1(folder: Path) -> None:
    store = get_typestore(Stores.ROS1_NOETIC)
    store.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", "tf2_msgs/msg/TFMessage"))
    writer = Writer1(folder / "a.bag")
    writer.set_compression(Writer1.CompressionFormat.BZ2)
    with writer:
        links: dict[str, Any] = {}
        for topic, kind, ns, message in sorted(bags.usual(bags.Flight(count=2))[:12], key=lambda one: one[2]):
            if topic not in links:
                links[topic] = writer.add_connection(topic, kind, typestore=store)
            writer.write(links[topic], int(ns), store.serialize_ros1(bags.as_ros1(message, store), kind))


def _read_bag(pattern: str) -> Callable[[Path], None]:
    def read(folder: Path) -> None:
        (path,) = folder.glob(pattern)
        with open_bag(path) as bag:
            for number, message in enumerate(bag.messages(bag.topics)):
                bag.header_stamp_ns(message)
                try:
                    decoded = bag.decode(message)
                    if message.type in (IMAGE, COMPRESSED):
                        ImageWriter().encoded(message.type, decoded)
                except (UndecodableError, BadImageError):
                    pass
                if number > LIMIT:
                    break
        if path.is_file():  # The YAML of a folder takes longer than all else.
            inspect_bag(path)

    return read


def _splat(folder: Path) -> None:
    rng = np.random.default_rng(0)
    shapes = {"means": (5, 3), "quats_wxyz": (5, 4), "log_scales": (5, 3), "logit_opacities": (5,), "sh": (5, 4, 3)}
    arrays = {name: rng.normal(size=shape).astype(np.float32) for name, shape in shapes.items()}
    write_splat_ply(folder / "a.ply", SplatArrays(**arrays))


def _clouds(folder: Path) -> None:
    positions = [(400_000.0, 5_100_000.0, 600.0), (400_001.5, 5_100_002.25, 601.0)]
    header = laspy.LasHeader(version="1.4", point_format=6)
    header.vlrs.append(laspy.vlrs.known.WktCoordinateSystemVlr(CRS("EPSG:32632").to_wkt("WKT1_GDAL")))
    las = laspy.LasData(header)
    las.x, las.y, las.z = np.array(positions).T
    las.write(folder / "a.las")
    las.write(folder / "b.laz")
    vertex = np.array(positions, dtype=[(axis, "<f8") for axis in "xyz"])
    PlyData([PlyElement.describe(vertex, "vertex")], byte_order="<").write(str(folder / "c.ply"))


def _read_clouds(folder: Path) -> None:
    origin = Origin(lat_deg=46.05, lon_deg=7.7, alt_m=600.0)
    for chunk in CloudReader(folder, CloudCrs(crs="EPSG:32632")).chunks(origin):
        assert np.isfinite(chunk.position_in_geo).all()


def _meshes(folder: Path) -> None:
    corners = np.array([[4e5, 5.1e6, 600.0], [4e5, 5.1e6 + 1, 600.0], [4e5 + 1, 5.1e6, 601.0]])
    mesh = trimesh.Trimesh(corners - corners[0].round(), [[0, 1, 2]], process=False)
    for name in ("a.obj", "b.glb", "c.ply"):
        mesh.export(folder / name)
    mesh.export(folder / "d.ply", encoding="ascii")
    (folder / "coords.txt").write_text("WGS84 UTM 32N\n400000 5100000\n")
    (folder / "metadata.xml").write_text("<M><SRS>EPSG:32632</SRS><SRSOrigin>400000,5100000,0</SRSOrigin></M>")


def _e57(folder: Path) -> None:
    points = np.array([[1.0, 2.0, 3.0], [2.0, 2.5, 3.5]])
    write_e57(folder / "a.e57", [ScanFile(points)], kind="scaled", crs="EPSG:32632")
    write_e57(folder / "b.e57", [ScanFile(points), ScanFile(points)], kind="spherical")


def _depth_maps(folder: Path) -> None:
    values = np.full((12, 16), 7.0)
    write_exr(folder / "a.exr", {"Z": values.astype(np.float32)})
    cv2.imwrite(str(folder / "b.png"), values.astype(np.uint16))
    cv2.imwrite(str(folder / "c.tif"), values.astype(np.float32))


def _read_spz(folder: Path) -> None:
    for name in ("a.spz", "b.spz", "c.spz"):
        read_spz(folder / name)
    spz_georeference((folder / "c.spz").read_bytes())


def _spz(folder: Path) -> None:
    _splat(folder)
    splat = read_splat_ply(folder / "a.ply")
    (folder / "a.ply").unlink()
    write_spz(folder / "a.spz", splat, 3)
    write_spz(folder / "b.spz", splat, 4)
    place = SpzGeoreference("EPSG:4978", (4e6, -1e4, 4.9e6), (0.5, 0.5, 0.5, 0.5))
    write_spz(folder / "c.spz", splat, 4, place)


def _sidecar(folder: Path) -> None:
    covariance = tuple(tuple(row) for row in (np.eye(7) * 1e-4).tolist())
    sidecar = GeorefSidecar(
        origin=(4e6, 6e5, 4.8e6), rotation=(0, 0, 0, 1), scale=1.0, origin_lla=(46, 7, 500), crs_wkt="",
        vertical_datum=VerticalDatum(name="ellipsoidal", stated=True), covariance=covariance, accuracy=None,
        georeference_sigma=None,
    )  # fmt: skip
    write_sidecar(sidecar, folder / "a.ply")


def _read_sidecar(folder: Path) -> None:
    sidecar = load_json(GeorefSidecar, sidecar_path(folder / "a.ply"))
    sidecar.ecef_from_file()


def _products(folder: Path) -> None:
    save_json(material(images=4)[2], folder / "Survey.json")
    save_json(trained_model(Similarity()).model_copy(update={"initial": initial()}), folder / "TrainedModel.json")
    shift = RigEstimate(name="time-offset", unit="s", value=(1,), sigma=(1,), start=(0,), observable=(True,))
    save_json(RigCalibration(applied=(shift,)), folder / "RigCalibration.json")
    report = report_with(triangulated=check_points_with(count=3, rmse_h_m=0.1, rmse_v_m=0.1, rmse_3d_m=0.2))
    save_json(report, folder / "EvaluationReport.json")


def _read_products(folder: Path) -> None:
    for kind in (Survey, TrainedModel, RigCalibration, EvaluationReport):
        _attempt(lambda kind=kind: _read_product(kind, folder))


def _read_product(kind: type[ProductT], folder: Path) -> None:
    product = load_json(kind, folder / f"{kind.__name__}.json")
    if isinstance(product, TrainedModel) and product.initial is not None:
        Similarity.from_record(product.initial.geo_from_local)


def _arrays(folder: Path) -> None:
    count = 4
    points = GeolocatedPoints(
        np.arange(count), np.zeros((count, 3)), np.zeros((count, 3, 3)), np.ones(count, np.int32), np.ones(count),
        np.ones(count), np.ones(count, bool), "sfm",
    )  # fmt: skip
    save_npz(folder / Path(POINTS).name, vars(points))
    shapes = {
        "position_time_s": (3,), "antenna_in_geo": (3, 3), "sigma_m": (3, 3), "attitude_time_s": (3,),
        "geo_from_body": (3, 3, 3), "image_time_s": (2,), "cam_from_body": (2, 3, 3), "antenna_in_body": (2, 3),
        "nominal_from_cam": (3, 3), "time_offset_s": (), "max_gap_s": (),
    }  # fmt: skip
    zeros = {name: np.zeros(shape) for name, shape in shapes.items()}
    track = NavigationTrack(image=np.array(["a.jpg", "b.jpg"]), body_known=np.array(True), **zeros)
    save_npz(folder / "track.npz", vars(track))
    np.savez(folder / "checkpoint.npz", iteration=np.array(3), **{"gaussians/means": np.zeros((5, 3), np.float32)})


def _read_arrays(folder: Path) -> None:
    _attempt(lambda: GeolocatedPoints.load(folder / Path(POINTS).name))
    _attempt(lambda: NavigationTrack.load(folder / "track.npz"))
    _attempt(lambda: load_checkpoint(folder / "checkpoint.npz"))


def _workspace(folder: Path) -> None:
    _, model, survey = material(images=3, points=20)
    workspace = write_workspace(folder, survey, model)
    (folder / "georef.toml").write_text(
        '[ingest]\nsigma_h = 0.02\nlever_arm = "0.1,0,-0.3"\ntime_offset = "2"\n[train]\niterations = 40\n'
    )
    remember(workspace.root, {"sfm": {"threads": 1}, "train": {"preset": "smoke"}})
    manifest = Manifest(
        stage="sfm", config={}, inputs={}, versions={}, started="2026-01-01T00:00:00Z", duration_s=1.0,
        key_figure="3 of 3", values={"registered": 3}, warnings=[Remark(code="careful", sentence="Careful.")],
    )  # fmt: skip
    save_json(manifest, folder / "sfm/manifest.json")
    (folder / "geolocate.partial").mkdir()
    (folder / "geolocate.partial/failure.txt").write_text("no overlap")


def _read_workspace(folder: Path) -> None:
    status(Workspace(folder))
    tables = load_toml(folder / "georef.toml", BY_NAME)
    for name, table in tables.items():
        resolve(BY_NAME[name].options, table, {}, folder / "georef.toml")


def _stages(folder: Path) -> None:
    """A workspace up to the initial similarity, without manifests: as put there by hand."""
    _, model, survey = material(images=6, points=40)
    workspace = write_workspace(folder, survey, model)
    for name in ("geolocate", "init-sim3"):
        run_stage(workspace, BY_NAME[name], {})
    for manifest in folder.rglob("manifest.json"):
        manifest.unlink()


def _run_stages(folder: Path) -> None:
    """Run each stage on the products as they are, also if one before it refused them."""
    workspace = Workspace(folder)
    for name in ("geolocate", "init-sim3"):
        spec = BY_NAME[name]
        kept = {path: path.read_bytes() for path in (folder / spec.folder).iterdir()}
        try:
            _attempt(lambda spec=spec: run_stage(workspace, spec, {}, force=True))
        finally:
            shutil.rmtree(folder / spec.folder)
            (folder / spec.folder).mkdir()
            for path, data in kept.items():
                path.write_bytes(data)


def _attempt(read: Callable[[], Any]) -> Any:
    """Return what a reader returns; None for a refused file."""
    try:
        return read()
    except GeorefError:
        return None


def _telemetry(folder: Path) -> None:
    one = gopro.Payload([gopro.Sample(46.02, 7.75, 1700.0), gopro.Sample(46.02001, 7.75, 1700.0)])
    for name, text in (("a", gopro.gps5(one)), ("b", gopro.gps9(one))):
        (folder / f"{name}.mp4").write_bytes(gopro.telemetry_alone([text] * 3, [1.0] * 3))


SUBTITLES = (
    "1\n00:00:00,000 --> 00:00:00,033\n2026-05-01 12:00:00.123\n[iso: 100] [latitude: 46.020000] "
    "[longitude: 7.750000] [rel_alt: 50.000 abs_alt: 1670.000]\n\n2\n00:00:00,033 --> 00:00:00,066\n"
    "[latitude: 46.020001] [longitude: 7.750000] [rel_alt: 50.100 abs_alt: 1670.100]\n"
)

READERS: dict[str, Reader] = {
    "photographs": Reader(_photographs, _read_photographs),
    "trajectory": Reader(
        _trajectories, lambda folder: [_attempt(lambda p=p: read_trajectory(p)) for p in folder.iterdir()]
    ),
    "geo.txt": Reader(_geo, lambda folder: read_geo(folder / "geo.txt")),
    "gcp_list.txt": Reader(_ground_points, _read_ground_points),
    "markers": Reader(_write(markers=XML), _each(read_markers_xml)),
    "reference": Reader(_write(reference=REFERENCE), _each(read_markers, read_cameras)),
    "pix4d": Reader(
        _write(
            a="label,x,y,z,sigma_h\nP,4e5,5e6,9,0.1\n",
            b="P,46,7,9,0.1,0.2\nQ,47,8,9\n",
            c="a.jpg,P,1.5,2.5,1\n",
            d="from,to,distance,sigma,use\nP,Q,2.5,0.01,check\n",
            e="EPSG:4979\nP 7 46 9\nQ 7.1 46 9.5\n",
        ),
        _each(read_point_table, read_marks, read_distances, read_point_list),
    ),
    "mrk": Reader(_write(mrk=MRK), _each(read_mrk)),
    "subtitles": Reader(_write(srt=SUBTITLES), _each(read_subtitles)),
    "telemetry": Reader(_telemetry, _each(read_telemetry)),
    "pos": Reader(
        _write(
            a=DEGREES.format(clock="GPST") + f"2024/05/01 12:00:18.000 46.02 7.75 1620.25{TAIL}",
            b=DEGREES.format(clock="UTC") + f"2312 302418.0 46.02 7.75 1620.25{TAIL}",
            c=f"{POS_HEAD}%  GPST  x-ecef(m) y-ecef(m) z-ecef(m) {SIGMAS}2312 302418.0 4397e3 598e3 4567e3{TAIL}",
        ),
        _each(read_pos),
    ),
    "crs": Reader(_crs, _read_crs, slow=True),
    "metashape-cameras": _solved(foreign_files.metashape, "cameras.xml"),
    "opensfm": _solved(foreign_files.opensfm, "reconstruction.json"),
    "odm-shots": _solved(foreign_files.odm, "odm"),
    "nerfstudio": _solved(foreign_files.nerfstudio, "transforms.json"),
    "realityscan": _solved(foreign_files.realityscan, "cameras.csv"),
    "opf": _solved(foreign_files.opf, "opf"),
    "colmap-binary": Reader(_sparse, read_sparse),
    "colmap-text": Reader(_sparse_text, read_sparse),
    "bag-mcap": Reader(_bag(StoragePlugin.MCAP), _read_bag("bag/*.mcap"), "bag/*.mcap"),
    "bag-mcap-zstd": Reader(_bag(StoragePlugin.MCAP, CompressionMode.STORAGE), _read_bag("bag"), "bag/*"),
    "bag-db3": Reader(_bag(StoragePlugin.SQLITE3), _read_bag("bag/*.db3"), "bag/*.db3"),
    "bag-db3-zstd": Reader(_bag(StoragePlugin.SQLITE3, CompressionMode.MESSAGE), _read_bag("bag"), "bag/*"),
    "bag-ros1": Reader(_bag1, _read_bag("*.bag")),
    "spz": Reader(_spz, _read_spz),
    "clouds": Reader(_clouds, _read_clouds),
    "e57": Reader(
        _e57, lambda folder: [_attempt(lambda p=p: list(open_e57(p).chunks(9))) for p in folder.iterdir()]
    ),
    "meshes": Reader(_meshes, _read_clouds),
    "depth-maps": Reader(_depth_maps, _each(read_depth_image)),
    "splat-ply": Reader(_splat, lambda folder: read_splat_ply(folder / "a.ply")),
    "sidecar": Reader(_sidecar, _read_sidecar),
    "products": Reader(_products, _read_products),
    "arrays": Reader(_arrays, _read_arrays),
    "workspace": Reader(_workspace, _read_workspace, "**/*"),
    "stages": Reader(_stages, _run_stages, "[gis][efn]*/**/*.[jnb]*", slow=True),
}

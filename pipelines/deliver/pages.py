"""Pages that show a splat in a browser: beside a tileset (`index.html`), and in one file (`splat.html`).

The program of a page is its template with `page.js`, which both share; the scene enters it as one JSON document. A
policy in each page runs its own scripts, by their hashes, and loads nothing else.

- `tiles.html` shows a tileset in CesiumJS, with coordinates, scale bar and surveyed points. It needs a web server,
  the tiles and CesiumJS: no account, no imagery, no terrain.
- `splat.html` holds splat, cameras, surveyed points, measurements, accuracy and place on Earth. It draws with Spark
  on three.js, whose script it holds too (`renderer.js.gz`, with their licences at its head): a browser opens it
  from a disk, without a server and without a network.
"""

import base64
import gzip
import hashlib
import html
import itertools
import re
from collections.abc import Sequence
from importlib import resources
from pathlib import Path
from typing import Annotated, Any, Literal
from urllib.parse import quote, urlsplit

import numpy as np
from numpy.typing import ArrayLike
from pydantic import AfterValidator, Field

from pipelines.core.figures import length_text
from pipelines.core.files import replace_text
from pipelines.core.manifest import hash_file
from pipelines.core.products import Product
from pipelines.core.sentences import printable, without_folders
from pipelines.core.stages import MODEL, SAVED_MEASUREMENTS, TILES
from pipelines.core.types import Float32Array, Matrix3, Vector3, vector3
from pipelines.core.workspace import Workspace
from pipelines.deliver.placement import Placement
from pipelines.geodesy.crs import PointCrs, parse_crs
from pipelines.geodesy.enu import (
    SEMI_MAJOR_M,
    ecef_from_enu,
    ecef_from_enu_rotation,
    ecef_from_lla,
    lla_from_ecef,
)
from pipelines.geodesy.vertical import ELLIPSOIDAL
from pipelines.geometry.cameras import CameraPoses
from pipelines.geometry.similarity import Similarity
from pipelines.geometry.sparse_model import SparseModel
from pipelines.survey.options import CrsOptions
from pipelines.survey.saved_measurements import CLOSED, Kind, NamedMeasurement, Quantity, read_measurements
from pipelines.survey.survey import Survey, SurveyedPoint
from pipelines.survey.target_crs import TargetCrs, usable_crs

PAGE, TILESET = "index.html", Path(TILES).name
_PLACEHOLDER, _POLICY = '{"to be filled": "pages.py"}', "to be filled: pages.py"
_SCRIPT = re.compile(r"<script>(.*?)</script>", re.DOTALL)
_SHARED = "// to be filled: page.js"
# The first view shows these of the Gaussians: single ones of the sky or of a far background lie kilometres away.
_SHOWN = 0.75
_LEAST_RADIUS_M = 1.0
_CRS_BOX = 4.0  # of the radius, to each side: cameras of the usual views lie inside
_LEAST_CRS_BOX_M = 300.0
_MOST_CRS_BOX_M = 10_000.0
# Polynomials of the coordinates of a CRS.
_DEGREE = 3
_EXPONENTS = tuple(powers for powers in itertools.product(range(_DEGREE + 1), repeat=3) if sum(powers) <= _DEGREE)
_NODES = 7  # of each axis: more than the polynomial has coefficients along it
_MOST_DECIMALS = 3

# Names come from files of other people: control characters are shown, and none turns the direction of writing.
ShownText = Annotated[str, AfterValidator(printable)]


class Fact(Product):
    """Line of the page: what it tells, and the value."""

    name: ShownText
    value: ShownText


PointKind = Literal["control", "check"]


class PagePoint(Product):
    """Control or check point with its surveyed place in EPSG:4978."""

    name: ShownText
    kind: PointKind
    ecef: Vector3


class Axis(Product):
    """Axis of a CRS: its short name, its unit, and the decimals of which the polynomial is sure."""

    name: str
    unit: str
    decimals: int


class LocalCrs(Product):
    """Polynomials of the coordinates of a CRS, in a box around a scene.

    A coordinate is Σ coefficient · (e / a)^i (n / b)^j (u / c)^k; e, n, u are East-North-Up metres at the scene.

    Attributes:
        axes: of the coordinates, easting or longitude first.
        half_extent_m: (a, b, c), half of the box's sides; the polynomials are not to be used outside.
        exponents: (i, j, k) of each coefficient.
        coefficients: of the three axes, for each row of exponents.
        error_m: largest departure from the CRS that was found in the box.
    """

    axes: tuple[Axis, Axis, Axis]
    half_extent_m: Vector3
    exponents: tuple[tuple[int, int, int], ...]
    coefficients: tuple[Vector3, ...]
    error_m: float


class ScenePage(Product):
    """Content of the page.

    Attributes:
        tileset: address of the tileset, relative to the page.
        cesium: address of the folder of CesiumJS, relative to the page or absolute; ends in a slash.
        origin_lla: latitude, longitude in degrees, ellipsoidal height: middle of the scene.
        radius_m: of the scene, for the first view.
        facts: what the reader must know of the coordinates.
        crs: coordinates to show beside longitude, latitude and ellipsoidal height; None: no others.
    """

    title: ShownText
    tileset: str
    cesium: str
    origin_lla: Vector3
    radius_m: float = Field(gt=0)
    facts: tuple[Fact, ...]
    cautions: tuple[ShownText, ...]
    points: tuple[PagePoint, ...]
    crs: LocalCrs | None = None


def scene_page(
    title: str,
    placement: Placement,
    center_in_file: Float32Array,
    *,
    survey: Survey,
    target: TargetCrs,
    cesium: str,
) -> ScenePage:
    """Return the content of the page of a splat; an InputError: the CRS does not reach it, or lacks a grid.

    Args:
        placement: of its frame `file`.
        center_in_file: (N, 3) centres of its Gaussians, metres.
    """
    assert placement.origin_lla is not None  # tiles are refused before, without a place on Earth
    kinds: dict[PointKind, Sequence[SurveyedPoint]] = {
        "control": survey.control_points,
        "check": survey.check_points,
    }
    origin = survey.origin_on_earth
    radius, box = scene_extent_m(center_in_file)
    return ScenePage(
        title=title,
        tileset=TILESET,
        cesium=cesium,
        origin_lla=vector3(placement.origin_lla),
        radius_m=radius,
        facts=facts_of(placement, target),
        cautions=tuple(caution.sentence for caution in placement.cautions),
        points=tuple(
            PagePoint(name=point.name, kind=kind, ecef=vector3(ecef_from_enu(point.position_in_geo, origin)))
            for kind, points in kinds.items()
            for point in points
        ),
        crs=fit_local_crs(target.crs, placement.origin_lla, (box, box, box)),
    )


def scene_extent_m(center_in_file: Float32Array) -> tuple[float, float]:
    """Return the radius of a scene for its first view, and half of the side of the box with coordinates in a CRS.

    Args:
        center_in_file: (N, 3) centres of its Gaussians, metres from the middle of the scene.
    """
    distance_m = np.linalg.norm(center_in_file, axis=1)
    radius_m = max(float(np.quantile(distance_m, _SHOWN)), _LEAST_RADIUS_M)
    return radius_m, float(np.clip(_CRS_BOX * radius_m, _LEAST_CRS_BOX_M, _MOST_CRS_BOX_M))


def write_scene_page(page: ScenePage, folder: Path) -> None:
    """Write the page into a folder, whole or not at all; an OSError: it cannot be written."""
    program = page_template("tiles.html")
    program = program.replace(_POLICY, html.escape(_policy(program, page.cesium)), 1)
    replace_text(folder / PAGE, program.replace(_PLACEHOLDER, script_json(page), 1))


def page_template(name: str) -> str:
    """Return the template of a page with the script in it that pages of splats and of tiles share."""
    templates = resources.files(__package__).joinpath("templates")
    shared = templates.joinpath("page.js").read_text(encoding="utf-8")
    return templates.joinpath(name).read_text(encoding="utf-8").replace(_SHARED, shared.rstrip("\n"), 1)


def script_json(page: Product) -> str:
    """Return the content of a page as JSON for a script element, which no name can end: it has no `<`."""
    return re.sub("[<>&\u2028\u2029]", lambda match: f"\\u{ord(match[0]):04x}", page.model_dump_json())


def _policy(program: str, cesium: str) -> str:
    """Return the content security policy of the page.

    CesiumJS starts workers from blobs, which load scripts from blobs, and decodes textures from blobs. Its decoder
    of SPZ is WebAssembly whose calls are made from text (`unsafe-eval`): else CesiumJS 1.145 does not start.
    """
    script = _SCRIPT.search(program)
    assert script is not None
    digest = base64.b64encode(hashlib.sha256(script[1].encode()).digest()).decode()
    library = quote(cesium, safe="/:@[]%") if urlsplit(cesium).netloc else "'self'"
    files = "'self'" if library == "'self'" else f"'self' {library}"
    return "; ".join(
        (
            "default-src 'none'",
            f"script-src 'sha256-{digest}' 'unsafe-eval' blob: {library}",
            f"worker-src blob: {library}",
            f"connect-src {files} blob: data:",
            f"img-src {files} blob: data:",
            f"style-src {library} 'unsafe-inline'",
            "base-uri 'none'",
            "form-action 'none'",
        )
    )


def facts_of(placement: Placement, target: TargetCrs) -> tuple[Fact, ...]:
    """Return what the reader of a page must know of its coordinates: CRS, heights, accuracy, assumptions."""
    accuracy = placement.accuracy
    facts = (
        ("CRS", target.crs.name),
        ("Heights", f"{target.crs.vertical.described}; of the survey's input: {placement.vertical.described}"),
        ("h", "height above the WGS84 ellipsoid; labels stand at it, too"),
        ("Accuracy", "not known: nothing states it yet" if accuracy is None else accuracy.text),
        *(("Assumed", sentence) for sentence in target.assumed),
    )
    return tuple(Fact(name=name, value=value) for name, value in facts)


def fit_local_crs(crs: PointCrs, origin_lla: ArrayLike, half_extent_m: Vector3) -> LocalCrs:
    """Return the polynomials of a CRS in a box around a place; an InputError: it leaves the domain, or no grid.

    Args:
        origin_lla: (3,) latitude, longitude in degrees, ellipsoidal height: middle of the box.
        half_extent_m: half of its sides east, north and up.
    """
    chebyshev = np.cos(np.pi * (np.arange(_NODES) + 0.5) / _NODES)
    between = np.linspace(-1.0, 1.0, _NODES + 1)
    nodes, checks = (
        np.stack(np.meshgrid(along, along, along, indexing="ij"), axis=-1).reshape(-1, 3)
        for along in (chebyshev, between)
    )
    plan_m = crs.horizontal_unit * (SEMI_MAJOR_M if crs.is_geographic else 1.0)
    unit_m = np.array([plan_m, plan_m, crs.height_unit_m])
    places = np.vstack([nodes, checks])
    enu = places * half_extent_m
    lla = lla_from_ecef(ecef_from_lla(origin_lla) + enu @ ecef_from_enu_rotation(origin_lla).T)
    values = crs.serving(lla).xyz_from_lla(lla)
    if crs.is_geographic:  # a polynomial cannot jump at the date line
        values[:, 0] -= 360.0 * np.round((values[:, 0] - values[0, 0]) / 360.0)
    powers = np.stack([np.prod(places ** np.array(exponents), axis=1) for exponents in _EXPONENTS], axis=1)
    solved = np.linalg.lstsq(powers[: len(nodes)], values[: len(nodes)], rcond=None)[0]
    errors = np.abs(powers[len(nodes) :] @ solved - values[len(nodes) :]).max(axis=0)
    decimals = np.clip(np.floor(-np.log10(2 * errors + 1e-12)), 0, _MOST_DECIMALS + np.round(np.log10(unit_m)))
    axes = [
        Axis(name=name, unit=unit, decimals=int(count))
        for name, unit, count in zip(_axis_names(crs), crs.short_units, decimals, strict=True)
    ]
    return LocalCrs(
        axes=(axes[0], axes[1], axes[2]),
        half_extent_m=half_extent_m,
        exponents=tuple((i, j, k) for i, j, k in _EXPONENTS),
        coefficients=tuple((x, y, z) for x, y, z in solved.tolist()),
        error_m=float((errors * unit_m).max()),
    )


def _axis_names(crs: PointCrs) -> tuple[str, str, str]:
    if crs.is_geocentric:
        return "X", "Y", "Z"
    height = "h" if crs.vertical.name == ELLIPSOIDAL else "H"
    return ("lon", "lat", height) if crs.is_geographic else ("E", "N", height)


_TEMPLATES = Path(str(resources.files(__package__))) / "templates"
RENDERER = _TEMPLATES / "renderer.js.gz"  # made by .ci/renderer.py
_SPLAT, _RENDERER = "to be filled: the splat", "to be filled: the renderer"
_LLA = "EPSG:4979"
_DECIMALS_M, _DECIMALS_ROTATION = 4, 7


class PageCamera(Product):
    """Camera of a photograph, in the frame of the page: its name, centre in metres, rotation and half angles.

    Attributes:
        cam_from_page: its rows are the axes x right, y down, z forward.
        half: tangents of half of its field of view, across and down.
    """

    name: ShownText
    at: Vector3
    cam_from_page: Matrix3
    half: tuple[float, float]


class SurveyedPlace(Product):
    """Control or check point at its surveyed place in the frame of the page."""

    name: ShownText
    kind: PointKind
    at: Vector3


class PageMeasurement(Product):
    """Saved measurement, its points in the frame of the page.

    Attributes:
        closed: the last point is joined to the first.
        facts: the CRS, and the coordinates of a single point.
        older: it was measured in another trained model.
    """

    name: ShownText
    kind: Kind
    at: tuple[Vector3, ...]
    closed: bool
    quantities: tuple[Quantity, ...]
    facts: tuple[Fact, ...]
    older: bool


class SplatPage(Product):
    """Content of the page; its frame is East-North-Up in metres at the middle of the scene, or the local frame.

    Attributes:
        radius_m: of the scene, for the first view.
        facts: what the reader must know of place, accuracy and splat.
        crs: coordinates to show; none in a local frame.
        georef: content of the sidecar that other files of the splat have beside them.
        mip_filter: whether the splat was trained with opacities that make up for the dilation on the screen.
    """

    title: ShownText
    radius_m: float = Field(gt=0)
    facts: tuple[Fact, ...]
    cautions: tuple[ShownText, ...]
    cameras: tuple[PageCamera, ...]
    points: tuple[SurveyedPlace, ...]
    measurements: tuple[PageMeasurement, ...]
    crs: tuple[LocalCrs, ...]
    georef: dict[str, Any]
    mip_filter: bool = False


def splat_page(
    workspace: Workspace,
    placement: Placement,
    center_in_file: Float32Array,
    survey: Survey,
    options: CrsOptions,
    *,
    poses: CameraPoses,
    sparse: SparseModel,
) -> SplatPage:
    """Return the content of the page of a splat; an InputError: a CRS that does not fit, or bad measurements.

    Args:
        placement: of its frame `file`, which is that of the page.
        center_in_file: (N, 3) centres of its Gaussians, metres.
        poses, sparse: solved cameras in `model`, and the SfM model with the solved lenses.
    """
    middle_in_geo = placement.file_from_geo.inverse().apply(np.zeros((1, 3)))
    target = usable_crs(options, survey.origin, middle_in_geo, survey.vertical)
    radius_m, box_m = scene_extent_m(center_in_file)
    surveyed: dict[PointKind, Sequence[SurveyedPoint]] = {
        "control": survey.control_points,
        "check": survey.check_points,
    }
    model = hash_file(workspace.path(MODEL), {})
    measured = read_measurements(workspace.root / Path(SAVED_MEASUREMENTS).parent)
    return SplatPage(
        title=workspace.root.resolve().name,
        radius_m=radius_m,
        facts=_facts(placement, target),
        cautions=tuple(without_folders(caution.sentence) for caution in placement.cautions),
        cameras=_cameras(poses, sparse, placement.file_from_model),
        points=tuple(
            SurveyedPlace(name=point.name, kind=kind, at=_places(placement, [point.position_in_geo])[0])
            for kind, points in surveyed.items()
            for point in points
        ),
        measurements=tuple(_measurement(each, placement, target, model) for each in measured),
        crs=_coordinates(placement, target, box_m),
        georef=placement.sidecar().model_dump(mode="json", by_alias=True),
    )


def _facts(placement: Placement, target: TargetCrs) -> tuple[Fact, ...]:
    """Return the facts of any page, for a reader who has no program to call, and the place on Earth."""
    facts = [
        Fact(name=fact.name, value=without_folders(fact.value))
        for fact in facts_of(placement, target)
        if fact.name != "h"
    ]
    if placement.origin_lla is None:
        place = "not on Earth: a local metric frame"
    else:
        lat, lon, height = placement.origin_lla
        place = f"lat {lat:.6f}°, lon {lon:.6f}°, {height:.1f} m above the WGS84 ellipsoid (h): middle of the scene"
    return (Fact(name="Place", value=place), *facts)


def _coordinates(placement: Placement, target: TargetCrs, box_m: float) -> tuple[LocalCrs, ...]:
    if placement.origin_lla is None:
        return ()
    box, crs = (box_m, box_m, box_m), (parse_crs(_LLA), target.crs)
    return tuple(fit_local_crs(each, placement.origin_lla, box) for each in crs)


def _cameras(poses: CameraPoses, sparse: SparseModel, file_from_model: Similarity) -> tuple[PageCamera, ...]:
    turn = file_from_model.rotation.T
    centers = np.round(file_from_model.apply(poses.cam_center_in_model), _DECIMALS_M)
    cameras = []
    for index, name in enumerate(sparse.image_name):
        lens = sparse.camera_of(index)
        x, y, z = np.round(poses.cam_from_model[index] @ turn, _DECIMALS_ROTATION)
        focal_px = lens.mean_focal_px
        cameras.append(
            PageCamera(
                name=name,
                at=vector3(centers[index]),
                cam_from_page=(vector3(x), vector3(y), vector3(z)),
                half=(lens.width / 2 / focal_px, lens.height / 2 / focal_px),
            )
        )
    return tuple(cameras)


def _measurement(
    measured: NamedMeasurement, placement: Placement, target: TargetCrs, model: str
) -> PageMeasurement:
    facts = [Fact(name="CRS", value=measured.crs)]
    if measured.kind == "point":
        xyz, sigma = measured.points[0].xyz, measured.points[0].sigma_m
        decimals = 7 if target.crs.name == measured.crs and target.crs.is_geographic else 3
        plan = ", ".join(f"{value:.{decimals}f}" for value in xyz[:2])
        facts.append(Fact(name="Place", value=f"{plan}, {xyz[2]:.3f}"))
        if sigma is not None:
            facts.append(Fact(name="σ E, N, U", value=", ".join(length_text(value) for value in sigma)))
    return PageMeasurement(
        name=measured.name,
        kind=measured.kind,
        at=_places(placement, [point.position_in_geo for point in measured.points]),
        closed=measured.kind in CLOSED and len(measured.points) > 2,
        quantities=measured.quantities,
        facts=tuple(facts),
        older=measured.model != model,
    )


def _places(placement: Placement, points_in_geo: ArrayLike) -> tuple[Vector3, ...]:
    return tuple(vector3(place) for place in np.round(placement.file_from_geo.apply(points_in_geo), _DECIMALS_M))


def write_splat_page(path: Path, page: SplatPage, spz: bytes) -> None:
    """Write the page with an SPZ file, whole or not at all; an OSError: it cannot be written."""
    replace_text(path, splat_page_text(page, spz))


def splat_page_text(page: SplatPage, spz: bytes) -> str:
    """Return the page with the bytes of an SPZ file, whose axes are right, up and back: east, up and south."""
    renderer = gzip.decompress(RENDERER.read_bytes()).decode()
    text = page_template("splat.html")
    program = _SCRIPT.search(text)
    assert program is not None
    parts = {
        _POLICY: html.escape(_file_policy(renderer, program[1])),
        _PLACEHOLDER: script_json(page),
        _SPLAT: base64.b64encode(spz).decode(),
        _RENDERER: renderer,
    }
    done = []
    for placeholder, part in parts.items():
        before, _, text = text.partition(placeholder)
        done += [before, part]
    return "".join((*done, text))


def _file_policy(*scripts: str) -> str:
    """Return the content security policy: Spark decodes and sorts in WebAssembly and in workers made of blobs."""
    hashes = " ".join(
        f"'sha256-{base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()}'" for script in scripts
    )
    return "; ".join(
        (
            "default-src 'none'",
            f"script-src {hashes} 'wasm-unsafe-eval' blob:",
            "worker-src blob:",
            "img-src data: blob:",
            "style-src 'unsafe-inline'",
            "base-uri 'none'",
            "form-action 'none'",
        )
    )

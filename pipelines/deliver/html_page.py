"""The page in one file: splat, cameras, surveyed points, measurements, accuracy and place on Earth.

The page's program is the template `splat.html`. It draws with Spark on three.js, whose script it holds too
(`renderer.js.gz`, with their licences at its head): a browser opens it from a disk, without a server and without a
network. Its own policy enforces that: it runs the two scripts, by their hashes, and loads nothing.
"""

import base64
import gzip
import hashlib
import html
import re
from collections.abc import Sequence
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from pydantic import Field

from pipelines.core.figures import length_text
from pipelines.core.files import replace_text
from pipelines.core.manifest import hash_file
from pipelines.core.products import Product
from pipelines.core.sentences import without_folders
from pipelines.core.stages import MODEL, SAVED_MEASUREMENTS
from pipelines.core.types import Float32Array, Matrix3, Vector3, vector3
from pipelines.core.workspace import Workspace
from pipelines.deliver.placement import Placement
from pipelines.deliver.tiles_page import (
    Fact,
    LocalCrs,
    PointKind,
    ShownText,
    facts_of,
    fit_local_crs,
    page_template,
    scene_extent_m,
    script_json,
)
from pipelines.geodesy.crs import parse_crs
from pipelines.geometry.cameras import CameraPoses
from pipelines.geometry.similarity import Similarity
from pipelines.geometry.sparse_model import SparseModel
from pipelines.survey.options import CrsOptions
from pipelines.survey.saved_measurements import CLOSED, Kind, NamedMeasurement, Quantity, read_measurements
from pipelines.survey.survey import Survey, SurveyedPoint
from pipelines.survey.target_crs import TargetCrs, usable_crs

_TEMPLATES = Path(str(resources.files(__package__))) / "templates"
RENDERER = _TEMPLATES / "renderer.js.gz"  # made by .ci/renderer.py
_SCENE, _POLICY = '{"to be filled": "html_page.py"}', "to be filled: html_page.py"
_SPLAT, _RENDERER = "to be filled: the splat", "to be filled: the renderer"
_LLA = "EPSG:4979"
_DECIMALS_M, _DECIMALS_ROTATION = 4, 7
_SCRIPT = re.compile(r"<script>(.*?)</script>", re.DOTALL)


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
    found = []
    for index, name in enumerate(sparse.image_name):
        lens = sparse.camera_of(index)
        x, y, z = np.round(poses.cam_from_model[index] @ turn, _DECIMALS_ROTATION)
        focal_px = lens.mean_focal_px
        found.append(
            PageCamera(
                name=name,
                at=vector3(centers[index]),
                cam_from_page=(vector3(x), vector3(y), vector3(z)),
                half=(lens.width / 2 / focal_px, lens.height / 2 / focal_px),
            )
        )
    return tuple(found)


def _measurement(
    measured: NamedMeasurement, placement: Placement, target: TargetCrs, model: str
) -> PageMeasurement:
    facts = [Fact(name="CRS", value=measured.crs)]
    if measured.kind == "point":
        place, sigma = measured.points[0].xyz, measured.points[0].sigma_m
        decimals = 7 if target.crs.name == measured.crs and target.crs.is_geographic else 3
        plan = ", ".join(f"{value:.{decimals}f}" for value in place[:2])
        facts.append(Fact(name="Place", value=f"{plan}, {place[2]:.3f}"))
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
        _POLICY: html.escape(_policy(renderer, program[1])),
        _SCENE: script_json(page),
        _SPLAT: base64.b64encode(spz).decode(),
        _RENDERER: renderer,
    }
    done = []
    for placeholder, part in parts.items():
        before, _, text = text.partition(placeholder)
        done += [before, part]
    return "".join((*done, text))


def _policy(*scripts: str) -> str:
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

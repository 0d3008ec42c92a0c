"""The page `index.html` beside a tileset: CesiumJS shows it with coordinates, scale bar and surveyed points.

The page's program is the template `tiles.html`; a scene enters it as one JSON document. It needs a web server, the
tiles and CesiumJS, and loads nothing else: no account, no imagery, no terrain. Its own policy enforces that: it
runs its own script, by its hash, and CesiumJS.
"""

from __future__ import annotations

import base64
import hashlib
import html
import re
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Annotated, Literal
from urllib.parse import quote, urlsplit

import numpy as np
from pydantic import AfterValidator, Field

from pipelines.core.files import replace_file
from pipelines.core.products import Product
from pipelines.core.sentences import printable
from pipelines.core.types import Float32Array, Vector3
from pipelines.deliver.placement import Placement
from pipelines.deliver.tiles_content import TILESET, LocalCrs, fit_local_crs
from pipelines.geodesy.enu import ecef_from_enu
from pipelines.survey.survey import Survey, SurveyedPoint
from pipelines.survey.target_crs import TargetCrs

PAGE = "index.html"
_PLACEHOLDER, _POLICY = '{"to be filled": "page.py"}', "to be filled: page.py"
_SCRIPT = re.compile(r"<script>(.*?)</script>", re.DOTALL)
# The first view shows these of the Gaussians: single ones of the sky or of a far background lie kilometres away.
_SHOWN = 0.75
_LEAST_RADIUS_M = 1.0
_CRS_BOX = 4.0  # of the radius, to each side: cameras of the usual views lie inside
_LEAST_CRS_BOX_M = 300.0
_MOST_CRS_BOX_M = 10_000.0


# Names come from files of other people: control characters are shown, and none turns the direction of writing.
ShownText = Annotated[str, AfterValidator(printable)]


class Fact(Product):
    """Line of the page: what it tells, and the value."""

    name: ShownText
    value: ShownText


class PagePoint(Product):
    """Control or check point with its surveyed place in EPSG:4978."""

    name: ShownText
    kind: Literal["control", "check"]
    ecef: Vector3


class ScenePage(Product):
    """Content of the page.

    Attributes:
        title: name of the scene.
        tileset: address of the tileset, relative to the page.
        cesium: address of the folder of CesiumJS, relative to the page or absolute; ends in a slash.
        origin_lla: latitude, longitude in degrees, ellipsoidal height: middle of the scene.
        radius_m: of the scene, for the first view.
        facts: what the reader must know of the coordinates.
        cautions: limits of the model, one sentence each.
        points: surveyed points to label.
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


@dataclass(frozen=True)
class ShownScene:
    """Scene to show.

    Attributes:
        title: name of the scene.
        placement: place on Earth of its frame `file`.
        center_in_file: (N, 3) centres of its Gaussians, metres.
    """

    title: str
    placement: Placement
    center_in_file: Float32Array


def scene_page(scene: ShownScene, survey: Survey, target: TargetCrs, cesium: str) -> ScenePage:
    """Return the content of the page of a splat.

    Args:
        scene: the splat.
        survey: has the control and check points.
        target: CRS in which coordinates are shown.
        cesium: address of the folder of CesiumJS.

    Raises:
        InputError: the scene is outside the domain of the CRS, or a grid is missing.
    """
    placement = scene.placement
    distance_m = np.linalg.norm(scene.center_in_file, axis=1)
    radius = max(float(np.quantile(distance_m, _SHOWN)), _LEAST_RADIUS_M)
    box = float(np.clip(_CRS_BOX * radius, _LEAST_CRS_BOX_M, _MOST_CRS_BOX_M))
    lat, lon, height = placement.origin_lla.tolist()
    return ScenePage(
        title=scene.title,
        tileset=TILESET,
        cesium=cesium,
        origin_lla=(lat, lon, height),
        radius_m=radius,
        facts=_facts(placement, target),
        cautions=tuple(caution.sentence for caution in placement.cautions),
        points=(
            *(_page_point(point, "control", survey) for point in survey.control_points),
            *(_page_point(point, "check", survey) for point in survey.check_points),
        ),
        crs=fit_local_crs(target.crs, placement.origin_lla, (box, box, box)),
    )


def write_page(page: ScenePage, folder: Path) -> None:
    """Write the page into a folder; the file appears whole or not at all.

    Raises:
        OSError: the file cannot be written.
    """
    program = resources.files(__package__).joinpath("templates", "tiles.html").read_text(encoding="utf-8")
    draft = folder / f"{PAGE}.tmp"
    program = program.replace(_POLICY, html.escape(_policy(program, page.cesium)), 1)
    draft.write_text(program.replace(_PLACEHOLDER, _script_json(page), 1), encoding="utf-8")
    replace_file(draft, folder / PAGE)


def _policy(program: str, cesium: str) -> str:
    """Return the content security policy of the page.

    CesiumJS starts workers from blobs, which load scripts from blobs, and decodes textures from blobs. Its decoder
    of SPZ is WebAssembly whose calls are made from text (`unsafe-eval`): else CesiumJS 1.145 does not start.
    """
    found = _SCRIPT.search(program)
    assert found is not None
    own = base64.b64encode(hashlib.sha256(found[1].encode()).digest()).decode()
    library = quote(cesium, safe="/:@[]%") if urlsplit(cesium).netloc else "'self'"
    files = "'self'" if library == "'self'" else f"'self' {library}"
    return "; ".join(
        (
            "default-src 'none'",
            f"script-src 'sha256-{own}' 'unsafe-eval' blob: {library}",
            f"worker-src blob: {library}",
            f"connect-src {files} blob: data:",
            f"img-src {files} blob: data:",
            f"style-src {library} 'unsafe-inline'",
            "base-uri 'none'",
            "form-action 'none'",
        )
    )


def _script_json(page: ScenePage) -> str:
    """Return JSON that no name in it can break out of an HTML script element: `<` only occurs escaped."""
    return re.sub("[<>&\u2028\u2029]", lambda found: f"\\u{ord(found[0]):04x}", page.model_dump_json())


def _page_point(point: SurveyedPoint, kind: Literal["control", "check"], survey: Survey) -> PagePoint:
    x, y, z = ecef_from_enu(point.position_in_geo, survey.origin).tolist()
    return PagePoint(name=point.name, kind=kind, ecef=(x, y, z))


def _facts(placement: Placement, target: TargetCrs) -> tuple[Fact, ...]:
    accuracy = "not known: nothing states it yet (georef evaluate)"
    if placement.accuracy is not None:
        accuracy = placement.accuracy.text
    input_heights = placement.vertical.name + ("" if placement.vertical.stated else " (assumed)")
    facts = (
        Fact(name="CRS", value=target.crs.name),
        Fact(name="Heights", value=f"{target.crs.vertical.name}; of the survey's input: {input_heights}"),
        Fact(name="h", value="height above the WGS84 ellipsoid; labels stand at it, too"),
        Fact(name="Accuracy", value=accuracy),
    )
    return facts + tuple(Fact(name="Assumed", value=sentence) for sentence in target.assumed)

"""Overview of a result: where on Earth it is, how good it is, what was made, and what each file is for.

Reads survey, trained model and the centres of its Gaussians. Writes nothing.
"""

import contextlib
from dataclasses import asdict, dataclass
from datetime import datetime
from pathlib import Path

import numpy as np

from pipelines.core.errors import GeorefError
from pipelines.core.figures import Headline
from pipelines.core.json_values import Json
from pipelines.core.products import Remark
from pipelines.core.stages import BY_NAME, DELIVERABLES, DESCRIPTIONS, GAUSSIANS, REPORT, StageSpec
from pipelines.core.staleness import StageState, cautions_by_stage, document_of_cautions, status
from pipelines.core.types import FloatArray, Vector3, vector3
from pipelines.core.workspace import Workspace
from pipelines.deliver.placement import solved_placement
from pipelines.formats.splat_ply import read_centres
from pipelines.formats.vector_files import feature, polygon
from pipelines.geodesy.enu import lla_from_enu
from pipelines.survey.headline import headline_of
from pipelines.survey.navigation import load_survey
from pipelines.survey.options import CrsOptions
from pipelines.survey.report import read_report
from pipelines.survey.solution import read_trained
from pipelines.survey.survey import Survey
from pipelines.survey.target_crs import usable_crs

_WITHIN = (0.01, 1 - 0.01)  # quantiles of the Gaussians at the bounds: beyond lie sky, and floaters
_MOST = 100_000  # Gaussians that the bounds are taken from


@dataclass(frozen=True)
class GeographicBounds:
    """Bounds in WGS84 degrees, west > east across the date line, and least and largest ellipsoidal height.

    `datum_assumed`: nobody stated the datum of the survey's heights.
    """

    west: float
    south: float
    east: float
    north: float
    height_m: tuple[float, float]
    datum_assumed: bool = False


@dataclass(frozen=True)
class Bounds:
    """Bounds of 98 % of the Gaussians along each coordinate.

    Attributes:
        on_earth: on the WGS84 ellipsoid; None: the result has a local frame.
        crs, units, heights: name of a CRS, units of its three coordinates, and datum of its heights.
        low, high: least and largest coordinates in it, easting or longitude first.
        assumed: what the user did not state of it.
    """

    on_earth: GeographicBounds | None
    crs: str
    units: tuple[str, str, str]
    heights: str
    low: Vector3
    high: Vector3
    assumed: tuple[str, ...]


@dataclass(frozen=True)
class MadeFile:
    """File or folder that was made, by its path in the workspace.

    Attributes:
        bytes: size, that of all its files for a folder.
        made: time; None: not recorded.
        state: state of its stage, as in `georef status`.
    """

    path: str
    description: str
    bytes: int
    made: datetime | None
    state: str


@dataclass(frozen=True)
class Overview:
    """Result of a workspace.

    Attributes:
        center_lla: latitude, longitude and ellipsoidal height of the middle of the scene; None: of a local frame.
        accuracy: headline of the result; None: nothing states it yet.
        psnr, area_ha: of the test views, dB, and the area of interest in hectares; None: not known.
        files: those that there are, with their use.
        outdated: stages whose product is stale or damaged, in the order of the work.
        interrupted: by stage, what an interrupted run has left beside the product.
    """

    workspace: Path
    gaussians: int
    center_lla: Vector3 | None
    bounds: Bounds
    accuracy: Headline | None
    psnr: float | None
    area_ha: float | None
    files: tuple[MadeFile, ...]
    outdated: tuple[StageState, ...]
    interrupted: dict[str, str]
    further: tuple[StageSpec, ...]
    cautions: dict[str, tuple[Remark, ...]]

    def feature(self) -> Json:
        """Return the overview as a GeoJSON feature: the bounds as geometry, all else as properties.

        Without a place on Earth, there is no geometry.
        """
        bounds, on_earth, center = self.bounds, self.bounds.on_earth, None
        if self.center_lla is not None:
            lat, lon, height = self.center_lla
            center = {"longitude": lon, "latitude": lat, "ellipsoidal_height_m": height}
        properties = {
            "workspace": str(self.workspace),
            "outdated": [{"stage": row.stage, "state": row.state, "reason": row.reason} for row in self.outdated],
            "interrupted": self.interrupted,
            "gaussians": self.gaussians,
            "center": center,
            "ellipsoidal_height_m": None if on_earth is None else on_earth.height_m,
            "crs": {
                "name": bounds.crs,
                "units": bounds.units,
                "heights": bounds.heights,
                "low": bounds.low,
                "high": bounds.high,
                "assumed": bounds.assumed,
            },
            "quality": {"accuracy": self.accuracy and self.accuracy.model_dump(), "psnr": self.psnr},
            "area_ha": self.area_ha,
            "files": [{**asdict(file), "made": file.made and file.made.isoformat()} for file in self.files],
            "further": {spec.command(self.workspace): spec.title for spec in self.further},
            "cautions": document_of_cautions(self.cautions),
        }
        if on_earth is None:
            return feature(None, properties)
        west, south, north = on_earth.west, on_earth.south, on_earth.north
        east = on_earth.east if on_earth.east >= west else on_earth.east + 360.0
        rectangle = polygon([(west, south), (east, south), (east, north), (west, north)])
        return feature(rectangle, properties, (west, south, on_earth.east, north))


def overview(workspace: Workspace, options: CrsOptions) -> Overview:
    """Return the overview of a trained workspace, its bounds in the CRS of the options; errors as of a `run`."""
    model = read_trained(workspace)
    survey = load_survey(workspace)
    means = read_centres(workspace.path(GAUSSIANS)).astype(np.float64)
    placement = solved_placement(model, survey, means, headline_of(workspace))
    report, rows = None, status(workspace)
    with contextlib.suppress(GeorefError):  # not evaluated, or damaged: `georef status` tells
        report = read_report(workspace.path(REPORT))
    test = None if report is None else report.test_views
    states, made = {BY_NAME[row.stage].folder: row for row in rows}, []
    for name, description in DESCRIPTIONS.items():
        path, row = workspace.root / name, states.get(name.partition("/")[0])
        if row is not None and path.exists():
            inside = path.rglob("*") if path.is_dir() else (path,)
            size = sum(file.stat().st_size for file in inside if file.is_file())
            made.append(MadeFile(name, description, size, row.finished, row.state))
    return Overview(
        workspace=workspace.root,
        gaussians=len(means),
        center_lla=None if placement.origin_lla is None else vector3(placement.origin_lla),
        bounds=_bounds(placement.geo_from_model.apply(means[:: max(1, len(means) // _MOST)]), survey, options),
        accuracy=placement.accuracy,
        psnr=None if test is None else test.psnr,
        area_ha=None if report is None else report.area_ha,
        files=tuple(made),
        outdated=tuple(row for row in rows if row.state in ("stale", "damaged")),
        interrupted={row.stage: row.interrupted for row in rows if row.interrupted},
        further=tuple(spec for spec in DELIVERABLES if not (workspace.root / spec.product).exists()),
        cautions=cautions_by_stage(workspace),
    )


def _bounds(points_in_geo: FloatArray, survey: Survey, options: CrsOptions) -> Bounds:
    on_earth = None
    if survey.origin is not None:
        lla = lla_from_enu(points_in_geo, survey.origin)
        lla[:, 1] -= 360.0 * np.round((lla[:, 1] - lla[0, 1]) / 360.0)
        (south, west, low_m), (north, east, high_m) = (row.tolist() for row in np.quantile(lla, _WITHIN, axis=0))
        on_earth = GeographicBounds(
            west=west - 360.0 * round(west / 360.0),
            south=south,
            east=east - 360.0 * round(east / 360.0),
            north=north,
            height_m=(low_m, high_m),
            datum_assumed=survey.vertical.is_assumed,
        )
    crs = usable_crs(options, survey.origin, np.quantile(points_in_geo, _WITHIN, axis=0), survey.vertical)
    low, high = np.quantile(crs.xyz_from_geo(points_in_geo), _WITHIN, axis=0)
    return Bounds(
        on_earth=on_earth,
        crs=crs.crs.name,
        units=crs.crs.units,
        heights=crs.crs.vertical.name,
        low=vector3(low),
        high=vector3(high),
        assumed=crs.assumed,
    )

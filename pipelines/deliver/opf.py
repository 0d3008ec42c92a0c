"""Export of the survey as a project of the Open Photogrammetry Format, which PIX4Dmatic opens.

Reads survey, SfM model, and the adjustment: of the training, or before it of init-sim3. Writes the folder `opf/`
with `project.opf`: adjusted cameras and lenses, tie points with their observations, measured positions, control and
check points with their marks (docs/deliverables.md).

OPF takes the coordinates of a map for Cartesian ones. Without --crs, the map is a transverse Mercator projection
around the scene, true to scale at its height: the bundle keeps its shape, and every coordinate its place on Earth.
"""

from dataclasses import replace
from pathlib import Path

import numpy as np

from pipelines.adjust.posterior import Posterior
from pipelines.adjust.solution import posterior_of
from pipelines.core.errors import InputError
from pipelines.core.products import Remark, is_checked, union
from pipelines.core.stages import OPF
from pipelines.core.types import BoolArray, FloatArray
from pipelines.core.workspace import StageRun, Summary
from pipelines.deliver.options import ExportOpfOptions
from pipelines.formats.georef_sidecar import write_sidecar
from pipelines.formats.opf_writer import OpfFrame, OpfPhotograph, OpfPoint, OpfScene, write_opf
from pipelines.geodesy.crs import grid_from_enu, grid_scale
from pipelines.geodesy.enu import SEMI_MAJOR_M, geo_from_enu_at, lla_from_enu
from pipelines.geodesy.vertical import ELLIPSOIDAL, VerticalChoice
from pipelines.geometry.intersection import refined_points
from pipelines.geometry.sparse_model import SparseModel
from pipelines.survey.headline import headline_of
from pipelines.survey.options import CrsOptions
from pipelines.survey.scene import network_of
from pipelines.survey.survey import Survey, SurveyedPoint
from pipelines.survey.target_crs import TargetCrs, target_crs
from pipelines.survey.trained_survey import SolvedSurvey, load_solved

_LENS_TOLERANCE_PX = 0.01
_SCALE_TOLERANCE = 2e-5  # of a map's scale: 2 cm in 1 km, and 0.04 px across 2000 px


def run(stage: StageRun, options: ExportOpfOptions) -> Summary:
    """Write the project; an InputError: a CRS that is no map, or does not reach the scene."""
    solved = load_solved(stage.workspace)
    survey = solved.survey
    center_in_geo = solved.geo_from_model.apply(solved.poses.cam_center_in_model)
    points_in_geo = center_in_geo
    if len(solved.point_in_model):
        points_in_geo = solved.geo_from_model.apply(solved.point_in_model)
    target = _target(options, survey, center_in_geo, points_in_geo)
    posterior = None
    if is_checked(solved.model.cautions):
        posterior = posterior_of(stage.workspace, solved.model, solved.sfm)
    on_map = _Map(target)
    frame = _frame(on_map, center_in_geo)
    scene = OpfScene(
        name=stage.workspace.root.resolve().name,
        frame=frame,
        model=_model_on_map(solved, on_map, frame),
        photographs=_photographs(solved, on_map),
        points=_points(survey, solved.sparse, on_map),
        rolling=_rolling(solved.sfm),
        covariances=None if posterior is None else _covariances(posterior, on_map.turns(center_in_geo)),
    )
    lens_error_px = write_opf(stage.out, scene)
    accuracy = headline_of(stage.workspace)
    limits = _limits(target, points_in_geo, lens_error_px)
    cautions = union(solved.model.cautions, limits)
    xyz = target.xyz_from_geo(center_in_geo)
    sidecar = target.sidecar([xyz.min(axis=0), xyz.max(axis=0)], accuracy, None, cautions)
    write_sidecar(sidecar, stage.out / Path(OPF).name)
    model = scene.model
    values = {
        "cameras": len(model.image_name),
        "points": len(model.point_id),
        "observations": len(model.obs_point),
        "control_points": sum(not point.is_check for point in scene.points),
        "check_points": sum(point.is_check for point in scene.points),
        "marks": sum(len(point.marks) for point in scene.points),
        "lens_error_px": lens_error_px,
        "crs": target.crs.name,
        "heights": target.crs.vertical.name,
        "assumed": "; ".join(target.assumed) or None,
    }
    figure = f"{len(model.image_name)} cameras, {len(model.point_id)} tie points"
    return Summary(figure, values, cautions=cautions)


def _target(options: CrsOptions, survey: Survey, center_in_geo: FloatArray, points_in_geo: FloatArray) -> TargetCrs:
    """Return the map of the project: the user's, or one around the scene with heights above the ellipsoid."""
    if survey.origin is None or options.crs is not None:
        target = target_crs(options, survey.origin, center_in_geo, survey.vertical)
        if target.origin is not None and (target.crs.is_geographic or target.crs.is_geocentric):
            message = f"OPF needs the CRS of a map, and {target.crs.name} is none. Give a projected one."
            raise InputError("crs-not-projected", message, field="--crs")
        return target
    lat, lon, height = lla_from_enu(np.median(points_in_geo, axis=0), survey.origin).tolist()
    around = (
        f"+proj=tmerc +lat_0={lat:.5f} +lon_0={lon:.5f} +k_0={1 + height / SEMI_MAJOR_M:.9f} +x_0=0 +y_0=0 "
        "+datum=WGS84 +units=m +no_defs"
    )
    vertical = options.vertical or VerticalChoice(ELLIPSOIDAL, None)
    own = options.model_copy(update={"crs": around, "vertical": vertical})
    return target_crs(own, survey.origin, center_in_geo, survey.vertical)


class _Map:
    """The map of the project: coordinates in it, and its directions at places in `geo`.

    Attributes:
        definition: WKT2 with three axes.
        units: metres (3,) in a unit of easting, northing and height.
    """

    def __init__(self, target: TargetCrs) -> None:
        self.target = target
        self.definition, height_unit_m = target.crs.with_heights()
        plan = 1.0 if target.origin is None else target.crs.horizontal_unit
        self.units = np.array([plan, plan, height_unit_m])

    def xyz(self, places_in_geo: FloatArray) -> FloatArray:
        """Return the coordinates (n, 3), easting first, of places (n, 3) in `geo`."""
        xyz = self.target.xyz_from_geo(places_in_geo)
        xyz[:, 2] *= self.target.crs.height_unit_m / self.units[2]
        return xyz

    def turns(self, place_in_geo: FloatArray) -> FloatArray:
        """Return the rotations (n, 3, 3) from the axes of `geo` to those of the map at places (n, 3)."""
        origin = self.target.origin
        if origin is None:
            return np.tile(np.eye(3), (len(place_in_geo), 1, 1))
        lla = lla_from_enu(place_in_geo, origin).reshape(-1, 3)
        return np.asarray(grid_from_enu(self.target.crs, lla) @ np.swapaxes(geo_from_enu_at(lla, origin), 1, 2))

    def measured(self, place_in_geo: FloatArray, cov_in_geo: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return coordinates (3,) and σ (3,) in units of the CRS, easting first, of a measured place."""
        turn = self.turns(place_in_geo[None])[0]
        sigma_m = np.sqrt(np.diag(turn @ cov_in_geo @ turn.T))
        return self.xyz(place_in_geo[None])[0], sigma_m / self.units


def _frame(on_map: _Map, center_in_geo: FloatArray) -> OpfFrame:
    in_metres, target = on_map.xyz(center_in_geo) * on_map.units, on_map.target
    swapped = target.origin is not None and target.crs.northing_first
    return OpfFrame(on_map.definition, -np.round(np.median(in_metres, axis=0)), on_map.units, swapped)


def _model_on_map(solved: SolvedSurvey, on_map: _Map, frame: OpfFrame) -> SparseModel:
    """Return the adjusted cameras, lenses and tie points in the processing CRS."""
    similarity, sparse = solved.geo_from_model, solved.sparse
    center_in_geo = similarity.apply(solved.poses.cam_center_in_model)
    rotation = solved.poses.cam_from_model @ similarity.rotation.T @ np.swapaxes(on_map.turns(center_in_geo), 1, 2)
    center = frame.processing(on_map.xyz(center_in_geo))
    # As the adjusted cameras see them; a point that they do not see at all is left out.
    points = refined_points(network_of(sparse, solved.poses, solved.point_in_model)).point_in_world
    known: BoolArray = np.asarray(np.isfinite(points).all(axis=1))
    place = np.cumsum(known) - 1
    seen = known[sparse.obs_point]
    return replace(
        sparse,
        rotation_cam_from_local=rotation,
        translation_cam_from_local=-np.einsum("nij,nj->ni", rotation, center),
        point_id=sparse.point_id[known],
        point_in_local=frame.processing(on_map.xyz(similarity.apply(points[known]))),
        point_rgb=sparse.point_rgb[known],
        point_error_px=sparse.point_error_px[known],
        obs_point=place[sparse.obs_point[seen]],
        obs_image=sparse.obs_image[seen],
        obs_xy_px=sparse.obs_xy_px[seen],
    )


def _photographs(solved: SolvedSurvey, on_map: _Map) -> list[OpfPhotograph]:
    images = {image.name: image for image in solved.survey.images}
    found = []
    for name in solved.sparse.image_name:
        image = images[name]
        xyz = sigma = None
        if image.fix is not None:
            place, cov = np.array(image.fix.position_in_geo), np.array(image.fix.cov_in_geo)
            xyz, sigma = on_map.measured(place, cov)
        found.append(OpfPhotograph(name, image.timestamp_s, xyz, sigma))
    return found


def _points(survey: Survey, sparse: SparseModel, on_map: _Map) -> list[OpfPoint]:
    """Return the control and check points, with the marks in photographs that have a camera."""
    registered = frozenset(sparse.image_name)

    def listed(point: SurveyedPoint, *, is_check: bool) -> OpfPoint:
        xyz, sigma = on_map.measured(np.array(point.position_in_geo), np.array(point.cov_in_geo))
        marks = tuple(
            (mark.image, mark.x_px, mark.y_px, mark.sigma_px) for mark in point.marks if mark.image in registered
        )
        return OpfPoint(point.name, is_check, xyz, sigma, marks)

    control = [listed(point, is_check=False) for point in survey.control_points]
    return control + [listed(point, is_check=True) for point in survey.check_points]


def _rolling(sfm: SparseModel) -> frozenset[int]:
    if sfm.travel_in_cam is None:
        return frozenset()
    return frozenset(sfm.image_camera_id[sfm.travel_in_cam.any(axis=1)].tolist())


def _covariances(posterior: Posterior, turns: FloatArray) -> FloatArray:
    both = np.zeros((len(turns), 6, 6))
    both[:, :3, :3] = both[:, 3:, 3:] = turns
    return np.asarray(both @ posterior.camera_cov @ np.swapaxes(both, 1, 2))


def _limits(target: TargetCrs, points_in_geo: FloatArray, lens_error_px: float) -> tuple[Remark, ...]:
    """Return what a project cannot hold of this survey."""
    limits = {}
    if lens_error_px > _LENS_TOLERANCE_PX:
        limits["opf-lens-replaced"] = (
            f"OPF's lens has one focal length and a polynomial up to r⁶: it is {lens_error_px:.2f} px off at most."
        )
    if target.origin is not None:
        middle = lla_from_enu(np.median(points_in_geo, axis=0)[None], target.origin).reshape(-1, 3)
        off = abs(float(grid_scale(target.crs, middle)[0]) - 1)
        if off > _SCALE_TOLERANCE:
            limits["opf-map-scale"] = (
                f"Lengths on the map {target.crs.name} are {1e6 * off:.0f} ppm off those on the ground, and "
                "heights are not: programs that take the map for Cartesian see a bundle of another shape. Without "
                "--crs the map is true to scale."
            )
    return tuple(Remark(code=code, sentence=sentence) for code, sentence in limits.items())

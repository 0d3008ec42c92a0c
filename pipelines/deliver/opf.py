"""Export of the survey as a project of the Open Photogrammetry Format, which PIX4Dmatic opens.

Reads survey, SfM model, and the adjustment: of the training, or before it of init-sim3. Writes the folder `opf/`
with `project.opf`: adjusted cameras and lenses, tie points with their observations, measured positions, control and
check points with their marks; of a trained model the surface as a point cloud, and the Gaussians
(docs/deliverables.md).

OPF takes the coordinates of a map for Cartesian ones. Without --crs, the map is a transverse Mercator projection
around the scene, true to scale at its height: the bundle keeps its shape, and every coordinate its place on Earth.
"""

from collections.abc import Sequence
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from pipelines.adjust.posterior import Posterior
from pipelines.adjust.solution import posterior_of
from pipelines.core.errors import DegenerateGeometryError, InputError
from pipelines.core.json_values import Json
from pipelines.core.products import Remark, is_checked, union
from pipelines.core.stages import MODEL, OPF
from pipelines.core.types import BoolArray, FloatArray, rows_of
from pipelines.core.workspace import StageRun, Summary
from pipelines.deliver.options import ExportOpfOptions
from pipelines.deliver.splat import load_splat
from pipelines.deliver.surface import shared_squares, surface_views
from pipelines.formats.georef_sidecar import write_sidecar
from pipelines.formats.opf_gltf import SurfaceWriter
from pipelines.formats.opf_writer import (
    POINT_CLOUD,
    SPLATS,
    SPLATS_FORMAT,
    OpfFrame,
    OpfPhotograph,
    OpfPoint,
    OpfScene,
    write_opf,
)
from pipelines.geodesy.crs import grid_from_enu, grid_scale
from pipelines.geodesy.enu import SEMI_MAJOR_M, geo_from_enu_at, lla_from_enu
from pipelines.geodesy.vertical import ELLIPSOIDAL, VerticalChoice
from pipelines.geometry.intersection import refined_points
from pipelines.geometry.similarity import Similarity
from pipelines.geometry.sparse_model import SparseModel
from pipelines.splat.gaussians import transformed, write_gaussians
from pipelines.surface.fusion import fusion_settings
from pipelines.surface.measured_area import area_of
from pipelines.surface.surface_views import model_renderer
from pipelines.survey.headline import headline_of
from pipelines.survey.navigation import load_survey
from pipelines.survey.options import CrsOptions
from pipelines.survey.scene import network_of
from pipelines.survey.solution import Solution, read_sfm, read_solution, read_trained
from pipelines.survey.survey import Survey, SurveyedPoint
from pipelines.survey.target_crs import TargetCrs, target_crs

_LENS_TOLERANCE_PX = 0.01
_MIN_VIEWS = 3  # that agree on a point of the cloud
_SPLAT = "splat.ply"
_FAR_M = 20_000.0  # from the middle of the scene
_SCALE_TOLERANCE = 2e-5  # of a map's scale: 2 cm in 1 km, and 0.04 px across 2000 px


def run(stage: StageRun, options: ExportOpfOptions) -> Summary:
    """Write the project; an InputError: a CRS that is no map, or does not reach the scene."""
    solution = read_solution(stage.workspace)
    sfm, survey = read_sfm(stage.workspace, solution), solution.weighted(load_survey(stage.workspace))
    center_in_geo = solution.center_in_geo
    points_in_geo = center_in_geo
    if len(sfm.point_in_local):
        points_in_geo = solution.similarity.apply(solution.point_in_model(sfm))
    target = _target(options, survey, center_in_geo, points_in_geo)
    posterior = None
    if is_checked(solution.cautions):
        posterior = posterior_of(stage.workspace, solution, sfm)
    on_map = _Map(target)
    frame = _frame(on_map, center_in_geo)
    made, surface, warnings = _made(stage, options, on_map, frame)
    scene = OpfScene(
        name=stage.workspace.root.resolve().name,
        frame=frame,
        model=_model_on_map(solution, sfm, on_map, frame),
        photographs=_photographs(survey, sfm.image_name, on_map),
        points=_points(survey, sfm, on_map),
        rolling=_rolling(sfm),
        covariances=None if posterior is None else _covariances(posterior, on_map.turns(center_in_geo)),
        made=made,
    )
    lens_error_px = write_opf(stage.out, scene)
    accuracy = headline_of(stage.workspace)
    limits = _limits(target, points_in_geo, lens_error_px)
    cautions = union(solution.cautions, limits)
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
        **surface,
        "lens_error_px": lens_error_px,
        "crs": target.crs.name,
        "heights": target.crs.vertical.name,
        "assumed": "; ".join(target.assumed) or None,
    }
    figure = f"{len(model.image_name)} cameras, {len(model.point_id)} tie points"
    figure += "".join(f", {count} {name.replace('_', ' ')}" for name, count in surface.items() if count)
    return Summary(figure, values, warnings, cautions)


def _target(options: CrsOptions, survey: Survey, center_in_geo: FloatArray, points_in_geo: FloatArray) -> TargetCrs:
    """Return the map of the project: the user's, or one around the scene with heights above the ellipsoid."""
    if survey.origin is None or options.crs is not None:
        target = target_crs(options, survey.origin, center_in_geo, survey.vertical)
        if target.origin is not None and (target.crs.is_geographic or target.crs.is_geocentric):
            message = f"OPF needs the CRS of a map, and {target.crs.name} is none."
            remedy = "Give a projected one."
            raise InputError("crs-not-projected", message, field="--crs", remedy=remedy)
        return target
    lat, lon, height = lla_from_enu(np.median(points_in_geo, axis=0), survey.origin).tolist()
    around = (
        f"+proj=tmerc +lat_0={lat:.5f} +lon_0={lon:.5f} +k_0={1 + height / SEMI_MAJOR_M:.9f} +x_0=0 +y_0=0 "
        "+datum=WGS84 +units=m +no_defs"
    )
    vertical = options.vertical or VerticalChoice(ELLIPSOIDAL, None)
    around_scene = options.model_copy(update={"crs": around, "vertical": vertical})
    return target_crs(around_scene, survey.origin, center_in_geo, survey.vertical)


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


def _model_on_map(solution: Solution, sfm: SparseModel, on_map: _Map, frame: OpfFrame) -> SparseModel:
    """Return the adjusted cameras, lenses and tie points in the processing CRS."""
    similarity, poses, sparse = solution.similarity, solution.poses, solution.with_lenses(sfm)
    center_in_geo = similarity.apply(poses.cam_center_in_model)
    rotation = poses.cam_from_model @ similarity.rotation.T @ np.swapaxes(on_map.turns(center_in_geo), 1, 2)
    center = frame.processing(on_map.xyz(center_in_geo))
    # As the adjusted cameras see them; a point that they do not see at all is left out.
    points = refined_points(network_of(sparse, poses, solution.point_in_model(sfm))).point_in_world
    known: BoolArray = np.asarray(np.isfinite(points).all(axis=1))
    row_of = np.cumsum(known) - 1
    seen = known[sparse.obs_point]
    return replace(
        sparse,
        rotation_cam_from_local=rotation,
        translation_cam_from_local=-np.einsum("nij,nj->ni", rotation, center),
        point_id=sparse.point_id[known],
        point_in_local=frame.processing(on_map.xyz(similarity.apply(points[known]))),
        point_rgb=sparse.point_rgb[known],
        point_error_px=sparse.point_error_px[known],
        obs_point=row_of[sparse.obs_point[seen]],
        obs_image=sparse.obs_image[seen],
        obs_xy_px=sparse.obs_xy_px[seen],
    )


def _made(
    stage: StageRun, options: ExportOpfOptions, on_map: _Map, frame: OpfFrame
) -> tuple[dict[str, list[Json]], dict[str, int], tuple[Remark, ...]]:
    """Write what was made of the calibration: resources by type of item, counts, and what is missing, and why."""
    made: dict[str, list[Json]] = {}
    counts = {"gaussians": 0, "cloud_points": 0}
    warnings: tuple[Remark, ...] = ()
    if not stage.workspace.has(MODEL):
        return made, counts, warnings
    counts["gaussians"] = _write_splat(stage, options, on_map, frame)
    made[SPLATS] = [{"uri": _SPLAT, "format": SPLATS_FORMAT}]
    if options.cloud:
        writer, remedy = SurfaceWriter(stage.out, POINT_CLOUD), ""
        try:
            with writer:
                _write_cloud(writer, stage, options, on_map, frame)
            reason = "" if writer.count else f"no point has the same depth in {_MIN_VIEWS} training views"
        except (DegenerateGeometryError, InputError) as error:
            if options.boundary is not None:
                raise
            reason, remedy = error.fault, error.remedy
        if reason:
            sentence = f"The project has no point cloud: {reason}"
            warnings = (Remark(code="opf-no-cloud", sentence=sentence, remedy=remedy),)
        else:
            made[POINT_CLOUD], counts["cloud_points"] = writer.resources, writer.count
    return made, counts, warnings


def _write_splat(stage: StageRun, options: ExportOpfOptions, on_map: _Map, frame: OpfFrame) -> int:
    """Write the Gaussians in the processing CRS as a PLY, and return their number.

    Each centre is where the map has it. All shapes, and centres far beyond the scene, where a map may end, follow
    the similarity of the map in the middle of the scene.
    """
    splat = load_splat(stage.workspace, options)
    geo_from_file, target = splat.placement.file_from_geo.inverse(), on_map.target
    middle_in_geo = geo_from_file.translation[None]
    scale = 1.0
    if target.origin is not None:
        middle = lla_from_enu(middle_in_geo, target.origin).reshape(-1, 3)
        scale = float(grid_scale(target.crs, middle)[0])
    rotation = on_map.turns(middle_in_geo)[0] @ geo_from_file.rotation
    similarity = Similarity(scale, rotation, frame.processing(on_map.xyz(middle_in_geo))[0])
    in_file = splat.gaussians.means.numpy()
    centers, near = similarity.apply(in_file), np.linalg.norm(in_file, axis=1) < _FAR_M
    centers[near] = frame.processing(on_map.xyz(geo_from_file.apply(in_file[near])))
    means = torch.from_numpy(centers.astype(np.float32))
    gaussians = replace(transformed(splat.gaussians, similarity), means=means)
    write_gaussians(stage.out / _SPLAT, gaussians, mip_filter=splat.mip_filter)
    return len(gaussians)


def _write_cloud(
    writer: SurfaceWriter, stage: StageRun, options: ExportOpfOptions, on_map: _Map, frame: OpfFrame
) -> None:
    """Write the surface of the trained model as `georef export-cloud` finds it, in the processing CRS."""
    model = read_trained(stage.workspace)
    sfm, survey = read_sfm(stage.workspace, model), model.weighted(load_survey(stage.workspace))
    renderer, geo_from_model = (
        model_renderer(stage.workspace, model, sfm, survey, progress=stage.progress),
        model.similarity,
    )
    with closing(surface_views(stage, renderer)) as views:
        settings = fusion_settings(views, geo_from_model, _MIN_VIEWS)
        area = area_of(options, stage.workspace, model, sfm, survey, progress=stage.progress)
        for square in shared_squares(views, geo_from_model, settings, stage.progress):
            part = rows_of(square, area.contains(square.position))
            if len(part.position):
                turn = on_map.turns(part.position.mean(axis=0)[None])[0]
                writer.write(frame.processing(on_map.xyz(part.position)), part.normal @ turn.T, part.rgb)


def _photographs(survey: Survey, names: Sequence[str], on_map: _Map) -> list[OpfPhotograph]:
    images = {image.name: image for image in survey.images}
    photographs = []
    for name in names:
        image = images[name]
        xyz = sigma = None
        if image.fix is not None:
            position, cov = np.array(image.fix.position_in_geo), np.array(image.fix.cov_in_geo)
            xyz, sigma = on_map.measured(position, cov)
        photographs.append(OpfPhotograph(name, image.timestamp_s, xyz, sigma))
    return photographs


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
    limits = []
    if lens_error_px > _LENS_TOLERANCE_PX:
        sentence = (
            f"OPF's lens has one focal length and a polynomial up to r⁶: it is {lens_error_px:.2f} px off at most."
        )
        limits.append(Remark(code="opf-lens-replaced", sentence=sentence))
    if target.origin is not None:
        middle = lla_from_enu(np.median(points_in_geo, axis=0)[None], target.origin).reshape(-1, 3)
        off = abs(float(grid_scale(target.crs, middle)[0]) - 1)
        if off > _SCALE_TOLERANCE:
            sentence = (
                f"Lengths on the map {target.crs.name} are {1e6 * off:.0f} ppm off those on the ground, and "
                "heights are not: programs that take the map for Cartesian see a bundle of another shape."
            )
            remedy = "Without --crs the map is true to scale."
            limits.append(Remark(code="opf-map-scale", sentence=sentence, remedy=remedy))
    return tuple(limits)

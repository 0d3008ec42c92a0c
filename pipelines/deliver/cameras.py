"""Export of the adjusted cameras and lenses, placed on Earth, in the forms that other programs read.

Reads survey, SfM model, initial similarity, and the adjustment: of the training, or before it of init-sim3. Writes
into `cameras/` (docs/deliverables.md):

- `colmap/`: cameras, images and points as a COLMAP model, in the frame of `splat.ply`;
- `transforms.json`, `sparse_pc.ply`: the same cameras and points for nerfstudio, in the same frame;
- `undistorted/`, if asked: photographs without distortion, and their model with pinhole cameras, in the same frame;
- `cameras.csv`: positions in the CRS of the contract, angles in both conventions, σ;
- `footprints.geojson`: the ground that each photograph shows;
- `covariances.npz` and `camera_covariances.csv`: full covariances of cameras and tie points, in the same frame, for
  who weights them in a solution of his own.
"""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from pipelines.adjust.posterior import Posterior
from pipelines.adjust.solution import posterior_of
from pipelines.core.files import replace_text
from pipelines.core.json_values import Json
from pipelines.core.products import Remark, is_checked, save_npz, union
from pipelines.core.stages import GAUSSIANS
from pipelines.core.types import FloatArray
from pipelines.core.workspace import StageRun, Summary
from pipelines.deliver.options import ExportCamerasOptions
from pipelines.deliver.placement import Placement, median_values, require_space, scene_sigma, solved_placement
from pipelines.formats.camera_files import CameraTable, Frame, lens_of, write_camera_table, write_transforms
from pipelines.formats.cloud_ply import write_point_ply
from pipelines.formats.colmap import write_sparse
from pipelines.formats.georef_sidecar import CrsSidecar, median_sigma, write_sidecar
from pipelines.formats.tables import table_text
from pipelines.formats.vector_files import feature, features_text, polygon
from pipelines.geodesy.crs import grid_from_enu, parse_crs
from pipelines.geodesy.enu import geo_from_enu_at, lla_from_ecef, lla_from_enu
from pipelines.geometry.cameras import Camera, CameraPoses, Pinhole, undistort
from pipelines.geometry.footprints import PointSurface, border_rays, footprint
from pipelines.geometry.intersection import refined_points
from pipelines.geometry.rotations import omega_phi_kappa_deg, omega_phi_kappa_jacobian, yaw_pitch_roll_deg
from pipelines.geometry.similarity import Similarity
from pipelines.geometry.sparse_model import SparseModel
from pipelines.splat.gaussians import read_gaussians
from pipelines.survey.area import LEAST_RAYS, without_outliers
from pipelines.survey.headline import headline_of
from pipelines.survey.navigation import load_survey
from pipelines.survey.photographs import undistorted_name, write_undistorted
from pipelines.survey.scene import network_of, photograph_files
from pipelines.survey.solution import Solution, TrainedModel, read_sfm, read_solution
from pipelines.survey.survey import Survey
from pipelines.survey.target_crs import TargetCrs, target_crs

# Components of a camera: rotation about its centre by the axes, rad, then position of the centre, m.
_COMPONENTS = ("rotation_e", "rotation_n", "rotation_u", "e", "n", "u")
_MOST_POINTS = 100_000  # with a covariance
_JPEG_BYTES_A_PIXEL = 1  # of a detailed photograph at quality 95
_LENS_TOLERANCE_PX = 0.01  # of a lens that nerfstudio's model replaces: below, nobody need know
_UNKNOWN = (
    Remark(code="cameras-without-sigma", sentence="The cameras have no σ: nothing checks the σ of the positions."),
)


def run(stage: StageRun, options: ExportCamerasOptions) -> Summary:
    """Write the cameras in all forms, and return their key figures."""
    solution = read_solution(stage.workspace)
    sfm, survey = read_sfm(stage.workspace, solution), solution.weighted(load_survey(stage.workspace))
    accuracy, points = headline_of(stage.workspace), solution.point_in_model(sfm)
    if isinstance(solution, TrainedModel):
        points = read_gaussians(stage.workspace.path(GAUSSIANS)).means.numpy()
    placement = solved_placement(solution, survey, points, accuracy)
    crs = target_crs(options, survey.origin, solution.center_in_geo, survey.vertical)
    _camera_table(solution, None, crs)  # a CRS that cannot hold the cameras is refused before the work begins
    sparse = solution.with_lenses(sfm)
    files = photograph_files(sparse, survey, stage.workspace) if options.undistorted else []
    pixels = sum(photograph.camera.width * photograph.camera.height for photograph in files)
    what = f"{len(files)} undistorted photographs"
    require_space(stage.out, _JPEG_BYTES_A_PIXEL * pixels, what, "leave out --undistorted")
    with stage.progress.task("cameras", 5) as task:
        posterior = posterior_of(stage.workspace, solution, sfm) if is_checked(solution.cautions) else None
        table = _camera_table(solution, posterior, crs)
        task.advance(note="σ")
        model = _model_in_file(solution, sfm, placement)
        _write_covariances(stage.out, model, posterior, placement)
        task.advance(note="covariances")
        write_sparse(model, stage.out / "colmap")
        write_sidecar(placement.sidecar(), stage.out / "colmap")
        task.advance(note="COLMAP")
        splits = {camera.name: camera.split for camera in solution.cameras}
        lens_limits = _write_nerfstudio(stage.out / "transforms.json", model, splits, placement)
        task.advance(note="nerfstudio")
        features: list[Json] = []  # GeoJSON cannot state a local frame
        if placement.ecef_from_file is not None:
            features, corner_lla = _footprints(survey, model, table, placement.ecef_from_file)
        replace_text(stage.out / "footprints.geojson", features_text(features))
        task.advance(note="footprints")
    if options.undistorted:
        pinholes = write_undistorted(stage.out / "undistorted/images", files, stage.progress)
        write_sparse(undistorted_model(model, pinholes), stage.out / "undistorted/sparse/0")
        write_sidecar(placement.sidecar(), stage.out / "undistorted")
    cautions, sigma = union(solution.cautions, _UNKNOWN if posterior is None else ()), None
    if np.isfinite(table.sigma_enu_m).all():
        east, north, up = table.sigma_enu_m.T
        sigma = scene_sigma("positions of the cameras: similarity, cameras and lens", np.hypot(east, north), up)
    if placement.ecef_from_file is not None:
        on_ellipsoid = TargetCrs(parse_crs("EPSG:4979"), crs.origin, corner_lla)
        corner = corner_lla[:, [1, 0, 2]]
        of_footprints = on_ellipsoid.sidecar([corner.min(axis=0), corner.max(axis=0)], accuracy, sigma, cautions)
        write_sidecar(of_footprints, stage.out / "footprints.geojson")
    write_camera_table(stage.out / "cameras.csv", table)
    position = table.position
    sidecar = crs.sidecar([position.min(axis=0), position.max(axis=0)], accuracy, sigma, cautions)
    write_sidecar(sidecar, stage.out / "cameras.csv")
    return _summary(table, model, sidecar, union(cautions, lens_limits))


def _camera_table(solution: Solution, posterior: Posterior | None, crs: TargetCrs) -> CameraTable:
    """Return the table of the adjusted cameras in a CRS; σ are NaN without a posterior.

    ω, φ, κ count from the axes of the CRS at each camera: grid east, grid north, up along the ellipsoid's normal.
    In a CRS without a grid they count from true east and north, as do yaw, pitch, roll and the σ of the position.
    In a local frame, all of them count from its axes.

    Raises:
        InputError: a camera lies outside the domain of the CRS, or its axes are left-handed.
    """
    cameras, poses, similarity = solution.cameras, solution.poses, solution.similarity
    geo_from_cam = similarity.rotation @ np.swapaxes(poses.cam_from_model, 1, 2)
    center_in_geo = similarity.apply(poses.cam_center_in_model)
    # Of (δθ [rad], δc [m]) along the axes of `geo`.
    covariance = np.full((len(cameras), 6, 6), np.nan) if posterior is None else posterior.camera_cov
    enu_from_geo = map_from_geo = np.tile(np.eye(3), (len(cameras), 1, 1))  # of a local frame
    if crs.origin is not None:
        lla = lla_from_enu(center_in_geo, crs.origin)
        enu_from_geo = np.swapaxes(geo_from_enu_at(lla, crs.origin), 1, 2)
        map_from_geo = grid_from_enu(crs.crs, lla) @ enu_from_geo
    angles = omega_phi_kappa_deg(map_from_geo @ geo_from_cam)
    by_turn = omega_phi_kappa_jacobian(angles) @ map_from_geo
    return CameraTable(
        name=tuple(camera.name for camera in cameras),
        split=tuple(camera.split for camera in cameras),
        position=crs.xyz_from_geo(center_in_geo),
        geographic=crs.crs.is_geographic,
        omega_phi_kappa_deg=angles,
        yaw_pitch_roll_deg=yaw_pitch_roll_deg(enu_from_geo @ geo_from_cam),
        sigma_enu_m=_sigma(enu_from_geo, covariance[:, 3:, 3:]),
        sigma_angles_deg=np.degrees(_sigma(by_turn, covariance[:, :3, :3])),
    )


def _sigma(jacobian: FloatArray, covariance: FloatArray) -> FloatArray:
    """Return σ (n, 3) of quantities with derivatives (n, 3, 3) by others that have covariances (n, 3, 3)."""
    propagated = jacobian @ covariance @ np.swapaxes(jacobian, 1, 2)
    return np.asarray(np.sqrt(np.diagonal(propagated, axis1=1, axis2=2)))


def _model_in_file(solution: Solution, sfm: SparseModel, placement: Placement) -> SparseModel:
    """Return the adjusted cameras and lenses in the frame of the placement, with the points as these see them."""
    file_from_model, poses, sparse = placement.file_from_model, solution.poses, solution.with_lenses(sfm)
    rotation = poses.cam_from_model @ file_from_model.rotation.T
    center = file_from_model.apply(poses.cam_center_in_model)
    points = file_from_model.apply(solution.point_in_model(sfm))
    refined = refined_points(network_of(sparse, CameraPoses(rotation, center), points))
    return replace(
        sparse,
        rotation_cam_from_local=rotation,
        translation_cam_from_local=-np.einsum("nij,nj->ni", rotation, center),
        point_in_local=refined.point_in_world,
        point_error_px=refined.error_px,
    )


def _write_covariances(folder: Path, model: SparseModel, posterior: Posterior | None, placement: Placement) -> None:
    """Write the covariances of cameras and tie points as NPZ, those of the cameras as a table of upper triangles.

    Both are NaN, or empty, where no covariance is known. Tie points are at most 100 000, evenly among all; their
    covariances include the errors of their own image observations. Those of the cameras are of (δθ [rad], δc [m]):
    R_file_from_cam' = Exp(δθ) R_file_from_cam.
    """
    file_from_geo = placement.file_from_geo
    rays = np.bincount(model.obs_point, minlength=len(model.point_id))
    known = np.flatnonzero((rays >= 2) & np.isfinite(model.point_in_local).all(axis=1))
    chosen = known[:: max(1, -(-len(known) // _MOST_POINTS))]
    position = model.point_in_local[chosen]
    of_cameras, of_points = np.full((len(model.image_name), 6, 6), np.nan), np.full((len(chosen), 3, 3), np.nan)
    if posterior is not None:
        turn, both = file_from_geo.rotation, np.kron(np.eye(2), file_from_geo.rotation)
        row_of = np.full(len(rays), -1)
        row_of[chosen] = np.arange(len(chosen))
        seen = np.flatnonzero(row_of[model.obs_point] >= 0)
        in_geo = file_from_geo.inverse().apply(position)
        of_points = posterior.of_tie_points(in_geo, row_of[model.obs_point[seen]], model.obs_image[seen])
        of_cameras, of_points = both @ posterior.camera_cov @ both.T, turn @ of_points @ turn.T
    arrays: dict[str, ArrayLike] = {
        "camera_name": model.image_name,
        "camera_cov": of_cameras,
        "point_id": model.point_id[chosen],
        "position": position,
        "point_cov_m2": of_points,
    }
    save_npz(folder / "covariances.npz", arrays)
    rows, columns = np.triu_indices(6)
    header = [f"cov_{_COMPONENTS[row]}_{_COMPONENTS[column]}" for row, column in zip(rows, columns, strict=True)]
    cells = (
        (name, *(f"{value:.9e}" if np.isfinite(value) else "" for value in values))
        for name, values in zip(model.image_name, of_cameras[:, rows, columns].tolist(), strict=True)
    )
    replace_text(folder / "camera_covariances.csv", table_text((("name", *header), *cells)))
    for file in ("covariances.npz", "camera_covariances.csv"):
        write_sidecar(placement.sidecar(), folder / file)


def undistorted_model(model: SparseModel, pinholes: Sequence[Pinhole]) -> SparseModel:
    """Return a model of undistorted photographs: a pinhole for each camera, and its pixels.

    Observations beyond the undistorted pictures are left out, and points that have no other.

    Args:
        pinholes: of each image, those of one camera equal.
    """
    owner = model.image_camera_id[model.obs_image]
    xy, inside, cameras = np.empty_like(model.obs_xy_px), np.zeros(len(owner), dtype=bool), {}
    for key, pinhole in dict(zip(model.image_camera_id.tolist(), pinholes, strict=True)).items():
        mine = owner == key
        xy[mine] = undistort(model.cameras[key], model.obs_xy_px[mine]) * (pinhole.fx, pinhole.fy)
        xy[mine] += (pinhole.cx, pinhole.cy)
        inside[mine] = pinhole.contains(xy[mine])
        params = np.array([pinhole.fx, pinhole.fy, pinhole.cx, pinhole.cy])
        cameras[key] = Camera("PINHOLE", pinhole.width, pinhole.height, params)
    points = np.unique(model.obs_point[inside])
    return replace(
        model,
        cameras=cameras,
        image_name=tuple(map(undistorted_name, model.image_name)),
        point_id=model.point_id[points],
        point_in_local=model.point_in_local[points],
        point_rgb=model.point_rgb[points],
        point_error_px=model.point_error_px[points],
        obs_point=np.searchsorted(points, model.obs_point[inside]),
        obs_image=model.obs_image[inside],
        obs_xy_px=xy[inside],
    )


def _write_nerfstudio(
    path: Path, model: SparseModel, splits: Mapping[str, str], placement: Placement
) -> tuple[Remark, ...]:
    """Write the cameras in nerfstudio's form, with points and sidecars, and return what that form cannot hold."""
    lenses = {key: lens_of(camera) for key, camera in model.cameras.items()}
    owner = [lenses[int(key)] for key in model.image_camera_id]
    kind = Counter(lens.model for lens in owner).most_common(1)[0][0]
    centers = model.cam_center_in_local
    chosen = [index for index, lens in enumerate(owner) if lens.model == kind]
    frames = [
        Frame(
            model.image_name[index],
            splits[model.image_name[index]],
            model.camera_of(index),
            model.rotation_cam_from_local[index].T,
            centers[index],
        )
        for index in chosen
    ]
    points = path.with_name("sparse_pc.ply")
    write_point_ply(points, model.point_in_local, model.point_rgb)
    write_sidecar(placement.sidecar(), points)
    write_transforms(path, frames, [owner[index] for index in chosen], points.name)
    limits = {}
    if len(chosen) < len(owner):
        limits["nerfstudio-one-camera-model"] = (
            f"transforms.json leaves out {len(owner) - len(chosen)} of {len(owner)} photographs: it holds one "
            f"camera model, {kind}."
        )
    error = max(owner[index].error_px for index in chosen)
    if error > _LENS_TOLERANCE_PX:
        limits["nerfstudio-lens-replaced"] = (
            f"transforms.json has a polynomial in place of the rational lens FULL_OPENCV: {error:.2f} px off at "
            "most."
        )
    cautions = tuple(Remark(code=code, sentence=sentence) for code, sentence in limits.items())
    sidecar = placement.sidecar()
    write_sidecar(sidecar.model_copy(update={"cautions": union(sidecar.cautions, cautions)}), path)
    return cautions


def _footprints(
    survey: Survey, model: SparseModel, table: CameraTable, ecef_from_file: Similarity
) -> tuple[list[Json], FloatArray]:
    """Return the outline of the ground that each photograph shows, with its properties, and all corners (M, 3).

    The geometry is null for a photograph that shows no ground. `clipped` says that part of the photograph lies
    above the horizon, or so near below it that the outline ends at ten times the height above ground. The corners
    are latitude, longitude, height; those of the cameras' centres if no photograph shows ground.

    Args:
        model: cameras and points in the frame of the placement, z up.
        table: the same cameras, with split and σ.
    """
    # Points that three photographs show, without the highest and lowest; all if none are left.
    rays = np.bincount(model.obs_point, minlength=len(model.point_id))
    good = rays >= LEAST_RAYS
    points = model.point_in_local[good if good.any() else slice(None)]
    kept = without_outliers(points)
    surface = PointSurface(kept if len(kept) else points)
    times = {image.name: image.timestamp_s for image in survey.images}
    borders = {key: border_rays(camera) for key, camera in model.cameras.items()}
    features, corners = [], []
    for index, (name, center) in enumerate(zip(model.image_name, model.cam_center_in_local, strict=True)):
        in_file = borders[int(model.image_camera_id[index])] @ model.rotation_cam_from_local[index]
        shown = footprint(in_file, center, surface)
        lla = lla_from_ecef(ecef_from_file.apply(shown.outline))
        east, north, up = table.sigma_enu_m[index].tolist()
        properties = {
            "name": name,
            "split": table.split[index],
            "time": _iso(times.get(name)),
            "sigma_e_m": east,
            "sigma_n_m": north,
            "sigma_u_m": up,
            "clipped": shown.clipped,
        }
        features.append(feature(polygon(lla[:, [1, 0]]), properties))
        corners.append(lla)
    seen = np.concatenate(corners)
    if not len(seen):
        seen = lla_from_ecef(ecef_from_file.apply(model.cam_center_in_local))
    return features, seen


def _iso(seconds: float | None) -> str | None:
    try:
        return None if seconds is None else datetime.fromtimestamp(seconds, UTC).isoformat(timespec="milliseconds")
    except (OverflowError, ValueError, OSError):  # a clock beyond the calendar
        return None


def _summary(table: CameraTable, model: SparseModel, sidecar: CrsSidecar, cautions: tuple[Remark, ...]) -> Summary:
    count = len(table.name)
    figure = f"{count} cameras, {sidecar.crs}{median_sigma(sidecar.sigma, 'camera positions')}"
    seen = model.point_error_px[np.isfinite(model.point_error_px)]
    values = {
        "cameras": count,
        "test_cameras": table.split.count("test"),
        "points": len(model.point_id),
        "reprojection_error_px": float(seen.mean()) if len(seen) else None,
        "crs": sidecar.crs,
        "heights": sidecar.vertical_datum.name,
        "assumed": "; ".join(sidecar.assumed) or None,
        **median_values(sidecar.sigma, "camera"),
    }
    return Summary(figure, values, cautions=cautions)

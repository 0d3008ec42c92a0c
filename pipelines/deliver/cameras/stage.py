"""Export of the adjusted cameras and lenses, placed on Earth, in the forms that other programs read.

Reads survey, SfM model, initial similarity, and the adjustment: of the training, or
before it of init-sim3. Writes into `cameras/` (docs/deliverables.md):

- `colmap/`: cameras, images and points as a COLMAP model, in the frame of `splat.ply`;
- `transforms.json`: the same cameras for nerfstudio, in the same frame;
- `cameras.csv`: positions in the CRS of the contract, angles in both conventions, σ;
- `footprints.geojson`: the ground that each photograph shows;
- `covariances.npz` and `camera_covariances.csv`: full covariances of cameras and tie points, in the same frame.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np

from pipelines.adjust.solution import posterior_of
from pipelines.core.cautions import Caution, is_checked, union
from pipelines.core.types import FloatArray
from pipelines.core.workspace import StageRun, Summary
from pipelines.deliver.cameras.covariances import covariances_in_file, write_covariances
from pipelines.deliver.cameras.footprints import footprints_of
from pipelines.deliver.cameras.on_earth import camera_table, cameras_on_earth
from pipelines.deliver.options import ExportCamerasOptions
from pipelines.deliver.placement import Placement, place
from pipelines.formats.camera_table import CameraTable, write_camera_table
from pipelines.formats.colmap_writer import write_sparse
from pipelines.formats.geojson import write_features
from pipelines.formats.georef_sidecar import CrsSidecar, SceneSigma, median_sigma, write_sidecar
from pipelines.formats.nerfstudio import Frame, lens_of, write_transforms
from pipelines.geodesy.crs import parse_crs
from pipelines.geometry.bundle import Network
from pipelines.geometry.refined_points import refined_points
from pipelines.geometry.sparse_model import SparseModel
from pipelines.scene.headline import headline_of
from pipelines.scene.target_crs import TargetCrs, target_crs
from pipelines.scene.trained_survey import SolvedSurvey, TrainedSurvey, load_solved

_UNKNOWN = (
    Caution(code="cameras-without-sigma", sentence="The cameras have no σ: nothing checks the σ of the positions."),
)
_LENS_TOLERANCE_PX = 0.01  # of a lens that nerfstudio's model replaces: below, nobody need know


def run(stage: StageRun, options: ExportCamerasOptions) -> Summary:
    """Write the cameras in all forms, and return their key figures.

    Raises:
        MissingProductError: a stage up to init-sim3 has not been run.
        InputError: a product is damaged, or the CRS cannot be used here.
    """
    solved = load_solved(stage.workspace)
    accuracy = headline_of(stage.workspace)
    points = solved.gaussians.means.numpy() if isinstance(solved, TrainedSurvey) else solved.point_in_model
    placement = place(solved.model, solved.survey, points, accuracy)
    on_earth = cameras_on_earth(solved, None)
    crs = target_crs(options, solved.survey.origin, on_earth.center_in_geo, solved.survey.vertical)
    camera_table(on_earth, crs)  # a CRS that cannot hold the cameras is refused before the work begins
    with stage.progress.task("cameras", 5) as task:
        posterior = None
        if is_checked(solved.model.cautions):
            posterior = posterior_of(stage.workspace, solved.model, solved.sfm)
        cameras = cameras_on_earth(solved, None if posterior is None else posterior.camera_cov)
        table = camera_table(cameras, crs)
        task.advance(note="σ")
        model = model_in_file(solved, placement)
        found = covariances_in_file(model, posterior, placement.file_from_geo)
        npz, csv = stage.out / "covariances.npz", stage.out / "camera_covariances.csv"
        write_covariances(found, npz, csv)
        for path in (npz, csv):
            write_sidecar(placement.sidecar(), path)
        task.advance(note="covariances")
        write_sparse(model, stage.out / "colmap")
        write_sidecar(placement.sidecar(), stage.out / "colmap")
        task.advance(note="COLMAP")
        lens_limits = _write_nerfstudio(stage.out / "transforms.json", model, placement)
        task.advance(note="nerfstudio")
        footprints = footprints_of(solved.survey, model, table, placement)
        write_features(stage.out / "footprints.geojson", footprints.features)
        task.advance(note="footprints")
    cautions, sigma = union(solved.model.cautions, _UNKNOWN if posterior is None else ()), _scene_sigma(table)
    on_ellipsoid = TargetCrs(parse_crs("EPSG:4979"), crs.origin, footprints.corner_lla)
    bounds = _bounds(footprints.corner_lla[:, [1, 0, 2]])
    write_sidecar(on_ellipsoid.sidecar(bounds, accuracy, sigma, cautions), stage.out / "footprints.geojson")
    write_camera_table(stage.out / "cameras.csv", table)
    sidecar = crs.sidecar(_bounds(table.position), accuracy, sigma, cautions)
    write_sidecar(sidecar, stage.out / "cameras.csv")
    return _summary(table, model, sidecar, union(cautions, lens_limits))


def model_in_file(solved: SolvedSurvey, placement: Placement) -> SparseModel:
    """Return the adjusted cameras and lenses in the frame of the placement, with the points as these see them."""
    file_from_model = placement.file_from_model
    rotation = solved.poses.cam_from_model @ file_from_model.rotation.T
    center = file_from_model.apply(solved.poses.cam_center_in_model)
    sparse = solved.sparse
    refined = refined_points(
        Network(
            sparse.cameras,
            sparse.image_camera_id,
            rotation,
            center,
            file_from_model.apply(solved.point_in_model),
            sparse.obs_point,
            sparse.obs_image,
            sparse.obs_xy_px,
        )
    )
    return replace(
        sparse,
        rotation_cam_from_local=rotation,
        translation_cam_from_local=-np.einsum("nij,nj->ni", rotation, center),
        point_in_local=refined.point_in_world,
        point_error_px=refined.error_px,
    )


def _write_nerfstudio(path: Path, model: SparseModel, placement: Placement) -> tuple[Caution, ...]:
    """Write the cameras in nerfstudio's form, with the sidecar, and return what that form cannot hold."""
    lenses = {key: lens_of(camera) for key, camera in model.cameras.items()}
    owner = [lenses[int(key)] for key in model.image_camera_id]
    kind = Counter(lens.model for lens in owner).most_common(1)[0][0]
    centers = model.cam_center_in_local
    chosen = [index for index, lens in enumerate(owner) if lens.model == kind]
    frames = [
        Frame(
            model.image_name[index],
            model.camera_of(index),
            model.rotation_cam_from_local[index].T,
            centers[index],
        )
        for index in chosen
    ]
    write_transforms(path, frames, [owner[index] for index in chosen])
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
    cautions = tuple(Caution(code=code, sentence=sentence) for code, sentence in limits.items())
    sidecar = placement.sidecar()
    write_sidecar(sidecar.model_copy(update={"cautions": union(sidecar.cautions, cautions)}), path)
    return cautions


def _bounds(points: FloatArray) -> FloatArray:
    return np.stack([points.min(axis=0), points.max(axis=0)])


def _scene_sigma(table: CameraTable) -> SceneSigma | None:
    """Return the predicted σ of the positions; None if they are not known."""
    if not np.isfinite(table.sigma_enu_m).all():
        return None
    horizontal: FloatArray = np.hypot(table.sigma_enu_m[:, 0], table.sigma_enu_m[:, 1])
    vertical = table.sigma_enu_m[:, 2]
    return SceneSigma(
        counts="positions of the cameras: similarity, cameras and lens",
        median_sigma_h_m=float(np.median(horizontal)),
        median_sigma_v_m=float(np.median(vertical)),
        largest_sigma_h_m=float(horizontal.max()),
        largest_sigma_v_m=float(vertical.max()),
    )


def _summary(table: CameraTable, model: SparseModel, sidecar: CrsSidecar, cautions: tuple[Caution, ...]) -> Summary:
    sigma, count = sidecar.sigma, len(table.name)
    figure = f"{count} cameras, {sidecar.crs}{median_sigma(sigma, 'camera positions')}"
    seen = model.point_error_px[np.isfinite(model.point_error_px)]
    values = {
        "cameras": count,
        "test_cameras": table.split.count("test"),
        "points": len(model.point_id),
        "reprojection_error_px": float(seen.mean()) if len(seen) else None,
        "crs": sidecar.crs,
        "heights": sidecar.vertical_datum.name,
        "assumed": "; ".join(sidecar.assumed) or None,
        "median_camera_sigma_h_m": None if sigma is None else sigma.median_sigma_h_m,
        "median_camera_sigma_v_m": None if sigma is None else sigma.median_sigma_v_m,
    }
    return Summary(figure, values, cautions=cautions)

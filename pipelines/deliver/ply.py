"""Export of the splat as a 3DGS PLY in real-world metres, with a sidecar that states its place on Earth.

Reads `ingest/survey.json`, `train/model.json` and `train/gaussians.ply`. Writes `export/splat.ply` and
`export/splat.ply.georef.json` (docs/formats.md). The similarity maps the model to Earth (GeoRefGS section 2.4).

The PLY's frame is East-North-Up at its own origin in the middle of the scene. There, float32 coordinates stay
small, and "up" is the vertical at the splat, not at the start of the survey.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from pipelines.core.cautions import NOT_CHECKED, Caution
from pipelines.core.errors import DegenerateGeometryError
from pipelines.core.products import load_json
from pipelines.core.stages import GAUSSIANS, MODEL, SPLAT
from pipelines.core.types import FloatArray, Quaternion, Row7, Vector3
from pipelines.core.workspace import StageRun, Summary
from pipelines.deliver.options import ExportPlyOptions
from pipelines.formats.georef_sidecar import GeorefSidecar, predicted_accuracy, write_sidecar
from pipelines.geodesy.crs import ECEF, parse_crs
from pipelines.geodesy.enu import (
    Origin,
    ecef_from_enu,
    ecef_from_enu_rotation,
    ecef_from_lla,
    lla_from_ecef,
    lla_of,
)
from pipelines.geometry.rotations import quat_xyzw_from_matrix
from pipelines.geometry.similarity import Similarity, SimilarityRecord, moved_pivot
from pipelines.scene.calibrated import load_survey
from pipelines.scene.survey import Survey
from pipelines.scene.trained_model import TrainedModel
from pipelines.splat.gaussians import Gaussians
from pipelines.splat.storage import read_gaussians, write_gaussians
from pipelines.splat.transform import transformed

_ORIGIN_DECIMALS_DEG = 6  # 0.1 m: short numbers can be copied without loss
_ORIGIN_DECIMALS_M = 1


@dataclass(frozen=True)
class ExportedSplat:
    """Splat in the frame of its PLY, with its sidecar.

    Attributes:
        gaussians: in the PLY's frame, metres.
        sidecar: place of that frame on Earth.
        left_out: number of Gaussians that were too transparent.
    """

    gaussians: Gaussians
    sidecar: GeorefSidecar
    left_out: int


def run(stage: StageRun, options: ExportPlyOptions) -> Summary:
    """Write the PLY and its sidecar, and return their key figures.

    Raises:
        MissingProductError: ingest or train has not been run.
        InputError: a product is damaged.
        DegenerateGeometryError: no Gaussian is opaque enough.
    """
    survey = load_survey(stage.workspace)
    model = load_json(TrainedModel, stage.workspace.path(MODEL))
    gaussians = read_gaussians(stage.workspace.path(GAUSSIANS))
    export = export_splat(gaussians, model, survey, options)
    path = stage.out / SPLAT.rpartition("/")[2]
    write_gaussians(path, export.gaussians)
    write_sidecar(export.sidecar, path)
    accuracy = export.sidecar.accuracy
    sigma = "" if accuracy is None else f", σ {accuracy.sigma_h_m:.3f} m H, {accuracy.sigma_v_m:.3f} m V"
    values = {
        "gaussians": len(export.gaussians),
        "left_out": export.left_out,
        "origin_lla": export.sidecar.origin_lla,
        "sigma_h_m": None if accuracy is None else accuracy.sigma_h_m,
        "sigma_v_m": None if accuracy is None else accuracy.sigma_v_m,
    }
    return Summary(f"{len(export.gaussians)} Gaussians{sigma}", values, cautions=export.sidecar.cautions)


def export_splat(
    gaussians: Gaussians, model: TrainedModel, survey: Survey, options: ExportPlyOptions
) -> ExportedSplat:
    """Return the Gaussians of a model in an East-North-Up frame at the scene, with the sidecar of that frame.

    Args:
        gaussians: in the frame `model`.
        model: has the similarity geo ← model and its covariance.
        survey: has the origin of geo and the vertical datum.
        options: the least opacity.

    Raises:
        DegenerateGeometryError: no Gaussian is opaque enough.
    """
    kept = gaussians.select(torch.sigmoid(gaussians.logit_opacities) >= options.min_opacity)
    if len(kept) == 0:
        raise DegenerateGeometryError(
            f"none of {len(gaussians)} Gaussians has an opacity of {options.min_opacity} or more: "
            "lower --min-opacity"
        )
    geo_from_model = Similarity.from_record(model.geo_from_model)
    scene_in_geo = np.median(geo_from_model.apply(kept.means.numpy()), axis=0)
    origin_lla = _rounded_origin(scene_in_geo, survey.origin)
    ply_from_geo = _enu_at(origin_lla).inverse() @ _enu_at(lla_of(survey.origin))
    in_ply = transformed(kept, ply_from_geo @ geo_from_model)
    covariance = _covariance_in_ply(model.geo_from_model, ply_from_geo)
    sidecar = _sidecar(origin_lla, covariance, survey, model.cautions)
    return ExportedSplat(in_ply, sidecar, len(gaussians) - len(kept))


def _rounded_origin(point_in_geo: FloatArray, origin: Origin) -> FloatArray:
    """Return latitude, longitude and height of a point, rounded: these numbers define the frame exactly."""
    lla = lla_from_ecef(ecef_from_enu(point_in_geo, origin))
    return np.array([*np.round(lla[:2], _ORIGIN_DECIMALS_DEG), np.round(lla[2], _ORIGIN_DECIMALS_M)])


def _enu_at(lla: FloatArray) -> Similarity:
    """Return the similarity ecef ← enu of the East-North-Up frame at latitude, longitude and height (3,)."""
    return Similarity(1.0, ecef_from_enu_rotation(lla), ecef_from_lla(lla))


def _covariance_in_ply(geo_from_model: SimilarityRecord, ply_from_geo: Similarity) -> FloatArray | None:
    """Return the similarity's covariance (7, 7) about the PLY's origin, along its axes; None if unknown."""
    covariance = np.array(geo_from_model.covariance)
    if not covariance.any():
        return None
    ply_origin_in_geo = ply_from_geo.inverse().translation
    about_origin = moved_pivot(covariance, geo_from_model.pivot, ply_origin_in_geo)
    turn = np.eye(7)
    turn[1:4, 1:4] = turn[4:, 4:] = ply_from_geo.rotation
    return np.asarray(turn @ about_origin @ turn.T)


def _sidecar(
    origin_lla: FloatArray, covariance: FloatArray | None, survey: Survey, cautions: tuple[Caution, ...]
) -> GeorefSidecar:
    ecef_from_ply = _enu_at(origin_lla)
    unchecked = any(caution.code == NOT_CHECKED for caution in cautions)
    return GeorefSidecar(
        origin=_vector(ecef_from_ply.translation),
        rotation=_quaternion(ecef_from_ply.rotation),
        scale=1.0,
        origin_lla=_vector(origin_lla),
        vertical_datum=survey.vertical,
        crs_wkt=parse_crs(ECEF).wkt,
        covariance=None if covariance is None else tuple(map(_row, covariance)),
        accuracy=None if covariance is None or unchecked else predicted_accuracy(covariance, np.zeros(3)),
        cautions=cautions,
    )


def _quaternion(rotation: FloatArray) -> Quaternion:
    x, y, z, w = quat_xyzw_from_matrix(rotation).tolist()
    return x, y, z, w


def _row(values: FloatArray) -> Row7:
    s, rx, ry, rz, x, y, z = values.tolist()
    return s, rx, ry, rz, x, y, z


def _vector(values: FloatArray) -> Vector3:
    x, y, z = values.tolist()
    return x, y, z

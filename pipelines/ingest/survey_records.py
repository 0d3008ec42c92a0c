"""Images and surveyed points as the survey records them: positions, attitudes and covariances in geo."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from pipelines.core.types import FloatArray, IntArray, Matrix3, Vector3
from pipelines.geodesy.enu import Origin, enu_from_ecef, geo_from_enu_at, lla_from_ecef, lla_of
from pipelines.geometry.rotations import quat_xyzw_from_matrix
from pipelines.ingest.flight_record import LEAST_IMAGES, FlightRecord
from pipelines.ingest.ground_points import GroundPoint, UnmarkedPoints
from pipelines.ingest.image_poses import ImagePoses
from pipelines.ingest.options import IngestOptions
from pipelines.scene.survey import Attitude, Fix, SurveyedPoint, SurveyImage, UnmarkedPoint

SIGMA_GIMBAL_DEG = 2.0
SIGMA_TABLE_ATTITUDE_DEG = 1.0


def image_records(
    flight: FlightRecord, session_of: IntArray, origin: Origin, options: IngestOptions
) -> tuple[SurveyImage, ...]:
    """Return the photographs with fixes and attitudes in the frame at an origin, and their split.

    Args:
        flight: photographs and their measured poses.
        session_of: (N,) session of each fix.
        origin: of the frame.
        options: of `ingest`.
    """
    poses = flight.poses
    fixes, attitudes = _fixes(poses, session_of, origin), _attitudes(poses, origin, options)
    test = held_out(len(flight.photos), options.test_every)
    return tuple(
        SurveyImage(
            name=photo.name,
            camera_id=flight.camera_of[photo.name],
            sha256=photo.file.sha256,
            timestamp_s=float(poses.time_s[row]) if np.isfinite(poses.time_s[row]) else None,
            fix=fixes[row],
            attitude=attitudes[row],
            split="test" if row in test else "train",
        )
        for row, photo in enumerate(flight.photos)
    )


def held_out(count: int, every: int) -> range:
    """Return the rows of the test images: every N-th, none where that would leave too few to train on."""
    rows = range(0, count, every) if every else range(0)
    return rows if count - len(rows) >= LEAST_IMAGES else range(0)


def point_records(
    points: Sequence[GroundPoint], origin: Origin, options: IngestOptions
) -> tuple[SurveyedPoint, ...]:
    """Return control or check points in the frame at an origin."""
    if not points:
        return ()
    position_in_ecef = np.array([point.position_in_ecef for point in points])
    position = enu_from_ecef(position_in_ecef, origin)
    sigma_m = np.array([_sigma_enu_m(point, options) for point in points])
    covariance = _turned(sigma_m, position_in_ecef, origin)
    return tuple(
        SurveyedPoint(
            name=point.name,
            position_in_geo=_vector(position[row]),
            cov_in_geo=_matrix(covariance[row]),
            marks=point.marks,
            land_cover="vegetated" if point.name in options.vegetated else "open",
        )
        for row, point in enumerate(points)
    )


def unmarked_records(points: UnmarkedPoints, origin: Origin, options: IngestOptions) -> tuple[UnmarkedPoint, ...]:
    """Return points without enough marks in the frame at an origin."""
    return tuple(
        UnmarkedPoint(**record.model_dump(), use=use)
        for use, of_use in points.items()
        for record in point_records(of_use, origin, options)
    )


def _sigma_enu_m(point: GroundPoint, options: IngestOptions) -> Vector3:
    """Return σ by precedence: option, then file, then default."""
    stated = options.model_fields_set
    horizontal = point.sigma_h_m if point.sigma_h_m and "sigma_gcp_h" not in stated else options.sigma_gcp_h
    vertical = point.sigma_v_m if point.sigma_v_m and "sigma_gcp_v" not in stated else options.sigma_gcp_v
    return horizontal, horizontal, vertical


def _fixes(poses: ImagePoses, session_of: IntArray, origin: Origin) -> list[Fix | None]:
    position = enu_from_ecef(poses.position_in_ecef, origin)
    covariance = _turned(poses.sigma_enu_m, poses.position_in_ecef, origin)
    return [
        Fix(
            position_in_geo=_vector(position[row]),
            cov_in_geo=_matrix(covariance[row]),
            source=poses.source,
            sigma_source=poses.sigma_source[row],
            session=int(session_of[row]),
        )
        if located
        else None
        for row, located in enumerate(poses.located)
    ]


def _turned(sigma_enu_m: FloatArray, position_in_ecef: FloatArray, origin: Origin) -> FloatArray:
    """Return covariances in geo (N, 3, 3) of σ (N, 3) against north and up at each place (N, 3)."""
    geo_from_enu = geo_from_enu_at(lla_from_ecef(position_in_ecef), origin)
    return geo_from_enu @ (sigma_enu_m[:, :, None] ** 2 * np.swapaxes(geo_from_enu, -1, -2))


def _attitudes(poses: ImagePoses, origin: Origin, options: IngestOptions) -> list[Attitude | None]:
    attitudes: list[Attitude | None] = [None] * len(poses.position_in_ecef)
    rows = np.flatnonzero(np.isfinite(poses.enu_from_cam).all(axis=(1, 2))).tolist()
    # Without a position, north is the origin's: within a survey it turns by minutes of arc.
    located = poses.located[rows, None]
    place = np.where(located, lla_from_ecef(poses.position_in_ecef[rows]), lla_of(origin))
    geo_from_cam = geo_from_enu_at(place, origin) @ poses.enu_from_cam[rows]
    for row, quat in zip(rows, quat_xyzw_from_matrix(geo_from_cam), strict=True):
        x, y, z, w = (float(value) for value in quat)
        attitudes[row] = Attitude(
            quat_xyzw=(x, y, z, w),
            sigma_deg=_attitude_sigma_deg(poses, row, options),
            source=poses.attitude_source[row],
        )
    return attitudes


def _attitude_sigma_deg(poses: ImagePoses, row: int, options: IngestOptions) -> float:
    """Return σ by precedence: option, then file, then the source's default."""
    if options.sigma_attitude is not None:
        return options.sigma_attitude
    if np.isfinite(poses.sigma_attitude_deg[row]):
        return float(poses.sigma_attitude_deg[row])
    return SIGMA_GIMBAL_DEG if poses.attitude_source[row] == "gimbal" else SIGMA_TABLE_ATTITUDE_DEG


def _vector(values: ArrayLike) -> Vector3:
    x, y, z = (float(value) for value in np.asarray(values))
    return (x, y, z)


def _matrix(values: FloatArray) -> Matrix3:
    return (_vector(values[0]), _vector(values[1]), _vector(values[2]))

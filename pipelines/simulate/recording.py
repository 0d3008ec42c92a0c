"""Records of the instruments and the surveyor for a flight, the truth behind them, and the survey's tables."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from pipelines.core.types import FloatArray, IntArray, Matrix3, vector3
from pipelines.geodesy.enu import Origin, lla_from_enu
from pipelines.geometry.rotations import ENU_FROM_NED, geo_from_cam, quat_xyzw_from_matrix, yaw_pitch_roll_deg
from pipelines.simulate import flight
from pipelines.simulate.mesh import Raycaster
from pipelines.simulate.options import SimulateOptions
from pipelines.simulate.scene import target_corners
from pipelines.simulate.truth import TrueLens, TrueMark, TrueNavigation, TrueTarget, Truth
from pipelines.simulate.world import LEAST_RAYS, World, choose_control, project_targets

POINTS_CRS = "EPSG:4979"


@dataclass(frozen=True)
class PhotoRecords:
    """Records of N photographs."""

    names: tuple[str, ...]
    stamp_ns: IntArray  # (N,) camera clock
    lla: FloatArray  # (N, 3) degrees and ellipsoidal metres of the antenna
    yaw_pitch_roll_deg: FloatArray  # (N, 3) of the camera
    body_yaw_pitch_roll_deg: FloatArray  # (N, 3) of the aircraft
    sigma_enu_m: FloatArray  # (3,) that the receiver states


def write_trajectory(path: Path, photos: PhotoRecords) -> None:
    """Write a line for each photograph: position and attitude at its stamp."""
    rows = ["image,timestamp,latitude,longitude,altitude,yaw,pitch,roll,sigma_e,sigma_n,sigma_u"]
    sigma = ",".join(f"{value:.4g}" for value in photos.sigma_enu_m)
    for name, stamp, lla, angles in zip(
        photos.names, photos.stamp_ns, photos.lla, photos.yaw_pitch_roll_deg, strict=True
    ):
        turned = ",".join(f"{angle:.4f}" for angle in angles)
        rows.append(f"{name},{_seconds(stamp)},{_position(lla)},{turned},{sigma}")
    _write(path, rows)


def write_tables(folder: Path, recording: Recording, enu_from_body: FloatArray, origin: Origin) -> None:
    """Write trajectory, raw navigation on the navigation clock, control and check points.

    The attitudes (K, 3, 3) are those of the log at their places: East-North-Up from forward-right-down.
    """
    photos, gnss, imu = recording.photos, recording.gnss, recording.imu
    write_trajectory(folder / "trajectory.csv", photos)
    sigma = ",".join(f"{value:.4g}" for value in photos.sigma_enu_m)
    rows = ["timestamp,latitude,longitude,altitude,sigma_e,sigma_n,sigma_u"]
    for stamp, lla in zip(gnss.stamp_ns, recording.gnss_lla, strict=True):
        rows.append(f"{_seconds(stamp)},{_position(lla)},{sigma}")
    _write(folder / "gnss.csv", rows)
    rows = ["timestamp,qx,qy,qz,qw"]
    for stamp, quat in zip(imu.stamp_ns, quat_xyzw_from_matrix(enu_from_body), strict=True):
        rows.append(f"{_seconds(stamp)}," + ",".join(f"{part:.9f}" for part in quat))
    _write(folder / "imu.csv", rows)
    for name, role in (("gcp_list.txt", "control"), ("checkpoints.txt", "check")):
        # The form of ODM's gcp_list.txt: x is the longitude.
        rows = [POINTS_CRS]
        for target, position in zip(recording.truth.targets, recording.target_in_geo, strict=True):
            lat, lon, alt = lla_from_enu(position, origin)
            for mark in target.marks if target.role == role else ():
                place = f"{lon:.10f} {lat:.10f} {alt:.5f} {mark.written_x_px:.3f} {mark.written_y_px:.3f}"
                rows.append(f"{place} {mark.image} {target.name}")
        _write(folder / name, rows)


def _seconds(stamp_ns: np.int64) -> str:
    return f"{stamp_ns // 1_000_000_000}.{stamp_ns % 1_000_000_000 // 1000:06d}"


def _position(lla: FloatArray) -> str:
    return f"{lla[0]:.9f},{lla[1]:.9f},{lla[2]:.4f}"


def _write(path: Path, rows: list[str]) -> None:
    path.write_text("\n".join(rows) + "\n", encoding="utf-8", newline="\n")


_LEAST_SIGMA_M = 0.001  # no receiver states less


@dataclass(frozen=True)
class Recording:
    """All records of a flight."""

    photos: PhotoRecords
    gnss: flight.GnssLog
    gnss_lla: FloatArray  # (M, 3) degrees and metres
    imu: flight.ImuLog
    imu_in_geo: FloatArray  # (K, 3) places of the attitudes
    truth: Truth  # of the whole survey, with its P targets
    target_in_geo: FloatArray  # (P, 3) places of the targets, as surveyed


def _receiver(options: SimulateOptions) -> flight.Receiver:
    overrides: dict[str, Any] = {
        "sigma_h_m": options.sigma_h,
        "sigma_v_m": options.sigma_v,
        "bias_m": options.bias,
        "bias_period_s": options.bias_period,
        "common_error_m": options.common_error,
        "outlier_share": options.outlier_share,
        "outlier_m": options.outlier_size,
    }
    given = {name: value for name, value in overrides.items() if value is not None}
    return replace(flight.RECEIVERS[options.gnss], **given)


def record(options: SimulateOptions, world: World, raycaster: Raycaster, seed: np.random.SeedSequence) -> Recording:
    """Return what the flight records of the world: fixes, attitudes, photographs and marks, with errors."""
    gnss_seed, imu_seed, mark_seed = seed.spawn(3)
    receiver = _receiver(options)
    gnss = flight.record_gnss(world.trajectory, world.mounting, receiver, np.random.default_rng(gnss_seed))
    imu = flight.record_imu(
        world.trajectory, world.mounting, options.sigma_attitude, np.random.default_rng(imu_seed)
    )
    photos = _photo_records(world, receiver, gnss, imu)
    targets, target_in_geo = _mark(options, world, photos.names, raycaster, np.random.default_rng(mark_seed))
    imu_time_s = (imu.stamp_ns - photos.stamp_ns[0]) / 1e9 - world.mounting.clock_offset_s
    return Recording(
        photos=photos,
        gnss=gnss,
        gnss_lla=lla_from_enu(gnss.position_in_geo, world.origin),
        imu=imu,
        imu_in_geo=world.trajectory.position(imu_time_s),
        truth=_truth(options, world, receiver, gnss, photos, targets=targets),
        target_in_geo=target_in_geo,
    )


def _photo_records(
    world: World, receiver: flight.Receiver, gnss: flight.GnssLog, imu: flight.ImuLog
) -> PhotoRecords:
    """Return fix and attitude at each photograph's stamp, as a user reads them off the logs."""
    stamps = world.trajectory.stamp_ns
    fixes = flight.fixes_at(gnss, stamps)
    enu_from_body = flight.in_local_enu(flight.attitudes_at(imu, stamps), fixes, world.origin)
    angles = yaw_pitch_roll_deg(enu_from_body @ world.trajectory.cam_from_body.T)
    # The aircraft's angles are those of a camera that looks along the nose.
    level_cam_from_body = geo_from_cam([0.0, 0.0, 0.0]).T @ ENU_FROM_NED
    body_angles = yaw_pitch_roll_deg(enu_from_body @ level_cam_from_body.T)
    # These are the names of the frames of a bag, so that the marks in one gcp_list.txt fit photographs and bag.
    names = tuple(f"frame_{i:06d}.jpg" for i in range(len(stamps)))
    stated = np.maximum([receiver.sigma_h_m, receiver.sigma_h_m, receiver.sigma_v_m], _LEAST_SIGMA_M)
    return PhotoRecords(names, stamps, lla_from_enu(fixes, world.origin), angles, body_angles, stated)


def _mark(
    options: SimulateOptions, world: World, names: tuple[str, ...], raycaster: Raycaster, rng: np.random.Generator
) -> tuple[tuple[TrueTarget, ...], FloatArray]:
    """Return the P targets that at least two photographs see, and their places (P, 3) as surveyed."""
    seen, pixels = project_targets(world.sites, world.poses, world.lens, raycaster, world.target_m)
    rays = seen.sum(axis=1)
    control = set(choose_control(world.sites, rays, options.control))
    targets, surveyed = [], []
    for i in np.nonzero(rays >= LEAST_RAYS)[0]:
        role: Literal["control", "check"] = "control" if i in control else "check"
        name = f"{'G' if role == 'control' else 'C'}{world.number[i]:02d}"
        marks = []
        for j in np.nonzero(seen[i])[0]:
            x, y = pixels[i, j]
            dx, dy = rng.normal(0, options.sigma_mark, 2)
            # The files hold three decimals.
            marks.append(TrueMark(
                image=names[j], x_px=x, y_px=y, written_x_px=round(x + dx, 3), written_y_px=round(y + dy, 3)
            ))  # fmt: skip
        position = world.sites[i].target_position
        surveyed.append(position + world.survey_error[i])
        a, b, c, d = map(vector3, target_corners(world.scene, world.sites[i], world.target_m))
        targets.append(
            TrueTarget(
                name=name,
                number=int(world.number[i]),
                role=role,
                surface=world.sites[i].kind,
                position_in_geo=vector3(position),
                corners_in_geo=(a, b, c, d),
                marks=tuple(marks),
            )
        )
    return tuple(targets), np.array(surveyed).reshape(-1, 3)


def _truth(
    options: SimulateOptions,
    world: World,
    receiver: flight.Receiver,
    gnss: flight.GnssLog,
    photos: PhotoRecords,
    *,
    targets: tuple[TrueTarget, ...],
) -> Truth:
    lens, mounting = world.lens, world.mounting
    true_fixes = flight.fixes_at(replace(gnss, position_in_geo=gnss.true_in_geo), photos.stamp_ns)
    errors = flight.fixes_at(gnss, photos.stamp_ns) - true_fixes
    return Truth(
        scene=options.scene,
        flight=options.flight,
        seed=options.seed,
        origin=world.origin,
        lens=TrueLens(model=lens.colmap_model, width=lens.width, height=lens.height, params=lens.colmap_params),
        images=photos.names,
        stamp_ns=tuple(int(stamp) for stamp in photos.stamp_ns),
        centers=tuple(vector3(pose.center) for pose in world.poses),
        travels=tuple(vector3(pose.travel) for pose in world.poses),
        cam_from_enu=tuple(_matrix(pose.geo_from_cam.T) for pose in world.poses),
        fix_errors=tuple(vector3(error) for error in errors),
        navigation=TrueNavigation(
            receiver=options.gnss,
            sigma_h_m=receiver.sigma_h_m,
            sigma_v_m=receiver.sigma_v_m,
            bias_amplitude_m=vector3(gnss.bias_amplitude_m),
            bias_phase_rad=vector3(gnss.bias_phase_rad),
            bias_period_s=receiver.bias_period_s,
            common_error_m=receiver.common_error_m,
            outlier_m=receiver.outlier_m,
            wrong_images=tuple(photos.names[i] for i in gnss.wrong_photos),
            sigma_attitude_deg=options.sigma_attitude,
            antenna_in_body_m=vector3(mounting.antenna_in_body),
            nominal_from_cam=_matrix(mounting.nominal_from_cam),
            cam_from_body=_matrix(world.trajectory.cam_from_body),
            clock_offset_s=mounting.clock_offset_s,
        ),
        target_kind=options.target_kind,
        targets=targets,
        sigma_mark_px=options.sigma_mark,
        sigma_survey_m=options.sigma_survey,
        sun_in_geo=vector3(world.scene.sun),
    )


def _matrix(values: FloatArray) -> Matrix3:
    a, b, c = (vector3(row) for row in values)
    return a, b, c

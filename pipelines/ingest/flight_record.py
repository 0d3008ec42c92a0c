"""Record of a flight, whatever it was read from: photographs, their cameras, measured poses, navigation by time.

σ of positions is by option, by file, or by the kind of receiver. The navigation is as recorded, Earth-centred,
until the survey's frame is known. Lever arm and boresight lead from the places and attitudes that the instruments
measured to those of the cameras.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal

import numpy as np

from pipelines.core.errors import InputError
from pipelines.core.types import BoolArray, FloatArray
from pipelines.formats.trajectory_csv import complete
from pipelines.geodesy.enu import Origin, ecef_from_enu_rotation, enu_from_ecef, geo_from_enu_at, lla_from_ecef
from pipelines.geodesy.vertical import VerticalDatum
from pipelines.geometry.rotations import exp_so3
from pipelines.geometry.trajectory import Rig, Trajectory, mount, with_rig
from pipelines.ingest.options import IngestOptions
from pipelines.ingest.photo_folder import Photo
from pipelines.ingest.remarks import Remarks
from pipelines.ingest.rig_instants import Accompanying, Quaternion
from pipelines.survey.navigation import NavigationTrack
from pipelines.survey.survey import CameraPrior

SigmaSource = Literal["file", "option", "default"]
LEAST_IMAGES = 3
# σ horizontal and vertical in metres where the file is silent, by kind of receiver, from the best to the worst.
RECEIVER_SIGMA_M = {
    "RTK fixed": (0.02, 0.03),
    "RTK float": (0.5, 1.0),
    "single-frequency": (2.5, 5.0),
    "unknown receiver": (5.0, 10.0),
}
RECEIVERS = tuple(RECEIVER_SIGMA_M)
# σ of the common error horizontal and vertical in metres, by kind of receiver. No file tells it: the σ in files are
# those of single positions against the base station, not of the base station itself.
COMMON_SIGMA_M = {
    "RTK fixed": (0.03, 0.05),
    "RTK float": (0.3, 0.6),
    "single-frequency": (1.5, 3.0),
    "unknown receiver": (2.0, 4.0),
}
# Median horizontal σ up to which fixes without a stated solution count as RTK fixed, or as RTK float.
_FIXED_SIGMA_M, _FLOAT_SIGMA_M = 0.1, 1.0
_LEAST_GAP_S, _GAP_STEPS, _MOST_BURST = 1.0, 2.5, 10.0
_HALF_WINDOW_S = 0.5  # of a trajectory, for the velocity at a moment


@dataclass(frozen=True)
class ImagePoses:
    """Measured poses of N images; NaN rows where nothing was measured."""

    position_in_ecef: FloatArray  # (N, 3) metres
    sigma_enu_m: FloatArray  # (N, 3)
    sigma_source: tuple[SigmaSource, ...]  # (N,) who gave σ
    receivers: tuple[str, ...]  # (N,) kinds of receiver, of `RECEIVERS`, as recorded
    enu_from_cam: FloatArray  # (N, 3, 3) attitude against north and up at the camera
    attitude_source: tuple[str, ...]  # (N,) kinds of file, as of `survey.survey.Attitude`
    sigma_attitude_deg: FloatArray  # (N,) σ that the attitudes state
    time_s: FloatArray  # (N,) seconds since 1970 UTC
    source: str  # of the positions, with their CRS and the datum that their heights counted from
    crs_name: str
    vertical: VerticalDatum
    # What disagreeing sources add to the error that all positions share, σ horizontal and vertical
    common_sigma_m: tuple[float, float] = (0.0, 0.0)
    # The Earth-centred trajectory that images were matched with by time, None where it was by name
    recorded: Trajectory | None = None
    # (N, 3, 3) σ of the motion as vectors in ECEF: along it by the σ of each time, and by an error that all times
    # share; and of what bends between two samples of a slow track
    along_track_m: FloatArray | None = None

    @property
    def located(self) -> BoolArray:
        """Which images have a position (N,)."""
        return complete(self.position_in_ecef)

    @property
    def coarse_times_m(self) -> float:
        """Median σ along the motion by the times, in metres; zero where it is below that of the positions."""
        if self.along_track_m is None or not self.located.any():
            return 0.0
        along_m = float(np.median(np.linalg.norm(self.along_track_m[self.located, :2], axis=(1, 2))))
        return along_m if along_m > float(np.median(self.sigma_enu_m[self.located, :2])) else 0.0


@dataclass(frozen=True)
class RecordedNavigation:
    """The navigation on its own clock, and how the cameras of N photographs sit in it."""

    positions: Trajectory  # of the antenna, Earth-centred
    attitudes: Trajectory  # rotations body → East-North-Up at the antenna, forward-right-down
    rig: Rig  # of the N photographs, as `ingest` was told or as `/tf` has it
    body_known: bool  # whether the body's axes are known; where not, the camera's nominal axes stand for them
    images: tuple[str, ...]
    image_time_s: FloatArray  # (N,) times of the photographs on the camera's clock
    time_offset_s: float  # navigation clock minus camera clock


@dataclass(frozen=True)
class FlightRecord:
    """Record of a flight; `navigation` is None where it was not recorded by time.

    `accompanying` are photographs of the other lenses of a rig, and `rotations` the stated ones of these lenses,
    lens ← reference as x, y, z, w, by photograph. `originals` has the hashes of the photographs in
    `original_folder` of which `folder` has copies with fewer bits, by name.
    """

    folder: Path
    photos: list[Photo]
    cameras: tuple[CameraPrior, ...]
    camera_of: dict[str, int]
    poses: ImagePoses
    navigation: RecordedNavigation | None
    accompanying: tuple[Accompanying, ...] = ()
    rotations: Mapping[str, Quaternion] = field(default_factory=dict)
    original_folder: Path | None = None
    originals: Mapping[str, str] = field(default_factory=dict)


def kind_of_receiver(receiver: str, sigma_h_m: float) -> str:
    """Return the kind of receiver of a session: as recorded, or better where its σ is that of corrected positions.

    Programs that write corrected positions into photographs leave the other tags as they were. σ of decimetres may
    be those of a float solution or of code corrections, whose common error is that of a plain receiver.
    """
    if receiver in ("RTK fixed", "RTK float"):
        return receiver
    if sigma_h_m <= _FIXED_SIGMA_M:
        return "RTK fixed"
    return "RTK float" if receiver == RECEIVERS[-1] and sigma_h_m <= _FLOAT_SIGMA_M else receiver


def with_defaults(
    stated: FloatArray, receivers: Sequence[str], located: BoolArray, options: IngestOptions, remarks: Remarks
) -> tuple[FloatArray, tuple[SigmaSource, ...]]:
    """Return σ east, north, up (N, 3) by precedence, and who gave it (N,).

    σ of the file (N, 3) are NaN where it is silent. Defaults are noted but for images without a position.
    """
    from_file = complete(stated)
    defaults = np.array([RECEIVER_SIGMA_M[receiver] for receiver in receivers]).reshape(-1, 2)
    sigma = np.where(np.isfinite(stated), stated, defaults[:, [0, 0, 1]])
    if options.sigma_h is not None:
        sigma[:, :2] = options.sigma_h
    if options.sigma_v is not None:
        sigma[:, 2] = options.sigma_v
    for receiver in sorted(set(receivers)):
        rows = located & ~from_file & (np.array(receivers) == receiver)
        horizontal_m, vertical_m = RECEIVER_SIGMA_M[receiver]
        parts = [f"{horizontal_m:g} m horizontal"] if options.sigma_h is None else []
        parts += [f"{vertical_m:g} m vertical"] if options.sigma_v is None else []
        if rows.any() and parts:
            remarks.assume(
                "default-position-sigma",
                f"{int(rows.sum())} positions have no σ of their own: {', '.join(parts)} is assumed ({receiver}).",
                "State it with --sigma-h and --sigma-v.",
            )
    overridden = options.sigma_h is not None or options.sigma_v is not None
    sources: list[SigmaSource] = ["option" if overridden else "file" if row else "default" for row in from_file]
    return sigma, tuple(sources)


def track_in_geo(recorded: RecordedNavigation, origin: Origin) -> NavigationTrack | None:
    """Return the navigation in the frame at an origin; None if it has no positions."""
    positions, attitudes = recorded.positions, recorded.attitudes
    if not len(positions):
        return None
    mounts, arms = recorded.rig.of_each(len(recorded.images))
    # Attitudes are turned from north and up where each was taken. Where they begin or end beyond the positions, the
    # first or last position stands for the place: at 45° latitude north turns by a second of arc in 30 m.
    time_s = np.clip(attitudes.time_s, positions.time_s[0], positions.time_s[-1])
    antenna_in_ecef = replace(positions, max_gap_s=np.inf).at(time_s).position
    return NavigationTrack(
        position_time_s=positions.time_s,
        antenna_in_geo=enu_from_ecef(positions.position, origin),
        sigma_m=positions.sigma_m,
        attitude_time_s=attitudes.time_s,
        geo_from_body=geo_from_enu_at(lla_from_ecef(antenna_in_ecef), origin) @ attitudes.rotation,
        image=np.array(recorded.images, dtype=np.str_),
        image_time_s=recorded.image_time_s,
        cam_from_body=mounts,
        antenna_in_body=arms,
        nominal_from_cam=recorded.rig.nominal_from_cam,
        time_offset_s=np.array(recorded.time_offset_s),
        max_gap_s=np.array(positions.max_gap_s),
        body_known=np.array(recorded.body_known),
    )


def gap_limit(time_s: FloatArray, options: IngestOptions) -> float:
    """Return the longest gap in s to interpolate over between samples at times (K,): --max-gap, or by their rate.

    A sample may be missing, and stamps jitter: the limit is two and a half usual intervals, and at least a second.
    """
    if options.max_gap is not None:
        return options.max_gap
    known = time_s[np.isfinite(time_s)]
    if len(known) < 2:
        return _LEAST_GAP_S
    apart_s = np.diff(np.sort(known))
    usual_s = float(np.median(apart_s))
    slow_s = float(np.quantile(apart_s, 0.9))  # of a logger that writes in bursts, or at two rates
    return max(_LEAST_GAP_S, _GAP_STEPS * usual_s, 1.25 * slow_s if slow_s < _MOST_BURST * usual_s else 0.0)


def along_track(recorded: Trajectory, time_s: FloatArray, sigmas_s: Sequence[FloatArray]) -> FloatArray:
    """Return σ vectors (N, 3, 3) at times (N,) with two σ (N,) of a trajectory, as `ImagePoses.along_track_m`."""
    ends = [recorded.at(time_s + side * _HALF_WINDOW_S).position for side in (-1.0, 0.0, 1.0)]
    slopes = ((ends[2] - ends[0]) / 2.0, ends[2] - ends[1], ends[1] - ends[0])
    velocity = np.full_like(ends[1], np.nan)
    for slope in slopes:
        velocity = np.where(complete(velocity)[:, None], velocity, slope / _HALF_WINDOW_S)
    along = [np.nan_to_num(velocity * sigma_s[:, None]) for sigma_s in sigmas_s]
    return np.stack([*along, recorded.chord_error(time_s, _LEAST_GAP_S)], axis=1)


def require_enough(count: int, source: Path, field: str, remarks: Remarks) -> None:
    """Refuse fewer photographs than a survey needs, with everything that was noted on the way."""
    if count < LEAST_IMAGES:
        reasons = "".join(f" {warning.sentence}" for warning in remarks.warnings)
        raise InputError(
            "too-few-images",
            f"{count} images are usable, at least {LEAST_IMAGES} are needed.{reasons}",
            remedy=" ".join(filter(None, (warning.remedy for warning in remarks.warnings))),
            path=source,
            field=field,
        )


def given_rig(options: IngestOptions) -> Rig:
    """Return mount, lever arm (metres, in body) and boresight as the options state them, None where they do not."""
    return Rig(
        cam_from_body=None if options.camera_mount is None else mount(options.camera_mount),
        antenna_in_body=None if options.lever_arm is None else np.array(options.lever_arm),
        nominal_from_cam=exp_so3(np.radians(options.boresight)),
    )


def body_mount(rig: Rig) -> FloatArray:
    """Return the mount (3, 3); where none is stated, the camera's nominal axes stand for the body's."""
    return np.eye(3) if rig.cam_from_body is None else rig.cam_from_body


def at_cameras(poses: ImagePoses, rig: Rig, names: Sequence[str], remarks: Remarks) -> ImagePoses:
    """Bring positions of the antenna to the camera, and attitudes of the nominal camera to the true one.

    Raises:
        InputError: a lever arm without the mount, whose axes it is given in.
    """
    if rig.antenna_in_body is not None and rig.cam_from_body is None:
        raise InputError(
            "mount-missing",
            "--lever-arm is given in the axes of the body.",
            field="--lever-arm",
            remedy="Give these with --camera-mount YAW,PITCH,ROLL.",
        )
    mounted = replace(rig, cam_from_body=body_mount(rig))
    enu_from_body = poses.enu_from_cam @ body_mount(rig)
    position_in_ecef, enu_from_cam = camera_poses(poses.position_in_ecef, enu_from_body, mounted, names, remarks)
    return replace(poses, position_in_ecef=position_in_ecef, enu_from_cam=enu_from_cam)


def camera_poses(
    antenna_in_ecef: FloatArray, enu_from_body: FloatArray, rig: Rig, names: Sequence[str], remarks: Remarks
) -> tuple[FloatArray, FloatArray]:
    """Return camera centres in ECEF (N, 3) and attitudes camera → East-North-Up (N, 3, 3), NaN where unknown.

    A position that a lever arm would move, but without an attitude to move it by, is left out and noted. The
    antenna's places are ECEF (N, 3), and the body's attitudes (N, 3, 3) against north and up there.
    """
    # With the antenna at zero, its own East-North-Up is a Cartesian frame that needs no place on Earth.
    offset_in_enu, enu_from_cam = with_rig(np.zeros_like(antenna_in_ecef), enu_from_body, rig)
    located = complete(antenna_in_ecef)
    lost = np.flatnonzero(located & ~complete(offset_in_enu))
    remarks.warn_counted(
        "attitude-missing",
        [names[row] for row in lost.tolist()],
        "Positions without an attitude to apply the lever arm with are left out",
    )
    ecef_from_enu = ecef_from_enu_rotation(lla_from_ecef(antenna_in_ecef[located]))
    position_in_ecef = antenna_in_ecef.copy()
    position_in_ecef[located] += np.einsum("nij,nj->ni", ecef_from_enu, offset_in_enu[located])
    return position_in_ecef, enu_from_cam

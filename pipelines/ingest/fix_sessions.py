"""Sessions of fixes that share one error, of a base station, a receiver or a day, and the σ of that error."""

from __future__ import annotations

import numpy as np

from pipelines.core.types import FloatArray, IntArray
from pipelines.ingest.image_poses import ImagePoses, SigmaSource
from pipelines.ingest.notes import Notes
from pipelines.ingest.options import IngestOptions
from pipelines.ingest.position_sigma import RECEIVERS
from pipelines.scene.survey import FixSession

# σ of the common error horizontal and vertical in metres, by kind of receiver. No file tells it: the σ in files are
# those of single positions against the base station, not of the base station itself.
COMMON_SIGMA_M = {
    "RTK fixed": (0.03, 0.05),
    "RTK float": (0.3, 0.6),
    "single-frequency": (1.5, 3.0),
    "unknown receiver": (2.0, 4.0),
}
# Gap in time after which the base station may stand elsewhere, and the satellites do.
SESSION_GAP_S = 4 * 3600.0
# Median σ, horizontal, up to which a receiver that does not tell its solution has had one of that kind.
_FIXED_SIGMA_M, _FLOAT_SIGMA_M = 0.1, 1.0


def fix_sessions(
    poses: ImagePoses, options: IngestOptions, notes: Notes
) -> tuple[tuple[FixSession, ...], IntArray]:
    """Return the sessions, and the session of each of N images (N,), 0 for images without a position.

    Positions of one kind of receiver form a session as long as none comes more than four hours after the one before
    it. Where the time of one is unknown, all of its kind form one session: a session too many would count as an
    independent check of a common error.

    Args:
        poses: measured, of the N images.
        options: σ that the user gave.
        notes: the defaults that were assumed.
    """
    sessions: list[FixSession] = []
    session_of = np.zeros(len(poses.receivers), dtype=np.int64)
    located, sigma_h_m = poses.located, poses.sigma_enu_m[:, :2].max(axis=1)
    for receiver in RECEIVERS:
        rows = np.flatnonzero(located & (np.array(poses.receivers) == receiver))
        by_time = _by_time(poses.time_s[rows])
        session_of[rows] = len(sessions) + by_time
        for number in np.unique(by_time):
            kind = _kind(receiver, float(np.median(sigma_h_m[rows[by_time == number]])))
            sessions.append(_session(kind, options))
    counts = np.bincount(session_of[located], minlength=len(sessions))
    for kind in COMMON_SIGMA_M:
        of_kind = sum(
            int(count) for session, count in zip(sessions, counts, strict=True) if session.receiver == kind
        )
        if of_kind:
            _note_default(kind, of_kind, options, notes)
    return tuple(sessions), session_of


def _by_time(time_s: FloatArray) -> IntArray:
    session = np.zeros(len(time_s), dtype=np.int64)
    if np.isfinite(time_s).all():
        order = np.argsort(time_s, kind="stable")
        session[order[1:]] = np.cumsum(np.diff(time_s[order]) > SESSION_GAP_S)
    return session


def _kind(receiver: str, sigma_h_m: float) -> str:
    """Return the kind of receiver of a session: as recorded, or better where its σ tells of corrections.

    Programs that write corrected positions into photographs leave the other tags as they were. Decimetres do not
    tell a float solution from code corrections, whose common error is that of a plain receiver.
    """
    if receiver in ("RTK fixed", "RTK float"):
        return receiver
    if sigma_h_m <= _FIXED_SIGMA_M:
        return "RTK fixed"
    return "RTK float" if receiver == RECEIVERS[-1] and sigma_h_m <= _FLOAT_SIGMA_M else receiver


def _session(kind: str, options: IngestOptions) -> FixSession:
    horizontal_m, vertical_m = COMMON_SIGMA_M[kind]
    given_h, given_v = options.sigma_common_h, options.sigma_common_v
    h_m, v_m = horizontal_m if given_h is None else given_h, vertical_m if given_v is None else given_v
    overridden = given_h is not None or given_v is not None
    source: SigmaSource = "option" if overridden else "default"
    return FixSession(receiver=kind, sigma_common_m=(h_m, h_m, v_m), sigma_source=source)


def _note_default(kind: str, count: int, options: IngestOptions, notes: Notes) -> None:
    horizontal_m, vertical_m = COMMON_SIGMA_M[kind]
    defaults = {
        "--sigma-common-h": f"{horizontal_m:g} m horizontal",
        "--sigma-common-v": f"{vertical_m:g} m vertical",
    }
    if options.sigma_common_h is not None:
        del defaults["--sigma-common-h"]
    if options.sigma_common_v is not None:
        del defaults["--sigma-common-v"]
    if defaults:
        notes.assume(
            f"σ of the error that the positions of a session share ({count}): {', '.join(defaults.values())} "
            f"({kind}); state yours with {' and '.join(defaults)}"
        )

"""Options of `georef calibrate`, `georef geolocate` and `georef init-sim3`."""

from typing import Annotated, Literal, get_args

from pydantic import Field

from pipelines.core.options import WRITTEN, StageOptions, from_text, listed_names
from pipelines.survey.survey import RigParameters

# Systematic errors to be estimated beside the common error of the fixes.
EstimatedErrorName = Literal["lever-arm", "boresight"]


EstimatedErrorNames = Annotated[
    tuple[EstimatedErrorName, ...],
    from_text(lambda text: () if text == "none" else listed_names(text, get_args(EstimatedErrorName), "; or none")),
    WRITTEN,
]


class CalibrateOptions(StageOptions):
    """Options of the calibration of the rig: parameters to estimate, and parameters to apply.

    After sfm, the track of the cameras is fitted to the navigation that ingest recorded from a bag or a trajectory
    by time. Each parameter is stated with its σ. A parameter that the flight does not determine is reported as not
    observable, and is not applied. Parameters requested in ingest (--time-offset auto, --estimate) are applied to
    the positions and attitudes of later stages; other parameters only with --apply. The survey itself stays as
    recorded.

    Positions by photograph, of EXIF or a table with image names, are tested for a lag against the exposures, which
    is applied where lines in two directions show it; --no-apply leaves them as they are.

    Examples:
      georef calibrate flight
      georef calibrate flight --estimate time-offset --max-offset 5
      georef calibrate flight --estimate time-offset,boresight,lever-arm --apply
    """

    estimate: RigParameters | None = Field(
        None,
        description="Any of time-offset, boresight and lever-arm, with commas (default: those that ingest "
        "was to estimate).",
    )
    max_offset: float = Field(
        2.0, gt=0, le=60, description="Search for the time offset up to so many seconds from the present one."
    )
    apply: bool | None = Field(
        None,
        description="Apply all observable estimates, or none (default: those that ingest was to estimate).",
    )


class GeolocateOptions(StageOptions):
    """Options of the forward intersection of every SfM point in the frame `geo`.

    Each point gets its own position, covariance, number of rays and intersection angle.

    Examples:
      georef geolocate flight
      georef geolocate flight --attitude sfm --min-angle 2
    """

    attitude: Literal["auto", "recorded", "sfm"] = Field(
        "auto", description="Rotations of the rays: recorded with the images, or SfM's aligned to geo."
    )
    sigma_px: float = Field(0.7, gt=0, description="σ of an image observation in pixels.")
    min_angle: float = Field(1.0, gt=0, lt=90, description="Least intersection angle of an inlier in degrees.")
    max_sigma: float | None = Field(
        None, gt=0, description="Largest σ along any axis of an inlier, in metres (default: no limit)."
    )


class InitSim3Options(StageOptions):
    """Options of the similarity from the SfM model into the frame `geo`.

    The default is robust and weighted by the covariances of the measurements; --method paper is the plain
    least-squares estimate.

    Examples:
      georef init-sim3 flight
      georef init-sim3 flight --method paper
      georef init-sim3 flight --max-residual 5
    """

    method: Literal["robust", "paper"] = Field(
        "robust", description="robust: RANSAC and weights from covariances; paper: plain least squares."
    )
    max_residual: float | None = Field(
        None, gt=0, description="Fail if the RMS residual of the camera centres is larger, in metres."
    )
    control_points: bool = Field(True, description="Use the control points.")
    estimate: EstimatedErrorNames = Field(
        (),
        description="Systematic errors to estimate beside the common error of the positions: lever-arm, boresight, "
        "with a comma; or none.",
    )
    up: Literal["plane", "photographs"] = Field(
        "plane",
        description="Vertical of a local frame without recorded attitudes: square to the plane of the cameras, or "
        "the mean upward direction of the photographs, as for a facade.",
    )
    seed: int = Field(0, ge=0, description="Seed of the RANSAC.")
    accept_inconsistency: bool = Field(
        False, description="Go on where sources are inconsistent, with a caution and larger σ."
    )

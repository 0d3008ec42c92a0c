"""Options of `georef calibrate`, `georef geolocate` and `georef init-sim3`."""

from typing import Literal

from pydantic import Field

from pipelines.core.options import StageOptions


class CalibrateOptions(StageOptions):
    """Options of the calibration of the rig: search of the time offset, and whether what is found is applied.

    After sfm, the track of the cameras is fitted to the navigation that ingest recorded from a bag or a trajectory
    by time. This gives the time offset (ingest's --time-offset auto), and where boresight or lever arm are to be
    solved (ingest's --estimate) the values that init-sim3 starts from. Each is stated with its σ. A parameter that
    the flight does not determine is reported as not observable, and is not applied. The others are applied to the
    positions and attitudes of later stages. The survey itself stays as recorded.

    Positions by photograph, of EXIF or a table with image names, are tested for a lag against the exposures, which
    is applied where lines in two directions show it; --no-apply leaves them as they are.

    Examples:
      georef calibrate flight
      georef calibrate flight --max-offset 5
      georef calibrate flight --no-apply
    """

    max_offset: float = Field(
        2.0, gt=0, le=60, description="Search for the time offset up to so many seconds from the present one."
    )
    apply: bool = Field(True, description="Apply what is observable to positions and attitudes.")


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
    up: Literal["plane", "photographs"] = Field(
        "plane",
        description="Vertical of a local frame without recorded attitudes: square to the plane of the cameras, or "
        "the mean upward direction of the photographs, as for a facade.",
    )
    seed: int = Field(0, ge=0, description="Seed of the RANSAC.")
    accept_inconsistency: bool = Field(
        False, description="Go on where sources are inconsistent, with a caution and larger σ."
    )

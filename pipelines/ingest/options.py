"""Options of `georef ingest`; those that exclude each other are refused before anything is read."""

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from pydantic import AfterValidator, Field

from pipelines.core.errors import InputError
from pipelines.core.options import (
    WRITTEN,
    InputMarker,
    InputPath,
    PlaceOnEarth,
    StageOptions,
    Triple,
    flag_name,
    from_text,
)
from pipelines.formats.image_file import HEIF_SUFFIXES, SUFFIXES
from pipelines.geodesy.vertical import Vertical
from pipelines.survey.survey import MountParameters, RigParameter, in_usual_order

ALL_SENSORS = "all"  # of --sensor: the lenses that expose together


@dataclass(frozen=True)
class Every:
    """Distance between frames, in seconds or in metres flown."""

    step: float
    unit: Literal["s", "m"]

    def __str__(self) -> str:
        return f"{self.step:g}{self.unit}"


def _every(text: str) -> Every:
    match = re.fullmatch(r"\s*(\d+(?:\.\d*)?|\.\d+)\s*([sm])\s*", text)
    if match is None or float(match[1]) <= 0:
        raise ValueError(f"{text!r} is neither seconds nor metres: give e.g. 2s or 5m")
    return Every(float(match[1]), "s" if match[2] == "s" else "m")


def _sensible(offset: float | Literal["auto"]) -> float | Literal["auto"]:
    if offset != "auto" and not abs(offset) < 1e6:
        raise ValueError("a number of seconds, or auto")
    return offset


def _known_dictionaries(names: tuple[str, ...]) -> tuple[str, ...]:
    from pipelines.formats.fiducials import dictionary_named  # OpenCV, which no other option needs

    known = []
    for name in names:
        spelled = dictionary_named(name.strip())
        if spelled is None:
            raise ValueError(
                f"{name!r} is no dictionary of OpenCV's: give e.g. DICT_APRILTAG_36h11, DICT_4X4_50, "
                "DICT_ARUCO_ORIGINAL"
            )
        known.append(spelled)
    return tuple(dict.fromkeys(known))


# Files of other kinds beside the photographs, such as thumbnails and logs, make nothing stale.
PhotographFolder = Annotated[Path, InputMarker(SUFFIXES | HEIF_SUFFIXES)]
GroundPointsPath = Annotated[Path, InputMarker(beside=((".opf", ("**/*.json",)),))]
MaskFolder = Annotated[Path, InputMarker(frozenset({".png"}))]
FrameDistance = Annotated[Every, from_text(_every), WRITTEN]
TimeOffset = Annotated[
    float | Literal["auto"],
    from_text(lambda text: text if text == "auto" else float(text)),
    AfterValidator(_sensible),
    WRITTEN,
]

TagDictionaries = Annotated[
    tuple[str, ...], from_text(lambda text: tuple(text.split(","))), AfterValidator(_known_dictionaries), WRITTEN
]


class IngestOptions(StageOptions):
    """What `georef ingest` reads, and what it assumes where the files are silent.

    Positions come from the photographs' EXIF and XMP, or from a trajectory (CSV, RTKLIB, DJI, Metashape) or an ODM
    geo.txt; or photographs and positions come from a ROS bag. Photographs in a folder are referenced where they
    are, unless --copy. Check points never enter any solve. Points without marks are listed for marking later.

    Examples:
      georef ingest flight --images photos
      georef ingest flight --images photos --gcp gcp_list.txt --check P7 --check P9
      georef ingest flight --images photos --trajectory track.csv --crs EPSG:32632 --vertical EGM2008
      georef ingest flight --images photos --trajectory flight_Timestamp.MRK --gcp markers.xml
      georef ingest flight --images photos --gcp gcps.csv --gcp-crs EPSG:2056+5728 --marks marks.csv
      georef ingest flight --bag flight_bag --every 5m --camera-mount 0,-90,0
      georef ingest flight --images photos --geo geo.txt --checkpoints checkpoints.txt --test-every 10
    """

    images: PhotographFolder | None = Field(None, description="Folder of photographs.")
    sensor: str | None = Field(
        None,
        description="Sensor whose photographs are used, where the folder holds several: visible, wide, zoom, "
        "thermal, or a band such as green, red, red-edge, nir (default: a visible one); all, of a bag too: those "
        "that were exposed together with it, too, as a rig.",
    )
    rig: InputPath | None = Field(
        None,
        description="COLMAP's rig_config.json: prefixes of the names of photographs that several lenses exposed "
        "together. The rig has one pose at each instant; the splat is trained from the reference lens.",
    )
    bag: InputPath | None = Field(
        None, description="ROS bag with photographs and navigation: rosbag2 folder, .mcap, .db3 or ROS 1 .bag."
    )
    video: InputPath | None = Field(
        None,
        description="Video to take photographs from: the sharpest frame of every --every (default: 1s). Positions "
        "come from DJI's .SRT beside it, or from a GoPro's telemetry in it.",
    )
    image_topic: str | None = Field(None, description="Topic of the photographs in the bag (default: by rule).")
    fix_topic: str | None = Field(None, description="Topic of the positions in the bag (default: by rule).")
    attitude_topic: str | None = Field(None, description="Topic of the attitudes in the bag (default: by rule).")
    every: FrameDistance | None = Field(
        None,
        description="Take a frame of the bag every 2s, or every 5m flown (default: all); of a video, every 2s.",
    )
    skip_blurred: bool = Field(
        False,
        description="Leave out photographs, and frames of a bag, that are less than half as sharp as those around.",
    )
    ground_height: float | None = Field(
        None,
        description="Height of the terrain in metres, above the datum of --vertical, else the ellipsoid: cameras "
        "below it or far above it are a caution.",
    )
    origin: PlaceOnEarth | None = Field(
        None,
        description="Zero of a bag's local frame (odometry, poses): latitude,longitude,ellipsoidal height.",
    )
    time_offset: TimeOffset = Field(
        0.0, description="Navigation clock minus camera clock in seconds; auto: estimate it after sfm."
    )
    estimate: MountParameters = Field(
        (),
        description="Solve boresight, lever-arm or both (with a comma) in the adjustment, beside cameras and "
        "positions; what the flight does not show enlarges the predicted σ.",
    )
    lever_arm: Triple | None = Field(
        None,
        description="Antenna from the camera along the body's axes, forward,right,down in metres (default: /tf).",
    )
    camera_mount: Triple | None = Field(
        None,
        description="Rotation of the camera in the body, yaw,pitch,roll in degrees; 0,-90,0 looks down "
        "(default: /tf).",
    )
    boresight: Triple = Field(
        (0.0, 0.0, 0.0), description="Rotation vector from the true to the nominal camera axes, x,y,z in degrees."
    )
    trajectory: InputPath | None = Field(
        None,
        description="Positions: CSV with a header, RTKLIB's .pos, DJI's .MRK, or Metashape's reference; the "
        "content decides.",
    )
    events: InputPath | None = Field(
        None, description="DJI's .MRK beside a trajectory by time: times and antenna offsets of the photographs."
    )
    geo: InputPath | None = Field(None, description="ODM geo.txt with the image positions.")
    gcp: GroundPointsPath | None = Field(
        None,
        description="Ground control points: ODM's gcp_list.txt, Metashape's markers (XML) or reference, PIX4D's "
        "CSV, or an OPF project; the content decides.",
    )
    checkpoints: GroundPointsPath | None = Field(None, description="Check points, in any form of --gcp.")
    marks: InputPath | None = Field(
        None, description="PIX4D's CSV of image marks: image, point, x, y; for points whose file has none."
    )
    marks_as_shown: bool = Field(
        False,
        description="Marks were made on photographs turned as EXIF's orientation says, as browsers and most "
        "programs show them.",
    )
    targets: TagDictionaries | None = Field(
        None,
        description="Dictionaries (with commas, named as by OpenCV: DICT_APRILTAG_36h11, DICT_4X4_50) of ArUco or "
        "AprilTag targets, which are found in the photographs as marks of the points that have their numbers.",
    )
    distances: InputPath | None = Field(
        None,
        description="Measured distances between marked points, as of scale bars: CSV with from, to, distance, and "
        "optionally sigma and use (control or check). Without positions and ground points: a local metric frame.",
    )
    gcp_crs: str | None = Field(
        None, description="CRS of ground points whose file states none, e.g. EPSG:32632 or EPSG:4326+5773."
    )
    check: tuple[str, ...] = Field((), description="Name of a control point to use as a check point instead.")
    vegetated: tuple[str, ...] = Field(
        (), description="Name of a check point under vegetation: its height is reported apart (ASPRS VVA)."
    )
    test_every: int = Field(8, ge=0, description="Hold out every N-th image for testing (0: none).")
    crs: str | None = Field(None, description="CRS of x,y,z columns in the trajectory, e.g. EPSG:32632+5773.")
    vertical: Vertical | None = Field(
        None, description="Vertical datum of the heights: ellipsoidal, EGM96, EGM2008 or EPSG:n."
    )
    sigma_h: float | None = Field(None, gt=0, description="Horizontal σ of every position in metres.")
    sigma_v: float | None = Field(None, gt=0, description="Vertical σ of every position in metres.")
    sigma_common_h: float | None = Field(
        None,
        ge=0,
        description="Horizontal σ of the error that all positions of a session share, as of their base station, in "
        "metres; 0: none (default: by receiver).",
    )
    sigma_common_v: float | None = Field(
        None, ge=0, description="Vertical σ of that error in metres; 0: none (default: by receiver)."
    )
    sigma_attitude: float | None = Field(None, gt=0, description="σ of the attitude in degrees.")
    sigma_gcp_h: float = Field(0.02, gt=0, description="Horizontal σ of surveyed points in metres.")
    sigma_gcp_v: float = Field(0.03, gt=0, description="Vertical σ of surveyed points in metres.")
    sigma_mark: float = Field(0.5, gt=0, description="σ of an image mark in pixels.")
    sigma_distance: float = Field(
        0.002, gt=0, description="σ of a distance in metres, where --distances states none."
    )
    max_gap: float | None = Field(
        None,
        gt=0,
        description="Longest gap to interpolate over in the trajectory, in seconds (default: 2.5 times its usual "
        "interval, at least 1).",
    )
    focal_px: float | None = Field(None, gt=0, description="Focal length in pixels, instead of the one from EXIF.")
    rolling_shutter: float | None = Field(
        None,
        ge=0,
        le=1,
        description="Readout time of a photograph in seconds, from its first row to its last; 0: a global or "
        "mechanical shutter (default: by camera model, else 0).",
    )
    masks: MaskFolder | None = Field(
        None,
        description="Folder of masks, each named as its photograph with .png added: black pixels are left out of "
        "sfm, surface, training and test.",
    )
    mask: InputPath | None = Field(
        None, description="Mask for every photograph, such as of the drone's own legs: black pixels are left out."
    )
    mask_sky: bool = Field(
        False, description="Leave out the sky: what is smooth and blue or white above the horizon of the attitude."
    )
    accept_inconsistency: bool = Field(
        False, description="Go on where the table of positions disagrees with EXIF, with a caution."
    )
    copy_images: bool = Field(
        False, description="Copy the photographs into the workspace.", json_schema_extra={"flag": "--copy"}
    )

    @property
    def time_offset_s(self) -> float:
        """Seconds; zero while the offset is still to be estimated."""
        return 0.0 if self.time_offset == "auto" else self.time_offset

    @property
    def estimated(self) -> tuple[RigParameter, ...]:
        """Parameters of the rig that are to be estimated after sfm, in the usual order."""
        return in_usual_order((*self.estimate, *(("time-offset",) if self.time_offset == "auto" else ())))


_BAG_ONLY = ("image_topic", "fix_topic", "attitude_topic", "every", "origin")
_BESIDE_VIDEO = ("images", "bag", "geo", "events", "sensor", "rig")  # what --video excludes


def check_options(options: IngestOptions, frames: Path | None) -> None:
    """Refuse options that make no survey; photographs of a bag need a place, `frames`, to be written to."""
    if options.bag is not None:
        _check_bag(options, frames)
    else:
        for name in _BAG_ONLY:
            if getattr(options, name) is not None and not (name == "every" and options.video is not None):
                flag = flag_name(IngestOptions, name)
                raise InputError("needs-bag", f"{flag} needs a --bag, which is not given.", field=flag)
    if options.video is not None:
        _check_video(options, frames)
    if options.trajectory is not None and options.geo is not None:
        raise InputError(
            "two-position-files",
            "--trajectory and --geo are both given.",
            field="--geo",
            remedy="Remove one of them.",
        )
    if options.crs is not None and options.trajectory is None:
        raise InputError(
            "crs-without-trajectory",
            "--crs is for the x,y,z columns of --trajectory; other files state their CRS.",
            field="--crs",
            remedy="Remove --crs.",
        )
    if options.events is not None and (options.trajectory is None or options.lever_arm is not None):
        raise InputError(
            "events-need-antenna-track",
            "--events needs the antenna's --trajectory with times, and has the lever arm itself.",
            field="--events",
            remedy=(
                "Give --trajectory, and remove --lever-arm. A .MRK without a trajectory is given by --trajectory."
            ),
        )
    for name in ("marks", "targets", "gcp_crs", "marks_as_shown"):
        needed = (options.gcp, options.checkpoints, options.distances if name != "gcp_crs" else None)
        if getattr(options, name) not in (None, False) and not any(needed):
            flag = flag_name(IngestOptions, name)
            raise InputError(
                "needs-ground-points",
                f"{flag} needs ground points.",
                field=flag,
                remedy="Give --gcp or --checkpoints.",
            )
    if options.check and options.gcp is None:
        raise InputError("check-without-gcp", "--check names points of --gcp, which is not given.", field="--check")
    if options.test_every == 1:
        raise InputError(
            "nothing-to-train-on",
            "--test-every 1 leaves no image to train on.",
            field="--test-every",
            remedy="Give 0, or 2 and more.",
        )


def _check_video(options: IngestOptions, frames: Path | None) -> None:
    if frames is None:
        raise InputError(
            "video-without-workspace", "A video needs a workspace for its photographs.", field="--video"
        )
    for name in _BESIDE_VIDEO:
        if getattr(options, name) is not None:
            flag = flag_name(IngestOptions, name)
            raise InputError("video-and-other-source", f"{flag} and --video exclude each other.", field="--video")


def _check_bag(options: IngestOptions, frames: Path | None) -> None:
    if frames is None:
        raise InputError("bag-without-workspace", "A bag needs a workspace for its photographs.", field="--bag")
    if options.crs is not None:
        raise InputError(
            "crs-with-bag",
            "A --bag has latitude, longitude and ellipsoidal height, or metres from --origin.",
            field="--crs",
            remedy="Remove --crs.",
        )
    beside = [
        name
        for name in ("images", "sensor", "rig", "trajectory", "geo", "events")
        if getattr(options, name) not in (None, ALL_SENSORS if name == "sensor" else None)
    ]
    if beside:
        flag = flag_name(IngestOptions, beside[0])
        hint = " --image-topic chooses a camera." if beside[0] == "sensor" else ""
        raise InputError(
            "bag-and-other-source",
            "A --bag already has photographs and positions.",
            field="--bag",
            remedy=f"Remove {flag}.{hint}",
        )

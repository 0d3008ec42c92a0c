"""Simulate a survey whose truth is known exactly.

Reads: nothing. Writes a survey folder, not a workspace: `images/`, `trajectory.csv`, `gnss.csv`, `imu.csv`,
`gcp_list.txt`, `checkpoints.txt`, `truth.json`; on request `depth/`, `bag/`, `lidar.laz` and
`lidar_trajectory.csv`; of a second epoch `heights.npz` (docs/simulator.md).
"""

import logging
import shutil
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import shapely

from pipelines.core.errors import InputError
from pipelines.core.extras import require
from pipelines.core.files import remove, replace_folder, sync_tree
from pipelines.core.machine import chosen_threads
from pipelines.core.products import Remark, save_json
from pipelines.core.progress import SILENT, Progress
from pipelines.core.types import vector3
from pipelines.formats.bag_writer import BagCamera, BagFlight, write_bag
from pipelines.formats.exif_writer import DroneTags, with_tags
from pipelines.simulate.flight import in_local_enu
from pipelines.simulate.lens import Renderer, Sensor
from pipelines.simulate.lidar import LidarFlight, lidar_files
from pipelines.simulate.mesh import Raycaster
from pipelines.simulate.options import SimulateOptions
from pipelines.simulate.recording import Recording, record, write_tables
from pipelines.simulate.scene import SimulatedScene, build_scene
from pipelines.simulate.truth import TrueChange, TrueLidar, TrueRegion
from pipelines.simulate.world import WANTED_RAYS, World, check_clearance, make_world

log = logging.getLogger(__name__)

TRUTH = "truth.json"
TRUE_HEIGHTS = "heights.npz"
WANTED_CHECKS = 30
_TRUE_REACH_M, _TRUE_CELL_M, _TRUE_SKY_M = 80.0, 0.25, 150.0  # of the true heights


@dataclass(frozen=True)
class SimulationSummary:
    """Summary of a simulation; `well_seen` counts the check points with at least 6 marks."""

    directory: Path
    images: int
    control_points: int
    check_points: int
    well_seen: int
    bag_messages: int
    warnings: tuple[Remark, ...]

    @property
    def key_figure(self) -> str:
        return f"{self.images} photographs, {self.control_points} control and {self.check_points} check points"


@dataclass(frozen=True)
class RecordedFlight:
    """Flight over a world with all records, without the photographs."""

    world: World
    renderer: Renderer
    recording: Recording
    photo_seed: np.random.SeedSequence
    lidar_seed: np.random.SeedSequence


def fly_survey(options: SimulateOptions) -> RecordedFlight:
    """Make the world of these options, fly over it and record, without photographs.

    World, flight and noise of the photographs have random numbers apart from those of the records: options that
    differ in the receiver alone give the same flight.

    Raises:
        InputError: the options cannot be flown or photographed.
        BackendUnavailableError: the ray caster is not installed.
    """
    world_seed, *flight_seeds = np.random.SeedSequence(options.seed).spawn(4)
    if options.epoch == "2":
        flight_seeds = [seed.spawn(1)[0] for seed in flight_seeds]
    record_seed, photo_seed, lidar_seed = flight_seeds
    world = make_world(options, world_seed)
    renderer = Renderer(world.scene, world.lens, int(options.samples), rolling=options.rolling_shutter > 0)
    check_clearance(world, renderer.raycaster)
    recording = record(options, world, renderer.raycaster, record_seed)
    return RecordedFlight(world, renderer, recording, photo_seed, lidar_seed)


def simulate(
    options: SimulateOptions, directory: Path, progress: Progress = SILENT, *, overwrite: bool = False
) -> SimulationSummary:
    """Simulate a survey into `directory`, which appears when complete; see `fly_survey` for further errors.

    The same options give the same bytes. `overwrite` allows replacing an earlier simulation, and no other folder.

    Raises:
        BackendUnavailableError: `--bag` without rosbags.
        InputError: the folder is in use.
    """
    _check_folder(directory, overwrite=overwrite)
    if options.bag != "none":
        require("bags")
    flight = fly_survey(options)
    recording = flight.recording
    with _draft(directory) as draft:
        _write_photographs(options, flight, draft, progress)
        truth = recording.truth
        if options.lidar:
            truth = truth.model_copy(update={"lidar": write_lidar_flight(options, flight, draft, progress)})
        if options.epoch == "2":
            truth = truth.model_copy(update={"change": _write_change(options, flight.world.scene, draft)})
        save_json(truth, draft / TRUTH)
        messages = _write_records(options, flight.world, recording, draft)
    check = [target for target in recording.truth.targets if target.role == "check"]
    control, well_seen = len(truth.targets) - len(check), sum(len(target.marks) >= WANTED_RAYS for target in check)
    summary = SimulationSummary(
        directory=directory,
        images=options.images,
        control_points=control,
        check_points=len(check),
        well_seen=well_seen,
        bag_messages=messages,
        warnings=_warnings(options, well_seen, control),
    )
    for warning in summary.warnings:
        log.warning("simulate: %s", warning.text)
    log.info("simulate: %s", summary.key_figure)
    return summary


def _write_change(options: SimulateOptions, scene: SimulatedScene, folder: Path) -> TrueChange:
    """Write the heights of both epochs, without targets, as `heights.npz`, and return the change between them."""
    world_seed = np.random.SeedSequence(options.seed).spawn(1)[0]
    first = build_scene(options.scene, world_seed.spawn(1)[0])
    side = round(2 * _TRUE_REACH_M / _TRUE_CELL_M)
    line = (np.arange(side) + 0.5) * _TRUE_CELL_M - _TRUE_REACH_M
    x, y = (axis.ravel() for axis in np.meshgrid(line, line))
    start = np.stack([x, y, np.full(len(x), _TRUE_SKY_M)], axis=1)
    down = np.broadcast_to([0.0, 0.0, -1.0], start.shape)
    before, after = (
        _TRUE_SKY_M - Raycaster(one.mesh).first_hits(start, down).distance.astype(np.float64)
        for one in (first, scene)
    )
    np.savez_compressed(folder / TRUE_HEIGHTS, before=before.reshape(side, side), after=after.reshape(side, side))
    regions = []
    for change in scene.changes:
        inside = shapely.contains_xy(shapely.Polygon(change.outline), x, y)
        risen = (after - before)[inside] * _TRUE_CELL_M**2
        regions.append(
            TrueRegion(
                kind=change.kind,
                outline=tuple((float(east), float(north)) for east, north in change.outline),
                cut_m3=float(-np.minimum(risen, 0.0).sum()),
                fill_m3=float(np.maximum(risen, 0.0).sum()),
            )
        )
    return TrueChange(corner=(-_TRUE_REACH_M,) * 2, cell_m=_TRUE_CELL_M, regions=tuple(regions))


def _check_folder(directory: Path, *, overwrite: bool) -> None:
    """Raise an InputError before the work begins if `directory` exists and may not be replaced."""
    if not directory.exists():
        return
    if not directory.is_dir():
        raise InputError("not-a-folder", "The path exists and is not a folder.", path=directory)
    if any(directory.iterdir()):
        if not (directory / TRUTH).exists():
            raise InputError(
                "folder-not-empty",
                "The folder holds something other than a simulation.",
                path=directory,
                remedy="Choose another.",
            )
        if not overwrite:
            raise InputError(
                "simulation-exists",
                "The folder already holds a simulation.",
                path=directory,
                remedy="--force replaces it.",
            )


def write_lidar_flight(
    options: SimulateOptions, flight: RecordedFlight, folder: Path, progress: Progress = SILENT
) -> TrueLidar:
    """Write the cloud of a LiDAR flight over the world of a survey, and the scanner's track; return the truth."""
    lidar = LidarFlight(options, flight.world.scene, flight.lidar_seed)
    with lidar_files(folder, flight.world.origin) as write, progress.task("lidar") as task:
        for strip in lidar.strips():
            write(strip)
            task.advance()
    return lidar.truth()


@contextmanager
def _draft(directory: Path) -> Iterator[Path]:
    """Yield a folder that becomes `directory` on success, and vanishes otherwise."""
    draft = directory.with_name(f".{directory.name}.partial")
    old = directory.with_name(f".{directory.name}.old")
    for leftover in (draft, old):
        remove(leftover)
    try:
        draft.mkdir(parents=True)
    except OSError as error:
        raise InputError(
            "folder-not-made", f"The folder cannot be made: {error.strerror}.", path=directory
        ) from error
    try:
        yield draft
        sync_tree(draft)
        replace_folder(draft, directory, old)
    finally:
        for leftover in (draft, old):
            shutil.rmtree(leftover, ignore_errors=True)


def _write_photographs(options: SimulateOptions, flight: RecordedFlight, folder: Path, progress: Progress) -> None:
    """Write all photographs, and depth maps on request, several at a time.

    Each photograph has its own stream of noise, whatever the order.
    """
    count, rng = options.images, np.random.default_rng(flight.photo_seed)
    (folder / "images").mkdir()
    if options.depth:
        (folder / "depth").mkdir()
    gains = 1.1 * np.exp(rng.normal(0, options.exposure, count))
    tints = np.exp(rng.normal(0, options.white_balance, (count, 3)))
    sensors = [
        Sensor(float(gain), vector3(tint), options.noise, options.vignetting)
        for gain, tint in zip(gains, tints, strict=True)
    ]
    streams = rng.spawn(count)

    def write(i: int) -> None:
        pose, name = flight.world.poses[i], flight.recording.photos.names[i]
        rgb = flight.renderer.photograph(pose, sensors[i], streams[i])
        _, encoded = cv2.imencode(".jpg", rgb[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, options.quality])
        jpeg = encoded.tobytes()
        if options.exif:
            jpeg = with_tags(jpeg, _tags(options, flight.world, flight.recording, i))
        (folder / "images" / name).write_bytes(jpeg)
        if options.depth:
            np.save(folder / "depth" / f"{Path(name).stem}.npy", flight.renderer.depth(pose))

    with progress.task("photographs", count) as task, ThreadPoolExecutor(chosen_threads(options.threads)) as pool:
        jobs = [pool.submit(write, i) for i in range(count)]
        try:
            for job in jobs:
                job.result()
                task.advance()
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise


def _tags(options: SimulateOptions, world: World, recording: Recording, i: int) -> DroneTags:
    photos = recording.photos
    lat, lon, alt = vector3(photos.lla[i])
    return DroneTags(
        width=world.lens.width,
        height=world.lens.height,
        focal_px=world.lens.focal_px,
        stamp_ns=int(photos.stamp_ns[i]),
        lat_deg=lat,
        lon_deg=lon,
        alt_m=alt,
        relative_alt_m=alt - world.origin.alt_m,
        yaw_pitch_roll_deg=vector3(photos.yaw_pitch_roll_deg[i]),
        body_yaw_pitch_roll_deg=vector3(photos.body_yaw_pitch_roll_deg[i]),
        sigma_enu_m=None if options.gnss == "consumer" else vector3(photos.sigma_enu_m),
    )


def _write_records(options: SimulateOptions, world: World, recording: Recording, folder: Path) -> int:
    """Write tables, truth and bag; return the number of messages in the bag."""
    enu_from_body = in_local_enu(recording.imu.geo_from_body, recording.imu_in_geo, world.origin)
    write_tables(folder, recording, enu_from_body, world.origin)
    if options.bag == "none":
        return 0
    lens = world.lens
    camera = BagCamera(
        lens.width, lens.height, lens.focal_px, lens.center_px, (lens.k1, lens.k2, lens.p1, lens.p2, 0.0),
        world.trajectory.cam_from_body,
    )  # fmt: skip
    flight = BagFlight(
        camera=camera,
        image_stamp_ns=recording.photos.stamp_ns,
        image_paths=tuple(folder / "images" / name for name in recording.photos.names),
        fix_stamp_ns=recording.gnss.stamp_ns,
        fix_lla=recording.gnss_lla,
        fix_sigma_enu_m=recording.photos.sigma_enu_m,
        fix_status=0 if options.gnss == "consumer" else 2,
        antenna_in_body=world.mounting.antenna_in_body,
        imu_stamp_ns=recording.imu.stamp_ns,
        imu_enu_from_body=enu_from_body,
        imu_rate=recording.imu.rate_in_body,
        imu_force=recording.imu.specific_force_in_body,
        imu_sigma_deg=options.sigma_attitude,
    )
    return write_bag(folder / "bag", options.bag, flight)


def _warnings(options: SimulateOptions, well_seen: int, control: int) -> tuple[Remark, ...]:
    warnings = []
    if options.targets and well_seen < WANTED_CHECKS:
        sentence = f"Only {well_seen} check points are seen in {WANTED_RAYS} photographs or more."
        remedy = "Take more --images, larger ones (--size), or more --targets."
        warnings.append(Remark(code="few-check-points", sentence=sentence, remedy=remedy))
    if control < options.control:
        sentence = f"Only {control} of {options.control} control points are placed."
        remedy = "Take more --targets or --images."
        warnings.append(Remark(code="few-control-points", sentence=sentence, remedy=remedy))
    return tuple(warnings)

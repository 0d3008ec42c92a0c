"""Mapping by COLMAP: cameras and points from features and matches in a database."""

import logging
import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any, Literal

from numpy.typing import ArrayLike

from pipelines.core.machine import chosen_threads
from pipelines.core.progress import Progress
from pipelines.geometry.cameras import ColmapCamera, ColmapDatabase, Reconstruction
from pipelines.sfm.features import SfmJob
from pipelines.sfm.options import SfmOptions

log = logging.getLogger(__name__)

MapperName = Literal["incremental", "global"]

# Up to here the incremental mapper takes minutes; its time grows faster than the number of photographs.
_INCREMENTAL_UP_TO = 150
_FEWEST_IMAGES = 3
# Tracks that position each photograph in the global mapper, the longest ones. Of 400 photographs, all 98 000 tracks
# took 2.3 times as long as 9700, for the same model. The mapper's own triangulation and adjustment of the others
# take longer than all the rest.
_GLOBAL_TRACKS = 200
# Steps of its adjustment. Without positions a large model straightens slowly: those that follow have them.
_GLOBAL_STEPS = 25
# Growth of a model by which the incremental mapper adjusts it as a whole again; in between, it adjusts what is
# around each new photograph. At COLMAP's 1.1, 100 photographs take half as long again for the same model
# (examples/benchmarks/results/scale.md, "Adjustments of the incremental mapper").
_GROWTH = 1.4
_REGISTERED = 0.95  # of the photographs: if the global mapper has less, the incremental one has its turn


@dataclass(frozen=True)
class MapperRun:
    """Files and effort of a mapper; the folder `scratch` is empty, for COLMAP's own output."""

    database: Path
    images: Path
    scratch: Path
    threads: int
    seed: int
    lens_held: bool = False  # at what the database says, instead of being solved
    names: Sequence[str] = ()  # of the photographs that are mapped; none: all
    fewest: int = _FEWEST_IMAGES  # photographs of a model; two: points that two photographs alone show count


def chosen_mapper(photographs: int, options: SfmOptions) -> MapperName:
    """Return the mapper that the options name, else the one for so many photographs."""
    if options.mapper != "auto":
        return options.mapper
    return "incremental" if photographs <= _INCREMENTAL_UP_TO else "global"


def map_database(
    colmap: ModuleType, job: SfmJob, progress: Progress, *, lens_held: bool = False
) -> tuple[list[Any], MapperName]:
    """Return the models (`pycolmap.Reconstruction`) of a database with features and matches, the largest first, and
    their mapper.

    With `--mapper auto`, a global mapper that leaves out more than one photograph of twenty is followed by the
    incremental one, and the larger model counts.
    """
    count = len(job.survey.images)
    mapper = chosen_mapper(count, job.options)
    models = _models(colmap, mapper, job, progress, lens_held=lens_held)
    if mapper == "global" and job.options.mapper == "auto" and _registered(models) < _REGISTERED * count:
        log.warning(
            "The global mapper registered %d of %d photographs; the incremental mapper follows.",
            _registered(models),
            count,
        )
        others = _models(colmap, "incremental", job, progress, lens_held=lens_held)
        if _registered(others) > _registered(models):
            return others, "incremental"
    return models, mapper


def run_mapper(colmap: ModuleType, mapper: MapperName, run: MapperRun, registered: Callable[[], None]) -> list[Any]:
    """Return the models of a mapper, the largest first; those of the global mapper have few tracks.

    The incremental mapper calls `registered` when it has registered a photograph.
    """
    if mapper == "global":
        options = colmap.GlobalPipelineOptions()
        options.num_threads, options.random_seed = run.threads, run.seed
        options.mapper.track_required_tracks_per_view = _GLOBAL_TRACKS
        options.mapper.skip_retriangulation, options.mapper.ba_num_iterations = True, 1
        options.mapper.bundle_adjustment.ceres.solver_options.max_num_iterations = _GLOBAL_STEPS
        if run.lens_held:
            adjustment = options.mapper.bundle_adjustment
            adjustment.refine_focal_length = adjustment.refine_extra_params = False
        models = colmap.global_mapping(run.database, run.images, run.scratch, options)
    else:
        options = colmap.IncrementalPipelineOptions()
        options.num_threads, options.random_seed, options.min_model_size = run.threads, run.seed, run.fewest
        options.image_names = list(run.names)
        options.triangulation.ignore_two_view_tracks = run.fewest > 2
        options.ba_global_frames_ratio = options.ba_global_points_ratio = _GROWTH
        if run.lens_held:
            options.ba_refine_focal_length = options.ba_refine_extra_params = False
        models = colmap.incremental_mapping(
            run.database, run.images, run.scratch, options, next_image_callback=registered
        )
    size = [(model.num_reg_images(), model.num_points3D(), model) for model in models.values()]
    return [model for *_, model in sorted(size, key=lambda row: row[:2], reverse=True)]


def _models(
    colmap: ModuleType, mapper: MapperName, job: SfmJob, progress: Progress, *, lens_held: bool
) -> list[Any]:
    title = "global mapping" if mapper == "global" else "mapping"
    title += ", lens held" if lens_held else ""
    with progress.task(title, len(job.survey.images)) as task, scratch_beside(job.database) as scratch:
        threads = chosen_threads(job.options.threads)
        run = MapperRun(job.database, job.images, scratch, threads, job.options.seed, lens_held)
        models = run_mapper(colmap, mapper, run, lambda: task.advance(1))
        if mapper == "global":
            task.advance(len(job.survey.images))
        return models


@contextmanager
def replaced_lens(colmap: ModuleType, path: Path, params: Mapping[int, ArrayLike]) -> Iterator[None]:
    """Give cameras in a database other parameters for a while."""
    with colmap.Database.open(path) as database:
        stated = {camera.camera_id: camera for camera in database.read_all_cameras() if camera.camera_id in params}
        before = {camera_id: camera.params.copy() for camera_id, camera in stated.items()}
        _write_params(database, stated, params)
    try:
        yield
    finally:
        with colmap.Database.open(path) as database:
            _write_params(database, stated, before)


def _write_params(
    database: ColmapDatabase, cameras: Mapping[int, ColmapCamera], params: Mapping[int, ArrayLike]
) -> None:
    for camera_id, camera in cameras.items():
        camera.params = params[camera_id]
        database.update_camera(camera)


def triangulate(
    colmap: ModuleType, model: Reconstruction, database: Path, progress: Progress, *, limit_px: float | None = None
) -> None:
    """Add the tracks of a database to a `pycolmap.Reconstruction` of known cameras, in place.

    Observations further than `limit_px` from their point are left out; without it, COLMAP's 4 px.
    """
    with colmap.Database.open(database) as opened:
        cache = colmap.DatabaseCache.create(opened, colmap.DatabaseCacheOptions())
    mapper, options = colmap.IncrementalMapper(cache), colmap.IncrementalTriangulatorOptions()
    filters = colmap.IncrementalMapperOptions()
    if limit_px is not None:
        options.merge_max_reproj_error = options.complete_max_reproj_error = limit_px
        filters.filter_max_reproj_error = limit_px
    mapper.begin_reconstruction(model)
    images = sorted(model.reg_image_ids())
    with progress.task("triangulation", len(images)) as task:
        for image_id in images:
            mapper.triangulate_image(options, image_id)
            task.advance()
        mapper.complete_and_merge_tracks(options)
        mapper.filter_points(filters)
    mapper.end_reconstruction(False)


def _registered(models: list[Reconstruction]) -> int:
    return models[0].num_reg_images() if models else 0


@contextmanager
def scratch_beside(database: Path) -> Iterator[Path]:
    """Make an empty folder for COLMAP's own output, and remove it at the end.

    The name is fixed, so that the next run removes the folder of a killed one.
    """
    scratch = database.parent / "mapping"
    shutil.rmtree(scratch, ignore_errors=True)
    scratch.mkdir()
    try:
        yield scratch
    finally:
        shutil.rmtree(scratch, ignore_errors=True)

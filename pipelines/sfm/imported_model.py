"""Engine `imported`: cameras that another program has solved, with its points or triangulated ones."""

import logging
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path, PurePosixPath
from types import ModuleType
from typing import Any, Self

from pipelines.core.errors import InputError
from pipelines.core.machine import chosen_threads
from pipelines.core.progress import Progress
from pipelines.core.workspace import StageRun
from pipelines.formats.colmap import (
    flatten,
    load_reconstruction,
    quiet_colmap,
    reconstruction_of,
    write_reconstruction,
)
from pipelines.formats.solved_cameras import PhotoSize
from pipelines.geometry.cameras import Reconstruction
from pipelines.sfm.chunks import remove_chunks
from pipelines.sfm.colmap_reconstruction import ColmapReconstructor
from pipelines.sfm.estimate import ReconstructionEstimate, estimate_reconstruction
from pipelines.sfm.features import SfmJob
from pipelines.sfm.foreign_cameras import foreign_file
from pipelines.sfm.imported_adjustment import Rule, settle_imported
from pipelines.sfm.known_poses import triangulated_again, triangulated_from
from pipelines.sfm.model_poses import check_observations
from pipelines.sfm.options import SfmOptions
from pipelines.survey.image_names import ImageNames
from pipelines.survey.survey import Survey

log = logging.getLogger(__name__)

# Below the folder of a project, where COLMAP's mapper numbers its models as it finds them.
_PLACES = ("", "sparse/0", "sparse", "0")
_IMAGES = ("images.bin", "images.txt")
_WITHOUT_DISTORTION = frozenset({"PINHOLE", "SIMPLE_PINHOLE"})
_FEWEST_IMAGES = 3
_SEEN = 0.5  # of the images with a pose: where fewer have observations, the model is poses alone


@dataclass(frozen=True)
class ImportedModel:
    """Import of solved cameras from a path; without `triangulates` no features are computed.

    `foreign`: the file is another program's than COLMAP's.
    """

    path: Path
    triangulates: bool = False
    foreign: bool = False
    remedy: str = "COLMAP cannot read the imported model: export it again"

    @classmethod
    def of(cls, path: Path, *, triangulates: bool) -> Self:
        """Return the import of a path; cameras without points in their file are triangulated in any case.

        Raises:
            InputError: the path is a file without such cameras.
        """
        file = foreign_file(path)
        return cls(path, triangulates or (file is not None and not file.has_points), file is not None)

    def estimate(
        self, photographs: int, photo_px: tuple[int, int], options: SfmOptions
    ) -> ReconstructionEstimate | None:
        return estimate_reconstruction(photographs, photo_px, options) if self.triangulates else None

    def prepare(self, stage: StageRun, survey: Survey, options: SfmOptions) -> bool:
        if not self.triangulates:
            return True
        with quiet_colmap():
            import_poses(
                self.path, survey, says=False
            )  # What cannot be imported is said before features are computed.
        return ColmapReconstructor().prepare(stage, survey, options)

    def reconstruct(self, job: SfmJob, progress: Progress) -> Any:
        with quiet_colmap() as colmap:
            if self.triangulates:
                model, folder = import_poses(self.path, job.survey)
                held = self._rule(job.options) == "hold"
                model = triangulated_from(colmap, model, job, folder, progress, held=held)
                model = self._settled(colmap, model, job, progress)
                check_observations(flatten(model), folder)
                model.extract_colors_for_all_images(job.images)
            else:
                model = self._settled(colmap, import_model(self.path, job.survey), job, progress)
            model.update_point_3d_errors()
            write_reconstruction(model, job.sparse)
        if self.triangulates:
            remove_chunks(job.database.parent)
        return model

    def _rule(self, options: SfmOptions) -> Rule:
        if options.adjust_imported != "auto":
            return "adjust" if options.adjust_imported == "yes" else "hold"
        return "judge" if self.foreign and not options.triangulate else "hold"

    def _settled(self, colmap: ModuleType, model: Reconstruction, job: SfmJob, progress: Progress) -> Any:
        """Return the model, adjusted where options and tie points say so; COLMAP's own stays as it is, unjudged."""
        if job.options.adjust_imported == "auto" and not self.triangulates and not self.foreign:
            return model
        again = partial(triangulated_again, colmap, database=job.database, progress=progress)
        return settle_imported(
            colmap,
            model,
            self._rule(job.options),
            again=again if self.triangulates else None,
            principal_point=job.options.principal_point,
            threads=chosen_threads(job.options.threads),
            progress=progress,
        )


def import_model(path: Path, survey: Survey) -> Any:
    """Return the solved cameras at `path` as a `pycolmap.Reconstruction`, reduced to the survey's images.

    The path is a file of another program (`foreign_cameras.py`), or a folder: that of a COLMAP model, of a COLMAP
    project that has it in `sparse/0` or `sparse`, or of another program's project. Images are renamed as in the
    survey. Errors of points are computed from the observations.

    Raises:
        InputError: the path holds no solved cameras, fewer than 3 of its images are in the survey, its cameras have
            other sizes than the photographs, its images have no observations, or its poses contradict them.
    """
    model, folder = import_poses(path, survey)
    _require_observations(model, folder)
    check_observations(flatten(model), folder)
    model.update_point_3d_errors()
    return model


def import_poses(path: Path, survey: Survey, *, says: bool = True) -> tuple[Any, Path]:
    """Return the model at `path` reduced to the survey's images, whatever it observes, and its folder or file.

    Remarks are logged if it `says` them. Raises as `import_model`, but for observations.
    """
    warn = log.warning if says else log.debug
    file = foreign_file(path)
    if file is None:
        source = find_model(path.parent if path.is_file() else path)
        model = load_reconstruction(source)
    else:
        source = file.path
        solved = file.read(source, _photo_size(survey, source))
        for remark in solved.remarks:
            warn("%s", remark.text, extra={"code": remark.code})
        model = reconstruction_of(solved.model)
    foreign = _rename(model, survey, source, warn)
    for frame_id in {image.frame_id for image in foreign}:  # The images of a rig share a frame.
        model.deregister_frame(frame_id)
    others = [image.name for image in foreign] if file is None else list(solved.foreign)
    if model.num_reg_images() < _FEWEST_IMAGES:
        example = others[0] if others else "none"
        raise InputError(
            "too-few-images-in-survey",
            (
                f"{model.num_reg_images()} of its images are in the survey, and at least three are needed. The "
                f"model has {example!r} …, the survey {survey.images[0].name!r} …: names may differ in folder, "
                "case and suffix only."
            ),
            path=source,
            remedy="Give `georef ingest` the photographs of the model, or rename its images.",
        )
    if others:
        warn("%d images of the imported model are not in the survey, and were left out.", len(others))
    _check_cameras(model, survey, source, warn)
    return model, source


def _photo_size(survey: Survey, source: Path) -> PhotoSize:
    """Return what gives the size of the photograph that a name in a file means; names match as in tables."""
    names, sizes = ImageNames(image.name for image in survey.images), _photo_sizes(survey)

    def photo_size(name: str) -> tuple[int, int] | None:
        photograph = names.find(_relative(name), path=source) if name.strip() else None
        return None if photograph is None else sizes[photograph]

    return photo_size


def _photo_sizes(survey: Survey) -> dict[str, tuple[int, int]]:
    priors = {prior.camera_id: prior for prior in survey.cameras}
    return {image.name: (priors[image.camera_id].width, priors[image.camera_id].height) for image in survey.images}


def _rename(model: Reconstruction, survey: Survey, folder: Path, warn: Callable[..., None]) -> list[Any]:
    """Give the posed images of a model their names in the survey; return those that are none of its images.

    Raises:
        InputError: a name fits several photographs, or two names one photograph.
    """
    names = ImageNames(image.name for image in survey.images)
    taken: dict[str, str] = {}
    foreign, renamed = [], []
    for image_id in sorted(model.reg_image_ids()):
        image = model.images[image_id]
        photograph = names.find(_relative(image.name), path=folder)
        if photograph is None:
            foreign.append(image)
            continue
        if photograph in taken:
            message = f"{taken[photograph]!r} and {image.name!r} of the model are both the photograph {photograph}."
            raise InputError("image-twice", message, path=folder, field="images")
        taken[photograph] = image.name
        if image.name != photograph:
            renamed.append(f"{image.name} is {photograph}")
            image.name = photograph
    if renamed:
        warn(
            "%d images of the model have another folder, case or suffix than their photographs (%s).",
            len(renamed),
            renamed[0],
        )
    return foreign


def _relative(name: str) -> str:
    """Return a name without the folders of another machine."""
    pure = PurePosixPath(name.replace("\\", "/"))
    return pure.name if pure.is_absolute() or ".." in pure.parts or name[1:2] == ":" else name


def _require_observations(model: Reconstruction, folder: Path) -> None:
    """Refuse a model of poses alone; leave out single images without observations.

    Raises:
        InputError: fewer than half of the images with a pose observe points.
    """
    posed = [model.images[image_id] for image_id in sorted(model.reg_image_ids())]
    blind = [image for image in posed if image.num_points3D == 0]
    if len(blind) > (1.0 - _SEEN) * len(posed) or len(posed) - len(blind) < _FEWEST_IMAGES:
        raise InputError(
            "model-without-observations",
            f"{len(blind)} of its {len(posed)} images have a pose, but no observations of points (such as "
            f"{blind[0].name}). The adjustment needs points: --triangulate takes the poses and triangulates points "
            "from the photographs.",
            path=folder,
            field="images",
        )
    for frame_id in {image.frame_id for image in blind}:
        model.deregister_frame(frame_id)
    if blind:
        log.warning(
            "%d images of the model observe no points and are left out (such as %s); --triangulate takes them.",
            len(blind),
            blind[0].name,
        )


def find_model(path: Path) -> Path:
    """Return the folder of the model at or below `path`; `path` itself if there is none.

    Among several models of a project the one with most images is returned, with a warning.
    """
    places = [path / place for place in _PLACES]
    folder = next((place for place in places for name in _IMAGES if (place / name).exists()), None)
    if folder is None:
        beside = [child for parent in (path / "sparse", path) for child in _numbered(parent)]
        folder = beside[0] if beside else path
    models = _numbered(folder.parent) if folder != path else []
    if len(models) < 2:
        return folder
    sizes = {model: _number_of_images(model) for model in models}
    largest = max(models, key=lambda model: sizes[model])
    log.warning(
        "%s is imported: it has %d images, the most of %d models beside each other (%s).",
        largest,
        sizes[largest],
        len(models),
        ", ".join(f"{model.name}: {size}" for model, size in sizes.items()),
    )
    return largest


def _numbered(parent: Path) -> list[Path]:
    """Return the folders of numbered models in a folder, by number."""
    folders = {file.parent for name in _IMAGES for file in parent.glob(f"[0-9]*/{name}")}
    return sorted(folders, key=lambda folder: (len(folder.name), folder.name))


def _number_of_images(folder: Path) -> int:
    """Return how many images a model has, by the head of its file or by its lines; what is wrong is said later."""
    try:
        if (folder / "images.bin").exists():
            with (folder / "images.bin").open("rb") as stream:
                return int.from_bytes(stream.read(8), "little")
        with (folder / "images.txt").open("rb") as stream:
            return sum(not line.startswith(b"#") for line in stream) // 2
    except OSError:
        return 0


def _check_cameras(model: Reconstruction, survey: Survey, folder: Path, warn: Callable[..., None]) -> None:
    size_of = _photo_sizes(survey)
    flat = set()
    for image_id in model.reg_image_ids():
        image = model.images[image_id]
        camera = model.cameras[image.camera_id]
        width, height = size_of[image.name]
        undistorted = camera.model_name in _WITHOUT_DISTORTION
        if (camera.width, camera.height) != (width, height):
            cause = "undistorted copies" if undistorted else "copies of another size"
            raise InputError(
                "undistorted-copies" if undistorted else "photograph-size",
                (
                    f"Its camera {image.camera_id} ({camera.model_name}) has {camera.width}×{camera.height} "
                    f"pixels, the photograph {image.name} {width}×{height}: the model was made of {cause}."
                ),
                path=folder,
                remedy=(
                    "Import the model of the photographs themselves, or give the folder of the copies to `georef "
                    "ingest --images`."
                ),
            )
        if undistorted:
            flat.add(image.camera_id)
    if flat:
        warn(
            "The imported model has no lens distortion (camera %s). If it was made of undistorted copies, import "
            "the model of the photographs themselves.",
            ", ".join(map(str, sorted(flat))),
        )

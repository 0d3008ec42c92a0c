"""Engine `imported`: a COLMAP model that another program has made."""

import logging
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pipelines.core.errors import InputError
from pipelines.core.progress import Progress
from pipelines.core.workspace import StageRun
from pipelines.formats.colmap import load_reconstruction, quiet_colmap, write_reconstruction
from pipelines.sfm.features import SfmJob
from pipelines.sfm.options import SfmOptions
from pipelines.survey.survey import Survey

log = logging.getLogger(__name__)

# Below the folder of a project: COLMAP's mapper numbers its models and puts the largest first as a rule.
_PLACES = ("", "sparse/0", "sparse", "0")
_IMAGES = ("images.bin", "images.txt")
_WITHOUT_DISTORTION = frozenset({"PINHOLE", "SIMPLE_PINHOLE"})


@dataclass(frozen=True)
class ImportedModel:
    """Import of a COLMAP model from a folder; nothing is computed."""

    path: Path
    remedy: str = "COLMAP cannot read the imported model: export it again"

    def estimate(self, photographs: int, photo_px: tuple[int, int], options: SfmOptions) -> None:
        return None

    def prepare(self, stage: StageRun, survey: Survey, options: SfmOptions) -> bool:
        return True

    def reconstruct(self, job: SfmJob, progress: Progress) -> Any:
        with quiet_colmap():
            model = import_model(self.path, job.survey)
            write_reconstruction(model, job.sparse)
        return model


def import_model(path: Path, survey: Survey) -> Any:
    """Return the COLMAP model at `path` (a `pycolmap.Reconstruction`), reduced to the survey's images.

    The folder is that of the model, or of a COLMAP project that has it in `sparse/0` or `sparse`.

    Raises:
        InputError: the folder holds no COLMAP model, fewer than 3 of its images are in the survey, or its cameras
            have other sizes than the photographs.
    """
    folder = find_model(path)
    model = load_reconstruction(folder)
    names = {image.name for image in survey.images}
    foreign = [image for image in model.images.values() if image.has_pose and image.name not in names]
    for frame_id in {image.frame_id for image in foreign}:  # The images of a rig share a frame.
        model.deregister_frame(frame_id)
    if model.num_reg_images() < 3:
        raise InputError(
            "too-few-images-in-survey",
            f"{model.num_reg_images()} of its images are in the survey, and at least three are needed; names must "
            "be equal.",
            path=folder,
        )
    if foreign:
        log.warning("%d images of the imported model are not in the survey, and were left out.", len(foreign))
    _check_cameras(model, survey, folder)
    return model


def find_model(path: Path) -> Path:
    """Return the folder of the model at or below `path`; `path` itself if there is none.

    Among several models of a project the one in `sparse/0` is returned, with a warning.
    """
    places = [path / place for place in _PLACES]
    folder = next((place for place in places for name in _IMAGES if (place / name).exists()), path)
    others = {file.parent for name in _IMAGES for file in folder.parent.glob(f"[0-9]*/{name}")} - {folder}
    if folder != path and others:
        log.warning("%s is imported; %d further models lie beside it.", folder, len(others))
    return folder


def _check_cameras(model: Any, survey: Survey, folder: Path) -> None:
    priors = {prior.camera_id: prior for prior in survey.cameras}
    size_of = {
        image.name: (priors[image.camera_id].width, priors[image.camera_id].height) for image in survey.images
    }
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
                f"Its camera {image.camera_id} ({camera.model_name}) has {camera.width}×{camera.height} pixels, "
                f"the photograph {image.name} {width}×{height}: the model was made of {cause}. Import the model of "
                "the photographs themselves, or give the folder of the copies to `georef ingest --images`.",
                path=folder,
            )
        if undistorted:
            flat.add(image.camera_id)
    if flat:
        log.warning(
            "The imported model has no lens distortion (camera %s). If it was made of undistorted copies, import "
            "the model of the photographs themselves.",
            ", ".join(map(str, sorted(flat))),
        )

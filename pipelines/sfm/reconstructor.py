"""Engines of structure from motion, and the choice among them."""

from typing import Any, Protocol

from pipelines.core.progress import Progress
from pipelines.core.workspace import StageRun
from pipelines.sfm.colmap_reconstruction import ColmapReconstructor
from pipelines.sfm.estimate import ReconstructionEstimate
from pipelines.sfm.features import SfmJob
from pipelines.sfm.imported_model import ImportedModel
from pipelines.sfm.options import SfmOptions
from pipelines.survey.survey import Survey


class Reconstructor(Protocol):
    """Engine of structure from motion: photographs, pairs to match and options in, a model out.

    The product of every engine is a COLMAP model, which the later stages read as a `SparseModel`.
    """

    @property
    def remedy(self) -> str:
        """Advice after a crash."""

    def estimate(
        self, photographs: int, photo_px: tuple[int, int], options: SfmOptions
    ) -> ReconstructionEstimate | None:
        """Return the estimate for photographs whose largest has so many pixels; None: nothing is to be computed."""

    def prepare(self, stage: StageRun, survey: Survey, options: SfmOptions) -> bool:
        """Do what comes before `reconstruct` in the process of the stage, which can start jobs.

        Return whether `reconstruct` continues what an interrupted run has left, and may fail because of that.

        Raises:
            ResourceError: the reconstruction would not fit into the memory.
            GeorefError: a job has failed.
        """

    def reconstruct(self, job: SfmJob, progress: Progress) -> Any:
        """Write the largest model into the folder `job.sparse`, in a child process; return its `Reconstruction`.

        Raises:
            GeorefError: photographs or imported model are not those of the survey, or no model was found.
        """


def reconstructor_of(options: SfmOptions) -> Reconstructor:
    """Return the engine that the options choose: COLMAP, or a model that is imported.

    Raises:
        InputError: the model to import cannot be read.
    """
    if options.import_model is None:
        return ColmapReconstructor()
    return ImportedModel.of(options.import_model, triangulates=options.triangulate)

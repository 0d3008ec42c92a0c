"""Stage `clean`: a model without floaters, of a wished size, made from the trained one; the loss is stated.

1. Gaussians that are too transparent, or outside a crop, go.
2. Of the others, floaters go: those whose place (`clean.floaters`) and whose looks say so. A place alone does
   not: stereo misses wires, and the sky is far from everything. The looks are an opacity below a tenth, or
   photographs whose error grows with the opacity.
3. With --gaussians, those that show least in the training views are merged into their neighbours
   (`clean.consolidation`). With --sh-degree, harmonics are cut off.
4. After step 3, what is left is fitted to the renders of the trained model.

Reads `ingest/survey.json`, the photographs, `sfm/sparse`, `sim3/`, `train/model.json` and `train/gaussians.ply`.
Writes `clean/gaussians.ply` (frame `model`), which the files of the splat take, `clean/clean.json`,
`clean/reason.npy` with the reason for which each trained Gaussian went, and `clean/removed.ply` with the floaters.

The surface, and so rasters, cloud and mesh, stay those of the trained model.
"""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from scipy.special import expit

from pipelines.clean.consolidation import consolidated, most_shown
from pipelines.clean.floaters import Evidence, MeasuredView, before_surface, evidence_of, isolated
from pipelines.clean.options import CleanOptions
from pipelines.core.errors import DegenerateGeometryError
from pipelines.core.products import Product, Remark, save_json
from pipelines.core.progress import Progress
from pipelines.core.stages import CLEANED, CLEANING, REMOVED
from pipelines.core.types import BoolArray, ByteArray
from pipelines.core.workspace import StageRun, Summary, Workspace
from pipelines.geometry.cameras import ViewPose, pose_matrix
from pipelines.splat.appearance import WITH_SHAPES, ShownView, refine_appearance, shuffled_passes
from pipelines.splat.gaussians import Gaussians, write_gaussians
from pipelines.splat.initialise import scene_extent
from pipelines.splat.rasterizer.api import Rasterizer, RasterSettings
from pipelines.splat.sh import coefficient_count
from pipelines.surface.depth_maps import DepthMaps
from pipelines.surface.measured_area import crop_of
from pipelines.surface.photometry import mean_psnr
from pipelines.surface.surface_views import ModelRenderer, model_renderer
from pipelines.survey.navigation import load_survey
from pipelines.survey.photographs import save_array
from pipelines.survey.scene import load_solved_scene, photographs
from pipelines.survey.solution import Solution, read_sfm, read_trained

# Reasons for which a Gaussian went, by their number in `reason.npy`; 0: it stays.
REASONS = ("kept", "transparent", "outside", "before_surface", "isolated", "consolidated")
KEPT, TRANSPARENT, OUTSIDE, BEFORE_SURFACE, ISOLATED, CONSOLIDATED = range(len(REASONS))
REASON_FILE = "reason.npy"
_TRANSLUCENT = 0.1  # opacity of a veil
# Squared error of the three colours, of a pixel that the Gaussian fills: 0.06 each. Where training has ended, it is
# about zero; a veil of half the opacity before a surface whose colours differ by 0.2 has 0.06.
_CONTRADICTED = 0.01
_MOST_COMPARED = 16  # training views, where there are no test views
_TOLERATED_DB = 0.1  # that the removal of floaters may cost before it is said


class Cleaning(Product):
    """Record of `georef clean`: numbers of Gaussians, and the quality before and after.

    Attributes:
        trained, cleaned: numbers of Gaussians.
        removed: number of Gaussians by the reason for which they went.
        sh_degree: of the harmonics that are left.
        compared: views whose PSNR is stated; training views where the survey has no test views.
        psnr_trained, psnr_without_floaters, psnr_cleaned: mean over them, in dB: of the trained model, after the
            removal of what is transparent, outside or floats, and of the cleaned model. The photographs outside a
            crop count.
    """

    format_version: Literal[1] = 1
    trained: int
    cleaned: int
    removed: dict[str, int]
    sh_degree: int
    compared: Literal["test views", "training views"]
    views: int
    psnr_trained: float | None
    psnr_without_floaters: float | None
    psnr_cleaned: float | None


def run(stage: StageRun, options: CleanOptions) -> Summary:
    """Write the cleaned model and what was removed, and return their key figures.

    Raises:
        DegenerateGeometryError: nothing is left.
        InputError: a photograph or a product cannot be read.
    """
    progress, model = stage.progress, read_trained(stage.workspace)
    sfm, survey = read_sfm(stage.workspace, model), load_survey(stage.workspace)
    renderer = model_renderer(stage.workspace, model, sfm, survey, progress=progress)
    renderer.images.build(progress)
    backend = renderer.backend
    gaussians, views = renderer.gaussians, model.indices("train")
    needed = options.floaters or options.gaussians is not None
    evidence = evidence_of(renderer, backend, views, progress) if needed else None
    reason = _reasons(stage.workspace, gaussians, evidence, options, progress)
    if not (reason == KEPT).any():
        message = f"None of {len(reason)} Gaussians is left. Lower --min-opacity, or check --boundary."
        raise DegenerateGeometryError("nothing-left", message)
    compared = _compared(model)
    before = mean_psnr(renderer, compared, progress)
    clean = renderer.showing(gaussians.select(torch.from_numpy(reason == KEPT)))
    without = mean_psnr(clean, compared, progress)
    fewer = clean.gaussians
    if evidence is not None and options.gaussians is not None:
        rows, weight_px = np.flatnonzero(reason == KEPT), evidence.weight_px[reason == KEPT]
        reason[rows[~most_shown(weight_px, options.gaussians)]] = CONSOLIDATED
        fewer = consolidated(fewer, weight_px, options.gaussians)
    smaller = _smaller(clean, fewer, backend, options, progress)
    made = smaller.gaussians
    after = without if smaller is clean else mean_psnr(smaller, compared, progress)
    filtered = model.mip_filter
    write_gaussians(stage.out / Path(CLEANED).name, made, mip_filter=filtered)
    floats = (reason == BEFORE_SURFACE) | (reason == ISOLATED)
    if floats.any():
        removed = gaussians.select(torch.from_numpy(floats))
        write_gaussians(stage.out / Path(REMOVED).name, removed, mip_filter=filtered)
    save_array(stage.out / REASON_FILE, reason)
    counts = np.bincount(reason, minlength=len(REASONS)).tolist()
    record = Cleaning(
        trained=len(reason),
        cleaned=len(made),
        removed=dict(zip(REASONS[1:], counts[1:], strict=True)),
        sh_degree=made.sh_degree,
        compared="test views" if model.indices("test") else "training views",
        views=len(compared),
        psnr_trained=before,
        psnr_without_floaters=without,
        psnr_cleaned=after,
    )
    save_json(record, stage.out / Path(CLEANING).name)
    return _summary(record, model.cautions)


def _summary(record: Cleaning, cautions: tuple[Remark, ...]) -> Summary:
    figure, warnings = f"{record.cleaned} of {record.trained} Gaussians", []
    before, without, after = record.psnr_trained, record.psnr_without_floaters, record.psnr_cleaned
    if before is not None and without is not None and after is not None:
        figure += f", PSNR of the {record.compared} {before:.2f} → {after:.2f} dB"
        if without < before - _TOLERATED_DB:
            sentence = (
                f"Without what was removed as transparent, outside or floating, the {record.compared} have "
                f"{before - without:.2f} dB less PSNR: it was part of the scene, or a crop left it out."
            )
            remedy = f"Look at {REMOVED}, and give a larger --floater-sigma or --no-floaters."
            warnings.append(Remark(code="clean-costs-detail", sentence=sentence, remedy=remedy))
    return Summary(
        figure,
        {
            **record.model_dump(mode="json", exclude={"format_version", "removed"}),
            **{f"removed_{reason}": count for reason, count in record.removed.items()},
        },
        warnings=tuple(warnings),
        cautions=cautions,
    )


def _compared(solution: Solution) -> list[int]:
    """Return the views whose PSNR is stated: the test views, or without any some training views."""
    views = solution.indices("train")
    return solution.indices("test") or views[:: -(-len(views) // _MOST_COMPARED)]


def _reasons(
    workspace: Workspace,
    gaussians: Gaussians,
    evidence: Evidence | None,
    options: CleanOptions,
    progress: Progress,
) -> ByteArray:
    """Return the reason (N,) for which each Gaussian goes, as a number of `REASONS`."""
    opacity, crop = expit(gaussians.logit_opacities.numpy()), crop_of(workspace, options)
    reason = np.full(len(gaussians), KEPT, dtype=np.uint8)
    if crop is not None:
        reason[~crop.keeps(gaussians.means.numpy())] = OUTSIDE
    reason[opacity < options.min_opacity] = TRANSPARENT
    if options.floaters and evidence is not None:
        kept = np.flatnonzero(reason == KEPT)
        some = gaussians.select(torch.from_numpy(kept))
        before = before_surface(some, _measured(workspace, progress), options.floater_sigma)
        alone = isolated(some.means.numpy(), np.exp(some.log_scales.amax(dim=1).numpy()))
        doubtful = (opacity[kept] < _TRANSLUCENT) | (evidence.mean_error[kept] > _CONTRADICTED)
        floats = _floating(before, alone, doubtful)
        reason[kept[floats & alone]] = ISOLATED
        reason[kept[floats & before]] = BEFORE_SURFACE
    return reason


def _floating(before: BoolArray, alone: BoolArray, doubtful: BoolArray) -> BoolArray:
    """Return what floats: its place is wrong in both ways, or in one and its looks are doubtful."""
    return np.asarray((before & alone) | ((before | alone) & doubtful))


def _measured(workspace: Workspace, progress: Progress) -> Iterator[MeasuredView]:
    """Yield the depth maps of the training photographs, which training has left in the cache or are made again."""
    model = read_trained(workspace)
    _, survey, scene = load_solved_scene(workspace)
    maps = DepthMaps(
        workspace.cache / "surface", scene, photographs(scene.sparse, survey, workspace, model.max_image_size)
    )
    maps.images.build(progress)
    maps.build(progress)
    for index in map(int, scene.train):
        center = scene.poses.cam_center_in_model[index]
        pose = ViewPose(maps.camera(index), scene.poses.cam_from_model[index], center)
        yield MeasuredView(pose, maps.depth(index))


def _smaller(
    clean: ModelRenderer, kept: Gaussians, backend: Rasterizer, options: CleanOptions, progress: Progress
) -> ModelRenderer:
    """Return the renderer of the Gaussians that are left, without harmonics above the degree of the options.

    Where anything is missing now, what is left is fitted to the renders of the renderer `clean`.
    """
    degree = clean.model.sh_degree if options.sh_degree is None else options.sh_degree
    count = coefficient_count(min(degree, kept.sh_degree))
    if len(kept) == len(clean.gaussians) and count == kept.sh.shape[1]:
        return clean
    cut = replace(kept, sh=kept.sh[:, :count].contiguous())
    views = clean.model.indices("train")
    order = shuffled_passes(len(views), options.refit_passes, np.random.default_rng(0))

    def training_view(number: int) -> ShownView:
        pose = clean.pose(views[number])
        matrix = torch.from_numpy(pose_matrix(pose.cam_from_model, pose.center_in_model)).float()
        return ShownView(matrix, pose.pinhole, clean.render(pose).colour.clamp(0, 1))

    model = clean.model
    settings = RasterSettings(min(model.sh_degree, cut.sh_degree), model.background)
    if not order:
        return clean.showing(cut)
    extent_m = scene_extent(clean.poses.cam_center_in_model)
    fitted = refine_appearance(
        cut, training_view, order, backend, settings, rates=WITH_SHAPES, extent_m=extent_m, progress=progress
    )
    return clean.showing(fitted)

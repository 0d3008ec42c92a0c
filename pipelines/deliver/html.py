"""Export of the splat with its viewer as one HTML file, which opens without a server and without a network.

Reads `ingest/survey.json`, `sfm/sparse`, `train/model.json`, `train/gaussians.ply`, and of `georef view`
`view/measurements.geojson`. Writes `html/splat.html` (docs/deliverables.md), with the sidecar in its content.

A file for mail has a largest size. A larger splat loses what costs its pictures least: degrees of its harmonics,
then Gaussians, which are merged as for distant levels of detail. The loss is measured in renders.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch

from pipelines.core.errors import InputError
from pipelines.core.products import Remark
from pipelines.core.stages import HTML
from pipelines.core.types import joined_rows
from pipelines.core.workspace import StageRun, Summary
from pipelines.deliver.options import ExportHtmlOptions
from pipelines.deliver.pages import Fact, splat_page, splat_page_text, write_splat_page
from pipelines.deliver.placement import ENU_FROM_Y_UP, Placement
from pipelines.deliver.splat import codec_arrays, load_splat, splat_values
from pipelines.formats.splat_ply import SplatArrays
from pipelines.formats.spz import decode_spz, encode_wide_spz
from pipelines.geometry.cameras import Camera, CameraPoses, Pinhole, pose_matrix
from pipelines.geometry.similarity import Similarity
from pipelines.geometry.sparse_model import SparseModel
from pipelines.splat.gaussians import Gaussians, transformed
from pipelines.splat.level_of_detail import Tiler, best_cut, build_tiles, scene_box
from pipelines.splat.metrics import psnr
from pipelines.splat.rasterizer.api import RasterSettings
from pipelines.splat.rasterizer.backends import rasterizer
from pipelines.splat.sh import coefficient_count
from pipelines.survey.navigation import load_survey
from pipelines.survey.solution import read_sfm, read_solution

_RESERVED_BYTES = 4000  # for what the page says of the loss
_TILES = 500  # at least, into which a splat is cut that loses Gaussians: steps of their number
_VIEWS, _VIEW_PX = 6, 320  # renders that measure the loss
Measure = Callable[[SplatArrays, SplatArrays], float]


def run(stage: StageRun, options: ExportHtmlOptions) -> Summary:
    """Write the page; errors as of `load_splat`, or an InputError: too small a limit, or an unfit CRS."""
    splat = load_splat(stage.workspace, options)
    solution, survey = read_solution(stage.workspace), load_survey(stage.workspace)
    sparse = solution.with_lenses(read_sfm(stage.workspace, solution))
    # Readers of SPZ take its axes for right, up and back: whoever takes it out of the page sees it upright.
    whole = codec_arrays(transformed(splat.gaussians, Similarity(1.0, ENU_FROM_Y_UP.T)), options.sh_degree)
    centers = splat.gaussians.means.numpy()
    page = splat_page(
        stage.workspace, splat.placement, centers, survey, options, poses=solution.poses, sparse=sparse
    )
    most_bytes = int(options.max_megabytes * 1e6)
    fixed_bytes = len(splat_page_text(page, b"").encode()) + _RESERVED_BYTES
    measured = _Views(solution.poses, sparse, splat.placement, mip_filter=splat.mip_filter).psnr_db
    held = fitted(whole, (most_bytes - fixed_bytes) * 3 // 4, measured, mip_filter=splat.mip_filter)
    page = page.model_copy(update={"facts": (*page.facts, held.fact), "mip_filter": splat.mip_filter})
    path = stage.out / Path(HTML).name
    write_splat_page(path, page, held.spz)
    size = path.stat().st_size
    values = {
        **splat_values(splat),
        "gaussians_in_page": held.count,
        "sh_degree": held.degree,
        "loss_psnr_db": held.psnr_db,
        "cameras": len(page.cameras),
        "measurements": len(page.measurements),
        "bytes": size,
    }
    remark = Remark(
        code="splat-reduced",
        sentence=f"To stay within {options.max_megabytes:g} MB, the page has {held.sentence}.",
        remedy="--max-megabytes sets the limit.",
    )
    return Summary(
        f"{held.count} Gaussians, {size / 1e6:.1f} MB",
        values,
        warnings=() if held.psnr_db is None else (remark,),
        cautions=splat.placement.cautions,
    )


@dataclass(frozen=True)
class HeldSplat:
    """Splat as a page holds it, and what it lost.

    Attributes:
        count, of: number of its Gaussians, and of those of the whole splat.
        degree, of_degree: of its harmonics, and of those of the whole splat.
        psnr_db: of its renders against those of the whole splat; None: it is the whole.
    """

    spz: bytes
    count: int
    of: int
    degree: int
    of_degree: int
    psnr_db: float | None = None

    @property
    def sentence(self) -> str:
        parts = [f"{self.count} Gaussians"]
        if self.count < self.of:
            parts = [f"{self.count} of {self.of} Gaussians, merged"]
        if self.degree < self.of_degree:
            parts.append(f"harmonics of degree {self.degree} instead of {self.of_degree}")
        text = ", ".join(parts)
        return text if self.psnr_db is None else f"{text}: PSNR {self.psnr_db:.1f} dB against the whole splat"

    @property
    def fact(self) -> Fact:
        return Fact(name="Splat", value=self.sentence)


def fitted(whole: SplatArrays, most_bytes: int, psnr_db: Measure, *, mip_filter: bool = False) -> HeldSplat:
    """Return a splat as SPZ of at most so many bytes; an InputError: not even its coarsest level fits.

    Args:
        psnr_db: of the renders of the splat that is held against those of the whole.
    """
    highest = _degree(whole)
    for degree in range(highest, -1, -1):
        held = replace(whole, sh=whole.sh[:, : coefficient_count(degree)])
        spz = encode_wide_spz(held, mip_filter=mip_filter)
        if len(spz) <= most_bytes:
            loss = None if degree == highest else psnr_db(decode_spz(spz), whole)
            return HeldSplat(spz, len(held), len(whole), degree, highest, loss)
    contents: dict[str, SplatArrays] = {}

    def keep(name: str, content: SplatArrays, *, is_leaf: bool) -> None:
        contents[name] = content

    root = build_tiles([held], scene_box(held.means), Tiler(max(len(held) // _TILES, 1), keep))
    most = int(len(held) * most_bytes / len(spz))
    while most >= root.count:
        merged = joined_rows([contents[tile.name] for tile in best_cut(root, most)])
        spz = encode_wide_spz(merged, mip_filter=mip_filter)
        if len(spz) <= most_bytes:
            return HeldSplat(spz, len(merged), len(whole), 0, highest, psnr_db(decode_spz(spz), whole))
        most = min(int(0.95 * most), len(merged) - 1)
    message = f"The page does not fit, even with {root.count} Gaussians."
    remedy = "Give a larger limit."
    raise InputError("page-too-small", message, field="--max-megabytes", remedy=remedy)


def _degree(splat: SplatArrays) -> int:
    return int(np.sqrt(splat.sh.shape[1])) - 1


class _Views:
    """Views of some photographs, by which the loss of a splat is measured; both in the axes of SPZ."""

    def __init__(self, poses: CameraPoses, sparse: SparseModel, placement: Placement, *, mip_filter: bool) -> None:
        self._backend = rasterizer("cpu", mip_filter=mip_filter)
        axes_from_model = Similarity(1.0, ENU_FROM_Y_UP.T) @ placement.file_from_model
        rotations = poses.cam_from_model @ axes_from_model.rotation.T
        centers = axes_from_model.apply(poses.cam_center_in_model)
        chosen = np.unique(np.linspace(0, len(centers) - 1, _VIEWS).round().astype(int))
        self._poses = [torch.tensor(pose_matrix(rotations[i], centers[i]), dtype=torch.float32) for i in chosen]
        self._pinholes = [_pinhole(sparse.camera_of(int(i))).limited(_VIEW_PX) for i in chosen]

    def psnr_db(self, held: SplatArrays, whole: SplatArrays) -> float:
        """Return the mean PSNR of the renders of one splat against those of another, on black."""
        splats = [_gaussians(each) for each in (held, whole)]
        psnr_of_views = []
        for pose, pinhole in zip(self._poses, self._pinholes, strict=True):
            with torch.no_grad():
                image, target = (
                    self._backend.render(
                        each, pose, pinhole, RasterSettings(each.sh_degree, (0.0, 0.0, 0.0))
                    ).colour
                    for each in splats
                )
            psnr_of_views.append(psnr(image, target.clamp(0, 1)))
        return float(np.mean(psnr_of_views))


def _gaussians(splat: SplatArrays) -> Gaussians:
    return Gaussians(**{name: torch.from_numpy(np.ascontiguousarray(part)) for name, part in vars(splat).items()})


def _pinhole(lens: Camera) -> Pinhole:
    focal = lens.mean_focal_px
    return Pinhole(lens.width, lens.height, focal, focal, lens.width / 2, lens.height / 2)

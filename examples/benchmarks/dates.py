"""Difference of two tied dates, checked by points in common that are held out: `dates.py EARLIER LATER`.

Both workspaces are solved (`georef init-sim3`), the later one with `--earlier`; nothing need be trained. Half of
the points in common, drawn at random, tie the dates anew. On ground that has not changed, the others then show the
error of the difference, with the noise of their own marks: it is printed over its σ, of marks and difference. What
errs slowly over the ground is seen in the medians of sixteen blocks.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from pipelines.adjust.init_sim3 import estimate_similarity
from pipelines.adjust.options import InitSim3Options
from pipelines.adjust.relative import Relative, Solved, relative
from pipelines.change.datum import load_epoch
from pipelines.core.stages import POINTS, SPARSE
from pipelines.core.types import FloatArray, IntArray
from pipelines.core.workspace import Workspace
from pipelines.formats.colmap import read_sparse
from pipelines.geometry.statistics import mad_sigma
from pipelines.survey.area import ground_sampling_m
from pipelines.survey.common_points import CommonPoints
from pipelines.survey.navigation import load_survey
from pipelines.survey.solution import GeolocatedPoints
from pipelines.survey.survey import Survey

_SIDE = 4  # blocks along a side
_MEDIAN = 1.2533  # σ of a median over that of a mean


def main() -> None:
    """Print the figures, east, north and up in millimetres."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("earlier", type=Path)
    parser.add_argument("later", type=Path)
    parser.add_argument("--seed", type=int, default=0, help="of the draw of the points that are held out")
    args = parser.parse_args()
    epoch, workspace = load_epoch(Workspace(args.earlier)), Workspace(args.later)
    earlier, survey = Solved(epoch.posterior, epoch.survey.origin_on_earth), load_survey(workspace)
    common = survey.common
    if common is None:
        parser.error(f"{args.later} is tied to no earlier date")
    whole, later = _tied(workspace, survey, earlier, common)
    sampling_m = ground_sampling_m(later.posterior.solution, later.posterior.sparse)
    assert sampling_m is not None
    print(
        f"{int(whole.used.sum())} of {len(whole.used)} points in common used, on {float(common.spread):.0%} of the "
        f"ground in common; GSD {1000 * sampling_m:.0f} mm"
    )
    print(f"σ of the difference, median over the scene: {_mm(_sigma(whole))}")
    print(
        f"later minus earlier place of these points, median: {_mm(np.median(whole.missed_m[whole.used], axis=0))}"
    )
    held = np.random.default_rng(args.seed).permutation(np.sort(common.point_id))[: len(common) // 2]
    half, later = _tied(workspace, survey, earlier, common.without(held.tolist()))
    place, missed, sigma = _checked(later, half, common, held)
    ratio = missed / sigma
    print(f"of {len(missed)} points held out, NMAD: {_mm([mad_sigma(one) for one in missed.T])}")
    print(f"error/σ by the NMAD: {', '.join(f'{mad_sigma(one):.2f}' for one in ratio.T)}")
    medians, count = _block_medians(place, missed)
    noise = _MEDIAN * np.array([mad_sigma(one) for one in missed.T]) / np.sqrt(np.median(count))
    rms = np.sqrt(np.mean(medians**2, axis=0))
    print(f"medians of {len(medians)} blocks, RMS: {_mm(rms)}; {_mm(noise)} of it by the noise of the marks")


def _tied(workspace: Workspace, survey: Survey, earlier: Solved, common: CommonPoints) -> tuple[Relative, Solved]:
    """Return the difference of the dates as some points tie them, and the later date so solved."""
    points = GeolocatedPoints.load(workspace.path(POINTS))
    tied = survey.model_copy(update={"common": common})
    posterior, _ = estimate_similarity(tied, read_sparse(workspace.path(SPARSE)), points, InitSim3Options())
    later = Solved(posterior, survey.origin_on_earth)
    return relative(later, earlier, common), later


def _checked(
    later: Solved, tie: Relative, common: CommonPoints, held: IntArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return places (K, 3) of the points held out, later minus earlier, and the σ of that."""
    left = common.without(sorted(set(common.point_id.tolist()) - set(held.tolist())))
    place, point, camera = later.tracks(left.point_id)
    _, _, cov = later.posterior.derivatives(place, point, camera, of_tracks=True)
    assert tie.grid is not None
    cov = cov + left.cov_in_geo(later.origin) + tie.grid.cov_at(place)
    known = np.isfinite(cov).all(axis=(1, 2))
    missed = place - left.position_in_geo(later.origin)
    return place[known], missed[known], np.sqrt(np.diagonal(cov[known], axis1=1, axis2=2))


def _sigma(tie: Relative) -> FloatArray:
    assert tie.grid is not None
    return np.asarray(np.median(tie.grid.sigma_m, axis=0))


def _block_medians(place: FloatArray, missed: FloatArray) -> tuple[FloatArray, IntArray]:
    """Return the medians (B, 3) of blocks that hold as many points each, and the numbers (B,) of these."""
    inner = np.linspace(0, 1, _SIDE + 1)[1:-1]
    column, row = (np.searchsorted(np.quantile(place[:, axis], inner), place[:, axis]) for axis in (0, 1))
    block = column * _SIDE + row
    names, count = np.unique(block, return_counts=True)
    return np.array([np.median(missed[block == name], axis=0) for name in names]), count


def _mm(values_m: FloatArray | list[float]) -> str:
    return ", ".join(f"{1000 * value:.1f}" for value in values_m) + " mm"


if __name__ == "__main__":
    main()

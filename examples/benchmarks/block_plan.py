"""Time and memory of dividing a survey into blocks: python examples/benchmarks/block_plan.py --photographs 10000.

The survey is made up: photographs in strips, straight down on rolling ground, a thousand SfM points in each. The
plan reads no photographs. Time and memory of the plan are printed apart from those of making the survey.
"""

from __future__ import annotations

import argparse
import time

import numpy as np

from pipelines.core.machine import peak_memory_bytes
from pipelines.geometry.cameras import Camera, project
from pipelines.geometry.similarity import Similarity
from pipelines.geometry.sparse_model import SparseModel
from pipelines.survey.scene import SparseScene
from pipelines.train.blocks.plan import plan_blocks
from pipelines.train.options import PlanOptions

_CAMERA = Camera("OPENCV", 5280, 3956, np.array([3700.0, 3700.0, 2640.0, 1978.0, -0.01, 0.004, 0.0, 0.0]))
_HEIGHT_M, _ALONG_M, _ACROSS_M = 100.0, 21.0, 43.0
_DOWN = np.diag([1.0, -1.0, -1.0])


def made_up_scene(photographs: int, points_in_view: int) -> SparseScene:
    """Return a survey whose frames `local` and `model` are one."""
    rng = np.random.default_rng(0)
    rows = round(np.sqrt(photographs * _ALONG_M / _ACROSS_M))
    columns = -(-photographs // rows)
    place = np.stack(np.meshgrid(_ALONG_M * np.arange(columns), _ACROSS_M * np.arange(rows)), axis=-1)
    center = np.column_stack([place.reshape(-1, 2)[:photographs], np.full(photographs, _HEIGHT_M)])
    half = _HEIGHT_M * np.array([_CAMERA.width, _CAMERA.height]) / (2 * 3700.0)
    low, high = center[:, :2].min(axis=0) - half, center[:, :2].max(axis=0) + half
    count = int(points_in_view * np.prod(high - low) / np.prod(2 * half))
    ground = rng.uniform(low, high, (count, 2))
    ground = ground[np.argsort(ground[:, 1])]
    point = np.column_stack([ground, 8 * np.sin(ground[:, 0] / 60) * np.cos(ground[:, 1] / 70)])
    owners, images, pixels = [], [], []
    for index, middle in enumerate(center):
        first, last = np.searchsorted(ground[:, 1], [middle[1] - 1.2 * half[1], middle[1] + 1.2 * half[1]])
        near = first + np.flatnonzero(np.abs(ground[first:last, 0] - middle[0]) < 1.2 * half[0])
        xy = project(_CAMERA, (point[near] - middle) @ _DOWN.T)
        inside = ((xy > 0) & (xy < [_CAMERA.width, _CAMERA.height])).all(axis=1)
        owners.append(near[inside])
        images.append(np.full(inside.sum(), index))
        pixels.append(xy[inside])
    owner, image = np.concatenate(owners), np.concatenate(images)
    order = np.lexsort((image, owner))
    sparse = SparseModel(
        cameras={1: _CAMERA},
        image_id=np.arange(1, photographs + 1),
        image_name=tuple(f"{index:05d}.jpg" for index in range(photographs)),
        image_camera_id=np.ones(photographs, dtype=np.int64),
        rotation_cam_from_local=np.tile(_DOWN, (photographs, 1, 1)),
        translation_cam_from_local=-center @ _DOWN.T,
        point_id=np.arange(1, count + 1),
        point_in_local=point,
        point_rgb=np.full((count, 3), 128, dtype=np.uint8),
        point_error_px=np.ones(count),
        obs_point=owner[order],
        obs_image=image[order],
        obs_xy_px=np.concatenate(pixels)[order],
    )
    everyone = np.arange(photographs)
    return SparseScene(sparse, Similarity(), Similarity(), everyone, everyone[:0])


def main() -> None:
    """Print time, memory and balance of the plan."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--photographs", type=int, default=10_000)
    parser.add_argument("--points-in-view", type=int, default=1000)
    parser.add_argument("--gaussians", type=int, default=60_000_000)
    parser.add_argument("--memory", type=float, default=8.0, help="Of a worker, GiB.")
    parser.add_argument("--blocks", type=int)
    args = parser.parse_args()
    scene = made_up_scene(args.photographs, args.points_in_view)
    made = peak_memory_bytes()
    options = PlanOptions(
        blocks=args.blocks,
        block_memory=args.memory,
        max_gaussians=args.gaussians,
        max_image_size=1600,
        sh_degree=3,
    )
    clock, processor = time.monotonic(), time.process_time()
    plan = plan_blocks(scene, options)
    seconds, worked, peak = time.monotonic() - clock, time.process_time() - processor, peak_memory_bytes()
    share = [block.share * len(plan.blocks) for block in plan.blocks]
    cameras = [len(block.cameras) for block in plan.blocks]
    print(f"{args.photographs} photographs, {len(scene.sparse.obs_point) / 1e6:.1f} M observations")
    print(f"{len(plan.blocks)} blocks in {seconds:.1f} s, {worked:.1f} s of them on processors")
    if made is not None and peak is not None:
        print(f"memory {peak / 2**30:.2f} GiB at the peak, of which the survey {made / 2**30:.2f} GiB")
    print(f"load of a block {min(share):.2f} … {max(share):.2f} of the mean")
    print(f"{min(cameras)} … {max(cameras)} photographs in a block")
    print(f"largest: {max(block.peak_bytes for block in plan.blocks) / 2**30:.1f} GiB predicted")


if __name__ == "__main__":
    main()

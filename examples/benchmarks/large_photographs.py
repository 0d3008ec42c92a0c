"""Compare the memory of a training on large photographs with its estimate: large_photographs.py --help.

Photographs of a workspace are enlarged, with their cameras, and trained at that size for a few iterations, as in
the last part of a training: in crops of photographs that are not shrunken.
"""

from __future__ import annotations

import argparse
import time
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from pathlib import Path

import cv2

from pipelines.core.machine import peak_memory_bytes
from pipelines.core.plan import photograph_folder
from pipelines.core.workspace import Workspace
from pipelines.geometry.cameras import Camera
from pipelines.splat.memory import predicted_peak_bytes
from pipelines.splat.rasterizer.backends import rasterizer
from pipelines.surface.depth_maps import DepthMaps
from pipelines.survey.photographs import ImageCache, Photograph
from pipelines.survey.scene import SparseScene, load_solved_scene
from pipelines.survey.solution import Solution
from pipelines.train.estimate import training_size
from pipelines.train.georeference.problem import frozen_problem
from pipelines.train.initial_gaussians import TrainingScene
from pipelines.train.options import TrainOptions
from pipelines.train.surface import SceneSurface
from pipelines.train.trainer import make_trainer


def enlarged(
    workspace: Workspace, scratch: Path, count: int, size_px: int
) -> tuple[Solution, SparseScene, list[Photograph]]:
    """Solution and scene of the first training photographs, enlarged, and their files."""
    solution, survey, whole = load_solved_scene(workspace)
    first = whole.train[:count]
    scene, solution = whole.of_images(first), solution.of_images(first).model_copy(update={"lenses": ()})
    folder = photograph_folder(workspace, survey.image_dir)
    cameras = {}
    for key, camera in scene.sparse.cameras.items():
        factor = size_px / max(camera.width, camera.height)
        lengths = camera.params.copy()
        lengths[:4] *= factor
        cameras[key] = Camera(camera.model, round(camera.width * factor), round(camera.height * factor), lengths)
    factor = cameras[int(scene.sparse.image_camera_id[0])].width / scene.sparse.camera_of(0).width
    sparse = replace(scene.sparse, cameras=cameras, obs_xy_px=scene.sparse.obs_xy_px * factor)
    shots = []
    for index, name in enumerate(sparse.image_name):
        camera, file = sparse.camera_of(index), scratch / f"{index}.jpg"
        with ProcessPoolExecutor(1) as pool:  # its memory does not count
            pool.submit(write_enlarged, folder / name, file, (camera.width, camera.height)).result()
        shots.append(Photograph(name, file, camera))
    return solution, replace(scene, sparse=sparse), shots


def write_enlarged(source: Path, file: Path, size: tuple[int, int]) -> None:
    """Write a photograph at another size."""
    photograph = cv2.imread(str(source), cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
    assert photograph is not None
    cv2.imwrite(str(file), cv2.resize(photograph, size, interpolation=cv2.INTER_CUBIC))


def peak_mib() -> float:
    """Peak of this process."""
    return (peak_memory_bytes() or 0) / 2**20


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("workspace", type=Path, help="with init-sim3 done; its cameras have one model with fx, fy")
    parser.add_argument("scratch", type=Path, help="empty folder for photographs and cache")
    parser.add_argument("--photographs", type=int, default=6)
    parser.add_argument("--size", type=int, default=5472, help="longer side in pixels")
    parser.add_argument("--crop-size", type=int, default=1024)
    parser.add_argument("--max-gaussians", type=int, default=300_000)
    parser.add_argument("--iterations", type=int, default=40)
    arguments = parser.parse_args()
    arguments.scratch.mkdir(parents=True)
    solution, scene, shots = enlarged(
        Workspace(arguments.workspace), arguments.scratch, arguments.photographs, arguments.size
    )
    options = TrainOptions(
        iterations=arguments.iterations,
        max_image_size=arguments.size,
        crop_size=arguments.crop_size,
        max_gaussians=arguments.max_gaussians,
        coarse_to_fine=False,
        georeference="frozen",
    )
    backend, images = rasterizer(options.backend), ImageCache(arguments.scratch / "cache", shots, arguments.size)
    size = training_size(options, len(images), images.largest())
    before = peak_mib()
    images.build()
    print(f"undistorted: peak {peak_mib() - before:.0f} MiB more", flush=True)
    maps = DepthMaps(arguments.scratch / "surface", scene, images)
    maps.build()
    print(f"depth maps: peak {peak_mib() - before:.0f} MiB more", flush=True)
    training = TrainingScene(scene, images, SceneSurface(maps))
    trainer = make_trainer(training, frozen_problem(solution, scene), backend, options)
    print(f"initial: peak {peak_mib() - before:.0f} MiB more", flush=True)
    trainer.step()
    print(f"first iteration: peak {peak_mib() - before:.0f} MiB more", flush=True)
    worked, pixels = time.process_time(), 0
    for _ in range(arguments.iterations - 1):
        pixels += trainer.step().pixels
    worked = (time.process_time() - worked) / max(arguments.iterations - 1, 1)
    largest = images.largest()
    print(
        f"{len(shots)} photographs of {largest.width}×{largest.height} px, {len(trainer.optimizer.gaussians)} "
        f"Gaussians, crops of {pixels / max(arguments.iterations - 1, 1) / 1e6:.2f} megapixels: "
        f"{worked:.2f} processor s an iteration, peak {peak_mib() - before:.0f} MiB more, "
        f"estimated {predicted_peak_bytes(size) / 2**20:.0f} MiB"
    )


if __name__ == "__main__":
    main()

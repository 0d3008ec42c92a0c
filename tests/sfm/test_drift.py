"""The adjustment with positions takes the bend out of a model, and heeds no wrong fix."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from pipelines.core.types import FloatArray, Vector3
from pipelines.formats.colmap import quiet_colmap
from pipelines.sfm.adjustment import remove_drift

pytestmark = pytest.mark.usefixtures("one_thread")

pycolmap = pytest.importorskip("pycolmap")
IMAGES, NOISE_PX = 24, 0.5
METRES = 20.0  # a unit of the model; its cameras are some 5 units from the points
FIX_M = 0.03
# A pixel at f = 1280 from 100 m is 8 cm: with 0.5 px, some 100 points fix a camera to about 4 cm / √100 and its
# turn, which trades against a shift, to a few times that. 3 cm of the fix is the larger part.
EXPECTED_M = 1.5 * np.sqrt(3) * FIX_M


def true_model() -> Any:
    pycolmap.set_random_seed(5)
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_frames_per_rig, options.num_points3D = 1, IMAGES, 100
    model = pycolmap.synthesize_dataset(options)
    rng = np.random.default_rng(0)
    for image in model.images.values():
        for point in image.points2D:
            point.xy = point.xy + rng.normal(0.0, NOISE_PX, 2)
    return model


def centers(model: Any) -> FloatArray:
    return np.array([model.images[key].projection_center() for key in sorted(model.reg_image_ids())])


def fixes_of(model: Any, noise_m: float = FIX_M) -> dict[str, Vector3]:
    """Measured positions in another frame, of another scale."""
    rng = np.random.default_rng(1)
    measured = METRES * centers(model) + [100.0, 200.0, 50.0] + rng.normal(0.0, noise_m, (IMAGES, 3))
    names = (model.images[key].name for key in sorted(model.reg_image_ids()))
    return {name: (float(e), float(n), float(u)) for name, (e, n, u) in zip(names, measured, strict=True)}


def bend(model: Any) -> None:
    """Lift cameras and points by the square of their place, up to about two metres."""
    largest = np.abs(centers(model)[:, 0]).max()

    def lift(place: FloatArray) -> FloatArray:
        return np.array([0.0, 0.0, 2.0 / METRES * (place[0] / largest) ** 2])

    for key in model.reg_image_ids():
        frame = model.frames[model.images[key].frame_id]
        pose = frame.rig_from_world
        shift = lift(model.images[key].projection_center())
        frame.rig_from_world = pycolmap.Rigid3d(pose.rotation, pose.translation - pose.rotation.matrix() @ shift)
    for point in model.points3D.values():
        point.xyz = point.xyz + lift(point.xyz)


def error_m(model: Any, fixes: dict[str, Vector3]) -> float:
    """RMS distance of the cameras from exact positions."""
    true = np.array([fixes[model.images[key].name] for key in sorted(model.reg_image_ids())])
    return float(np.sqrt(((centers(model) - true) ** 2).sum(1).mean()))


@pytest.mark.parametrize("wrong", [0, 4])
def test_a_bent_model_comes_to_the_true_places(wrong: int) -> None:
    model = true_model()
    exact, fixes = fixes_of(model, 0.0), fixes_of(model)
    bend(model)
    for name in sorted(fixes)[:wrong]:
        east, north, up = fixes[name]
        fixes[name] = (east + 15.0, north, up)
    with quiet_colmap() as colmap:
        sigma_m = remove_drift(colmap, model, fixes, threads=1)
    assert sigma_m is not None
    assert 0.05 < sigma_m < 2.0  # of the bend of up to 2 m, whatever the wrong fixes say
    assert error_m(model, exact) < EXPECTED_M


def test_positions_that_determine_nothing_change_nothing() -> None:
    model = true_model()
    before, fixes = centers(model), fixes_of(model)
    few = dict(sorted(fixes.items())[:9])
    line = {name: (float(index), 2.0 * index, 0.01 * index) for index, name in enumerate(sorted(fixes))}
    with quiet_colmap() as colmap:
        assert remove_drift(colmap, model, few, threads=1) is None
        assert remove_drift(colmap, model, line, threads=1) is None
        assert remove_drift(colmap, model, {}, threads=1) is None
    np.testing.assert_array_equal(centers(model), before)

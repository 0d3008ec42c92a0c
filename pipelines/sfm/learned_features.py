"""Learned features: ALIKED finds and describes them, LightGlue matches them, both by kornia on the CPU.

They connect photographs that SIFT does not: of other light or another season, of grass, leaves and water. They cost
some seconds a photograph and a pair; therefore only those photographs get them that need them (`rounds.py`).

LightGlue looks at the places of features beside what they look like, and has learned from upright pictures. A
photograph with an attitude is therefore turned by quarters until north is up. Without one, the places in it are
turned, and the turn with the most matches counts.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np

from pipelines.core.machine import chosen_threads
from pipelines.core.progress import Progress
from pipelines.core.types import Float32Array, FloatArray, IntArray
from pipelines.geometry.rotations import matrix_from_quat_xyzw
from pipelines.sfm.colmap_database import add_features, copy_database, finish_database, remove_database
from pipelines.sfm.features import SfmJob, verify_matches
from pipelines.sfm.learned_weights import DETECTOR, MATCHER, weights_file
from pipelines.survey.photographs import decoded_photograph
from pipelines.survey.survey import SurveyImage

if TYPE_CHECKING:
    import torch

_LONGEST_PX = 1024  # of the photograph: what the networks have learned from
_MOST_ENLARGED = 2.0  # of a smaller photograph, whose features are too few at its own size
_MOST_FEATURES = 2048
_LEAST_SCORE = 0.1  # of a match, LightGlue's own default
_FEWEST_MATCHES = 15  # COLMAP's fewest inliers of a pair
_LAYERS = 9
_DESCRIPTOR = 128


@dataclass(frozen=True)
class LearnedFeatures:
    """Features of a photograph: places (N, 2) in pixels of a picture of `size_px`, and descriptors (N, 128).

    The picture is the photograph of `photo_px`, resized and turned by `quarters` to the left. `upright`: north is
    up in it.
    """

    xy_px: Float32Array
    descriptor: Float32Array
    size_px: tuple[int, int]
    photo_px: tuple[int, int]
    quarters: int
    upright: bool

    def in_photograph_px(self) -> FloatArray:
        """Return the places (N, 2) in pixels of the whole photograph, the first one's centre at (0.5, 0.5)."""
        xy, (width, height) = self.xy_px + 0.5, self.size_px
        for _ in range(self.quarters % 4):
            # Turned back to the right: what was at the left edge comes to the top.
            xy, width, height = np.stack([height - xy[:, 1], xy[:, 0]], axis=1), height, width
        return np.asarray(xy * np.divide(self.photo_px, (width, height)), dtype=np.float64)

    def turned(self) -> LearnedFeatures:
        """Return the features of the picture turned by one more quarter to the left."""
        width, height = self.size_px
        xy = np.stack([self.xy_px[:, 1], width - 1 - self.xy_px[:, 0]], axis=1).astype(np.float32)
        return replace(self, xy_px=xy, size_px=(height, width), quarters=self.quarters + 1)


class LearnedMatcher:
    """The two networks, with the weights of the user's cache.

    Raises:
        BackendUnavailableError, InputError: kornia or the weights are missing.
    """

    def __init__(self, threads: int) -> None:
        import torch
        from kornia.feature import ALIKED, LightGlue

        torch.set_num_threads(chosen_threads(threads))
        self._torch = torch
        name = DETECTOR.removesuffix(".pth")
        self._detector = ALIKED(name, max_num_keypoints=_MOST_FEATURES, detection_threshold=0.0)
        # No kind of features: with one, kornia would download its weights.
        matcher: Any = LightGlue
        self._matcher = matcher(features=None, input_dim=_DESCRIPTOR, filter_threshold=_LEAST_SCORE)
        _load(torch, self._detector, weights_file(DETECTOR), {})
        # The file numbers layers within their kinds, kornia the kinds within layers.
        kinds = ("self_attn", "cross_attn")
        names = {f"{kind}.{i}.": f"transformers.{i}.{kind}." for kind in kinds for i in range(_LAYERS)}
        _load(torch, self._matcher, weights_file(MATCHER), names)

    def features(self, job: SfmJob, image: SurveyImage) -> LearnedFeatures:
        """Return the features of a photograph outside its mask; none of one that cannot be decoded."""
        pixels = decoded_photograph(job.images / image.name, image.sha256)
        if pixels is None:
            nothing = np.zeros((0, 2), np.float32), np.zeros((0, _DESCRIPTOR), np.float32)
            return LearnedFeatures(*nothing, (1, 1), (1, 1), 0, upright=False)
        height, width = pixels.shape[:2]
        scale = min(_MOST_ENLARGED, _LONGEST_PX / max(width, height))
        kernel = cv2.INTER_AREA if scale < 1 else cv2.INTER_CUBIC
        resized = cv2.resize(pixels, (round(width * scale), round(height * scale)), interpolation=kernel)
        quarters = quarters_to_north(image)
        turned = np.ascontiguousarray(np.rot90(resized[..., ::-1], quarters or 0))
        picture = self._torch.from_numpy(turned).permute(2, 0, 1)[None].float() / 255
        with self._torch.inference_mode():
            (detected,) = self._detector(picture)
        features = LearnedFeatures(
            detected.keypoints.float().numpy(),
            detected.descriptors.float().numpy(),
            (turned.shape[1], turned.shape[0]),
            (width, height),
            quarters or 0,
            upright=quarters is not None,
        )
        return _outside_mask(features, job, image)

    def matches(self, first: LearnedFeatures, second: LearnedFeatures) -> IntArray:
        """Return the matches (M, 2) of two photographs, as rows of their features."""
        best = np.zeros((0, 2), dtype=np.int64)
        for _ in range(1 if first.upright and second.upright else 4):
            matched = self._matches(first, second)
            best = matched if len(matched) > len(best) else best
            second = second.turned()
        return best if len(best) >= _FEWEST_MATCHES else best[:0]

    def _matches(self, first: LearnedFeatures, second: LearnedFeatures) -> IntArray:
        if min(len(first.xy_px), len(second.xy_px)) == 0:
            return np.zeros((0, 2), dtype=np.int64)
        pair = {f"image{place}": self._tensors(each) for place, each in enumerate((first, second))}
        with self._torch.inference_mode():
            return np.asarray(self._matcher(pair)["matches"][0].numpy(), dtype=np.int64)

    def _tensors(self, features: LearnedFeatures) -> dict[str, torch.Tensor]:
        return {
            "keypoints": self._torch.from_numpy(features.xy_px)[None],
            "descriptors": self._torch.from_numpy(features.descriptor)[None],
            "image_size": self._torch.tensor([features.size_px]),
        }


def add_learned(colmap: ModuleType, job: SfmJob, pairs: IntArray, progress: Progress) -> int:
    """Add learned features of the photographs of some pairs (P, 2), and their matches, to those in the database.

    Returns:
        The number of pairs with matches.
    """
    matcher = LearnedMatcher(job.options.threads)
    images = sorted(set(pairs.ravel().tolist()))
    features: dict[int, LearnedFeatures] = {}
    with progress.task("learned features", len(images)) as task:
        for index in images:
            features[index] = matcher.features(job, job.survey.images[index])
            task.advance()
    matches = {}
    with progress.task("learned matches", len(pairs)) as task:
        for a, b in pairs.tolist():
            rows = matcher.matches(features[a], features[b])
            if len(rows):
                matches[a, b] = rows
            task.advance()
    places = {index: features[index].in_photograph_px() for index in images}
    draft = job.database.with_name("learned.db")
    remove_database(draft)
    copy_database(job.database, draft)
    add_features(colmap, draft, places, matches)
    verify_matches(colmap, replace(job, database=draft), np.array(sorted(matches), dtype=np.int64), progress)
    finish_database(draft, job.database)
    remove_database(draft)
    return len(matches)


def _load(torch: ModuleType, network: torch.nn.Module, path: Path, names: dict[str, str]) -> None:
    """Load weights, data alone, into a network; parts of the weights' names are replaced."""
    state = {}
    for key, value in torch.load(path, map_location="cpu", weights_only=True).items():
        old = next((old for old in names if key.startswith(old)), "")
        state[names.get(old, "") + key.removeprefix(old)] = value
    loaded = network.load_state_dict(state, strict=False)
    absent = set(loaded.missing_keys) & {name for name, _ in network.named_parameters()}
    if absent or loaded.unexpected_keys:  # another version of kornia
        raise RuntimeError(f"{path.name} does not fit: {sorted(absent) or loaded.unexpected_keys}")
    network.eval()


def quarters_to_north(image: SurveyImage) -> int | None:
    """Return the quarters to the left that bring north up in a photograph from above; None: no attitude says it."""
    if image.attitude is None:
        return None
    cam_from_geo = matrix_from_quat_xyzw(image.attitude.quat_xyzw).T
    # Of an oblique view, what lies ahead is up already, whatever its direction: turned by the horizon.
    north = cam_from_geo[:2, 1] if abs(cam_from_geo[2, 2]) > np.sqrt(0.5) else cam_from_geo[:2, 2]
    right, down = north
    return round(float(np.degrees(np.arctan2(right, -down))) / 90) % 4


def _outside_mask(features: LearnedFeatures, job: SfmJob, image: SurveyImage) -> LearnedFeatures:
    if job.masks is None or not image.mask_sha256:
        return features
    mask = decoded_photograph(job.masks / f"{image.name}.png", image.mask_sha256)
    if mask is None:
        return features
    column, row = features.in_photograph_px().astype(int).T
    kept = mask[..., 0][row.clip(0, mask.shape[0] - 1), column.clip(0, mask.shape[1] - 1)] > 0
    return replace(features, xy_px=features.xy_px[kept], descriptor=features.descriptor[kept])

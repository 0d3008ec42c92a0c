"""Plain, slow stereo, as oracles of the kernels: OpenCV and numpy, one image after the other."""

from __future__ import annotations

import cv2
import numpy as np

from pipelines.core.types import Float32Array
from pipelines.geometry.cameras import ViewPose
from pipelines.surface.agreement import AgreementSettings
from pipelines.surface.matching import (
    NOISE_VARIANCE,
    UNSEEN,
    MatchSettings,
    StereoView,
    camera_matrix,
)
from pipelines.surface.sweep import SweepResult


def score_of_depth(
    reference: StereoView, neighbours: list[StereoView], depth: np.ndarray, settings: MatchSettings
) -> Float32Array:
    """Return the score (H, W) of depths (H, W), step by step as `Matcher` describes it."""
    scores = [correlation(reference.grey, warped(reference.camera, other, depth), settings) for other in neighbours]
    largest = np.sort(np.stack(scores), axis=0)[::-1][: settings.views]
    guide = cv2.ximgproc.createGuidedFilter(reference.grey, settings.reach_px, settings.edge_grey**2)
    score = guide.filter(np.ascontiguousarray(largest.mean(axis=0), dtype=np.float32))
    return np.where(depth > 0, score, np.float32(UNSEEN))


def warped(camera: ViewPose, other: StereoView, depth: np.ndarray) -> Float32Array:
    """Return the other view's grey levels (H, W) at the depths of a camera's rays; 0 outside its image."""
    place = camera.center_in_model + np.maximum(depth, 0)[..., None] * camera.rays() - other.camera.center_in_model
    x, y, z = np.moveaxis(place @ (camera_matrix(other.camera.pinhole, 0.5) @ other.camera.cam_from_model).T, -1, 0)
    u, v = (along / np.where(z > 0, z, 1) for along in (x, y))
    height, width = other.grey.shape
    inside = (z > 0) & (u >= 0) & (u <= width - 1) & (v >= 0) & (v <= height - 1)
    u, v = (np.where(inside, along, 0).astype(np.float32) for along in (u, v))
    return np.where(inside, cv2.remap(other.grey, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE), 0)


def correlation(image: Float32Array, other: Float32Array, settings: MatchSettings) -> Float32Array:
    """Return the normalised cross-correlation (H, W) over square windows; −1 where `other` is 0."""

    def mean(values: np.ndarray) -> np.ndarray:
        side = (settings.window_px, settings.window_px)
        return np.asarray(cv2.boxFilter(values.astype(np.float64), -1, side, borderType=cv2.BORDER_REFLECT))

    def variance(values: np.ndarray) -> np.ndarray:
        return np.maximum(mean(values.astype(np.float64) ** 2) - mean(values) ** 2, NOISE_VARIANCE)

    product = mean(image.astype(np.float64) * other) - mean(image) * mean(other)
    level = product / np.sqrt(variance(image) * variance(other))
    return np.where(other == 0, UNSEEN, level).astype(np.float32)


def agreed_by_numpy(reference: SweepResult, others: list[SweepResult], settings: AgreementSettings) -> np.ndarray:
    """Return the depths (H, W) of `agreed_depth`, from whole arrays."""
    own, rays = reference.depth(), reference.camera.rays()
    good = (reference.score > settings.least_score) & np.isfinite(own) & (own > 0)
    point = reference.camera.center_in_model + np.where(good, own, 1.0)[..., None] * rays
    weight = (reference.normals.offset_per_metre(reference.camera) * reference.sharpness) ** 2
    total, agree, through = np.zeros(own.shape), np.zeros(own.shape), np.zeros(own.shape)
    for other in others:
        camera, sweep = other.camera, other
        in_cam = (point - camera.center_in_model) @ camera.cam_from_model.T
        ahead, pinhole = np.where(in_cam[..., 2] > 0, in_cam[..., 2], 1.0), camera.pinhole
        column = np.floor(pinhole.fx * in_cam[..., 0] / ahead + pinhole.cx).astype(int)
        row = np.floor(pinhole.fy * in_cam[..., 1] / ahead + pinhole.cy).astype(int)
        seen = (in_cam[..., 2] > 0) & (row >= 0) & (row < camera.pinhole.height)
        seen &= (column >= 0) & (column < camera.pinhole.width)
        row, column = np.where(seen, row, 0), np.where(seen, column, 0)
        seen &= sweep.score[row, column] > settings.least_score
        normal = sweep.normals.normal_in_model[row, column]
        offset = (point * normal).sum(axis=-1)
        residual, along = sweep.offset_m[row, column] - offset, (rays * normal).sum(axis=-1)
        through += seen & (residual / (offset - normal @ camera.center_in_model) > settings.free)
        near = seen & (np.abs(residual) < settings.steps * sweep.step_m[row, column])
        near &= np.abs(residual / along) < 0.1 * own
        of_view = np.where(near, (along * sweep.sharpness[row, column]) ** 2, 0.0)
        total += of_view * np.where(near, residual / along, 0.0)
        weight = weight + of_view
        agree += near
    agreed = good & (agree >= settings.least_views) & (through < settings.most_through * agree)
    return np.where(agreed, own + total / weight, 0.0)

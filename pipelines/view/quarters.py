"""Quartered targets (black and white quarters, or a chequer) near an expected place of a photograph.

On a circle around the middle of such a target the grey values rise and fall twice, however obliquely it is seen.
"""

from dataclasses import dataclass

import cv2
import numpy as np

from pipelines.core.types import ByteArray, Float32Array, FloatArray

_RADII_PX = (3.0, 4.5, 7.0, 11.0, 16.0)  # of the circles: the smallest target is eight pixels wide
_ON_CIRCLE = 16
_LEAST_SHARE = 0.7  # of the variation on the circle that is of two periods
_LEAST_CONTRAST = 12.0  # amplitude of these, of 255 grey values
_LEAST_RELATIVE = 0.3  # amplitude by the mean on the circle: paint has it, and ground seldom
_RIVAL = 0.7  # of the best response, from which another place is as likely
_WINDOW_SHARE = 0.7  # half side of the window of the refinement, in radii of the largest circle in the target
_MOST_MOVED_PX = 2.0  # by the refinement
_LEAST_SIGMA_PX, _MOST_SIGMA_PX = 0.02, 0.4  # a middle known worse is no paint, or is hidden in part
# Neighbouring pixels share grey values by lens, sensor and compression: so many count as one.
_PIXELS_OF_ONE = 6.0


@dataclass(frozen=True)
class QuarteredTarget:
    """Middle (2,) of a quartered target, the centre of the top-left pixel (0.5, 0.5), with its σ along an axis."""

    center_px: FloatArray
    sigma_px: float
    share: float  # of the variation on circles that is of two periods


def find_quarters(grey: ByteArray, expected_px: FloatArray, reach_px: float) -> QuarteredTarget | None:
    """Return the quartered target within a distance of an expected place (2,); None: there is none, or several."""
    margin = int(np.ceil(reach_px + _RADII_PX[-1])) + 2
    corner = np.floor(expected_px).astype(int) - margin
    last = corner + 2 * margin + 1
    low, high = corner.clip(0), np.minimum(last, grey.shape[::-1])
    if (high - low < 2 * _RADII_PX[0] + 3).any():
        return None
    part = grey[low[1] : high[1], low[0] : high[0]].astype(np.float32)
    response, share = _responses(part)
    y, x = np.mgrid[: part.shape[0], : part.shape[1]]
    distance = np.hypot(x + low[0] + 0.5 - expected_px[0], y + low[1] + 0.5 - expected_px[1])
    response = np.where(distance <= reach_px, response, 0.0)
    strongest = response.max(axis=0)
    row, column = divmod(int(strongest.argmax()), strongest.shape[1])
    if strongest[row, column] <= 0:
        return None
    good = np.flatnonzero(response[:, row, column] > 0)
    first_run = good[good - good[0] == np.arange(len(good))]
    radius = _RADII_PX[first_run[-1]]
    rivals = np.where(np.hypot(x - column, y - row) > 2 * radius, strongest, 0.0)
    if rivals.max() > _RIVAL * strongest[row, column]:
        return None
    middle = _refined(part, np.array([column, row], dtype=np.float64), max(2, round(_WINDOW_SHARE * radius)))
    if middle is None or middle[1] > _MOST_SIGMA_PX:
        return None
    place, sigma = middle
    return QuarteredTarget(place + low + 0.5, sigma, float(share[good[0], row, column]))


def _responses(grey: Float32Array) -> tuple[FloatArray, FloatArray]:
    """Return responses (R, H, W) of pixels for R circles, 0 where there is no middle, and shares (R, H, W)."""
    height, width = grey.shape
    angle = 2 * np.pi * np.arange(_ON_CIRCLE) / _ON_CIRCLE
    responses, shares = [], []
    for radius in _RADII_PX:
        smooth = cv2.GaussianBlur(grey, (0, 0), 0.15 * radius)
        ring = np.stack(
            [
                cv2.warpAffine(
                    smooth,
                    np.array([[1, 0, radius * np.cos(at)], [0, 1, radius * np.sin(at)]]),
                    (width, height),
                    flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
                    borderMode=cv2.BORDER_REPLICATE,
                )
                for at in angle
            ]
        )
        power = np.abs(np.fft.rfft(ring, axis=0)) ** 2
        # Two periods, and their overtones: the edges are sharp.
        of_two = power[2] + power[4] + power[6]
        share = of_two / np.maximum(power[1:].sum(axis=0), 1e-6)
        contrast = 2 * np.sqrt(power[2]) / _ON_CIRCLE
        sharp = contrast >= np.maximum(_LEAST_CONTRAST, _LEAST_RELATIVE * ring.mean(axis=0))
        inside = np.zeros(grey.shape, dtype=bool)
        rim = int(np.ceil(radius))
        inside[rim : height - rim, rim : width - rim] = True
        is_middle = inside & (share >= _LEAST_SHARE) & sharp
        responses.append(np.where(is_middle, contrast * share**2, 0.0))
        shares.append(share)
    return np.array(responses), np.array(shares)


def _refined(grey: Float32Array, middle: FloatArray, half: int) -> tuple[FloatArray, float] | None:
    """Return the middle (2,) to a part of a pixel, and its σ: gradients are across lines that meet there.

    As cv2.cornerSubPix: the place to which gradients in a window are perpendicular, by least squares.
    """
    smooth = np.asarray(cv2.GaussianBlur(grey, (0, 0), 0.7), dtype=np.float64)
    down, right = (np.asarray(np.gradient(smooth, axis=axis)) for axis in (0, 1))
    start, offset = middle, np.arange(-half, half + 1)
    for _ in range(20):
        column, row = np.rint(middle).astype(int)
        rows, columns = row + offset, column + offset
        if min(row, column) < half or row + half >= grey.shape[0] or column + half >= grey.shape[1]:
            return None
        x, y = np.meshgrid(columns, rows)
        gradient = np.stack([right[np.ix_(rows, columns)], down[np.ix_(rows, columns)]], axis=-1).reshape(-1, 2)
        place = np.stack([x, y], axis=-1).reshape(-1, 2)
        weight = np.exp(-((place - middle) ** 2).sum(axis=1) / (0.5 * half**2 + 1))
        normal = np.einsum("k,ki,kj->ij", weight, gradient, gradient)
        if np.linalg.cond(normal) > 100:
            return None
        moved = np.linalg.solve(normal, np.einsum("k,ki,kj,kj->i", weight, gradient, gradient, place))
        if np.abs(moved - start).max() > _MOST_MOVED_PX:
            return None
        done = np.abs(moved - middle).max() < 1e-3
        middle = moved
        if done:
            break
    # A target looks the same turned by half: what opposite pixels say together is noise, or what lies beside it.
    away = np.stack(np.meshgrid(offset, offset), axis=-1).reshape(-1, 2).astype(np.float64)
    at = (middle + away).astype(np.float32).reshape(len(offset), len(offset), 2)
    slope = np.stack(
        [np.ravel(cv2.remap(part, at[..., 0], at[..., 1], cv2.INTER_LINEAR)) for part in (right, down)], axis=-1
    )
    weight = np.exp(-(away**2).sum(axis=1) / (0.5 * half**2 + 1))
    pull = (weight * np.einsum("ki,ki->k", slope, away))[:, None] * slope
    together = pull + pull[::-1]
    inverse = np.linalg.inv(normal)
    cov = inverse @ (together.T @ together / 2) @ inverse * _PIXELS_OF_ONE
    return middle, max(float(np.sqrt(np.trace(cov) / 2)), _LEAST_SIGMA_PX)

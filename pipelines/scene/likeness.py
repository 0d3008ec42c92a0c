"""Where a render shows its photograph: elsewhere, the model has no surface that the photograph confirms."""

from __future__ import annotations

import cv2
import numpy as np

from pipelines.core.types import BoolArray, ByteArray, Float32Array

_WINDOW_PX = 15
_LEAST_SHARE = 0.5  # of the photograph's contrast, which the render must show
_LEAST_CONTRAST = 6.0  # grey levels of 255: a fainter pattern is noise, and confirms or refutes nothing


def shows_photograph(rendered: ByteArray, photograph: ByteArray) -> BoolArray:
    """Return where a render (H, W, 3) shows the contrast of its photograph (H, W, 3): (H, W).

    A wall that is missing in the model, or a roof that was painted on the ground, appears blurred. The share of the
    photograph's contrast in the render is the slope of a straight line from grey levels of the photograph to those
    of the render, in a window around the pixel. Brightness and exposure have no influence on where it is low.

    Args:
        rendered: RGB.
        photograph: RGB, undistorted, of the same camera and size.
    """
    shown, given = (
        cv2.cvtColor(np.ascontiguousarray(image), cv2.COLOR_RGB2GRAY) for image in (rendered, photograph)
    )
    render, photo = shown.astype(np.float32), given.astype(np.float32)
    mean_render, mean_photo = _mean(render), _mean(photo)
    variance = _mean(photo * photo) - mean_photo**2
    covariance = _mean(photo * render) - mean_photo * mean_render
    return np.asarray((covariance >= _LEAST_SHARE * variance) | (variance < _LEAST_CONTRAST**2))


def _mean(image: Float32Array) -> Float32Array:
    return np.asarray(cv2.boxFilter(image, -1, (_WINDOW_PX, _WINDOW_PX)))

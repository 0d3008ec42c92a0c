"""Light and shade of a surface in plan, as on a map: the sun in the north-west, halfway up."""

import numpy as np

from pipelines.core.types import FloatArray

_AZIMUTH, _ELEVATION = np.radians(315.0), np.radians(45.0)
LEVEL_LIGHT = float(np.sin(_ELEVATION))  # of level ground
_TINT = 0.55  # strength of the colours of heights


def sunlight(height: FloatArray, cell: float) -> FloatArray:
    """Return the light (H, W), 1 on ground that faces the sun, of heights whose rows run from the north.

    `cell` is a cell's side in the unit of the heights. A height that is not known darkens none beside it: the light
    there is that of level ground. Slopes that face away from the sun have negative light.
    """
    if min(height.shape) < 2:
        return np.full(height.shape, LEVEL_LIGHT)
    south, east = np.gradient(height, cell)
    towards_east, towards_north = np.array([np.sin(_AZIMUTH), np.cos(_AZIMUTH)]) * np.cos(_ELEVATION)
    light = (LEVEL_LIGHT - towards_east * east + towards_north * south) / np.sqrt(1.0 + east**2 + south**2)
    return np.where(np.isfinite(light), light, LEVEL_LIGHT)


def pale(colours: FloatArray) -> FloatArray:
    """Return colours (…, 3) from 0 to 1 of heights, so pale that light and shade can be seen on them."""
    return np.asarray(1 - _TINT + _TINT * colours)

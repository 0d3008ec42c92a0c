"""Pixels of photographs that disagree with the model: cars and shadows that have moved between the photographs.

Trimming by residuals, as in RobustNeRF (doi 10.48550/arXiv.2302.00833) and SpotLessSplats
(doi 10.48550/arXiv.2406.20055), without a network:

1. The signed difference of photograph and render is averaged over cells of the image, colour by colour. Leaves in
   wind and edges that are not yet sharp differ by as much to either side, and cancel out. An object that has moved
   leaves its colour.
2. A cell is an outlier if its difference is several times a high quantile of all cells, which runs through the
   training: while the model is still coarse, no cell is an outlier.
3. Outliers and the cells around them do not count in the photometric loss, but for every fifth view: parts that are
   only late to converge could not come back otherwise.
"""

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional

_CELL, _LEAST_CELL_PX = 1 / 40, 8  # side of a cell, as a share of the photograph's longer side, and its lower limit
_QUANTILE = 0.9  # of the differences of a view's cells
_TIMES = 8.0  # its multiple from which a cell is an outlier
_LEAST = 0.05  # lower limit of that, of colours 0 … 1
_MEMORY = 0.95  # weight of the earlier views in the running quantile
_AMNESTY = 5  # all pixels count in every view with such a number


@dataclass(frozen=True)
class OutlierSettings:
    """Settings of `OutlierPixels`."""

    most: float = 0.01  # share of the cells of a view, before those around them are added
    views: int = 50  # before the first outlier


class OutlierPixels:
    """Running quantile of the differences, and the pixels beyond it."""

    def __init__(self, device: torch.device, settings: OutlierSettings | None = None) -> None:
        self.settings = settings or OutlierSettings()
        self._quantile = torch.zeros((), device=device)
        self._views = 0

    @torch.no_grad()
    def inliers(self, rendered: Tensor, target: Tensor, mask: Tensor | None, longest_px: int) -> Tensor | None:
        """Return the pixels (H, W) of the mask that are no outliers, and add the view to the running quantile.

        Render and target are (H, W, 3), a part of a photograph whose longer side is `longest_px`. None: all pixels
        count.
        """
        settings = self.settings
        cell = max(_LEAST_CELL_PX, round(_CELL * longest_px))
        difference = _cell_differences(rendered - target, mask, cell)
        kept = _MEMORY if self._views else 0.0
        high, highest = difference.flatten().quantile(difference.new_tensor([_QUANTILE, 1 - settings.most]))
        self._quantile.lerp_(high, 1 - kept)
        self._views += 1
        if self._views <= settings.views or self._views % _AMNESTY == 0:
            return mask
        limit = torch.maximum(_TIMES * self._quantile, highest).clamp_min(_LEAST)
        outlier = functional.max_pool2d((difference > limit).float()[None, None], 3, stride=1, padding=1)
        height, width = target.shape[:2]
        outside = outlier[0, 0].repeat_interleave(cell, 0).repeat_interleave(cell, 1)[:height, :width] > 0
        return ~outside if mask is None else mask & ~outside

    def state(self) -> dict[str, Tensor]:
        return {"quantile": self._quantile.clone(), "views": torch.tensor(self._views)}

    def restore(self, state: dict[str, Tensor]) -> None:
        self._quantile.copy_(state["quantile"])
        self._views = int(state["views"])


def _cell_differences(difference: Tensor, mask: Tensor | None, cell: int) -> Tensor:
    """Return the largest absolute mean of the three colours in each cell; 0 where no pixel counts."""
    counts = torch.ones_like(difference[..., 0]) if mask is None else mask.to(difference)
    planes = torch.cat([difference * counts[..., None], counts[..., None]], dim=-1).permute(2, 0, 1)[None]
    means = functional.avg_pool2d(planes, cell, ceil_mode=True, count_include_pad=False)[0]
    # Of a cell that counts in part, the part decides by its share.
    return means[:3].abs().amax(dim=0)

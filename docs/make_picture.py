"""Make the README's picture from an evaluated workspace: `python docs/make_picture.py WORKSPACE --view 1`.

The picture shows this flight:

    georef simulate survey --images 48 --size 960x720 --seed 3
    georef run WORKSPACE --images survey/images --trajectory survey/trajectory.csv --vertical ellipsoidal \\
        --gcp survey/gcp_list.txt --checkpoints survey/checkpoints.txt \\
        --preset fast --iterations 2500 --max-image-size 720
"""

from __future__ import annotations

import argparse
from pathlib import Path

import cv2
import numpy as np

PICTURE = Path(__file__).parent / "images" / "flight.jpg"
GAP_PX, WIDTH_PX, QUALITY = 12, 1600, 85


def compose(render: Path, accuracy: Path) -> np.ndarray:
    """Return photograph, render and accuracy map side by side, BGR.

    Args:
        render: strip of photograph, render and difference, of equal widths.
        accuracy: map of the predicted accuracy, horizontal on its left half.
    """
    strip, whole_map = cv2.imread(str(render)), cv2.imread(str(accuracy))
    if strip is None or whole_map is None:
        raise SystemExit("no pictures there: run `georef evaluate` on the workspace first")
    height, width = strip.shape[0], strip.shape[1] // 3
    rows, columns = whole_map.shape[:2]
    horizontal = whole_map[round(0.075 * rows) : round(0.905 * rows), : columns // 2]  # without title and legend
    size = (round(horizontal.shape[1] * height / horizontal.shape[0]), height)
    gap = np.full((height, GAP_PX, 3), 255, dtype=np.uint8)
    small = cv2.resize(horizontal, size, interpolation=cv2.INTER_AREA)
    picture = np.hstack([strip[:, :width], gap, strip[:, width : 2 * width], gap, small])
    scale = WIDTH_PX / picture.shape[1]
    return cv2.resize(picture, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)


def main() -> None:
    """Write the picture."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("workspace", type=Path)
    parser.add_argument("--view", type=int, default=0, help="number of the test view")
    options = parser.parse_args()
    renders = sorted((options.workspace / "evaluate" / "renders").glob("*.png"))
    if not renders:
        raise SystemExit("no renders there: run `georef evaluate` on the workspace first")
    PICTURE.parent.mkdir(exist_ok=True)
    picture = compose(renders[options.view], options.workspace / "evaluate" / "accuracy.png")
    cv2.imwrite(str(PICTURE), picture, [cv2.IMWRITE_JPEG_QUALITY, QUALITY])


if __name__ == "__main__":
    main()

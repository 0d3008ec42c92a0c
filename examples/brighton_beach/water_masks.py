"""Write masks of the lake in three of the photographs: python water_masks.py FOLDER.

Water moves and mirrors: it is not the same surface in two photographs. The outlines were drawn by hand, in pixels
of the photographs of 2000×1125.
"""

import argparse
from pathlib import Path

import cv2
import numpy as np

SIZE_PX = (2000, 1125)
SHORE = {
    "DJI_0030.JPG": [
        (1720, 0), (1620, 130), (1480, 230), (1440, 300), (1430, 500), (1415, 600), (1420, 700), (1440, 790),
        (1510, 840), (1500, 900), (1470, 1000), (1500, 1125), (2000, 1125), (2000, 0),
    ],
    "DJI_0031.JPG": [
        (2000, 330), (1990, 480), (1850, 560), (1680, 640), (1590, 700), (1440, 790), (1420, 850), (1410, 900),
        (1400, 1000), (1390, 1125), (2000, 1125),
    ],
    "DJI_0032.JPG": [
        (1500, 1125), (1570, 1010), (1690, 1020), (1770, 1080), (1900, 1000), (2000, 1000), (2000, 1125),
    ],
}  # fmt: skip


def main() -> None:
    """Write a PNG for each photograph, named as COLMAP names masks; 0: left out."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    folder = parser.parse_args().folder
    folder.mkdir(parents=True, exist_ok=True)
    width, height = SIZE_PX
    for name, outline in SHORE.items():
        mask = np.full((height, width), 255, np.uint8)
        cv2.fillPoly(mask, [np.array(outline)], 0)
        cv2.imwrite(str(folder / f"{name}.png"), mask)


if __name__ == "__main__":
    main()

"""Table of the options of this engine, in OpenDroneMap's names where it has them, and the words of a call.

NodeODM's own Python reads the table by `config(parser=…)`: this file needs nothing but the standard library, and a
`type` is a class of Python, whose name NodeODM reads. What an option does is in `engine.py`.
"""

from __future__ import annotations

import argparse
import math
import os
import re
from collections.abc import Sequence
from typing import Any

# Steps of OpenDroneMap that exist here, in the order of this engine, and the stage of `georef` that each begins.
STEPS = {
    "dataset": "ingest",
    "opensfm": "sfm",
    "odm_georeferencing": "init-sim3",
    "openmvs": "train",
    "odm_orthophoto": "export-ply",
    "odm_report": "export-ply",
    "odm_postprocess": "export-ply",
}
QUALITIES = ["ultra", "high", "medium", "low", "lowest"]
_FLAG: dict[str, Any] = {"action": "store_true", "default": False}
_CENTIMETRES: dict[str, Any] = {"metavar": "<positive float>", "type": float, "default": 0.0}

OPTIONS: dict[str, dict[str, Any]] = {
    "preset": {
        "choices": ["by-quality", "smoke", "fast", "standard", "high"],
        "default": "by-quality",
        "help": "Effort of the training: high for small objects and dense trees, smoke to try whether the "
        "photographs fit together. by-quality: as pc-quality says. Default: %(default)s",
    },
    "pc-quality": {
        "choices": QUALITIES,
        "default": "medium",
        "help": "Effort by OpenDroneMap's name: ultra and high are the preset high, medium is standard, low is "
        "fast, lowest is smoke. Default: %(default)s",
    },
    "feature-quality": {
        "choices": QUALITIES,
        "default": "high",
        "help": "Longest side of photographs in which features are detected: 3200, 1600, 1200, 800 or 600 pixels. "
        "Default: %(default)s",
    },
    "fast-orthophoto": {
        **_FLAG,
        "help": "Make rasters and report only, without point cloud and mesh, by the preset fast unless another is "
        "named. Default: %(default)s",
    },
    "orthophoto-resolution": {
        **_CENTIMETRES,
        "help": "Width of a cell of the rasters in cm, not limited by the photographs; 0: the width of a pixel of "
        "the photographs on the ground. All rasters have one width: the smaller of this and dem-resolution. "
        "Default: %(default)s",
    },
    "dem-resolution": {**_CENTIMETRES, "help": "As orthophoto-resolution. Default: %(default)s"},
    "dsm": {**_FLAG, "help": "Deliver the surface model, odm_dem/dsm.tif. Default: %(default)s"},
    "dtm": {
        **_FLAG,
        "help": "Deliver the terrain model, odm_dem/dtm.tif: the ground without houses, trees and cars. "
        "Default: %(default)s",
    },
    "cog": {**_FLAG, "help": "Rasters are Cloud Optimized GeoTIFFs with and without this. Default: %(default)s"},
    "3d-tiles": {**_FLAG, "help": "Deliver the splat as 3D Tiles, 3d_tiles/model. Default: %(default)s"},
    "skip-3dmodel": {**_FLAG, "help": "Make no textured mesh. Default: %(default)s"},
    "skip-report": {**_FLAG, "help": "Make no report. Default: %(default)s"},
    "boundary": {
        "metavar": "<json>",
        "type": str,
        "default": "",
        "help": "GeoJSON polygon of the area of interest: rasters, cloud, mesh and splat end there. Without it: "
        "the ground that at least 3 photographs see. Default: %(default)s",
    },
    "crop": {
        "metavar": "<positive float>",
        "type": float,
        "default": 3.0,
        "help": "0: keep the splat whole, with sky and horizon. Any other number crops it to the area of interest, "
        "where rasters, cloud and mesh always end; the number itself is not used. Default: %(default)s",
    },
    "gps-accuracy": {
        "metavar": "<positive float>",
        "type": float,
        "default": 0.0,
        "help": "Standard deviation of the positions of the photographs in metres, horizontal and vertical; 0: as "
        "the photographs state it, or by their receiver. Default: %(default)s",
    },
    "vertical": {
        "metavar": "<string>",
        "type": str,
        "default": "",
        "help": "Vertical datum of the heights in the photographs: ellipsoidal, EGM96, EGM2008 or EPSG:n. "
        "Without it: as the photographs state it, or assumed, which the report says. Default: %(default)s",
    },
    "tolerance-h": {
        "metavar": "<positive float>",
        "type": float,
        "default": 0.0,
        "help": "Required horizontal accuracy in metres, an RMSE that the report tests at check points; 0: none. "
        "Default: %(default)s",
    },
    "tolerance-v": {
        "metavar": "<positive float>",
        "type": float,
        "default": 0.0,
        "help": "Required vertical accuracy in metres, as tolerance-h. Default: %(default)s",
    },
    "max-concurrency": {
        "metavar": "<positive integer>",
        "type": int,
        "default": os.cpu_count() or 1,
        "help": "Number of threads. Default: %(default)s",
    },
    "end-with": {
        "choices": list(STEPS),
        "default": "odm_postprocess",
        "help": "Last step. odm_georeferencing comes before openmvs, which is the training. Default: %(default)s",
    },
    "rerun-from": {
        "choices": list(STEPS),
        "default": "",
        "help": "First step that is repeated although its result is current. Default: %(default)s",
    },
}
# What the node adds by itself, and never shows.
_OF_THE_NODE = ("project-path", "gcp", "geo", "align", "split-image-groups")


def config(argv: Sequence[str] | None = None, parser: argparse.ArgumentParser | None = None) -> argparse.Namespace:
    """Add the options to a parser of argparse, and return the values of a call (default: this process's)."""
    parser = parser or argparse.ArgumentParser(prog="run.sh", allow_abbrev=False)
    for name, form in OPTIONS.items():
        parser.add_argument(f"--{name}", **form)
    for name in _OF_THE_NODE:
        parser.add_argument(f"--{name}", metavar="<path>", default="", help="Given by the node.")
    parser.add_argument("name", metavar="<task>", help="Name of the task's folder in project-path.")
    given = parser.parse_args(argv)
    for name, form in OPTIONS.items():
        value = getattr(given, name.replace("-", "_"))
        if str(form.get("metavar", "")).startswith("<positive") and not (math.isfinite(value) and value >= 0):
            parser.error(f"argument --{name}: {value} is not a positive number")
    if not re.fullmatch(r"\w[\w.-]*", given.name):
        parser.error(f"{given.name!r} is not the name of a folder")
    return given

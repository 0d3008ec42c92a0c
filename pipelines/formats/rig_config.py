"""COLMAP's `rig_config.json`: lenses that expose together, told apart by prefixes of their photographs' names.

The rest of the name is that of the instant: `left/0007.jpg` and `right/0007.jpg` were exposed together where the
prefixes are `left/` and `right/`. One lens of a rig is its reference. The pose of another one may be stated,
`cam_from_rig_rotation` as a quaternion w, x, y, z and `cam_from_rig_translation` in metres.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from pydantic import RootModel

from pipelines.core.errors import InputError
from pipelines.core.products import load_json
from pipelines.formats.solved_cameras import Foreign


@dataclass(frozen=True)
class RigLens:
    """Lens of a rig: the prefix of its photographs, and its rotation lens ← reference (x, y, z, w) if stated."""

    prefix: str
    quat_xyzw: tuple[float, float, float, float] | None = None


@dataclass(frozen=True)
class RigConfig:
    """Lenses that expose together; the reference is the first."""

    lenses: tuple[RigLens, ...]


class _Camera(Foreign):
    image_prefix: str
    ref_sensor: bool = False
    cam_from_rig_rotation: list[float] | None = None


class _Rig(Foreign):
    cameras: list[_Camera]


class _Rigs(RootModel[list[_Rig]]):
    pass


def read_rig_config(path: Path) -> tuple[RigConfig, ...]:
    """Read the rigs of a file.

    Raises:
        InputError: unreadable, not of that form, a rig without exactly one reference or with one lens, two lenses
            with one prefix, or a rotation that is none.

    Examples:
        >>> import json
        >>> cameras = [{"image_prefix": "left/", "ref_sensor": True}, {"image_prefix": "right/"}]
        >>> _ = Path("rig.json").write_text(json.dumps([{"cameras": cameras}]))
        >>> read_rig_config(Path("rig.json"))[0].lenses[1]
        RigLens(prefix='right/', quat_xyzw=None)
    """
    rigs = load_json(_Rigs, path).root
    if not rigs:
        raise InputError("rig-empty", "The file has no rig.", path=path, field="--rig")
    prefixes: set[str] = set()
    found = []
    for number, rig in enumerate(rigs):
        references = [camera for camera in rig.cameras if camera.ref_sensor]
        if len(references) != 1 or len(rig.cameras) < 2:
            raise InputError(
                "rig-reference",
                f"Rig {number + 1} has {len(rig.cameras)} cameras and {len(references)} with ref_sensor: a rig has "
                "two cameras or more, of which one is the reference.",
                path=path,
                field=f"{number}.cameras",
            )
        lenses = []
        for rank, camera in enumerate(sorted(rig.cameras, key=lambda camera: not camera.ref_sensor)):
            if any(camera.image_prefix.startswith(p) or p.startswith(camera.image_prefix) for p in prefixes):
                raise InputError(
                    "rig-prefix",
                    f"The prefix {camera.image_prefix!r} is the beginning of another camera's, or that of both: "
                    "no photograph may belong to two cameras.",
                    path=path,
                    field=f"{number}.cameras.{rank}.image_prefix",
                )
            prefixes.add(camera.image_prefix)
            lenses.append(RigLens(camera.image_prefix, _quaternion(camera, path, f"{number}.cameras.{rank}")))
        found.append(RigConfig(tuple(lenses)))
    return tuple(found)


def _quaternion(camera: _Camera, path: Path, field: str) -> tuple[float, float, float, float] | None:
    """Return a stated rotation as x, y, z, w of length one."""
    stated = camera.cam_from_rig_rotation
    if stated is None:
        return None
    length = float(np.linalg.norm(stated))
    if len(stated) != 4 or not 0.99 < length < 1.01:
        raise InputError(
            "rig-rotation",
            f"The rotation of {camera.image_prefix!r} is no quaternion w, x, y, z of length one.",
            path=path,
            field=f"{field}.cam_from_rig_rotation",
        )
    w, x, y, z = (value / length for value in stated)
    return x, y, z, w

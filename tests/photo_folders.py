"""A folder of photographs of several lenses and bodies, with the tags that their makers write."""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from pipelines.core.products import load_json
from pipelines.core.runner import Outcome, run_stage
from pipelines.core.stages import BY_NAME, SURVEY
from pipelines.core.workspace import Workspace
from pipelines.survey.survey import Survey
from tests.photos import ASCII, Entry, Exif, gps_entries, jpeg

DJI, PIX4D = "http://www.dji.com/drone-dji/1.0/", "http://pix4d.com/camera/1.0/"
AUX, PARROT = "http://ns.adobe.com/exif/1.0/aux/", "http://www.parrot.com/namespace/drone-parrot/"
EXIF_EX = "http://cipa.jp/exif/1.0/"
SMALL, LARGE = (40, 32), (64, 48)


def packet(space: str, values: Mapping[str, object], *, elements: bool = False) -> bytes:
    """A packet of XMP with properties of one namespace, as attributes or as elements."""
    attributes = " ".join(f'n:{name}="{value}"' for name, value in values.items())
    children = "".join(f"<n:{name}>{value}</n:{name}>" for name, value in values.items())
    body = f">{children}</rdf:Description>" if elements else f" {attributes}/>"
    return (
        '<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">'
        f'<rdf:Description rdf:about="" xmlns:n="{space}"{body}</rdf:RDF></x:xmpmeta>'
    ).encode()


class Folder:
    """A folder to which photographs are added, each a second and 10 m after the last."""

    def __init__(self, root: Path) -> None:
        self.root, self._seeds, self._seconds = root, itertools.count(), itertools.count()

    def instant(self) -> Exif:
        second = next(self._seconds)
        return Exif(
            photo=[
                (0x9003, ASCII, f"2026:05:04 10:{second // 60:02d}:{second % 60:02d}"),
                (0x9011, ASCII, "+00:00"),
            ],
            gps=gps_entries(46.0, 7.0 + 1e-4 * second),
        )

    def add(
        self,
        name: str,
        at: Exif | None = None,
        *,
        model: str = "M",
        size: tuple[int, int] = LARGE,
        xmp: bytes | None = None,
        image: tuple[Entry, ...] = (),
        photo: tuple[Entry, ...] = (),
    ) -> None:
        at = self.instant() if at is None else at
        tags = [(0x010F, ASCII, "Maker"), (0x0110, ASCII, model), *image]
        exif = Exif(image=tags, photo=[*at.photo, *photo], gps=at.gps)
        path, seed = self.root / name, next(self._seeds)
        path.parent.mkdir(parents=True, exist_ok=True)
        if path.suffix.lower() not in (".tif", ".tiff"):
            path.write_bytes(jpeg(seed, size, exif, xmp))
            return
        pixels = np.random.default_rng(seed).integers(0, 65535, (size[1], size[0]), dtype=np.uint16)
        moment = at.photo[0][2]
        info: dict[int, Any] = {
            0x010F: "Maker",
            0x0110: model,
            0x0132: moment,
            **({} if xmp is None else {700: xmp}),
        }
        Image.fromarray(pixels).save(path, tiffinfo=info)

    def ingest(self, workspace: str = "ws", **options: object) -> tuple[Survey, Outcome]:
        place = Workspace(self.root.parent / workspace)
        found = run_stage(place, BY_NAME["ingest"], {"images": self.root, "vertical": "ellipsoidal", **options})
        return load_json(Survey, place.path(SURVEY)), found

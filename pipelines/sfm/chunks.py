"""Chunks of a reconstruction: parts of features and of matches that processes work on independently.

The plan lies in the partial product of the stage, and a folder for each chunk beside it. A chunk is finished when
its folder holds `database.db`. The folder's name has a hash of all that the chunk is made from: a finished chunk is
used again exactly as long as it is right.
"""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import Field

from pipelines.core.products import Product
from pipelines.core.types import IntArray
from pipelines.core.versions import library_versions
from pipelines.scene.survey import Survey
from pipelines.sfm.options import SfmOptions

PLAN = "chunks.json"
FOLDER = "chunks"
DATABASE = "database.db"

Kind = Literal["features", "matches"]
Index = Annotated[int, Field(ge=0)]
# Matches of an image with its neighbours take about as long as its features: both kinds of chunks take as long.
_PAIRS_PER_PHOTOGRAPH = 8


class Chunk(Product):
    """Part of the features, or of the matches, of a survey.

    Attributes:
        name: unique in the plan, for people and for the command line.
        kind: what is computed.
        key: hash of all that the chunk is made from.
        images: indices of the photographs, ascending.
        pairs: indices of the photographs to match, for a chunk of matches.
    """

    name: str = Field(pattern=r"^(features|matches)-[0-9]{4,9}$")
    kind: Kind
    key: str = Field(pattern=r"^[0-9a-f]{16}$")
    images: tuple[Index, ...]
    pairs: tuple[tuple[Index, Index], ...] = ()

    def folder(self, partial: Path) -> Path:
        """Return the folder of the chunk in the partial product of the stage."""
        return partial / FOLDER / f"{self.name}-{self.key}"

    def database(self, partial: Path) -> Path:
        """Return the database of the chunk, which exists when the chunk is finished."""
        return self.folder(partial) / DATABASE

    def is_finished(self, partial: Path) -> bool:
        """Return whether the chunk is finished."""
        return self.database(partial).is_file()


class ChunkPlan(Product):
    """Chunks of a reconstruction.

    Attributes:
        format_version: version of the format.
        options: of the stage.
        chunks: those of features before those of matches.
    """

    format_version: Literal[1] = 1
    options: SfmOptions
    chunks: tuple[Chunk, ...]

    def of_kind(self, kind: Kind) -> tuple[Chunk, ...]:
        """Return the chunks of a kind."""
        return tuple(chunk for chunk in self.chunks if chunk.kind == kind)


def is_chunked(photographs: int, options: SfmOptions) -> bool:
    """Return whether a survey of so many photographs is worked in chunks."""
    return options.import_model is None and photographs > options.chunk_size


def plan_chunks(survey: Survey, pairs: IntArray, options: SfmOptions) -> ChunkPlan:
    """Return the chunks of a survey, of about equal size and about `options.chunk_size` photographs.

    Photographs and pairs are cut in their order, which for photographs is that of the flight as a rule: a chunk of
    matches needs the features of few chunks.

    Args:
        survey: has the photographs.
        pairs: (P, 2) indices of the photographs to match, sorted.
        options: of the stage.
    """
    features = _cut(np.arange(len(survey.images)), options.chunk_size)
    matches = _cut(pairs, options.chunk_size * _PAIRS_PER_PHOTOGRAPH)
    common = _digest(
        [prior.model_dump(mode="json") for prior in survey.cameras],
        options.model_dump(include={"camera_model", "max_image_size", "max_features", "doubled"}),
        library_versions(("pycolmap",))["pycolmap"],
    )
    photographs = [[image.name, image.camera_id, image.sha256] for image in survey.images]

    def chunk(kind: Kind, number: int, images: IntArray, pairs: IntArray) -> Chunk:
        listed: list[tuple[int, int]] = [(a, b) for a, b in pairs.tolist()]
        drawn = [options.seed, listed] if listed else []
        key = _digest(common, [[index, *photographs[index]] for index in images.tolist()], drawn)
        name = f"{kind}-{number:04d}"
        return Chunk(name=name, kind=kind, key=key, images=tuple(images.tolist()), pairs=tuple(listed))

    none = np.empty((0, 2), dtype=np.int64)
    chunks = [chunk("features", number, part, none) for number, part in enumerate(features)]
    chunks += [chunk("matches", number, np.unique(part), part) for number, part in enumerate(matches)]
    return ChunkPlan(options=options.model_copy(update={"threads": -1}), chunks=tuple(chunks))


def _cut(rows: IntArray, size: int) -> list[IntArray]:
    return np.array_split(rows, max(-(-len(rows) // size), 1))


def _digest(*content: object) -> str:
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()[:16]

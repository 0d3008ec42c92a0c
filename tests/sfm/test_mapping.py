"""Choice of the mapper by size, its second chance, and the memory that is asked for before it starts."""

from __future__ import annotations

import logging
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from pipelines.core.errors import ResourceError
from pipelines.core.products import save_json
from pipelines.core.progress import SILENT
from pipelines.core.stages import BY_NAME, SURVEY
from pipelines.core.workspace import StageRun, Workspace
from pipelines.sfm import colmap_reconstruction, mapping, stage
from pipelines.sfm.estimate import chunk_peak_bytes, peak_bytes, why_too_large
from pipelines.sfm.features import SfmJob
from pipelines.sfm.mapping import chosen_mapper, map_database
from pipelines.sfm.options import SfmOptions
from pipelines.sfm.reconstructor import reconstructor_of
from tests.refusals import numbers, refused
from tests.sfm_scenes import CONFIG, HEIGHT, WIDTH, survey_of

GIB = 1 << 30
PHOTO_PX = (5280, 3956)


@dataclass(frozen=True)
class Model:
    """Stands for a reconstruction."""

    registered: int

    def num_reg_images(self) -> int:
        return self.registered


def test_the_global_mapper_is_for_large_surveys() -> None:
    assert chosen_mapper(100, SfmOptions()) == "incremental"
    assert chosen_mapper(5000, SfmOptions()) == "global"
    assert chosen_mapper(5000, SfmOptions(mapper="incremental")) == "incremental"
    assert chosen_mapper(100, SfmOptions(mapper="global")) == "global"


@pytest.mark.parametrize(
    ("asked", "of_global", "of_incremental", "runs", "largest"),
    [
        ("auto", 960, 0, ["global"], 960),
        ("auto", 900, 990, ["global", "incremental"], 990),
        ("auto", 900, 300, ["global", "incremental"], 900),  # the larger model counts
        ("auto", None, 990, ["global", "incremental"], 990),  # none at all
        ("global", 900, 990, ["global"], 900),  # as the user asked
    ],
)
def test_a_mapper_that_leaves_many_out_is_followed_by_the_other(
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
    tmp_path: Path,
    asked: Any,
    of_global: int | None,
    of_incremental: int,
    runs: list[str],
    largest: int,
) -> None:
    ran: list[str] = []

    def run_mapper(_colmap: Any, mapper: str, *_: Any) -> list[Model]:
        ran.append(mapper)
        registered = of_global if mapper == "global" else of_incremental
        return [] if registered is None else [Model(registered)]

    monkeypatch.setattr(mapping, "run_mapper", run_mapper)
    survey = survey_of([f"{index}.jpg" for index in range(1000)])
    job = SfmJob(survey, tmp_path, tmp_path / "database.db", CONFIG.model_copy(update={"mapper": asked}))
    with caplog.at_level(logging.WARNING):
        models, chosen = map_database(None, job, SILENT)
    assert ran == runs
    assert models[0].num_reg_images() == largest
    assert chosen == ("global" if largest == of_global else "incremental")
    assert ("the incremental mapper follows" in caplog.text) is (len(runs) == 2)


def test_memory_follows_size_and_options() -> None:
    options = SfmOptions()
    sizes = [peak_bytes(count, PHOTO_PX, options) for count in (1000, 2000, 4000)]
    assert 1.5 < sizes[1] / sizes[0] < 2.1 and 1.5 < sizes[2] / sizes[1] < 2.1
    fewer = options.model_copy(update={"max_features": 1000})
    assert peak_bytes(4000, PHOTO_PX, fewer) < 0.3 * sizes[2]
    imported = SfmOptions(import_model=Path("sparse"))
    assert reconstructor_of(imported).estimate(4000, PHOTO_PX, imported) is None  # needs no memory
    small = SfmOptions(max_image_size=600)
    assert chunk_peak_bytes(PHOTO_PX, small) < chunk_peak_bytes(PHOTO_PX, options) < 2 * GIB


def test_the_advice_fits() -> None:
    options = SfmOptions()
    free_bytes = peak_bytes(10_000, PHOTO_PX, options) // 2
    advised = re.search(r"--max-features (\d+)", why_too_large(10_000, PHOTO_PX, options, free_bytes) or "")
    assert advised is not None
    followed = options.model_copy(update={"max_features": int(advised[1])})
    assert why_too_large(10_000, PHOTO_PX, followed, free_bytes) is None
    more = options.model_copy(update={"max_features": int(advised[1]) + 500})
    assert why_too_large(10_000, PHOTO_PX, more, free_bytes) is not None
    reason = why_too_large(10_000, PHOTO_PX, options, GIB // 2)
    assert reason is not None and "--import" in reason  # no number of features would do
    assert why_too_large(10_000, PHOTO_PX, options, None) is None


def test_a_survey_that_does_not_fit_is_refused_before_work(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    survey = survey_of([f"{index}.jpg" for index in range(900)])
    save_json(survey, tmp_path / SURVEY)
    workspace = Workspace(tmp_path)
    partial = workspace.partial(BY_NAME["sfm"])
    partial.mkdir()
    needed = peak_bytes(900, (WIDTH, HEIGHT), SfmOptions())
    monkeypatch.setattr(colmap_reconstruction, "free_main_memory_bytes", lambda: needed // 2)
    with refused("memory-too-small", ResourceError) as error:
        stage.run(StageRun(workspace, partial), SfmOptions())
    assert numbers(str(error.value))[0] == 900
    assert list(partial.iterdir()) == []

"""Chunks of a large survey: nothing lost, nothing twice, the same features and matches as in one process."""

from __future__ import annotations

import shutil
import signal
import sqlite3
import sys
import time
from collections.abc import Callable, Iterable, Sequence
from contextlib import closing
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pipelines.core.errors import InputError, WorkspaceBusyError
from pipelines.core.lock import WriteLock
from pipelines.core.products import save_json
from pipelines.core.progress import SILENT, Progress
from pipelines.core.stages import BY_NAME, SPARSE, SURVEY
from pipelines.core.workspace import StageRun, Workspace
from pipelines.formats.colmap import quiet_colmap, read_sparse
from pipelines.jobs.engine import Job, JobEnd
from pipelines.jobs.local import chosen_engine
from pipelines.sfm.chunks import ChunkPlan, plan_chunks, work_chunk, work_in_chunks, write_chunk
from pipelines.sfm.features import SfmJob, candidate_pairs, extract_features
from pipelines.sfm.stage import run
from tests.cli_runs import finish, start
from tests.refusals import numbers, refused
from tests.sfm_scenes import CONFIG, IMAGES, Photographs, survey_of

pytest.importorskip("pycolmap")
GEOREF = "from georef_cli.main import main; main()"
CHUNKED = CONFIG.model_copy(update={"chunk_size": 5})
CHUNKS = ["features-0000", "features-0001", "matches-0000", "matches-0001"]


@dataclass
class InThisProcess:
    """Engine whose jobs are calls in this process.

    Attributes:
        failing: names of jobs that fail.
        pretends: the other jobs leave an empty file in place of a result.
        worked: names of the jobs that were done.
    """

    failing: tuple[str, ...] = ()
    pretends: bool = False
    worked: list[str] = field(default_factory=list)

    def together(self, jobs: Iterable[Job]) -> int:
        return 1

    def run(self, title: str, jobs: Sequence[Job], ended: Callable[[JobEnd], None], progress: Progress) -> None:
        for job in jobs:
            command, root, option, name = job.arguments
            assert (command, option) == ("sfm", "--chunk")
            assert job.writes is not None
            error = "no more photographs" if name in self.failing else ""
            if not error:
                self.worked.append(name)
                if self.pretends:
                    job.writes.mkdir(parents=True, exist_ok=True)
                    (job.writes / "database.db").touch()
                else:
                    assert all(path.exists() for path in job.reads)
                    partial = Workspace(Path(root)).partial(BY_NAME["sfm"])
                    where = {"survey": f"{root}/{SURVEY}", "images": f"{root}/photos", "partial": str(partial)}
                    write_chunk({**where, "name": name}, SILENT)
            ended(JobEnd(job, 1 if error else 0, 0.0, "", error))


def begun(root: Path, photographs: Photographs) -> StageRun:
    """A run of `sfm` that has just begun."""
    (root / "photos").symlink_to(photographs.folder)
    save_json(survey_of(photographs.names), root / SURVEY)
    workspace = Workspace(root)
    workspace.partial(BY_NAME["sfm"]).mkdir()
    return StageRun(workspace, workspace.partial(BY_NAME["sfm"]))


@pytest.fixture
def flight(photographs: Photographs, tmp_path: Path) -> StageRun:
    """A run of `sfm` that has just begun."""
    return begun(tmp_path, photographs)


@pytest.fixture(scope="module")
def worked(photographs: Photographs, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The partial product of a run whose chunks are finished."""
    stage, engine = begun(tmp_path_factory.mktemp("worked"), photographs), InThisProcess()
    with chosen_engine(engine):
        work_in_chunks(stage, survey_of(photographs.names), CHUNKED)
    assert engine.worked == CHUNKS
    return stage.out


def plan_of(stage: StageRun, names: list[str]) -> ChunkPlan:
    survey = survey_of(names)
    plan = plan_chunks(survey, candidate_pairs(survey, CHUNKED), CHUNKED)
    (stage.out / "chunks.json").write_text(plan.model_dump_json())
    return plan


def rows(database: Path, table: str) -> list[tuple[object, ...]]:
    with closing(sqlite3.connect(database)) as connection:
        return connection.execute(f"select * from {table} order by 1").fetchall()


def test_the_same_database_and_model_as_in_one_process(mapped: Workspace, flight: StageRun, worked: Path) -> None:
    """COLMAP draws its random samples pair by pair, from the seed: chunks change nothing."""
    shutil.copytree(worked, flight.out, dirs_exist_ok=True)
    (flight.out / "database.db").write_bytes(b"half of an earlier one")
    engine = InThisProcess()
    with chosen_engine(engine):
        summary = run(flight, CHUNKED)
    assert engine.worked == []
    assert summary.values["registered"] == IMAGES
    whole = mapped.path("sfm/database.db")
    for table in ("cameras", "images", "keypoints", "descriptors", "matches", "two_view_geometries"):
        assert rows(flight.out / "database.db", table) == rows(whole, table)
    assert read_sparse(flight.out / "sparse").image_name == read_sparse(mapped.path(SPARSE)).image_name
    assert {path.name for path in flight.out.iterdir()} <= {"sparse", "database.db", "progress.txt"}


def test_a_failed_chunk_is_named_and_the_others_are_kept(flight: StageRun, photographs: Photographs) -> None:
    survey = survey_of(photographs.names)
    with (
        chosen_engine(InThisProcess(failing=("features-0000",), pretends=True)),
        refused("chunks-failed") as error,
    ):
        work_in_chunks(flight, survey, CHUNKED)
    assert numbers(str(error.value))[:2] == [1, 2]
    assert "features-0000" in str(error.value) and "no more photo" in str(error.value)
    assert (flight.out / "progress.txt").read_text() == "1 of 4 chunks"
    again = InThisProcess(pretends=True)
    with chosen_engine(again):
        work_in_chunks(flight, survey, CHUNKED)
    assert again.worked == ["features-0000", "matches-0000", "matches-0001"]
    assert (flight.out / "progress.txt").read_text() == "4 of 4 chunks"


def test_a_damaged_chunk_is_computed_again(flight: StageRun, photographs: Photographs, worked: Path) -> None:
    shutil.copytree(worked, flight.out, dirs_exist_ok=True)
    survey, plan = survey_of(photographs.names), plan_of(flight, photographs.names)
    features, matches = plan.chunks[0].database(flight.out), plan.chunks[2].database(flight.out)
    matches.unlink()
    features.write_bytes(features.read_bytes()[:5000])
    with chosen_engine(InThisProcess()), refused("chunk-damaged", InputError):
        work_in_chunks(flight, survey, CHUNKED)
    again = InThisProcess(pretends=True)
    with chosen_engine(again):
        work_in_chunks(flight, survey, CHUNKED)
    assert again.worked == ["features-0000", "matches-0000"]


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="SIGKILL")
def test_a_killed_chunk_goes_on_where_it_was(flight: StageRun, photographs: Photographs) -> None:
    """Photographs whose features were written stay, and the end is the same as without the kill."""
    plan = plan_of(flight, photographs.names)
    chunk, root = plan.chunks[0], flight.workspace.root
    draft = chunk.folder(flight.out) / "unfinished.db"
    draft.parent.mkdir(parents=True)
    with quiet_colmap() as colmap:
        job = SfmJob(survey_of(photographs.names), root / "photos", draft, CHUNKED)
        extract_features(colmap, job, chunk.images[:2], SILENT)
    before = rows(draft, "descriptors")
    process = start("sfm", root, "--chunk", chunk.name, code=GEOREF)
    while not (draft.parent / ".lock").exists():
        time.sleep(0.01)
        assert process.poll() is None
    process.kill()
    assert finish(process).code == -signal.SIGKILL
    assert not chunk.database(flight.out).is_file()
    assert work_chunk(flight.workspace, chunk.name, SILENT)
    assert rows(chunk.database(flight.out), "descriptors")[:2] == before
    assert len(rows(chunk.database(flight.out), "descriptors")) == len(chunk.images)
    assert not work_chunk(flight.workspace, chunk.name, SILENT)  # nothing is done twice


def test_one_process_a_chunk(flight: StageRun, photographs: Photographs) -> None:
    chunk = plan_of(flight, photographs.names).chunks[0]
    with WriteLock(chunk.folder(flight.out)).hold("sfm --chunk"), pytest.raises(WorkspaceBusyError):
        work_chunk(flight.workspace, chunk.name, SILENT)


def test_chunks_that_nobody_planned_are_refused(flight: StageRun, photographs: Photographs) -> None:
    with refused("no-chunk-plan", InputError):
        work_chunk(flight.workspace, "features-0000", SILENT)
    plan_of(flight, photographs.names)
    for name in ("features-0009", "../features-0000"):
        with refused("unknown-chunk", InputError) as error:
            work_chunk(flight.workspace, name, SILENT)
        assert "features-0000 … matches-0001" in error.value.message
    with refused("chunk-not-finished") as error:
        work_chunk(flight.workspace, "matches-0000", SILENT)
    assert "features-0000" in str(error.value)
    plan_of(flight, [*photographs.names, "more.jpg"])
    with refused("chunk-plan-outdated", InputError):
        work_chunk(flight.workspace, "features-0003", SILENT)
    shutil.rmtree(flight.workspace.root / "ingest")
    with refused("missing-product"):
        work_chunk(flight.workspace, "features-0000", SILENT)


@settings(max_examples=25, deadline=None)
@given(count=st.integers(2, 300), size=st.integers(4, 60), seed=st.integers(0, 9))
def test_every_photograph_and_every_pair_once(count: int, size: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    drawn = {tuple(sorted(rng.choice(count, 2, replace=False).tolist())) for _ in range(4 * count)}
    pairs = np.array(sorted(drawn))
    survey = survey_of([f"{index}.jpg" for index in range(count)])
    plan = plan_chunks(survey, pairs, CONFIG.model_copy(update={"chunk_size": size}))
    features, matches = ([chunk for chunk in plan.chunks if chunk.kind == kind] for kind in ("features", "matches"))
    assert [index for chunk in features for index in chunk.images] == list(range(count))
    assert [pair for chunk in matches for pair in chunk.pairs] == [tuple(pair) for pair in pairs.tolist()]
    assert max(len(chunk.images) for chunk in features) <= size
    assert all(set(chunk.images) == {index for pair in chunk.pairs for index in pair} for chunk in matches)
    assert (
        len({chunk.name for chunk in plan.chunks}) == len({chunk.key for chunk in plan.chunks}) == len(plan.chunks)
    )


def test_keys_follow_photographs_and_options() -> None:
    """Only the chunks that a change concerns are computed again; more threads or another mapper concern none."""
    survey = survey_of([f"{index}.jpg" for index in range(12)])
    pairs = np.array([(index, index + 1) for index in range(11)])

    def keys(**update: object) -> list[str]:
        options = CHUNKED.model_copy(update=update)
        return [chunk.key for chunk in plan_chunks(survey, pairs, options).chunks]

    before = keys()
    assert keys(threads=7, mapper="global", principal_point=False) == before
    assert not set(keys(max_features=900)) & set(before)
    assert [a == b for a, b in zip(keys(seed=1), before, strict=True)] == 4 * [True] + [False]
    first = survey.images[0].model_copy(update={"sha256": "1" * 64})
    survey = survey.model_copy(update={"images": (first, *survey.images[1:])})
    assert [a == b for a, b in zip(keys(), before, strict=True)] == [False, *3 * [True], False]

"""A pipeline without photographs: stages that write small files, to test what surrounds the stages.

Every product of a fake stage holds one text, in JSON: the stage's name, its options, and a digest of what it read.
The report of `evaluate`, which the command line reads back, has that text among its cautions.
A workspace is consistent when each stage's products hold the text that its manifest tells.
"""

from __future__ import annotations

import hashlib
import json
import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType

from pipelines.core.options import StageOptions
from pipelines.core.products import Remark, dump_json
from pipelines.core.stages import PIPELINE, STAGES, StageSpec, producer_of, products_of
from pipelines.core.workspace import StageRun, Summary, Workspace

Run = Callable[[StageRun, StageOptions], Summary]


def write_products(stage: StageRun, spec: StageSpec, text: str) -> None:
    """Write every product of `spec` into the stage's folder; a product without a suffix is a folder."""
    for product in products_of(spec):
        path = stage.out / product.removeprefix(f"{spec.folder}/")
        file = path if path.suffix else path / "content.txt"
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(text, encoding="utf-8")


def read_products(workspace: Workspace, spec: StageSpec) -> list[str]:
    """The texts of all products of a finished stage."""
    return [_text_of(workspace.path(product)) for product in products_of(spec)]


def fake_run(spec: StageSpec) -> Run:
    """The `run` of a fake stage."""

    def run(stage: StageRun, options: StageOptions) -> Summary:
        read = "".join(_text_of(stage.workspace.path(s.product)) for s in PIPELINE if _reads(spec, s))
        document = {"stage": spec.name, "options": options.model_dump(mode="json"), "read": _digest(read)}
        text = _in_form(spec, json.dumps(document, separators=(",", ":")))
        with stage.progress.task(spec.name, 2) as task:
            task.advance(note="half")
            task.advance()
        write_products(stage, spec, text)
        return Summary(f"{spec.name} done", {"text": text, "resumed": stage.resumed})

    return run


def install(**replaced: Run) -> None:
    """Put fake stages where the runner looks for stages; `replaced` by name, with `_` for `-`."""
    for spec in STAGES:
        module = ModuleType(spec.module)
        module.run = replaced.get(spec.name.replace("-", "_"), fake_run(spec))  # type: ignore[attr-defined]
        module.made_in_parts = lambda *_: False  # type: ignore[attr-defined]
        module.check_inputs = lambda *_: None  # type: ignore[attr-defined]
        sys.modules[spec.module] = module


def photographs(folder: Path) -> Path:
    """A folder that stands for one of photographs."""
    folder.mkdir(parents=True, exist_ok=True)
    for name in ("a.jpg", "b.jpg"):
        (folder / name).write_bytes(name.encode())
    return folder


def _in_form(spec: StageSpec, text: str) -> str:
    """The text of a fake stage, in the form of its product where somebody reads that."""
    if spec.name != "evaluate":
        return text
    from tests.reports import report_with

    return dump_json(report_with(cautions=(Remark(code="fake", sentence=text),)).model_dump(mode="json"))


def _text_of(path: Path) -> str:
    return (path if path.is_file() else path / "content.txt").read_text(encoding="utf-8")


def _digest(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()


def _reads(spec: StageSpec, other: StageSpec) -> bool:
    return any(producer_of(part.product) is other for part in spec.reads if not part.optional)

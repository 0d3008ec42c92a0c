"""Messages: what is so, what to type against it, and what of both a client sees."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator

import pytest

from pipelines.core.errors import GeorefError, InputError, MissingProductError
from pipelines.core.products import Remark
from pipelines.core.sentences import without_folders
from tests.test_architecture import inside, sources

# What is typed in a terminal: commands of the program, its options (also `f"{flag}-crs"`), its file of options.
TYPED = re.compile(r"`?\bgeoref [a-z]|georef\.toml|(?<![\w-])--[a-z]|flag\}-")
# Functions that take the sentence of a remark, and its place among the arguments.
MAKERS = {"Remark": 1, "_Finding": 1, "Hypothesis": 1, "ClockShift": 2, "_remark": 1, "warn_counted": 2}
MAKERS |= dict.fromkeys(("assume", "warn", "caution"), 1)


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("Those of /home/me/flight/a.csv and C:\\me\\b.csv are WGS84.", "Those of a.csv and b.csv are WGS84."),
        ("WGS 84 / UTM zone 32N; https://a.b/c; 3 px/m", "WGS 84 / UTM zone 32N; https://a.b/c; 3 px/m"),
        ("", ""),
    ],
)
def test_folders_are_left_out(text: str, told: str) -> None:
    assert without_folders(text) == told
    assert without_folders(told) == told


def test_a_remark_is_its_sentence_and_its_remedy_and_an_old_one_is_read() -> None:
    whole = Remark(code="a", sentence="It is so.", remedy="Type --this.")
    assert whole.text == "It is so. Type --this."
    assert Remark.model_validate_json(whole.model_dump_json()) == whole
    old = Remark.model_validate_json('{"code": "a", "sentence": "It is so. Type --this."}')
    assert (old.remedy, old.text) == ("", "It is so. Type --this.")


@pytest.mark.parametrize(
    ("error", "text", "message", "remedy"),
    [
        (GeorefError("a", "It is so."), "It is so.", "It is so.", None),
        (GeorefError("a", "It is so.", remedy="Go."), "It is so. Go.", "It is so.", "Go."),
        (InputError("a", "is so.", path="f.csv", line=3, remedy="Go."), "f.csv:3: is so. Go.", "is so.", "Go."),
        (
            MissingProductError("sfm/sparse", "georef sfm flight"),
            "sfm/sparse is missing. Run `georef sfm flight` first.",
            "sfm/sparse is missing.",
            "Run `georef sfm flight` first.",
        ),
    ],
)
def test_an_error_is_its_message_and_its_remedy(
    error: GeorefError, text: str, message: str, remedy: str | None
) -> None:
    assert str(error) == text
    assert (error.document()["message"], error.document()["remedy"]) == (message, remedy)


def test_no_sentence_of_a_remark_says_what_to_type() -> None:
    files = {name: tree for name, tree in sources().items() if inside(name, "pipelines")}
    said = [(name, *found) for name, tree in files.items() for found in sentences_in(tree)]
    assert len(said) > 150  # the search finds them
    assert [f"{name}:{line}: {text}" for name, line, text in said if TYPED.search(text)] == []


def sentences_in(tree: ast.Module) -> Iterator[tuple[int, str]]:
    """Yield line and source of each text that a file makes the sentence of a remark."""
    for function in ast.walk(tree):
        if not isinstance(function, ast.FunctionDef):
            continue
        named: dict[str, list[ast.expr]] = {}
        for node in ast.walk(function):
            if isinstance(node, ast.Assign | ast.AugAssign):
                for target in node.targets if isinstance(node, ast.Assign) else [node.target]:
                    if isinstance(target, ast.Name):
                        named.setdefault(target.id, []).append(node.value)
        for call in ast.walk(function):
            if not isinstance(call, ast.Call):
                continue
            maker = call.func.attr if isinstance(call.func, ast.Attribute) else getattr(call.func, "id", "")
            at = MAKERS.get(maker)
            if at is None:
                continue
            given = [word.value for word in call.keywords if word.arg == "sentence"] or call.args[at : at + 1]
            for text in given:
                for node in named.get(text.id, []) if isinstance(text, ast.Name) else [text]:
                    yield node.lineno, ast.unparse(node)

"""Options: precedence, ranges, unknown keys, and the errors that name them."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from pydantic.fields import FieldInfo

from pipelines.core.errors import InputError
from pipelines.core.options import StageOptions, flag_name, input_paths, load_toml, notation, resolve
from pipelines.core.stages import PIPELINE
from pipelines.ingest.options import Every, IngestOptions
from pipelines.sfm.options import SfmOptions
from pipelines.train.options import TrainOptions
from tests.refusals import refused

OPTIONS = {spec.name: spec.options for spec in PIPELINE}
TOML = Path("/surveys/flight/georef.toml")


def test_precedence() -> None:
    assert resolve(SfmOptions, {}, {}, TOML).max_image_size == SfmOptions().max_image_size
    assert resolve(SfmOptions, {"max_image_size": 900}, {}, TOML).max_image_size == 900
    assert resolve(SfmOptions, {"max_image_size": 900}, {"max_image_size": 800}, TOML).max_image_size == 800


@pytest.mark.parametrize(
    ("table", "flags", "path", "field", "code", "known"),
    [
        ({"max_image_sise": 9}, {}, TOML, "max_image_sise", "unknown-option", "mapper"),
        ({"max_image_size": 9}, {}, TOML, "max_image_size", "option-invalid", "equal to 128"),
        ({}, {"max_image_size": 9}, None, "--max-image-size", "option-invalid", "equal to 128"),
        ({"max_image_size": 9}, {"max_image_size": 8}, None, "--max-image-size", "option-invalid", "128"),
        ({"mapper": "best"}, {}, TOML, "mapper", "option-invalid", "'incremental' or 'global'"),
        ({}, {"import_model": 3}, None, "--import", "option-invalid", ""),
        ({"seed": "one"}, {}, TOML, "seed", "option-invalid", "integer"),
    ],
)  # fmt: skip
def test_errors_name_place_and_key(
    table: dict[str, Any], flags: dict[str, Any], path: Path | None, field: str, code: str, known: str
) -> None:
    with refused(code, InputError) as error:
        resolve(SfmOptions, table, flags, TOML)
    assert (error.value.path, error.value.field) == (path, field)
    assert known in error.value.message


def test_an_option_that_an_earlier_version_remembered_is_said_to_be_deleted(tmp_path: Path) -> None:
    requests = tmp_path / "requests.json"
    requests.write_text('{"sfm": {"old_mapper": "best"}}', encoding="utf-8")
    with refused("unknown-option", InputError) as error:
        resolve(SfmOptions, {}, {"old_mapper": "best"}, tmp_path / "georef.toml")
    assert (error.value.field, str(requests) in error.value.remedy) == ("--old-mapper", True)


@pytest.mark.parametrize("value", [float("nan"), float("inf"), -1.0, 0.0])
def test_a_sigma_is_a_positive_number(value: float) -> None:
    with refused("option-invalid", InputError) as error:
        resolve(IngestOptions, {}, {"sigma_gcp_h": value}, TOML)
    assert error.value.field == "--sigma-gcp-h"


def test_paths_of_the_file_are_relative_to_it() -> None:
    options = resolve(IngestOptions, {"images": "../photos", "gcp": "/control/gcp.txt"}, {"geo": "/g.txt"}, TOML)
    assert input_paths(options) == {
        "images": Path("/surveys/flight/../photos"),
        "gcp": Path("/control/gcp.txt"),
        "geo": Path("/g.txt"),
    }


def test_text_options_of_the_file_are_no_paths() -> None:
    assert resolve(IngestOptions, {"crs": "EPSG:32632"}, {}, TOML).crs == "EPSG:32632"


WRITTEN = {
    "every": "2s", "time_offset": "-0.25", "estimate": "lever-arm,boresight", "lever_arm": "0.1,0,-0.3",
    "camera_mount": "0,-90,0", "boresight": "0.5,0.3,-1", "origin": "46.02,7.75,1620",
}  # fmt: skip


def test_options_survive_storage() -> None:
    """A manifest stores options as JSON, a request stores flags: both must give the same options again."""
    flags = {"images": Path("/p"), "check": ("A", "B"), "sigma_h": 0.5, **WRITTEN}
    options = resolve(IngestOptions, {}, flags, TOML)
    assert IngestOptions.model_validate(options.model_dump(mode="json")) == options
    document = json.loads(json.dumps(options.model_dump(mode="json")))
    assert IngestOptions.model_validate(document) == options


def test_texts_are_parsed_once() -> None:
    options = resolve(IngestOptions, WRITTEN, {}, TOML)
    assert options.every == Every(2.0, "s")
    assert (options.time_offset, options.time_offset_s) == (-0.25, -0.25)
    assert set(options.estimate) == {"boresight", "lever-arm"}
    assert options.estimated == ("boresight", "lever-arm")
    assert (options.lever_arm, options.camera_mount) == ((0.1, 0.0, -0.3), (0.0, -90.0, 0.0))
    assert (options.boresight, options.origin) == ((0.5, 0.3, -1.0), (46.02, 7.75, 1620.0))
    automatic = resolve(IngestOptions, {}, {"time_offset": "auto"}, TOML)
    assert (automatic.time_offset, automatic.time_offset_s, automatic.estimated) == ("auto", 0.0, ("time-offset",))


def test_numbers_and_arrays_of_the_file_are_the_same_options() -> None:
    table = {"time_offset": -0.25, "estimate": ["lever-arm", "boresight"], "lever_arm": [0.1, 0, -0.3]}
    texts = {name: WRITTEN[name] for name in table}
    assert resolve(IngestOptions, table, {}, TOML) == resolve(IngestOptions, texts, {}, TOML)


@pytest.mark.parametrize(
    ("name", "value", "part"),
    [
        ("every", "2 minutes", "'2 minutes'"),
        ("every", "0s", "'0s'"),
        ("time_offset", "soon", "'soon'"),
        ("time_offset", "1e7", "auto"),
        ("estimate", "focus", "'focus' is none of boresight, lever-arm"),
        ("lever_arm", "1,2", "'1,2'"),
        ("boresight", "1,2,1e7", "1000000"),
        ("boresight", "1,2,nan", "finite number"),
        ("lever_arm", [1, 2], "Field required"),
        ("origin", "91,0,0", "−90 … 90"),
    ],
)
def test_texts_that_are_none(name: str, value: object, part: str) -> None:
    with refused("option-invalid", InputError) as error:
        resolve(IngestOptions, {}, {name: value}, TOML)
    assert error.value.field == flag_name(IngestOptions, name)
    assert part in error.value.message


@pytest.mark.parametrize(
    ("value", "text"),
    [
        ((0.1, 0.0, -0.3), "0.1,0,-0.3"),
        (46.0200001, "46.0200001"),
        (0.0, "0"),
        ("auto", "auto"),
        (Every(2.5, "m"), "2.5m"),
        (("bias", "boresight"), "bias,boresight"),
    ],
)
def test_a_value_is_shown_as_it_is_written(value: object, text: str) -> None:
    assert notation(value) == text


class TestToml:
    def load(self, folder: Path, text: bytes) -> dict[str, dict[str, Any]]:
        (folder / "georef.toml").write_bytes(text)
        return load_toml(folder / "georef.toml", OPTIONS)

    def test_missing_file_is_empty(self, tmp_path: Path) -> None:
        assert load_toml(tmp_path / "georef.toml", OPTIONS) == {}

    def test_byte_order_mark_and_crlf(self, tmp_path: Path) -> None:
        assert self.load(tmp_path, b"\xef\xbb\xbf[train]\r\nseed = 4\r\n") == {"train": {"seed": 4}}

    @pytest.mark.parametrize(
        ("text", "code", "field"),
        [
            (b"[train\n", "toml-invalid", None),
            (b"\xff\xfe[train]\n", "toml-invalid", None),
            (b"[trian]\n", "unknown-stage", "trian"),
            (b"train = 3\n", "not-a-table", "train"),
        ],
    )
    def test_errors(self, tmp_path: Path, text: bytes, code: str, field: str | None) -> None:
        with refused(code, InputError) as error:
            self.load(tmp_path, text)
        assert (error.value.path, error.value.field) == (tmp_path / "georef.toml", field)

    def test_folder_in_its_place(self, tmp_path: Path) -> None:
        (tmp_path / "georef.toml").mkdir()
        with refused("not-a-file", InputError):
            load_toml(tmp_path / "georef.toml", OPTIONS)


def fields() -> list[tuple[type[StageOptions], str, FieldInfo]]:
    return [(options, name, info) for options in OPTIONS.values() for name, info in options.model_fields.items()]


@pytest.mark.parametrize(("options", "name", "info"), fields())
def test_every_option_explains_itself(options: type[StageOptions], name: str, info: FieldInfo) -> None:
    """Help, docs and errors all come from the field: it must have a meaning, a valid default and its own flag."""
    assert info.description
    assert info.description.endswith((".", "…", ")"))
    options.model_validate({name: info.default})
    flags = [flag_name(options, other) for other in options.model_fields]
    assert flags.count(flag_name(options, name)) == 1


def test_presets_leave_room_for_explicit_sizes() -> None:
    options = TrainOptions()
    assert (options.iterations, options.max_image_size, options.max_gaussians) == (None, None, None)


@pytest.mark.parametrize("text", ["drift", "bias", "time-offset", ""])
def test_parameters_of_the_mount_that_cannot_be(text: str) -> None:
    with refused("option-invalid", InputError) as error:
        resolve(IngestOptions, {}, {"estimate": text}, TOML)
    assert error.value.field == "--estimate"
    assert f"{text!r} is none of boresight, lever-arm" in error.value.message


@pytest.mark.parametrize("stage", ["calibrate", "init-sim3"])
def test_the_mount_is_named_to_ingest_alone(tmp_path: Path, stage: str) -> None:
    requests = tmp_path / "requests.json"
    requests.write_text(json.dumps({stage: {"estimate": ["boresight"]}}), encoding="utf-8")
    with refused("unknown-option", InputError) as error:
        resolve(OPTIONS[stage], {}, {"estimate": ["boresight"]}, tmp_path / "georef.toml")
    assert (error.value.field, str(requests) in error.value.remedy) == ("--estimate", True)
    assert [name for name, options in OPTIONS.items() if "estimate" in options.model_fields] == ["ingest"]


def test_toml_nested_too_deeply_is_refused(tmp_path: Path) -> None:
    (tmp_path / "georef.toml").write_text("a = " + "[" * 10_000)
    with refused("toml-invalid", InputError):
        load_toml(tmp_path / "georef.toml", ("train",))

"""Options: precedence, ranges, unknown keys, and the errors that name them."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from pydantic.fields import FieldInfo

from pipelines.adjust.options import InitSim3Options
from pipelines.core.errors import InputError
from pipelines.core.options import StageOptions, flag_name, input_paths, load_toml, notation, resolve
from pipelines.core.stages import PIPELINE
from pipelines.ingest.options import Every, IngestOptions
from pipelines.sfm.options import SfmOptions
from pipelines.train.options import TrainOptions

OPTIONS = {spec.name: spec.options for spec in PIPELINE}
TOML = Path("/surveys/flight/georef.toml")


def test_precedence() -> None:
    assert resolve(SfmOptions, {}, {}, TOML).max_image_size == SfmOptions().max_image_size
    assert resolve(SfmOptions, {"max_image_size": 900}, {}, TOML).max_image_size == 900
    assert resolve(SfmOptions, {"max_image_size": 900}, {"max_image_size": 800}, TOML).max_image_size == 800


@pytest.mark.parametrize(
    ("table", "flags", "message"),
    [
        ({"max_image_sise": 9}, {}, r"^/surveys/flight/georef\.toml \[max_image_sise\]: unknown key; .*mapper"),
        ({"max_image_size": 9}, {}, r"^/surveys/flight/georef\.toml \[max_image_size\]: .*equal to 128"),
        ({}, {"max_image_size": 9}, r"^\[--max-image-size\]: .*greater than or equal to 128"),
        ({"max_image_size": 9}, {"max_image_size": 8}, r"^\[--max-image-size\]"),
        ({"mapper": "best"}, {}, r"georef\.toml \[mapper\]: .*'incremental' or 'global'"),
        ({}, {"import_model": 3}, r"^\[--import\]"),
        ({"seed": "one"}, {}, r"georef\.toml \[seed\]: .*integer"),
    ],
)  # fmt: skip
def test_errors_name_place_and_key(table: dict[str, Any], flags: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=message):
        resolve(SfmOptions, table, flags, TOML)


@pytest.mark.parametrize("value", [float("nan"), float("inf"), -1.0, 0.0])
def test_a_sigma_is_a_positive_number(value: float) -> None:
    with pytest.raises(InputError, match=r"\[--sigma-gcp-h\]"):
        resolve(IngestOptions, {}, {"sigma_gcp_h": value}, TOML)


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
    assert options.estimate == options.estimated == ("boresight", "lever-arm")
    assert (options.lever_arm, options.camera_mount) == ((0.1, 0.0, -0.3), (0.0, -90.0, 0.0))
    assert (options.boresight, options.origin) == ((0.5, 0.3, -1.0), (46.02, 7.75, 1620.0))
    automatic = resolve(IngestOptions, {}, {"time_offset": "auto"}, TOML)
    assert (automatic.time_offset, automatic.time_offset_s, automatic.estimated) == ("auto", 0.0, ("time-offset",))


def test_numbers_and_arrays_of_the_file_are_the_same_options() -> None:
    table = {"time_offset": -0.25, "estimate": ["lever-arm", "boresight"], "lever_arm": [0.1, 0, -0.3]}
    texts = {name: WRITTEN[name] for name in table}
    assert resolve(IngestOptions, table, {}, TOML) == resolve(IngestOptions, texts, {}, TOML)


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("every", "2 minutes", r"\[--every\]: .*'2 minutes' is neither seconds nor metres: give e.g. 2s or 5m"),
        ("every", "0s", r"\[--every\]: .*neither seconds nor metres"),
        ("time_offset", "soon", r"\[--time-offset\]: .*could not convert string to float: 'soon'"),
        ("time_offset", "1e7", r"\[--time-offset\]: .*a number of seconds, or auto"),
        ("estimate", "focus", r"\[--estimate\]: .*'focus' is none of time-offset, boresight, lever-arm"),
        ("lever_arm", "1,2", r"\[--lever-arm\]: .*three numbers with commas, like 46.02,7.75,1620"),
        ("boresight", "1,2,1e7", r"\[--boresight\]: .*three finite numbers"),
        ("boresight", "1,2,nan", r"\[--boresight\]: .*finite number"),
        ("lever_arm", [1, 2], r"\[--lever-arm\]: Field required"),
        ("origin", "91,0,0", r"\[--origin\]: .*latitude −90 … 90, longitude −180 … 180, height −1000 … 10000"),
    ],
)
def test_texts_that_are_none(name: str, value: object, message: str) -> None:
    with pytest.raises(InputError, match=message):
        resolve(IngestOptions, {}, {name: value}, TOML)


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
        ("text", "message"),
        [
            (b"[train\n", r"georef\.toml: not valid TOML: .*line 1"),
            (b"\xff\xfe[train]\n", r"georef\.toml: not valid TOML"),
            (b"[trian]\n", r"georef\.toml \[trian\]: unknown table; the stages are ingest, sfm"),
            (b"train = 3\n", r"georef\.toml \[train\]: expected a table"),
        ],
    )
    def test_errors(self, tmp_path: Path, text: bytes, message: str) -> None:
        with pytest.raises(InputError, match=message):
            self.load(tmp_path, text)

    def test_folder_in_its_place(self, tmp_path: Path) -> None:
        (tmp_path / "georef.toml").mkdir()
        with pytest.raises(InputError, match="cannot be read"):
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


@pytest.mark.parametrize(
    ("text", "names"),
    [
        ("none", ()),
        (["boresight", "lever-arm"], ("boresight", "lever-arm")),
        ("boresight,lever-arm", ("boresight", "lever-arm")),
    ],
)
def test_systematic_errors_are_named(text: str | list[str], names: tuple[str, ...]) -> None:
    options = InitSim3Options(estimate=text)
    assert options.estimate == names
    assert InitSim3Options.model_validate(options.model_dump(mode="json")) == options


@pytest.mark.parametrize("text", ["drift", "bias", ""])
def test_systematic_errors_that_cannot_be(text: str) -> None:
    with pytest.raises(InputError, match=rf"--estimate.*'{text}' is none of lever-arm, boresight"):
        resolve(InitSim3Options, {}, {"estimate": text}, Path("georef.toml"))


def test_toml_nested_too_deeply_is_refused(tmp_path: Path) -> None:
    (tmp_path / "georef.toml").write_text("a = " + "[" * 10_000)
    with pytest.raises(InputError, match="not valid TOML"):
        load_toml(tmp_path / "georef.toml", ("train",))

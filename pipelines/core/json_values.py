"""Values of JSON documents, apart from the types of arrays: `georef --help` does not wait for numpy."""

from typing import Any

JsonValue = Any  # of JSON, TOML or YAML: an object, list, text, number, truth value or nothing
Json = dict[str, JsonValue]  # object

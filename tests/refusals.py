"""Errors and remarks by their codes and numbers, so that the wording of a message may change."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator
from contextlib import contextmanager

import pytest

from pipelines.core.errors import GeorefError
from pipelines.core.products import Remark


@contextmanager
def refused(code: str, kind: type[GeorefError] = GeorefError) -> Iterator[pytest.ExceptionInfo[GeorefError]]:
    """Require an error of a kind with a code; its `value` has message, path, line and field."""
    with pytest.raises(kind) as caught:
        yield caught
    assert caught.value.code == code, f"{caught.value.code}: {caught.value}"


def codes(remarks: Iterable[Remark]) -> list[str]:
    return [remark.code for remark in remarks]


def logged_codes(caplog: pytest.LogCaptureFixture) -> list[str]:
    """Return the codes of the warnings that were logged."""
    return [record.code for record in caplog.records if hasattr(record, "code")]


def said(remarks: Iterable[Remark], code: str) -> str:
    """Return the sentence of the only remark with a code."""
    (sentence,) = (remark.sentence for remark in remarks if remark.code == code)
    return sentence


def numbers(text: str) -> list[float]:
    """Return the numbers of a message in order, without their units."""
    return [float(number) for number in re.findall(r"(?<![\w.])[-+]?\d+(?:\.\d+)?", text.replace("\u2212", "-"))]

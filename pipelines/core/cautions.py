"""Cautions: limits of a result that its next reader must know. Products carry those of their inputs on."""

from __future__ import annotations

from typing import Annotated

from pydantic import StringConstraints

from pipelines.core.products import Product

# Code of the caution that nothing checks the σ of the positions: no accuracy is stated then.
NOT_CHECKED = "not-checked"


# Attribute of log records with a caution: the command line repeats cautions at its end.
AT_END = "at_end"


class Caution(Product):
    """Limit of a result, for machines and for people.

    Attributes:
        code: kind of the limit, for machines: lower-case words joined by hyphens (docs/accuracy.md lists them).
        sentence: one full sentence for people.
    """

    code: Annotated[str, StringConstraints(pattern=r"^[a-z0-9]+(-[a-z0-9]+)*$")]
    sentence: Annotated[str, StringConstraints(min_length=1)]


def union(*groups: tuple[Caution, ...]) -> tuple[Caution, ...]:
    """Return the cautions of all groups in order, each once."""
    return tuple(dict.fromkeys(caution for group in groups for caution in group))


def is_checked(cautions: tuple[Caution, ...]) -> bool:
    """Return whether something checks the σ of the positions; no accuracy is stated otherwise."""
    return all(caution.code != NOT_CHECKED for caution in cautions)

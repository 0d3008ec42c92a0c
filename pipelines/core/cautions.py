"""Cautions: limits of a result that a machine and the next reader must see."""

from __future__ import annotations

from pipelines.core.products import Product


class Caution(Product):
    """Limit of a result.

    Attributes:
        code: stable kebab-case word for machines.
        sentence: one full sentence for people.
    """

    code: str
    sentence: str

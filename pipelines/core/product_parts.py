"""Products of a workspace, or parts of them, as inputs of a stage and of an option that names a workspace."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class ProductPart:
    """Product of another stage, or the part of it that decides a stage's result.

    Attributes:
        product: workspace path of a file or a folder.
        fields: paths of keys in the JSON document, through every item of a list: `images.fix.position_in_geo`.
            No other field of the document makes the stage stale. Without fields, the whole product counts.
        if_any: further fields, which count where they have a value: a document without them is as it was.
        without: keys of the JSON document that do not count, where `fields` names none.
        optional: whether the stage runs without this product. A part without any value then counts as missing.
        brings: further products that count if they exist and this part has a value.
    """

    product: str
    fields: tuple[str, ...] = ()
    if_any: tuple[str, ...] = ()
    without: tuple[str, ...] = ()
    optional: bool = False
    brings: tuple[str, ...] = ()


def whole_products(*products: str, optional: bool = False) -> tuple[ProductPart, ...]:
    """Return the parts of a stage's input that are whole products."""
    return tuple(ProductPart(product, optional=optional) for product in products)

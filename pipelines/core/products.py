"""Products of the stages: base class, reading and writing, and the cautions that they carry on from their inputs.

JSON products are pydantic models. They are validated when loaded, because users can replace a product by hand.
Arrays are stored as NPZ without pickle. Frames and units are those of docs/conventions.md: `geo` is East-North-Up
metres at the survey's origin, `local` the SfM model's frame, `model` the metric, origin-shifted frame of the
Gaussians.
"""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, ClassVar, Self, TypeVar

import numpy as np
from numpy.typing import ArrayLike
from pydantic import AfterValidator, BaseModel, ConfigDict, StringConstraints, ValidationError

from pipelines.core.errors import InputError
from pipelines.core.files import file_size, read_npz
from pipelines.core.json_values import JsonValue
from pipelines.core.sentences import fault_sentence, with_remedy
from pipelines.core.types import Matrix3, Quaternion
from pipelines.core.validators import covariance, image_name, unit_quaternion

# Users may write products by hand: a file larger than any survey's is refused before it is read.
_MAX_JSON_BYTES = 1 << 30

ImageName = Annotated[str, AfterValidator(image_name)]
Rotation = Annotated[Quaternion, AfterValidator(unit_quaternion)]
Covariance3 = Annotated[Matrix3, AfterValidator(covariance)]


class Product(BaseModel):
    """Base of the JSON products: immutable, no unknown keys, no NaN."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


ProductT = TypeVar("ProductT", bound=BaseModel)


def save_json(product: BaseModel, path: Path) -> None:
    """Write a JSON product, indented, UTF-8."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(product.model_dump_json(indent=1) + "\n", encoding="utf-8")


def load_json(product_type: type[ProductT], path: Path) -> ProductT:
    """Return a JSON product; an InputError names file and field: unreadable, too large, or not of that type."""
    try:
        file_size(path, limit_bytes=_MAX_JSON_BYTES, kind="product")
        return product_type.model_validate_json(path.read_text(encoding="utf-8"))
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(str(part) for part in first["loc"])
        raise InputError("product-invalid", fault_sentence(first), path=path, field=where or None) from error
    except UnicodeDecodeError as error:
        raise InputError("not-utf8", "is not a UTF-8 text file.", path=path) from error
    except (np.linalg.LinAlgError, RecursionError) as error:  # of a validator that computes
        raise InputError("product-invalid", f"has values that cannot be used: {error}.", path=path) from error
    except OSError as error:
        raise InputError("file-unreadable", f"cannot be read: {error.strerror}.", path=path) from error


def dump_json(document: JsonValue) -> str:
    """Return the JSON text of a plain document, also with remarks in it; it may hold no NaN and no infinity."""
    return json.dumps(document, indent=1, allow_nan=False, default=Remark.model_dump)


def save_npz(path: Path, arrays: Mapping[str, ArrayLike]) -> None:
    """Write arrays by name into a file without compression; missing folders are made."""
    path.parent.mkdir(parents=True, exist_ok=True)
    np.savez(path, **{name: np.asarray(array) for name, array in arrays.items()})  # type: ignore[arg-type]


@dataclass(frozen=True)
class ArrayProduct:
    """Base of the NPZ products: a field is an array or a text.

    `FORMS` states kind of number and shape by field, in which a letter stands for a length that arrays share;
    None: a text.
    """

    FORMS: ClassVar[dict[str, tuple[Any, ...] | None]]

    @classmethod
    def load(cls, path: Path) -> Self:
        """Read the product from NPZ; an InputError: no NPZ file with these arrays, or one of another form."""
        arrays: dict[str, Any] = {**read_npz(path, tuple(cls.FORMS))}
        lengths: dict[str, int] = {}
        for name, form in cls.FORMS.items():
            array = arrays[name]
            if form is None:
                arrays[name] = str(array)
                continue
            kind, *shape = form
            matches = array.dtype.kind in kind and array.ndim == len(shape)
            for length, wanted in zip(array.shape, shape, strict=False):
                expected = lengths.setdefault(wanted, length) if isinstance(wanted, str) else wanted
                matches = matches and length == expected
            if not matches:
                raise InputError("array-form", f"has the form {array.shape} {array.dtype}", path=path, field=name)
        return cls(**arrays)


# Code of the caution that nothing checks the σ of the positions: no accuracy is stated then.
NOT_CHECKED = "not-checked"


class Remark(Product):
    """Warning of a command, or caution of a product: a full sentence for people, a code for machines and tests.

    `remedy`: what to type against it, in sentences for whoever runs the program; empty: nothing. Pages for clients
    leave it out.
    """

    code: Annotated[str, StringConstraints(pattern=r"^[a-z0-9]+(-[a-z0-9]+)*$")]
    sentence: Annotated[str, StringConstraints(min_length=1)]
    remedy: str = ""

    @property
    def text(self) -> str:
        """Sentence and remedy, for whoever runs the program."""
        return with_remedy(self.sentence, self.remedy)


def union(*groups: tuple[Remark, ...]) -> tuple[Remark, ...]:
    """Return the remarks of all groups in order, each once."""
    return tuple(dict.fromkeys(caution for group in groups for caution in group))


def is_checked(cautions: tuple[Remark, ...]) -> bool:
    """Return whether something checks the σ of the positions; no accuracy is stated otherwise."""
    return all(caution.code != NOT_CHECKED for caution in cautions)

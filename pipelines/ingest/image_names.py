"""Which image a name in somebody's table means."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path, PurePosixPath

from pipelines.core.errors import InputError


class ImageNames:
    """The images of a survey, findable by the ways in which tables name them.

    Tried in this order: the path relative to the image folder; the file name alone; both without regard to case;
    the file name without its suffix.
    """

    def __init__(self, names: Iterable[str]) -> None:
        self._exact = set(names)
        self._forms: list[dict[str, list[str]]] = [{}, {}, {}, {}]
        for name in sorted(self._exact):
            for form, key in zip(self._forms, _keys(name), strict=True):
                form.setdefault(key, []).append(name)

    def find(self, text: str, *, path: Path, line: int) -> str | None:
        """Return the image that `text` names, or None.

        Args:
            text: as the table has it; backslashes separate folders too.
            path: the table, for errors.
            line: its line, for errors.

        Raises:
            InputError: it leaves the image folder, or fits several images equally well.
        """
        name = text.strip().replace("\\", "/").removeprefix("./")
        pure = PurePosixPath(name)
        if pure.is_absolute() or ".." in pure.parts or name[1:2] == ":":
            raise InputError(
                f"{text!r} leaves the image folder: name images relative to it", path=path, line=line, field="image"
            )
        if name in self._exact:
            return name
        for form, key in zip(self._forms, _keys(name), strict=True):
            candidates = form.get(key, [])
            if len(candidates) > 1:
                raise InputError(
                    f"{text!r} may be {' or '.join(candidates[:3])}: name it with its folder and suffix",
                    path=path,
                    line=line,
                    field="image",
                )
            if candidates:
                return candidates[0]
        return None


def _keys(name: str) -> tuple[str, str, str, str]:
    pure = PurePosixPath(name)
    return (pure.name, name.casefold(), pure.name.casefold(), pure.stem.casefold())

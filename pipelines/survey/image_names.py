"""Names of photographs, and which photograph of a survey a name in a table or in a model means."""

from collections.abc import Iterable
from functools import partial
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

    def find(self, text: str, *, path: Path, line: int | None = None) -> str | None:
        """Return the image that `text` names, or None; backslashes separate folders too.

        Raises:
            InputError: it leaves the image folder, or fits several images equally well; names path and line.
        """
        fault = partial(InputError, path=path, line=line, field="image")
        name = text.strip().replace("\\", "/").removeprefix("./")
        pure = PurePosixPath(name)
        if pure.is_absolute() or ".." in pure.parts or name[1:2] == ":":
            raise fault("image-outside-folder", f"{text!r} leaves the image folder. Name images relative to it.")
        if name in self._exact:
            return name
        for form, key in zip(self._forms, _keys(name), strict=True):
            candidates = form.get(key, [])
            if len(candidates) > 1:
                several = " or ".join(candidates[:3])
                raise fault("image-ambiguous", f"{text!r} may be {several}. Name it with its folder and suffix.")
            if candidates:
                return candidates[0]
        return None


def _keys(name: str) -> tuple[str, str, str, str]:
    pure = PurePosixPath(name)
    return (pure.name, name.casefold(), pure.name.casefold(), pure.stem.casefold())

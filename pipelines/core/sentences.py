"""Parts of sentences for people, and texts of others made safe for terminals and pages.

A terminal obeys escape sequences, and marks that turn the direction of writing show another name than there is.
"""

import re
import unicodedata
from collections.abc import Mapping, Sequence

from pipelines.core.json_values import JsonValue

_SHOWN = 8


def listed(names: Sequence[str]) -> str:
    """Return the first eight names with commas between them, and an ellipsis if there are more."""
    return ", ".join(names[:_SHOWN]) + (" …" if len(names) > _SHOWN else "")


def fault_sentence(fault: Mapping[str, JsonValue]) -> str:
    """Return the sentence of one of the errors of a pydantic `ValidationError`."""
    return str(fault["msg"]).removeprefix("Value error, ").removesuffix(".") + "."


def duration(seconds: float | None) -> str:
    """Return a duration as `0.4 s`, `12 s`, `3 min 20 s` or `1 h 05 min`; empty for None."""
    if seconds is None:
        return ""
    if seconds < 10:
        return f"{seconds:.1f} s"
    minutes, rest = divmod(round(seconds), 60)
    if minutes < 60:
        return f"{minutes} min {rest:02d} s" if minutes else f"{rest} s"
    return f"{minutes // 60} h {minutes % 60:02d} min"


def about(seconds: float | None) -> str:
    """Return an estimated duration: `43 s`, `2 min 50 s`, `36 min`, `7 h 30 min`; empty for None."""
    if seconds is None or seconds < 60:
        return duration(seconds)
    unit = 10 if seconds < 600 else 60 if seconds < 3600 else 600
    text = duration(round(seconds / unit) * unit)
    return text.removesuffix(" 00 s")


_FOLDERS = re.compile(r"(?<![\w:/.\\])(?:[A-Za-z]:)?[/\\](?:[^\s/\\:;,\"'`]+[/\\])+")


def without_folders(text: str) -> str:
    """Return a text for a client: of the paths in it, names without the folders of this machine."""
    return _FOLDERS.sub("", text)


def with_remedy(sentence: str, remedy: str) -> str:
    """Return a message for whoever runs the program: what is so, and what to type against it, if anything."""
    return f"{sentence} {remedy}" if remedy else sentence


# Control characters (ESC, and OSC and CSI of C1), marks that turn the direction of writing, lone surrogates
# (undecodable bytes of file names), and signs that break lines.
_UNSAFE = ("Cc", "Cf", "Cs", "Zl", "Zp")
_HARMLESS = "\u00ad\u200c\u200d"  # soft hyphen and joiners: many scripts need them


def printable(text: str) -> str:
    """Return a text in which unsafe characters, line breaks among them, are written as escapes such as `\\x1b`."""
    if text.isascii() and text.isprintable():
        return text
    return "".join(
        _escaped(sign) if unicodedata.category(sign) in _UNSAFE and sign not in _HARMLESS else sign for sign in text
    )


def printable_lines(text: str) -> str:
    """Return a text as `printable` does, but with its line breaks."""
    return "\n".join(printable(line) for line in text.split("\n"))


def _escaped(sign: str) -> str:
    code = ord(sign)
    if 0xDC80 <= code <= 0xDCFF:  # a byte that is not UTF-8, as Python decodes file names
        return f"\\x{code - 0xDC00:02x}"
    return sign.encode("unicode_escape", "backslashreplace").decode("ascii")

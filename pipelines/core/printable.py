"""Text made safe for terminals and pages: names and records of others hold control characters without effect.

A terminal obeys escape sequences, and marks that turn the direction of writing show another name than there is.
"""

from __future__ import annotations

import unicodedata

# Control characters (ESC, and OSC and CSI of C1), marks that turn the direction of writing, lone surrogates
# (undecodable bytes of file names), and signs that break lines.
_UNSAFE = ("Cc", "Cf", "Cs", "Zl", "Zp")
_HARMLESS = "\u00ad\u200c\u200d"  # soft hyphen and joiners: many scripts need them


def printable(text: str) -> str:
    """Return a text in which unsafe characters, line breaks among them, are written as escapes such as `\\x1b`."""
    if text.isascii() and text.isprintable():
        return text
    return "".join(_escaped(sign) if _is_unsafe(sign) else sign for sign in text)


def printable_lines(text: str) -> str:
    """Return a text of several lines with every line made printable."""
    return "\n".join(printable(line) for line in text.split("\n"))


def _is_unsafe(sign: str) -> bool:
    return unicodedata.category(sign) in _UNSAFE and sign not in _HARMLESS


def _escaped(sign: str) -> str:
    code = ord(sign)
    if 0xDC80 <= code <= 0xDCFF:  # a byte that is not UTF-8, as Python decodes file names
        return f"\\x{code - 0xDC00:02x}"
    return sign.encode("unicode_escape", "backslashreplace").decode("ascii")

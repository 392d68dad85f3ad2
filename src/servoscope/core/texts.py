"""Texts from outside, such as names of files and words of operators, as store, log, mail and page take them."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any

MAX_TEXT_CHARS = 1000
# control characters but tab and line feed, surrogates without a partner, and what reorders or hides text on a screen
UNSAFE = re.compile("\r\n|[\0-\x08\x0b-\x1f\x7f-\x9f\u2028\u2029\u202a-\u202e\u2066-\u2069\ud800-\udfff\ufeff]")
UNDECODED = range(0xDC80, 0xDD00)  # surrogates in which Python keeps bytes that are not UTF-8


def clean_text(text: str, longest: int = MAX_TEXT_CHARS) -> str:
    """Return a text that every encoding, database and screen takes: escaped where it is unsafe, and cut off."""
    if len(text) <= longest and not UNSAFE.search(text):
        return text
    safe = UNSAFE.sub(_escape, text[: longest + 1])
    return safe if len(safe) <= longest else f"{safe[: longest - 1]}\u2026"


def _escape(match: re.Match[str]) -> str:
    if match[0] == "\r\n":
        return "\n"
    code = ord(match[0])
    code -= 0xDC00 if code in UNDECODED else 0
    return f"\\x{code:02x}" if code < 0x100 else f"\\u{code:04x}"


def clean_texts(document: Any) -> Any:
    """Return a document, as JSON has them, with each text in it as `clean_text` returns it."""
    if isinstance(document, str):
        return clean_text(document)
    if isinstance(document, Mapping):
        return {clean_texts(key): clean_texts(value) for key, value in document.items()}
    if isinstance(document, list | tuple):
        return [clean_texts(value) for value in document]
    return document

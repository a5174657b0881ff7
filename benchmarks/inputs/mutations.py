"""Mutations of inputs: random damage of bytes and text, and hostile changes of structured files."""

from __future__ import annotations

import io
import json
import random
import re
import zipfile
from typing import Any

#: What stands in the place of a number, of a word, or between.
NUMBERS = ("9" * 5000, "9" * 400, "1e308", "-1e308", "1e-320", "1e999", "nan", "-inf", "0", "-0", "0x10", "1_000",
           "1e5", "18446744073709551616", "-1", "2147483648", "1048577", "0.1.2", "1,5", "٣", "true", "null", '"1"',
           "[]", "{}")
WORDS = ("", "a" * 5000, "\\ud800", "\\u0000", "\\", "a**b", "**/**/*", "*/" * 300, "../" * 300, "/dev/zero",
         "/dev/stdin", "/proc/self/mem", ".", "n" * 300, "%s%n{0}", "\x1b[2J", "\u202e", "\U0001f4a9", "NUL", "-", "'",
         '"', "{", "]]>")
TEXTS = ("[" * 3000, "{" * 3000, "(" * 3000, '{"a":' * 3000, "<a>" * 3000, "[[", "a." * 2000, "\n" * 3000, "\0" * 50,
         "," * 5000, ";" * 5000, "\t" * 5000, '"', "'''", '"""', "#", "\ufeff", "\r", "\x0c", "<!ENTITY a 'b'>", "&#0;",
         '<row r="1e308">', '<row r="99999999"/>', '<c r="ZZZ9999999">', " " * 5000)
_NUMBER = re.compile(r"[-+]?\d+(?:\.\d+)?(?:[eE][-+]?\d+)?")
_WORD = re.compile(r"[A-Za-z_][\w.-]*")


def damaged(sample: bytes, chance: random.Random, others: list[bytes]) -> bytes:
    """Return a mutation of a valid input; equal `chance` gives equal mutations."""
    kind = chance.random()
    if kind < 0.01:
        return chance.choice(others)
    if kind < 0.35:
        return in_bytes(sample, chance)
    if sample.startswith(b"PK\x03\x04"):
        return in_archive(sample, chance)
    try:
        text = sample.decode("utf-8")
    except UnicodeDecodeError:
        return in_bytes(in_text(sample.decode("latin-1"), chance).encode("latin-1", "replace"), chance)
    if text.startswith("{") and kind < 0.75:
        return in_json(text, chance)
    return in_text(text, chance).encode("utf-8", "surrogatepass")


def in_bytes(sample: bytes, chance: random.Random) -> bytes:
    """Delete, repeat, replace or move bytes, or set binary numbers to extreme values."""
    data = bytearray(sample)
    for _ in range(chance.choice((1, 1, 2, 3, 8))):
        at, length = chance.randrange(len(data) + 1), chance.choice((1, 1, 2, 4, 8, 40))
        piece = bytes(data[at:at + length])
        data[at:at + length] = chance.choice((
            b"", piece * 2, piece * 50, chance.randbytes(length), b"\xff" * length, b"\0" * length, b"\x7f" * length,
            piece[::-1], b"\xff\xfe", b"\xed\xa0\x80", b"\n", b'"', b"1e999", b"0" * length))
    if chance.random() < 0.05:
        del data[chance.randrange(len(data) + 1):]
    return bytes(data)


def in_text(text: str, chance: random.Random) -> str:
    """Replace, repeat or move numbers, words and lines."""
    for _ in range(chance.choice((1, 1, 1, 2, 4))):
        pattern, choices = chance.choice(((_NUMBER, NUMBERS), (_WORD, WORDS), (_NUMBER, WORDS), (None, TEXTS)))
        places = list(pattern.finditer(text)) if pattern is not None else []
        if places:
            match = chance.choice(places)
            text = text[:match.start()] + chance.choice(choices) + text[match.end():]
        elif chance.random() < 0.5:
            at = chance.randrange(len(text) + 1)
            text = text[:at] + chance.choice(TEXTS) + text[at:]
        else:
            lines = text.split("\n")
            i, j = chance.randrange(len(lines)), chance.randrange(len(lines))
            lines[i:i + 1] = chance.choice(([lines[j], lines[i]], [], [lines[j]], [lines[j] * 2]))
            text = "\n".join(lines)
    return text


def in_json(text: str, chance: random.Random) -> bytes:
    """Replace, remove, repeat or nest a value at a random position."""
    value = json.loads(text)
    for _ in range(chance.choice((1, 1, 2, 3))):
        holder, key = chance.choice(_places(value) or [({}, "")])
        odd: Any = chance.choice((None, True, -1, 0, 10**400, 1e308, -1e-320, float("nan"), float("inf"), "",
                                  "a" * 5000, "\ud800", "\0", "\n", [], {}, [[]] * 50, {"\udfff": 1}, {"": {}}, "a**b",
                                  2**64, 0.5))
        action = chance.randrange(4)
        if isinstance(holder, dict) and action == 0:
            holder.pop(key, None)
        elif isinstance(holder, dict) and action == 1:
            holder[chance.choice(WORDS)] = odd
        elif isinstance(holder, list) and action == 0:
            holder.append(odd)
        else:
            holder[key] = odd
    return json.dumps(value).encode()


def _places(value: Any) -> list[tuple[Any, Any]]:
    items = list(value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ())
    return [(value, key) for key, _ in items] + [place for _, item in items for place in _places(item)]


def in_archive(sample: bytes, chance: random.Random) -> bytes:
    """Damage one member of a valid archive."""
    stream = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(sample)) as archive, zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as other:
        names = archive.namelist()
        chosen = chance.choice([name for name in names if "sheet" in name or name == "content.xml"] or names
                               if chance.random() < 0.7 else names)
        for name in names:
            content = archive.read(name)
            if name == chosen:
                content = in_text(content.decode("utf-8", "replace"), chance).encode("utf-8", "surrogatepass")
                if chance.random() < 0.02:
                    content += bytes(20_000_000)
            other.writestr(name, content)
    return stream.getvalue()

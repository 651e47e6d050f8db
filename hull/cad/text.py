"""CAD files that are text: characters, lines and numbers, or what is wrong with them."""

import re

#: An exponent as Fortran writes it.
_FORTRAN = re.compile(r"^([-+]?[\d.]+)[dD]([-+]?\d+)$")

#: Numbers of vertices and of anything else that is counted are below this.
_LARGEST = 2**62

_LINE_ENDS = re.compile(r"\r\n|\r|\n")

#: How a text may begin that says how its characters are stored; longer marks first.
_MARKS = {
    b"\xff\xfe\x00\x00": "utf-32",
    b"\x00\x00\xfe\xff": "utf-32",
    b"\xef\xbb\xbf": "utf-8-sig",
    b"\xff\xfe": "utf-16",
    b"\xfe\xff": "utf-16",
}


def decode(content: bytes) -> str:
    """Return the characters of a file; what is not UTF-8 in a name is replaced.

    Raises
    ------
    ValueError
        If it is no text.
    """
    encoding = next((code for mark, code in _MARKS.items() if content.startswith(mark)), "utf-8")
    text = content.decode(encoding, errors="replace")
    if "\0" in text:
        line = len(_LINE_ENDS.split(text[: text.index("\0")]))
        raise ValueError(f"line {line}: it holds a zero byte, as no text does; export it again")
    return text


def split_lines(text: str) -> list[str]:
    """Return the lines of a text, however they end, and nothing after the last end."""
    lines = _LINE_ENDS.split(text)
    return lines if lines[-1] else lines[:-1]


def is_ended(text: str) -> bool:
    """Tell whether the last line of a text ends, so that none of its digits can be missing."""
    return text.endswith(("\n", "\r"))


def number(word: str) -> float:
    """Return the number that a word stands for.

    Raises
    ------
    ValueError
        If it stands for none.
    """
    try:
        if "_" not in word:  # which only Python reads
            return float(_FORTRAN.sub(r"\1e\2", word))
    except ValueError:
        pass
    comma = "; the decimal sign is a point" if "," in word else ""
    raise ValueError(f"{word!r} is no number{comma}; export it again")


def whole(word: str) -> int:
    """Return the whole number that a word stands for.

    Raises
    ------
    ValueError
        If it stands for none.
    """
    try:
        if "_" not in word and abs(found := int(word)) < _LARGEST:
            return found
    except ValueError:
        pass
    raise ValueError(f"{word[:40]!r} is no whole number; export it again")

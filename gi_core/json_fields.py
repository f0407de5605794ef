"""Typed access to JSON that is not to be trusted: each refusal says where, what was expected, and what was found."""

import sys
from collections.abc import Iterable
from typing import Any

from gi_core.errors import CorruptFileError

LONGEST_TEXT = 4096
# Beyond this a double no longer holds every whole number, and readers in other languages would see another one.
LARGEST_INTEGER = (1 << 53) - 1
_LONGEST_ECHO = 60
DEEPEST = 32


class Fields:
    """The members of one JSON object. Every method raises CorruptFileError for a member that is absent or not what was asked for."""

    def __init__(self, record: Any, where: str, names: Iterable[str] | None = None) -> None:
        """``names``, when given, are all the members that it has to have and may have."""
        if not isinstance(record, dict):
            raise CorruptFileError(f"{where}: expected an object, found {_shown(record)}; bake it again")
        self._record: dict[str, Any] = record
        self.where = where
        if names is not None and set(record) != (wanted := set(names)):
            missing, unknown = sorted(wanted - set(record)), sorted(set(record) - wanted)
            raise CorruptFileError(f"{where}: missing {missing or 'nothing'}, unknown {_shown(unknown)}; bake it again")

    def number(self, name: str, low: float = -1e9, high: float = 1e9) -> float:
        """A finite number within low..high."""
        value = self._record.get(name)
        # True is an int to Python; NaN and Infinity are numbers to its JSON reader, and in no range.
        if isinstance(value, bool) or not isinstance(value, int | float) or not low <= value <= high:
            raise self._unlike(name, f"a number of {low:g}..{high:g}")
        return float(value)

    def integer(self, name: str, low: int = 0, high: int = LARGEST_INTEGER) -> int:
        """A whole number within low..high."""
        value = self._record.get(name)
        if isinstance(value, bool) or not isinstance(value, int) or not low <= value <= high:
            raise self._unlike(name, f"a whole number of {low}..{high}")
        return value

    def has(self, name: str) -> bool:
        """Whether there is such a member, and it is not null."""
        return self._record.get(name) is not None

    def text(self, name: str, longest: int = LONGEST_TEXT) -> str:
        """A string that can be written to a terminal and a reply."""
        value = self._record.get(name)
        if not isinstance(value, str) or len(value) > longest or not _encodable(value):
            raise self._unlike(name, f"a text of at most {longest} characters")
        return value

    def choice(self, name: str, allowed: tuple[str, ...]) -> str:
        """One of a closed set of strings."""
        value = self._record.get(name)
        if value not in allowed:
            raise self._unlike(name, " or ".join(allowed))
        return str(value)

    def point(self, name: str, low: float = -1e9, high: float = 1e9) -> tuple[float, float, float]:
        """Three finite numbers."""
        value = self._record.get(name)
        if not isinstance(value, list) or len(value) != 3:
            raise self._unlike(name, "three numbers")
        x, y, z = (Fields({name: part}, self.where).number(name, low, high) for part in value)
        return x, y, z

    def triple(self, name: str, low: int, high: int) -> tuple[int, int, int]:
        """Three whole numbers within low..high."""
        value = self._record.get(name)
        if not isinstance(value, list) or len(value) != 3:
            raise self._unlike(name, "three whole numbers")
        x, y, z = (Fields({name: part}, self.where).integer(name, low, high) for part in value)
        return x, y, z

    def mapping(self, name: str) -> dict[str, Any]:
        """An object, its members unchecked."""
        value = self._record.get(name)
        if not isinstance(value, dict):
            raise self._unlike(name, "an object")
        return value

    def fields(self, name: str, names: Iterable[str] | None = None) -> "Fields":
        """An object's members."""
        return Fields(self.mapping(name), f"{self.where}: {name}", names)

    def sequence(self, name: str, most: int) -> list[Any]:
        """A list of at most ``most`` items, unchecked."""
        value = self._record.get(name)
        if not isinstance(value, list) or len(value) > most:
            raise self._unlike(name, f"a list of at most {most} items")
        return value

    def _unlike(self, name: str, expected: str) -> CorruptFileError:
        found = _shown(self._record[name]) if name in self._record else "nothing"
        return CorruptFileError(f"{self.where}: {name}: expected {expected}, found {found}; bake it again")


def is_finite(number: float) -> bool:
    """Whether a number is one that a float can hold: JSON and TOML have integers of any size, which math.isfinite does not take."""
    return abs(number) <= sys.float_info.max


def all_finite(value: Any, depth: int = 0) -> bool:
    """Whether free-form JSON can be written again as JSON: no NaN, no infinity, no lone surrogate, nothing that overflows, and not nested
    beyond DEEPEST."""
    if depth > DEEPEST:
        return False
    if isinstance(value, int | float):
        return is_finite(value)
    if isinstance(value, str):
        return _encodable(value)
    if isinstance(value, dict):
        return all(_encodable(name) and all_finite(part, depth + 1) for name, part in value.items())
    return all(all_finite(part, depth + 1) for part in value) if isinstance(value, list) else True


def _encodable(text: str) -> bool:
    try:
        text.encode()
    except UnicodeEncodeError:
        return False
    return True


def _shown(value: Any) -> str:
    try:
        text = ascii(value)
    except ValueError:  # Python refuses to print integers of more than 4300 digits
        return "a number of thousands of digits"
    return text if len(text) <= _LONGEST_ECHO else text[:_LONGEST_ECHO] + "..."

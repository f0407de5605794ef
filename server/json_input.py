"""Typed access to JSON or TOML that a user wrote: each refusal says where, what was expected, and what was found."""

import math
import re
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from gi_core.errors import InputError

_LONGEST_ECHO = 60
_ID = re.compile(r"[A-Za-z0-9_-]{1,64}", re.ASCII)


class Members:
    """The members of one object. Every method raises InputError for a member that is not what was asked for."""

    def __init__(self, record: Any, where: str, names: Iterable[str]) -> None:
        """``names`` are all that it may have; which of them it has to have is told by how they are read."""
        if not isinstance(record, dict):
            raise InputError(f"{where}: expected an object, found {shown(record)}")
        known = tuple(names)
        unknown = [name for name in record if name not in known]
        if unknown:
            raise InputError(f"{where}: expected members {', '.join(known)}, found {', '.join(map(shown, unknown[:5]))}")
        self._record: dict[str, Any] = record
        self.where = where

    def __contains__(self, name: str) -> bool:
        return name in self._record

    def value(self, name: str) -> Any:
        """A member as it is; None when there is none."""
        return self._record.get(name)

    def number(self, name: str, default: float | None, low: float, high: float) -> float:
        """A finite number within low..high; one without a default has to be there."""
        if name not in self._record and default is not None:
            return default
        return number(self._record.get(name), f"{self.where}: {name}", low, high)

    def integer(self, name: str, default: int | None, low: int, high: int) -> int:
        """A whole number within low..high; one without a default has to be there."""
        value = self._record.get(name, default)
        if isinstance(value, bool) or not isinstance(value, int) or not low <= value <= high:
            raise InputError(f"{self.where}: {name}: expected a whole number of {low}..{high}, found {shown(value)}")
        return value

    def flag(self, name: str, default: bool) -> bool:
        """True or false."""
        value = self._record.get(name, default)
        if not isinstance(value, bool):
            raise InputError(f"{self.where}: {name}: expected true or false, found {shown(value)}")
        return value


def identifier(value: Any, where: str) -> str:
    """The id of a thing of the live world. Raises InputError."""
    if not isinstance(value, str) or not _ID.fullmatch(value):
        raise InputError(f"{where}: expected 1 to 64 letters, digits, - or _, found {shown(value)}")
    return value


def number(value: Any, where: str, low: float, high: float) -> float:
    """A finite number within low..high. Raises InputError."""
    # True is an int to Python; NaN is in no range.
    if isinstance(value, bool) or not isinstance(value, int | float) or not low <= value <= high:
        raise InputError(f"{where}: expected a number of {low:g}..{high:g}, found {shown(value)}")
    return float(value)


def numbers(value: Any, where: str, count: int, low: float, high: float) -> tuple[float, ...]:
    """A list of ``count`` finite numbers within low..high. Raises InputError."""
    if not isinstance(value, list | tuple) or len(value) != count:
        raise InputError(f"{where}: expected {count} numbers, found {shown(value)}")
    return tuple(number(part, where, low, high) for part in value)


def read_text(path: Path, most_bytes: int) -> str:
    """A small UTF-8 file of the user's. Raises InputError when it cannot be read, or is larger than such a file should be."""
    try:
        with path.open("rb") as file:
            data = file.read(most_bytes + 1)
    except (OSError, ValueError) as error:  # a name with a zero byte is a ValueError
        raise InputError(f"{path}: cannot be read ({getattr(error, 'strerror', None) or error})") from error
    if len(data) > most_bytes:
        raise InputError(f"{path}: expected at most {most_bytes} bytes, found more")
    try:
        return data.decode()
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: expected UTF-8 text ({error})") from error


def shown(value: Any) -> str:
    """A value as refusals show it: one short line of ASCII, whatever it is."""
    if value is None:
        return "nothing"
    if isinstance(value, float) and not math.isfinite(value):
        return f"{value}"
    try:
        text = ascii(value)
    except (ValueError, RecursionError):  # integers of more than 4300 digits, and lists that are nested too deeply, cannot be printed
        return f"a {type(value).__name__} too large to show"
    return text if len(text) <= _LONGEST_ECHO else text[:_LONGEST_ECHO] + "..."

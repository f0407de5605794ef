"""Reading one TOML table by name and type, with errors that say which table and key; keys nobody asked for are refused. And JSON."""

import json
import math
import tomllib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from gi_core.errors import SourceError
from gi_core.json_fields import is_finite

Vector = tuple[float, float, float]
_COUNT_WORDS = {2: "two", 3: "three"}


class Table:
    """A table and its place in the file. Every accessor takes a key; a default of None means that the key is required."""

    def __init__(self, values: dict[str, Any], where: str) -> None:
        self.where = where
        self._values = values
        self._asked: list[str] = []

    def __contains__(self, key: str) -> bool:
        return key in self._values

    def take(self, key: str, default: Any) -> Any:
        """The value as TOML has it."""
        self._asked.append(key)
        if key not in self._values and default is None:
            raise SourceError(f"{self.where}: expected the key {key}, found {', '.join(self._values) or 'nothing'}")
        return self._values.get(key, default)

    def text(self, key: str, default: str | None) -> str:
        value = self.take(key, default)
        if not isinstance(value, str):
            raise self._wrong(key, "text", value)
        return value

    def flag(self, key: str, default: bool) -> bool:
        value = self.take(key, default)
        if not isinstance(value, bool):
            raise self._wrong(key, "true or false", value)
        return value

    def choice(self, key: str, allowed: Sequence[str], default: str | None) -> str:
        value = self.text(key, default)
        if value not in allowed:
            raise self._wrong(key, " or ".join(allowed), value)
        return value

    def number(self, key: str, default: float | None, lowest: float, highest: float) -> float:
        value = self.take(key, default)
        if not _is_number(value) or not lowest <= value <= highest:
            raise self._wrong(key, f"a number from {lowest:g} to {highest:g}", value)
        return float(value)

    def vector(self, key: str, default: Vector | None, lowest: float = -math.inf, highest: float = math.inf) -> Vector:
        """Three finite numbers. A default need not lie within the limits, so it can say "not given"."""
        value = self.take(key, default)
        if value is default and default is not None:
            return default
        x, y, z = self._numbers(key, value, 3, lowest, highest)
        return x, y, z

    def pair(self, key: str, default: tuple[float, float], lowest: float, highest: float) -> tuple[float, float]:
        """Two finite numbers."""
        x, y = self._numbers(key, self.take(key, list(default)), 2, lowest, highest)
        return x, y

    def table(self, key: str) -> "Table | None":
        value = self.take(key, {})
        if not isinstance(value, dict):
            raise self._wrong(key, f"a table [{key}]", value)
        return Table(value, f"{self.where}: [{key}]") if value else None

    def tables(self, key: str) -> "list[Table]":
        value = self.take(key, [])
        if not isinstance(value, list) or not all(isinstance(one, dict) for one in value):
            raise self._wrong(key, f"tables [[{key}]]", value)
        return [Table(one, f"{self.where}: [[{key}]] {number}") for number, one in enumerate(value, 1)]

    def refuse_unknown(self) -> None:
        """Raise SourceError for a key that no accessor has asked for: most often a misspelt one."""
        for key in self._values:
            if key not in self._asked:
                raise SourceError(f"{self.where}: unknown key {key}; expected {', '.join(self._asked)}")

    def _numbers(self, key: str, value: Any, count: int, lowest: float, highest: float) -> list[float]:
        if not isinstance(value, list) or len(value) != count or not all(_is_number(one) and lowest <= one <= highest for one in value):
            limits = "" if math.isinf(lowest) else f" from {lowest:g} to {highest:g}"
            raise self._wrong(key, f"{_COUNT_WORDS[count]} numbers{limits}", value)
        return [float(one) for one in value]

    def _wrong(self, key: str, expected: str, found: Any) -> SourceError:
        return SourceError(f"{self.where}: {key}: expected {expected}, found {found!r}")


def read_toml(path: Path) -> Table:
    """A file's top table. Raises SourceError when it cannot be read or is no TOML."""
    try:
        return Table(tomllib.loads(path.read_text(encoding="utf-8")), str(path))
    except (ValueError, RecursionError) as error:
        raise SourceError(f"{path}: expected TOML ({error})") from error
    except OSError as error:
        raise SourceError(f"{path}: cannot be read ({error.strerror})") from error


def read_json(path: Path, what: str) -> dict[str, Any]:
    """A file's one JSON object, which is to be ``what``. Raises SourceError when it cannot be read or is none."""
    try:
        document = json.loads(path.read_bytes())
    except (ValueError, RecursionError) as error:
        raise SourceError(f"{path}: expected {what}, found no valid JSON ({error})") from error
    except OSError as error:
        raise SourceError(f"{path}: cannot be read ({error.strerror})") from error
    if not isinstance(document, dict):
        raise SourceError(f"{path}: expected {what}, found a {type(document).__name__}")
    return document


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and is_finite(value)

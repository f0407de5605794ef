"""[[lamp]] tables of a world.toml <-> Lamp. What each key means is in world_file.py."""

import dataclasses
import json
from collections.abc import Iterable
from pathlib import Path

from bake_jobs.table import Table, read_toml
from gi_core.errors import InputError, SourceError
from gi_core.lights import (
    MAX_CONE_DEGREES,
    MAX_LUMENS,
    MAX_RANGE_M,
    MAX_SIZE_M,
    MAX_TEMPERATURE_K,
    MIN_CONE_DEGREES,
    MIN_RANGE_M,
    MIN_SIZE_M,
    MIN_TEMPERATURE_K,
    check_lamp,
    color_from_temperature,
)
from gi_core.world import LAMP_KINDS, Lamp

# Top-level keys of a world.toml that say nothing about its lamps.
_OTHER_KEYS = ("name", "north_degrees", "location", "source", "room", "decal", "hint")


def read_lamp(table: Table) -> Lamp:
    """One [[lamp]]. Raises SourceError naming the key that is wrong."""
    if "temperature_k" in table and "color" in table:
        raise SourceError(f"{table.where}: expected color or temperature_k, found both")
    temperature = table.number("temperature_k", 6500.0, MIN_TEMPERATURE_K, MAX_TEMPERATURE_K)
    by_temperature = color_from_temperature(temperature) if "temperature_k" in table else None
    lamp = Lamp(
        table.text("name", None),
        table.choice("kind", LAMP_KINDS, "point"),
        table.vector("position", None),
        table.number("lumens", None, 0.0, MAX_LUMENS),
        by_temperature or table.vector("color", Lamp.color, 0.0, 1e6),
        table.number("range_m", Lamp.range_m, MIN_RANGE_M, MAX_RANGE_M),
        table.vector("direction", Lamp.direction),
        table.number("cone_degrees", Lamp.cone_degrees, MIN_CONE_DEGREES, MAX_CONE_DEGREES),
        table.pair("size", Lamp.size, MIN_SIZE_M, MAX_SIZE_M),
        table.text("schedule", Lamp.schedule),
    )
    table.refuse_unknown()
    try:
        check_lamp(lamp)
    except InputError as error:
        raise SourceError(f"{table.where}: {error}") from error
    return lamp


def load_lamps(path: Path) -> tuple[Lamp, ...]:
    """The lamps of a world.toml, or of a file with nothing but [[lamp]] tables; its sources are not looked at.

    Raises SourceError naming the key that is wrong, or that there is no lamp.
    """
    top = read_toml(path)
    lamps = tuple(read_lamp(table) for table in top.tables("lamp"))
    for key in _OTHER_KEYS:
        top.take(key, ())
    top.refuse_unknown()
    if not lamps:
        raise SourceError(f"{path}: expected at least one [[lamp]], found none")
    return lamps


def lamps_toml(lamps: Iterable[Lamp]) -> str:
    """Text that ``load_lamps`` reads back as the same lamps; what a lamp has by default is left out."""
    return "\n".join(_table(lamp) for lamp in lamps)


def _table(lamp: Lamp) -> str:
    lines = ["[[lamp]]"]
    for field in dataclasses.fields(lamp):
        value = getattr(lamp, field.name)
        if field.default is dataclasses.MISSING or value != field.default:
            # JSON's numbers and lists are TOML's too, and so are its texts, but for DEL and what lies beyond 16 bits.
            lines.append(f"{field.name} = {json.dumps(value, ensure_ascii=False)}".replace("\x7f", "\\u007f"))
    return "\n".join([*lines, ""])

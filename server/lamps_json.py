"""Lamps as requests and the state file write them: the fields of a world.toml's [[lamp]], an id, and how they live."""

from dataclasses import asdict, fields, replace
from typing import Any

from gi_core.errors import InputError
from gi_core.lights import check_lamp, color_from_temperature
from gi_core.world import Lamp
from server.json_input import Members, identifier, numbers, shown
from server.live_state import LiveLamp

_SHAPE = tuple(field.name for field in fields(Lamp) if field.name != "name")
_LIFE = ("id", "dynamic", "keep")
_LARGEST = 1e12


def lamp_to_json(lamp: LiveLamp) -> dict[str, Any]:
    """What ``lamp_from_json`` takes back."""
    shape = {name: value for name, value in asdict(lamp.lamp).items() if name != "name"}
    return {"id": lamp.id, **shape, "dynamic": lamp.dynamic, "keep": lamp.kept}


def lamp_from_json(record: Any, where: str, *, new_id: str | None = None) -> LiveLamp:
    """A lamp from an object: ``kind``, ``position`` and ``lumens`` have to be there. Raises InputError.

    new_id : the id of one that gives none. ``temperature_k`` may stand in place of ``color``.
    """
    members = Members(record, where, (*_LIFE, *_SHAPE, "temperature_k"))
    for name in ("kind", "position", "lumens"):
        if name not in members:
            raise InputError(f"{where}: {name}: expected one, found none")
    given = identifier(members.value("id") if "id" in members else new_id, f"{where}: id")
    lamp = _changed(Lamp(given, "point", (0.0, 0.0, 0.0), 0.0), members)
    return LiveLamp(given, lamp, members.flag("dynamic", False), members.flag("keep", False))


def lamp_changed(before: LiveLamp, record: Any, where: str) -> LiveLamp:
    """A lamp with some fields replaced, all of which a request may name but the id. Raises InputError."""
    members = Members(record, where, ("dynamic", "keep", *_SHAPE, "temperature_k"))
    return LiveLamp(before.id, _changed(before.lamp, members), members.flag("dynamic", before.dynamic), members.flag("keep", before.kept))


def _changed(lamp: Lamp, members: Members) -> Lamp:
    changes: dict[str, Any] = {}
    for name in ("kind", "schedule"):
        if name in members:
            text = members.value(name)
            if not isinstance(text, str):
                raise InputError(f"{members.where}: {name}: expected a text, found {shown(text)}")
            changes[name] = text
    for name in ("lumens", "range_m", "cone_degrees"):
        if name in members:
            changes[name] = members.number(name, None, -_LARGEST, _LARGEST)
    for name, count in (("position", 3), ("direction", 3), ("color", 3), ("size", 2)):
        if name in members:
            changes[name] = tuple(numbers(members.value(name), f"{members.where}: {name}", count, -_LARGEST, _LARGEST))
    if "temperature_k" in members:
        if "color" in members:
            raise InputError(f"{members.where}: expected either color or temperature_k, found both")
        changes["color"] = color_from_temperature(members.number("temperature_k", None, 0.0, _LARGEST))
    changed = replace(lamp, **changes)
    check_lamp(changed)
    return changed

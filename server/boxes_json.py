"""Moving boxes as requests and the state file write them: the fields of shadow_plan.MovingBox, an id, and whether they are kept."""

from dataclasses import asdict, fields, replace
from typing import Any

from gi_core.errors import InputError
from gi_core.shadow_plan import MovingBox
from server.json_input import Members, identifier, numbers
from server.live_state import LiveBox
from server.player_paths import MAX_COORDINATE_M

# Thinner than a door nothing of it is left in the map's texels; larger than a block it is not a thing that moves.
MIN_HALF_SIZE_M, MAX_HALF_SIZE_M = 0.01, 100.0
MAX_TURN_DEGREES = 360.0
_SHAPE = tuple(field.name for field in fields(MovingBox))


def box_to_json(box: LiveBox) -> dict[str, Any]:
    """What ``box_from_json`` takes back."""
    return {"id": box.id, **asdict(box.box), "keep": box.kept}


def box_from_json(record: Any, where: str, *, new_id: str | None = None) -> LiveBox:
    """A box from an object: ``position`` and ``half_size`` have to be there. Raises InputError.

    new_id : the id of one that gives none
    """
    members = Members(record, where, ("id", *_SHAPE, "keep"))
    for name in ("position", "half_size"):
        if name not in members:
            raise InputError(f"{where}: {name}: expected one, found none")
    given = identifier(members.value("id") if "id" in members else new_id, f"{where}: id")
    return LiveBox(given, _changed(MovingBox((0.0, 0.0, 0.0), (0.0, 0.0, 0.0)), members), members.flag("keep", False))


def box_changed(before: LiveBox, record: Any, where: str) -> LiveBox:
    """A box with some fields replaced, all of which a request may name but the id. Raises InputError."""
    members = Members(record, where, (*_SHAPE, "keep"))
    return LiveBox(before.id, _changed(before.box, members), members.flag("keep", before.kept))


def _changed(box: MovingBox, members: Members) -> MovingBox:
    changes: dict[str, Any] = {}
    for name, low, high in (("position", -MAX_COORDINATE_M, MAX_COORDINATE_M), ("half_size", MIN_HALF_SIZE_M, MAX_HALF_SIZE_M)):
        if name in members:
            changes[name] = numbers(members.value(name), f"{members.where}: {name}", 3, low, high)
    if "turned_degrees" in members:
        changes["turned_degrees"] = members.number("turned_degrees", None, -MAX_TURN_DEGREES, MAX_TURN_DEGREES)
    return replace(box, **changes)

"""The artists' settings as requests write them."""

from dataclasses import fields, replace
from typing import Any

from gi_core.errors import InputError
from gi_core.settings import MAX_AMBIENT_LX, MAX_FACTOR, Settings
from server.json_input import Members, numbers


def changed_settings(before: Settings, record: Any) -> Settings:
    """Settings with some of them replaced. Raises InputError, also when none is named."""
    names = [field.name for field in fields(Settings)]
    members = Members(record, "settings", names)
    changes: dict[str, Any] = {}
    for name in names:
        if name not in members:
            continue
        if isinstance(getattr(before, name), tuple):
            changes[name] = numbers(members.value(name), f"settings: {name}", 3, 0.0, MAX_AMBIENT_LX)
        else:
            changes[name] = members.number(name, None, 0.0, MAX_FACTOR)
    if not changes:
        raise InputError(f"settings: expected any of {', '.join(names)}, found nothing")
    return replace(before, **changes)

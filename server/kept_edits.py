"""Live edits that asked to be kept, in a JSON file, written whole after each change and read at the next start: players, lamps, boxes, and
clock, weather and settings."""

import errno
import json
import threading
from collections.abc import Callable, Iterable, Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, get_args

from gi_core.container import write_atomic
from gi_core.errors import InputError
from gi_core.outputs import expect_file
from server.boxes_json import box_from_json, box_to_json
from server.json_input import Members, read_text
from server.lamps_json import lamp_from_json, lamp_to_json
from server.live_state import LiveBox, LiveLamp, LiveState, Part
from server.player_paths import EyeHeight
from server.players import Player, player_from_json
from server.world_clock import clock_to_json

MAX_FILE_BYTES = 1 << 26
PARTS: tuple[Part, ...] = get_args(Part)


@dataclass(frozen=True)
class Kept:
    """What a state file holds."""

    players: tuple[Player, ...] = ()
    lamps: tuple[LiveLamp, ...] = ()
    boxes: tuple[LiveBox, ...] = ()
    parts: Mapping[Part, dict[str, Any]] = field(default_factory=dict)
    """What PUT /v1/clock, weather and settings take."""


class KeptEdits:
    """Writes the state file. Safe to use from several threads."""

    def __init__(self, path: Path | None) -> None:
        """Raises InputError when nothing could be written there, rather than at the first edit."""
        if path is not None:
            expect_file(path, "--state")
        self._path = path
        self._lock = threading.Lock()

    def expect_possible(self) -> None:
        """Raise InputError when there is no file to keep anything in."""
        if self._path is None:
            raise InputError("keep: expected a server that was started with --state FILE, found none; leave keep out")

    def save(self, latest: Callable[[], LiveState]) -> None:
        """Write what of the latest state is to be kept, whole or not at all. Nothing without a file. Raises OSError."""
        if self._path is None:
            return
        with self._lock:  # asked for inside: of two that save, the one who waited must not write what was before the other's
            state = latest()
            record = {
                "players": [entry.player.to_json() for entry in state.players.values() if entry.kept],
                "lights": [lamp_to_json(lamp) for lamp in state.lamps.values() if lamp.kept],
                "boxes": [box_to_json(box) for box in state.boxes.values() if box.kept],
            }
            content = (json.dumps(record | _parts(state), indent=1, allow_nan=False) + "\n").encode()
            if len(content) > MAX_FILE_BYTES:
                raise OSError(errno.EFBIG, f"the state file would have more than {MAX_FILE_BYTES} bytes")
            write_atomic(self._path, content)


def _parts(state: LiveState) -> dict[str, dict[str, Any]]:
    """The parts of a state that are kept, as requests would set them."""
    clock = clock_to_json(state.clock, state.clock.start_tick)
    every = {"clock": {name: clock[name] for name in ("time", "rate", "paused")}, "weather": state.weather.description}
    every["settings"] = asdict(state.settings)
    return {part: record for part, record in every.items() if part in state.kept}


def load_kept(path: Path | None, eye_height: EyeHeight | None) -> Kept:
    """What a state file holds; nothing when there is none yet. Raises InputError for one that is not what ``save`` wrote."""
    if path is None or not path.exists():
        return Kept()
    try:
        record = json.loads(read_text(path, MAX_FILE_BYTES))
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path}: expected JSON that a server wrote ({str(error)[:200]})") from error
    members = Members(record, str(path), ("players", "lights", "boxes", *PARTS))
    players = tuple(
        player_from_json(entry, f"{path}: player {i}", eye_height=eye_height) for i, entry in enumerate(_list(members, "players"))
    )
    lamps = tuple(lamp_from_json(entry, f"{path}: light {i}") for i, entry in enumerate(_list(members, "lights")))
    # Servers before there were boxes wrote none.
    records = _list(members, "boxes") if "boxes" in members else ()
    boxes = tuple(box_from_json(entry, f"{path}: box {i}") for i, entry in enumerate(records))
    return Kept(players, lamps, boxes, {part: _object(members, part) for part in PARTS if part in members})


def _object(members: Members, name: str) -> dict[str, Any]:
    value = members.value(name)
    if not isinstance(value, dict):
        raise InputError(f"{members.where}: {name}: expected an object")
    return value


def _list(members: Members, name: str) -> Iterable[object]:
    value = members.value(name)
    if not isinstance(value, list):
        raise InputError(f"{members.where}: {name}: expected a list")
    return value

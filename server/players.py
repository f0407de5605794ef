"""Simulated players as users describe them: over HTTP, in a file for ``serve --players``, and back.

A players file is a JSON list of objects, or TOML with a [[player]] for each:

    [[player]]
    id = "runner"                       # letters, digits, - and _
    speed = 5.0                         # m/s, 0..200
    path = [[10, 1.6, 8], [90, 1.6, 8]] # points [x, y, z] in metres, a GeoJSON LineString, or the name of a file with one, beside this one;
                                        # without a path: a walk along streets
    loop = true                         # the last point leads to the first; else back and forth
    pause_s = [0.0, 4.0]                # shortest and longest pause at each corner, a turn of 10 degrees or more
    turn_s = 0.5                        # how long turning round on the spot takes
    seed = 7                            # of the pauses and of the walk along streets
    walk_m = 1000.0                     # how far the walk along streets goes before it turns back
    near = [40, 1.6, 8]                 # where it starts; anywhere in the city when not given
"""

import json
import tomllib
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from gi_core.dataset import Dataset
from gi_core.errors import InputError
from gi_core.json_fields import LARGEST_INTEGER
from server.json_input import Members, identifier, numbers, read_text, shown
from server.path_walk import PathWalk, Point
from server.player_paths import MAX_COORDINATE_M, EyeHeight, points_from_json, read_path_file
from server.street_lattice import StreetLattice
from server.street_walk import MAX_WALK_M, MIN_WALK_M, walk_streets

MAX_PLAYERS = 1000
MAX_SPEED_M_S = 200.0
MAX_DWELL_S = 3600.0
MAX_FILE_BYTES = 1 << 26


@dataclass(frozen=True)
class Player:
    """A simulated player; the top of this file says what each field means. ``path`` None is a walk along streets."""

    id: str
    speed: float = 1.4
    path: tuple[Point, ...] | None = None
    loop: bool = False
    pause_s: tuple[float, float] = (0.0, 0.0)
    turn_s: float = 0.0
    seed: int = 0
    walk_m: float = 1000.0
    near: Point | None = None

    def to_json(self) -> dict[str, Any]:
        """What ``player_from_json`` takes back."""
        return {name: value for name, value in asdict(self).items() if value is not None}

    def walk(self, dataset: Dataset, lattice: StreetLattice) -> PathWalk:
        """The player's motion. Reads the sectors that a walk along streets sees, some 40 a kilometre; InputError without streets."""
        points, loop = self.path, self.loop
        if points is None:
            # Its last point cannot lead straight to its first: it goes back as it came.
            points, loop = walk_streets(dataset, lattice, self.seed, self.walk_m, self.near), False
        return PathWalk(points, self.speed, loop, pause_s=self.pause_s, turn_s=self.turn_s, seed=self.seed)


def player_from_json(
    record: Any, where: str, *, new_id: str | None = None, eye_height: EyeHeight | None = None, folder: Path | None = None
) -> Player:
    """A player from an object. Raises InputError, which names the member, what was expected and what was found.

    new_id : the id of one that gives none; without it an id has to be there
    eye_height : for GeoJSON positions without a height
    folder : where files that ``path`` may name lie; without it (requests from outside) no path may be a file
    """
    members = Members(record, where, Player.__dataclass_fields__)
    name = identifier(members.value("id") if "id" in members else new_id, f"{where}: id")
    shortest, longest = numbers(members.value("pause_s"), f"{where}: pause_s", 2, 0.0, MAX_DWELL_S) if "pause_s" in members else (0.0, 0.0)
    if shortest > longest:
        raise InputError(f"{where}: pause_s: expected the shortest first, found {shown([shortest, longest])}")
    return Player(
        id=name,
        speed=members.number("speed", Player.speed, 0.0, MAX_SPEED_M_S),
        path=_path(members, eye_height, folder),
        loop=members.flag("loop", Player.loop),
        pause_s=(shortest, longest),
        turn_s=members.number("turn_s", Player.turn_s, 0.0, MAX_DWELL_S),
        seed=members.integer("seed", Player.seed, 0, LARGEST_INTEGER),
        walk_m=members.number("walk_m", Player.walk_m, MIN_WALK_M, MAX_WALK_M),
        near=_near(members),
    )


def read_players(path: Path, eye_height: EyeHeight | None = None) -> tuple[Player, ...]:
    """The players of a file, .json or .toml. Raises InputError."""
    text, is_toml = read_text(path, MAX_FILE_BYTES), path.suffix.lower() == ".toml"
    try:
        records = tomllib.loads(text) if is_toml else json.loads(text)
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path}: expected players as JSON or TOML ({str(error)[:200]})") from error
    if is_toml:
        records = Members(records, str(path), ["player"]).value("player") or []
    if not isinstance(records, list) or len(records) > MAX_PLAYERS:
        raise InputError(f"{path}: expected a list of at most {MAX_PLAYERS} players, found {_count(records)}")
    players = tuple(
        player_from_json(record, f"{path}: player {i}", eye_height=eye_height, folder=path.parent) for i, record in enumerate(records)
    )
    seen: set[str] = set()
    for player in players:
        if player.id in seen:
            raise InputError(f"{path}: expected each id once, found {player.id!r} twice")
        seen.add(player.id)
    return players


def _path(members: Members, eye_height: EyeHeight | None, folder: Path | None) -> tuple[Point, ...] | None:
    if "path" not in members:
        return None
    value, where = members.value("path"), f"{members.where}: path"
    if isinstance(value, str) and folder is not None:
        return read_path_file(folder / value, eye_height)
    return points_from_json(value, where, eye_height)


def _near(members: Members) -> Point | None:
    if "near" not in members:
        return None
    x, y, z = numbers(members.value("near"), f"{members.where}: near", 3, -MAX_COORDINATE_M, MAX_COORDINATE_M)
    return x, y, z


def _count(records: Any) -> str:
    return str(len(records)) if isinstance(records, list) else shown(records)

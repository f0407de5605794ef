"""Which sectors to load and which to give up, so that light is there before a player is. Pure: arrays in, a plan out.

What a volume reads comes first, then what it will read, soonest first. Memory is given up from the other end: what would be needed last.
A sector that is merely wanted takes the place of one that could only be needed a good deal later; so two that are wanted about equally
never take turns. What a volume reads is not given up, unless the volumes' sectors alone exceed the budget: then the nearest stay.
"""

from dataclasses import dataclass

import numpy as np

from gi_core.arrays import Bool, Float64, Int64
from gi_core.grid import SectorIndex
from gi_core.stream_need import Needs, SectorTable, distance_m, sector_needs

# A sector that fails to load is tried again after half a second, then twice as long each time: a file that is being replaced comes back
# at once, a damaged one costs next to nothing.
FIRST_RETRY_S, LONGEST_RETRY_S = 0.5, 60.0


@dataclass(frozen=True)
class StreamOptions:
    """What streaming trades.

    budget_bytes : of resident and loading sectors together; never exceeded
    look_ahead_s : how far ahead of a moving player sectors load; more costs memory, less risks a miss [s]
    load_margin_m : how far around the volume sectors load, so that a turn finds them there [m]
    keep_margin_m : how far around it they are worth keeping [m]; more than the load margin
    patience_s : how much later than a wanted sector a resident one must be needed to make room for it [s]
    swap_margin_m : how much farther a sector must be to make room for another when not even the volumes' own fit [m]
    max_loading : loads under way at a time; fewer keep what is urgent from waiting behind what is not
    """

    budget_bytes: int
    look_ahead_s: float = 3.0
    load_margin_m: float = 16.0
    keep_margin_m: float = 64.0
    patience_s: float = 1.0
    swap_margin_m: float = 16.0
    max_loading: int = 4

    def __post_init__(self) -> None:
        if not (self.budget_bytes > 0 and self.look_ahead_s >= 0 and 0 <= self.load_margin_m < self.keep_margin_m and self.max_loading > 0):
            raise ValueError(f"expected a budget, a load margin below the keep margin, and loads to be allowed, got {self}")


@dataclass(frozen=True, eq=False)
class StreamState:
    """Where a world's sectors are, a row for each sector of its table.

    resident_bytes : (n,) int64, 0 where a sector is not resident
    loading : (n,) bool
    retry_at_s : (n,) float64, when a sector that failed may be tried again [s]; 0 where none failed
    """

    resident_bytes: Int64
    loading: Bool
    retry_at_s: Float64

    def used_bytes(self, table: SectorTable) -> int:
        """What counts against the budget: resident sectors and those that load."""
        return int(self.resident_bytes.sum()) + int(table.bytes[self.loading].sum())

    @classmethod
    def empty(cls, table: SectorTable) -> "StreamState":
        """Nothing resident, nothing loading."""
        count = len(table.sectors)
        return cls(np.zeros(count, np.int64), np.zeros(count, bool), np.zeros(count))


@dataclass(frozen=True, eq=False)
class StreamPlan:
    """What to do now: the evictions first, then the loads in this order.

    left_out : sectors that a volume reads now and that the budget has no room for
    missing : sectors that a volume reads now and that are not resident, for whatever reason: they are late
    needs : what the plan was made from, a row for each sector of the table; tick_plan wants it too
    """

    loads: tuple[SectorIndex, ...]
    evictions: tuple[SectorIndex, ...]
    left_out: tuple[SectorIndex, ...]
    missing: tuple[SectorIndex, ...]
    needs: Needs


def retry_delay_s(attempts: int) -> float:
    """How long to wait after the ``attempts``-th failure in a row (1 is the first) [s]."""
    return float(min(FIRST_RETRY_S * 2.0 ** min(max(attempts - 1, 0), 60), LONGEST_RETRY_S))


def plan_streaming(
    table: SectorTable, state: StreamState, positions: Float64, velocities: Float64, *, now_s: float, options: StreamOptions
) -> StreamPlan:
    """Plan loads and evictions for players at positions (p, 3) [m] with velocities (p, 3) [m/s], all finite.

    Costs what players and their surroundings cost, and some vector operations over the world's sectors.
    """
    needs = sector_needs(
        table,
        positions,
        velocities,
        look_ahead_s=options.look_ahead_s,
        load_margin_m=options.load_margin_m,
        keep_margin_m=options.keep_margin_m,
    )
    resident = state.resident_bytes > 0
    wanted = np.flatnonzero(np.isfinite(needs.ahead_s) & ~resident & ~state.loading & (state.retry_at_s <= now_s))
    room = _Room(table, state.resident_bytes, needs, positions, options, options.budget_bytes - state.used_bytes(table))
    room.shrink_to_budget()
    slots = options.max_loading - int(np.count_nonzero(state.loading))
    loads: list[int] = []
    left_out: list[int] = []
    if slots > 0 and len(wanted):
        # Touched ones by distance, the others by time.
        nearness = np.where(needs.touched, needs.away_m, needs.keep_s)[wanted]
        order = np.lexsort((nearness, np.where(needs.touched, 0.0, needs.ahead_s)[wanted], ~needs.touched[wanted]))
        for row in wanted[order].tolist():
            if room.make_for(row):
                loads.append(row)
                if len(loads) == slots:
                    break
            elif needs.touched[row]:
                left_out.append(row)
            elif table.bytes[row] <= options.budget_bytes:
                break  # what is wanted later waits behind it, else small sectors would always take the room of a large one
    left_out += [row for row in room.evicted if needs.touched[row]]
    missing = np.flatnonzero(needs.touched & ~resident).tolist()

    def named(rows: list[int]) -> tuple[SectorIndex, ...]:
        return tuple(table.sectors[row] for row in rows)

    return StreamPlan(named(loads), named(room.evicted), named(left_out), named(missing), needs)


class _Room:
    """Free bytes, and who would have to go for more. Works out the order of going only once it matters."""

    def __init__(
        self, table: SectorTable, resident_bytes: Int64, needs: Needs, positions: Float64, options: StreamOptions, free: int
    ) -> None:
        self.evicted: list[int] = []
        self._table, self._bytes, self._needs, self._positions, self._options = table, resident_bytes, needs, positions, options
        self._free = free
        self._last_first: list[int] | None = None

    def shrink_to_budget(self) -> None:
        """Evict down to the budget, should sectors have turned out larger than the table says, or the budget smaller."""
        going = 0
        while self._free < 0 and going < len(self._order()):
            self._free += int(self._bytes[self._order()[going]])
            going += 1
        self._evict(going)

    def make_for(self, row: int) -> bool:
        """Take a sector's bytes, after as few evictions as it needs and is worth; whether it fits."""
        lacking = int(self._table.bytes[row]) - self._free
        going = 0
        while lacking > 0:
            if going == len(self._order()) or not self._worth(row, self._order()[going]):
                return False
            lacking -= int(self._bytes[self._order()[going]])
            going += 1
        self._free = -lacking
        self._evict(going)
        return True

    def _worth(self, wanted: int, resident: int) -> bool:
        """Whether a resident sector goes to make room for a wanted one."""
        needs, options = self._needs, self._options
        if needs.touched[resident]:
            return bool(needs.touched[wanted] and needs.away_m[resident] > needs.away_m[wanted] + options.swap_margin_m)
        return bool(needs.touched[wanted] or needs.keep_s[resident] > needs.ahead_s[wanted] + options.patience_s)

    def _evict(self, count: int) -> None:
        if count:
            self.evicted += self._order()[:count]
            del self._order()[:count]

    def _order(self) -> list[int]:
        """Resident rows, the one to be needed last first; those that volumes read at the end, the farthest first."""
        if self._last_first is None:
            needs = self._needs
            rows = np.flatnonzero(self._bytes)
            far = np.isinf(needs.keep_s[rows])
            distance = np.zeros(len(rows))
            distance[far] = distance_m(self._table.places[rows[far]], self._positions)
            touched = needs.touched[rows]
            distance[touched] = needs.away_m[rows[touched]]
            self._last_first = rows[np.lexsort((rows, -distance, -needs.keep_s[rows], touched))].tolist()
        return self._last_first

"""Which sectors are relit this tick. Pure: arrays in, rows out.

One place goes to the sectors that players stand in, in turn; the others to whichever sector needs light most. How much one needs it is

    need = ticks since it was relit  x  how much its light has changed  x  how near a player is

A settled sector needs nothing, so an idle world relights nothing; what nobody is near to counts as settled sooner.

Nobody starves. Change and nearness are weights within 1 .. 1 / WEIGHT_RATIO, whatever their values, while the wait grows without bound.
With g general places a tick, a sector that has waited a ticks loses only to sectors that have waited a / WEIGHT_RATIO or more, so in that
many ticks after none of the others wins twice. Among n sectors, q = floor((n - 1) / g), none waits longer than

    (WEIGHT_RATIO + 1) q + 1 ticks
"""

import numpy as np

from gi_core.arrays import Float64, Int64

# A relative change of light below this is not worth a relight: a ninth of the finest step that an 8-bit sRGB picture shows (0.9 %). Where
# no volume reads it, one below this over the weight of nearness is not.
SETTLED_CHANGE = 1e-3
# Least weights: of a change that is barely worth a relight, and of a sector that no volume reads.
_LEAST_CHANGE_WEIGHT, _LEAST_NEARNESS_WEIGHT = 0.25, 0.25
WEIGHT_RATIO = 1 / (_LEAST_CHANGE_WEIGHT * _LEAST_NEARNESS_WEIGHT)
# How near counts: full weight within a volume's reach of a player, a quarter from four times that on.
_NEAR_M = 50.0
PLACES = 2  # slide "Relighting": two sectors a frame


def plan_tick(tick: int, relit_at: Int64, change: Float64, away_m: Float64, *, places: int = PLACES) -> tuple[int, ...]:
    """Rows of the sectors to relight now, at most ``places`` of them, the players' own first; fewer when fewer need it.

    Parameters
    ----------
    relit_at : (n,) int64, the tick of each resident sector's last relight, before ``tick``
    change : (n,) float64, relative: how much its light has changed since then, or how far its bounces are from having settled
    away_m : (n,) float64 [m], from each sector to the nearest player, 0 where one stands in it; as in stream_need.Needs

    Raises ValueError for fewer than two places: with one, the players' own would starve all others.
    """
    if places < 2:
        raise ValueError(f"expected two places or more, got {places}")
    need = relight_need(tick, relit_at, change, away_m)
    if not need.any():
        return ()
    chosen: list[int] = []
    for candidates in (np.where(away_m == 0, need, 0.0), *(need for _ in range(places))):
        if len(chosen) == places:
            break
        best = int(candidates.argmax())
        if candidates[best] > 0:
            chosen.append(best)
            need[best] = 0.0
    return tuple(chosen)


def relight_need(tick: int, relit_at: Int64, change: Float64, away_m: Float64) -> Float64:
    """How much each sector needs to be relit, (n,); 0 for settled ones. Arguments as for ``plan_tick``."""
    need = np.zeros(len(change))
    nearness = np.maximum(_NEAR_M / np.maximum(away_m, _NEAR_M), _LEAST_NEARNESS_WEIGHT)
    off = np.flatnonzero(change * nearness > SETTLED_CHANGE)
    if len(off):  # in most ticks nobody is
        # The square root, because from a change of a thousandth to one of one is a long way.
        weight = np.clip(np.sqrt(change[off]), _LEAST_CHANGE_WEIGHT, 1.0) * nearness[off]
        need[off] = (tick - relit_at[off]) * weight
    return need


def longest_wait(sectors: int, *, places: int = PLACES) -> int:
    """Ticks within which each of so many sectors that need light is relit, whatever else does. See the top of this file.

    Sectors that are loaded during the wait count among them.
    """
    return int(WEIGHT_RATIO + 1) * ((sectors - 1) // (places - 1)) + 1

"""How the live world keeps up."""

import os
import time
from pathlib import Path
from typing import Annotated, Any

from fastapi import APIRouter, Query

from server.dependencies import LiveQuery, ServiceDep
from server.live_access import TickerDep
from server.live_models import LiveReply
from server.service import Service
from server.tick_stats import TickTime, percentiles
from server.ticker import Ticker

router = APIRouter(prefix="/v1", tags=["live world"])


@router.get("/live", response_model=LiveReply)
def live(service: ServiceDep, ticker: TickerDep, query: Annotated[LiveQuery, Query()]) -> dict[str, Any]:
    """How ticks go (percentiles of the last minute, counts since the start), what is resident, and what failed.

    With `since`, also each tick by itself: who asks once in a while, with the last tick that it was told of, misses none.
    """
    times = [] if query.since is None else ticker.stats.later_than(query.since)
    each = None if query.since is None else {name: [getattr(time, name) for time in times] for name in TickTime._fields}
    return {**live_facts(service, ticker), "recent": each}


def live_facts(service: Service, ticker: Ticker) -> dict[str, Any]:
    """What /v1/live says."""
    stats, streamer, state = ticker.stats, ticker.world.streamer, ticker.state
    streams, replies, volumes = service.streams, service.replies, service.player_volumes
    return {
        "tick": ticker.tick,
        "tick_rate": ticker.rate_hz,
        "tick_ms": stats.tick_ms,
        "parts_ms": {name: percentiles(values) for name, values in dict(stats.parts_ms).items()},
        "lateness_ms": stats.lateness_ms,
        "late_ticks": stats.late_ticks,
        "skipped": stats.skipped,
        "ticks": stats.ticks,
        "failed_ticks": stats.failed_ticks,
        "failure": None if ticker.failure is None else service.public(ticker.failure),
        "misses": stats.misses,
        "loads": stats.loads,
        "evictions": stats.evictions,
        "resident_sectors": len(streamer.residents),
        "resident_bytes": streamer.resident_bytes,
        "loading": streamer.loading,
        "failures": [
            {
                "sector": [index.x, index.z],
                "attempts": failure.attempts,
                "retry_in_s": round(max(failure.retry_at_s - time.monotonic(), 0.0), 3),
                "reason": service.public(failure.reason),
            }
            for index, failure in sorted(dict(streamer.failures).items())
        ],
        "relit": stats.relit,
        "settled": stats.settled,
        "volumes": stats.volumes,
        "waiting": stats.waiting,
        "players": len(state.players),
        "lamps": len(state.lamps),
        "boxes": len(state.boxes),
        "jumps": state.jumps,
        "streams": {"clients": streams.clients, "frames": streams.counts.frames, "bytes": streams.counts.bytes},
        "memory_bytes": memory_bytes(),
        "cache": {
            "hits": replies.hits,
            "misses": replies.misses,
            "bytes": replies.nbytes,
            "player_volume_hits": volumes.hits,
            "player_volume_misses": volumes.misses,
        },
    }


def memory_bytes() -> int | None:
    """Resident memory of this process; None where the system does not say it like Linux."""
    try:
        return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")
    except (OSError, ValueError, IndexError):
        return None

"""Figures for Prometheus. Each application has a registry of its own; most figures are counted elsewhere and read when asked for."""

from collections.abc import Iterator

from prometheus_client import CollectorRegistry, ProcessCollector, generate_latest
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, HistogramMetricFamily, Metric
from prometheus_client.registry import Collector
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from server.service import Service
from server.tick_stats import BUCKETS_S
from server.ticker import Ticker

# Clients may send any word as a method; each label is kept for ever.
_METHODS = frozenset({"GET", "POST", "PUT", "PATCH", "DELETE", "OPTIONS"})


# Method, route, status.
RequestKey = tuple[str, str, int]


class Metrics:
    """The figures of one application."""

    def __init__(self, service: Service) -> None:
        self._registry = CollectorRegistry(auto_describe=False)
        self._registry.register(_ServiceFigures(service))
        ProcessCollector(registry=self._registry)
        self._requests: dict[RequestKey, int] = {}
        self._registry.register(_RequestFigures(self._requests))

    def count_request(self, method: str, route: str, status: int) -> None:
        """A reply was sent; ``route`` is a template, so that their number is bounded. On the event loop alone."""
        key = method if method in _METHODS else "other", route, status
        self._requests[key] = self._requests.get(key, 0) + 1

    def text(self) -> bytes:
        """All figures in Prometheus' text format."""
        return generate_latest(self._registry)


class CountRequests:
    """Counts HTTP replies. Pure ASGI; inside what turns HEAD into GET, and what answers from finished replies, which counts its own."""

    def __init__(self, app: ASGIApp, metrics: Metrics) -> None:
        self._app = app
        self._metrics = metrics

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        status = 500  # also of what fails before it begins to answer

        async def noting(message: Message) -> None:
            nonlocal status
            if message["type"] == "http.response.start":
                status = message["status"]
            await send(message)

        try:
            await self._app(scope, receive, noting)
        finally:
            self._metrics.count_request(scope["method"], route_of(scope), status)


def route_of(scope: Scope) -> str:
    """The template of the route that answered a request; ``unmatched`` where none did."""
    path = getattr(scope.get("route"), "path", None)
    return path if isinstance(path, str) and path else "unmatched"


class _RequestFigures(Collector):
    """Replies by what was asked and what came of it."""

    def __init__(self, counts: dict[RequestKey, int]) -> None:
        self._counts = counts

    def collect(self) -> Iterator[Metric]:
        found = CounterMetricFamily("sectorlight_http_requests", "Replies, by route and status.", labels=("method", "route", "status"))
        for (method, route, status), count in sorted(self._counts.copy().items()):
            found.add_metric((method, route, str(status)), count)
        yield found


class _ServiceFigures(Collector):
    """Reads what the service and its live world have counted. Never starts the live world."""

    def __init__(self, service: Service) -> None:
        self._service = service

    def collect(self) -> Iterator[Metric]:
        service = self._service
        replies, volumes, streams = service.replies, service.player_volumes, service.streams
        yield _counter("query_cache_hits", "Queries that were answered with bytes made before.", replies.hits)
        yield _counter("query_cache_misses", "Queries that were computed.", replies.misses)
        yield _gauge("query_cache_bytes", "Replies that are kept.", replies.nbytes)
        yield _counter("player_volume_cache_hits", "Players' volumes that were encoded before.", volumes.hits)
        yield _counter("player_volume_cache_misses", "Players' volumes that were encoded.", volumes.misses)
        yield _gauge("stream_clients", "WebSocket streams that are open.", streams.clients)
        yield _counter("streams", "WebSocket streams that were opened.", streams.counts.clients)
        yield _counter("streams_refused", "WebSocket streams that were refused for their number.", streams.counts.refused)
        yield _counter("stream_frames", "Frames sent on streams.", streams.counts.frames)
        yield _counter("stream_bytes", "Bytes of those frames.", streams.counts.bytes)
        ticker = service.live.started_ticker
        yield _gauge("live_running", "1 while the live world ticks.", float(ticker is not None and ticker.is_running))
        if ticker is not None:
            yield from _live_figures(ticker)


def _live_figures(ticker: Ticker) -> Iterator[Metric]:
    stats, streamer, state = ticker.stats, ticker.world.streamer, ticker.state
    yield _counter("ticks", "Ticks that were made.", stats.ticks)
    yield _counter("late_ticks", "Ticks that ended after the next was due.", stats.late_ticks)
    yield _counter("skipped_ticks", "Ticks whose time had passed before they could begin.", stats.skipped)
    yield _counter("failed_ticks", "Ticks that raised an error.", stats.failed_ticks)
    yield tick_seconds(tuple(stats.bucket_counts), stats.seconds)
    yield _counter("relit_sectors", "Sectors that were relit.", stats.relit)
    yield _counter("settled_sectors", "Sectors that were brought to a query's very bytes.", stats.settled)
    yield _counter("filled_volumes", "Players' volumes that were filled.", stats.volumes)
    yield _gauge("waiting_volumes", "Volumes that wait for another tick.", stats.waiting)
    yield _counter("sector_misses", "Sectors that volumes read and that were not there, summed over ticks.", stats.misses)
    yield _counter("sector_loads", "Sectors that were loaded.", stats.loads)
    yield _counter("sector_evictions", "Sectors that were given up.", stats.evictions)
    yield _gauge("failing_sectors", "Sectors whose files cannot be loaded now.", len(streamer.failures))
    yield _gauge("resident_sectors", "Sectors on the device.", len(streamer.residents))
    yield _gauge("resident_bytes", "Bytes of those sectors.", streamer.resident_bytes)
    yield _gauge("players", "Simulated players.", len(state.players))
    yield _gauge("lamps", "Lamps.", len(state.lamps))


def tick_seconds(counts: tuple[int, ...], seconds: float) -> HistogramMetricFamily:
    """How long ticks take, as a histogram: Prometheus' buckets hold all that are no greater."""
    running, buckets = 0, []
    for end, count in zip((*map(str, BUCKETS_S), "+Inf"), counts, strict=True):
        running += count
        buckets.append((end, running))
    return HistogramMetricFamily("sectorlight_tick_seconds", "How long ticks take.", buckets=buckets, sum_value=seconds)


def _counter(name: str, text: str, value: float) -> CounterMetricFamily:
    return CounterMetricFamily(f"sectorlight_{name}", text, value=value)


def _gauge(name: str, text: str, value: float) -> GaugeMetricFamily:
    return GaugeMetricFamily(f"sectorlight_{name}", text, value=value)

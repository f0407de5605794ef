"""The options of ``sectorlight loadtest``. What they do is imported when it runs."""

import sys
from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer


class LoadTestMode(StrEnum):
    """How the clients of a load test get their volumes."""

    stream = "stream"
    fetch = "fetch"


def loadtest(
    url: Annotated[str, typer.Argument(help="Of a running server, as in http://127.0.0.1:8000")],
    players: Annotated[int, typer.Option(min=1, max=1000, help="Simulated players to make; a client follows each.")] = 1,
    seconds: Annotated[float, typer.Option(min=1, max=1e6, help="How long, once all players are there.")] = 30.0,
    warm_up: Annotated[
        float,
        typer.Option(min=0, max=1e6, help="Seconds that players walk before anything is counted."),
    ] = 0.0,
    path: Annotated[
        Path | None,
        typer.Option(
            help="JSON: a list of points x, y, z in metres, several such lists, or GeoJSON LineStrings of x, z, height; without it players"
            " walk the streets."
        ),
    ] = None,
    speed: Annotated[float, typer.Option(min=0, max=200, help="Of the players, in m/s.")] = 5.0,
    mode: Annotated[
        LoadTestMode, typer.Option(help="stream: a WebSocket for each player; fetch: ask for its volume at the rate of ticks.")
    ] = LoadTestMode.stream,
    seed: Annotated[int, typer.Option(min=0, help="Of the walks that the server makes up.")] = 0,
    token_file: Annotated[Path | None, typer.Option(envvar="SECTORLIGHT_TOKEN_FILE", help="File with the server's bearer token.")] = None,
    json_path: Annotated[Path | None, typer.Option("--json", metavar="OUT", help="Write the report here.")] = None,
    plot_path: Annotated[Path | None, typer.Option("--plot", metavar="OUT.png", help="Draw it second by second here.")] = None,
    pop_bound: Annotated[
        float, typer.Option(min=0.001, max=1, help="A voxel pops when it changes by more than this share between two ticks.")
    ] = 0.2,
    max_tick_p99_ms: Annotated[float | None, typer.Option(help="Exit 1 above this: 99th percentile of the server's ticks.")] = None,
    max_lateness_p99_ms: Annotated[
        float | None, typer.Option(help="Exit 1 above this: 99th percentile of how late ticks begin after they were due.")
    ] = None,
    max_late_share: Annotated[float | None, typer.Option(help="Exit 1 above this: late ticks, as a share of all.")] = None,
    max_skipped: Annotated[int | None, typer.Option(help="Exit 1 above this: ticks whose time had passed before they could begin.")] = None,
    max_volume_p99_ms: Annotated[float | None, typer.Option(help="Exit 1 above this: 99th percentile of a volume's latency.")] = None,
    max_megabits: Annotated[float | None, typer.Option(help="Exit 1 above this: Mbit/s per player.")] = None,
    max_misses: Annotated[int | None, typer.Option(help="Exit 1 above this: ticks of players in sectors without light.")] = None,
    max_pops: Annotated[int | None, typer.Option(help="Exit 1 above this: voxels that popped, but for jumps of the clock.")] = None,
    max_errors: Annotated[int | None, typer.Option(help="Exit 1 above this: requests, streams and frames that failed.")] = None,
    max_cache_miss_share: Annotated[
        float | None, typer.Option(help="Exit 1 above this: queries and players' volumes made anew, as a share of all that were asked for.")
    ] = None,
    max_memory_gained_mb: Annotated[float | None, typer.Option(help="Exit 1 above this: by how much the server's memory grew.")] = None,
) -> None:
    """Put players into a running server's world, follow each with a client, and report how the server keeps up.

    The players are deleted in the end, also after Ctrl-C, which ends the test early and still reports.
    """
    from server import loadtest_command
    from server.cli import INTERRUPTED, writing
    from server.loadtest import Options
    from server.loadtest_limits import Limits
    from server.settings import read_token

    options = Options(
        loadtest_command.checked_url(url),
        players,
        seconds,
        mode.value,
        speed,
        () if path is None else loadtest_command.read_paths(path),
        seed,
        None if token_file is None else read_token(token_file),
        pop_bound,
        warm_up,
    )
    limits = Limits(
        tick_p99_ms=max_tick_p99_ms,
        lateness_p99_ms=max_lateness_p99_ms,
        late_share=max_late_share,
        skipped=max_skipped,
        volume_p99_ms=max_volume_p99_ms,
        megabits=max_megabits,
        misses=max_misses,
        pops=max_pops,
        errors=max_errors,
        cache_miss_share=max_cache_miss_share,
        memory_gained_mb=max_memory_gained_mb,
    )
    with writing(json_path or plot_path):
        missed, interrupted = loadtest_command.run_command(options, limits, json_path, plot_path)
    for line in missed:
        print(f"sectorlight: {line}", file=sys.stderr)
    if interrupted:
        sys.exit(INTERRUPTED)
    if missed:
        sys.exit(1)

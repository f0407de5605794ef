"""The options of ``sectorlight serve``. What they do is imported when it runs."""

from pathlib import Path
from typing import Annotated

import typer

from server.cli_options import DeviceOption


def serve(
    dataset: Annotated[Path, typer.Argument(help="A baked dataset's folder.")],
    host: Annotated[
        str, typer.Option(envvar="SECTORLIGHT_HOST", help="Address to listen on; beyond loopback needs --token-file.")
    ] = "127.0.0.1",
    port: Annotated[int, typer.Option(envvar="SECTORLIGHT_PORT", min=0, max=65535, help="0 takes a free one.")] = 8000,
    device: DeviceOption = None,
    token_file: Annotated[Path | None, typer.Option(envvar="SECTORLIGHT_TOKEN_FILE", help="File with the bearer token of writes.")] = None,
    players: Annotated[
        Path | None,
        typer.Option(
            envvar="SECTORLIGHT_PLAYERS", metavar="FILE", help="Who walks from the start, .json or .toml; starts the live world at once."
        ),
    ] = None,
    state: Annotated[
        Path | None,
        typer.Option(
            envvar="SECTORLIGHT_STATE",
            metavar="FILE",
            help="Where edits that ask to be kept are kept; its clock and weather go before --time and --weather.",
        ),
    ] = None,
    epw: Annotated[
        Path | None, typer.Option(envvar="SECTORLIGHT_EPW", metavar="FILE", help="A measured year's weather, for PUT /v1/weather.")
    ] = None,
    sky: Annotated[
        Path | None,
        typer.Option(
            envvar="SECTORLIGHT_SKY", metavar="FILE", help="A sky of your own for every hour: .hdr, or .exr with the extra `sky`."
        ),
    ] = None,
    sky_lux: Annotated[
        float | None, typer.Option(envvar="SECTORLIGHT_SKY_LUX", help="What that sky gives open ground; without: its numbers are cd/m2.")
    ] = None,
    sky_azimuth: Annotated[
        float, typer.Option(envvar="SECTORLIGHT_SKY_AZIMUTH", help="Compass azimuth in degrees that the picture's middle looks to.")
    ] = 0.0,
    sky_holds_sun: Annotated[
        bool,
        typer.Option("--sky-holds-sun", envvar="SECTORLIGHT_SKY_HOLDS_SUN", help="The sun is in the picture: the model's is left out."),
    ] = False,
    tick_rate: Annotated[
        int, typer.Option(envvar="SECTORLIGHT_TICK_RATE", min=1, max=240, help="Of the live world, in Hz: more is smoother and costs more.")
    ] = 30,
    sectors_per_tick: Annotated[
        int,
        typer.Option(
            envvar="SECTORLIGHT_SECTORS_PER_TICK",
            min=2,
            max=64,
            help="That a tick of the live world relights at most: more follow lamps that flicker and clocks that race, and cost time.",
        ),
    ] = 2,
    time: Annotated[
        str, typer.Option(envvar="SECTORLIGHT_TIME", help="Where the live world's clock starts: 13:00, or ISO 8601 with a date.")
    ] = "12:00",
    weather: Annotated[
        str, typer.Option(envvar="SECTORLIGHT_WEATHER", help="The live world's at the start: a preset, or one with overrides.")
    ] = "clear",
    budget_mb: Annotated[
        int,
        typer.Option(
            envvar="SECTORLIGHT_BUDGET_MB",
            min=16,
            max=1 << 20,
            help="Memory of the live world's sectors, on the device and in this process; never exceeded. Volumes (some 4 MB a player "
            "with a stream), shadow maps and queries come on top.",
        ),
    ] = 384,
) -> None:
    """Serve a dataset over HTTP: its light at any hour and weather, and a live world with a clock, lights and players."""
    from server.cli_serve import run
    from server.live import LiveOptions
    from server.settings import Settings, SkyFile

    live = LiveOptions(
        ticks_per_second=tick_rate,
        start_time=time,
        start_weather=weather,
        budget_bytes=budget_mb << 20,
        places=sectors_per_tick,
        players_file=players,
        state_file=state,
        epw_file=epw,
    )
    if sky is None and (sky_lux is not None or sky_azimuth or sky_holds_sun):
        raise typer.BadParameter("expected --sky FILE beside --sky-lux, --sky-azimuth and --sky-holds-sun")
    own_sky = None if sky is None else SkyFile(sky, sky_azimuth, sky_lux, sky_holds_sun)
    run(dataset, Settings(host=host, port=port, device=device, token_file=token_file, sky=own_sky, live=live))

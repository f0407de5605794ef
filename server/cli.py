"""The ``sectorlight`` command. Subcommands import what they need when they run, so that ``--help`` is quick and a server needs no baker.

Exit status: 0 done; 2 the user's input is wrong; 1 our failure; 130 interrupted.
"""

import re
import sys
from pathlib import Path
from typing import Annotated

import typer

from gi_core.errors import FormatError, InputError, SectorlightError, SectorMissingError

INTERRUPTED = 130  # 128 + SIGINT, what a shell expects

app = typer.Typer(
    help="Dynamic global illumination of a city: bake once, serve its light at any hour and weather.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    add_completion=False,
)

SectorRange = tuple[tuple[int, int], tuple[int, int]]


def main() -> None:
    """Run the command line and exit with its status."""
    try:
        app()
    except (InputError, FormatError, SectorMissingError) as error:
        fail(str(error.args[0]) if error.args else error.code, 2)
    except SectorlightError as error:
        fail(str(error), 1)
    except KeyboardInterrupt:
        fail("interrupted", INTERRUPTED)


def fail(message: str, status: int) -> None:
    """One line on stderr, then exit."""
    print(f"sectorlight: {' '.join(message.split())}", file=sys.stderr)
    sys.exit(status)


def parse_sectors(text: str | None) -> SectorRange | None:
    """``X0:X1,Z0:Z1``, half open -> ((X0, X1), (Z0, Z1)); InputError when it is anything else or empty."""
    if text is None:
        return None
    match = re.fullmatch(r"(-?\d{1,6}):(-?\d{1,6}),(-?\d{1,6}):(-?\d{1,6})", text.replace(" ", ""))
    if not match:
        raise InputError(f"--sectors: expected X0:X1,Z0:Z1 as in --sectors=-2:3,0:4, found {text[:60]!r}")
    x0, x1, z0, z1 = (int(number) for number in match.groups())
    if x0 >= x1 or z0 >= z1:
        raise InputError(f"--sectors: expected X0 < X1 and Z0 < Z1 (half open), found {text[:60]!r}")
    return (x0, x1), (z0, z1)


@app.command()
def bake(
    source: Annotated[
        str, typer.Argument(help=".glb .gltf .obj .ply .geojson .city.json world.toml, or procedural:midtown?blocks=8x8&seed=1")
    ],
    output: Annotated[Path, typer.Option("--output", "-o", help="The dataset's folder.")],
    quality: Annotated[str, typer.Option(help="Preset: draft or talk, the 2016 method as the slides give it.")] = "talk",
    jobs: Annotated[int, typer.Option(min=0, max=1024, help="Processes; 0 means one per core.")] = 0,
    sectors: Annotated[str | None, typer.Option(help="X0:X1,Z0:Z1, half open; sector (i, j) covers [64 i, 64 i + 64) m.")] = None,
    seed: Annotated[int, typer.Option(min=0, help="Same source, settings and seed give the same bytes.")] = 0,
    restart: Annotated[bool, typer.Option("--restart/--resume", help="Bake finished sectors again, or keep them.")] = False,
) -> None:
    """Bake a city into a dataset."""
    from bake_jobs.runner import bake as run

    run(source, output, quality, jobs, parse_sectors(sectors), seed, restart)


@app.command()
def info(
    dataset: Annotated[Path, typer.Argument(help="A baked dataset's folder.")],
    sector: Annotated[str | None, typer.Argument(help="X,Z: one sector in detail; after -- when X is negative.")] = None,
) -> None:
    """What a dataset holds: counts, bytes, settings, its error report."""
    from server.cli_info import show_dataset, show_sector

    if sector is None:
        show_dataset(dataset)
    else:
        show_sector(dataset, sector)


@app.command()
def serve(
    dataset: Annotated[Path, typer.Argument(help="A baked dataset's folder.")],
    host: Annotated[
        str, typer.Option(envvar="SECTORLIGHT_HOST", help="Address to listen on; beyond loopback needs --token-file.")
    ] = "127.0.0.1",
    port: Annotated[int, typer.Option(envvar="SECTORLIGHT_PORT", min=0, max=65535, help="0 takes a free one.")] = 8000,
    device: Annotated[str | None, typer.Option(envvar="SECTORLIGHT_DEVICE", help="Part of an OpenCL device's name.")] = None,
    token_file: Annotated[Path | None, typer.Option(envvar="SECTORLIGHT_TOKEN_FILE", help="File with the bearer token of writes.")] = None,
) -> None:
    """Serve a dataset over HTTP."""
    from server.cli_serve import run
    from server.settings import Settings

    run(dataset, Settings(host=host, port=port, device=device, token_file=token_file))


if __name__ == "__main__":
    main()

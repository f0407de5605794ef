"""The ``sectorlight`` command. Subcommands import what they need when they run, so that ``--help`` is quick and a server needs no baker.

Exit status: 0 done; 2 the user's input is wrong; 1 our failure; 130 interrupted.
"""

import re
import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, NoReturn, cast

import typer

from gi_core.errors import FormatError, InputError, KernelBuildError, SectorlightError, SectorMissingError
from server.cli_loadtest import loadtest
from server.cli_options import DeviceOption
from server.cli_serve_options import serve
from server.version import program_version

INTERRUPTED = 130  # 128 + SIGINT, what a shell expects
# A bake of so many measures itself unless told otherwise.
REPORTED_SECTORS = 100
BENCH_SOURCE = "procedural:midtown?blocks=1x1&seed=1"

app = typer.Typer(
    help="Dynamic global illumination of a city: bake once, serve its light at any hour and weather.",
    pretty_exceptions_enable=False,
    add_completion=False,
)

# Typer hands out only some of what it raises for arguments that it cannot read, and has moved the rest from Click into itself.
USAGE_ERRORS = cast("tuple[type[typer.BadParameter], ...]", typer.BadParameter.__bases__)

SectorRange = tuple[tuple[int, int], tuple[int, int]]


def main() -> None:
    """Run the command line and exit with its status."""
    # What ends services and containers is as good as Ctrl-C: a bake then says what it keeps, and leaves no workers behind.
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        sys.exit(app(sys.argv[1:] or ["--help"], standalone_mode=False))
    except USAGE_ERRORS as error:
        more = "" if error.ctx is None else f"; `{error.ctx.command_path} --help` tells more"
        fail(error.format_message().rstrip(".") + more, 2)
    except (InputError, FormatError, SectorMissingError) as error:
        fail(str(error.args[0]) if error.args else error.code, 2)
    except SectorlightError as error:
        fail(str(error), 1)
    except OSError as error:
        fail(describe(error), 1)


def fail(message: str, status: int) -> NoReturn:
    """One line on stderr, then exit."""
    print(f"sectorlight: {' '.join(message.split())}", file=sys.stderr)
    sys.exit(status)


def describe(error: OSError, where: Path | None = None) -> str:
    """What the system refused and why. A full disk names no path: then it is ``where``."""
    path = where if error.filename is None else error.filename
    reason = error.strerror or str(error)
    return reason if path is None else f"{path}: {reason}"


@contextmanager
def writing(output: Path | None) -> Iterator[None]:
    """Names ``output`` in errors of the system that name no path themselves."""
    try:
        yield
    except SectorlightError:  # some are OSErrors too, and have their own words
        raise
    except OSError as error:
        fail(describe(error, output), 1)


def parse_sectors(text: str) -> SectorRange:
    """``X0:X1,Z0:Z1``, half open -> ((X0, X1), (Z0, Z1)); InputError when it is anything else or empty."""
    match = re.fullmatch(r"(-?\d{1,6}):(-?\d{1,6}),(-?\d{1,6}):(-?\d{1,6})", text.replace(" ", ""))
    if not match:
        raise InputError(f"--sectors: expected X0:X1,Z0:Z1 as in --sectors=-2:3,0:4, found {text[:60]!r}")
    x0, x1, z0, z1 = (int(number) for number in match.groups())
    if x0 >= x1 or z0 >= z1:
        raise InputError(f"--sectors: expected X0 < X1 and Z0 < Z1 (half open), found {text[:60]!r}")
    return (x0, x1), (z0, z1)


def _print_version(wanted: bool) -> None:
    if wanted:
        print(f"sectorlight {program_version()}")
        raise typer.Exit


@app.callback()
def _program(
    version: Annotated[bool, typer.Option("--version", callback=_print_version, is_eager=True, help="Print the version and exit.")] = False,
) -> None:
    pass


@app.command()
def bake(
    source: Annotated[
        str, typer.Argument(help=".glb .gltf .obj .ply .geojson .city.json world.toml, or procedural:midtown?blocks=8x8&seed=1")
    ],
    output: Annotated[Path, typer.Option("--output", "-o", help="The dataset's folder.")],
    quality: Annotated[
        str,
        typer.Option(
            help="Preset: draft, the quickest; talk, the 2016 method as its slides give it; standard, right for more; reference, dearest."
        ),
    ] = "standard",
    jobs: Annotated[int, typer.Option(min=0, max=1024, help="Processes; 0 means one per core.")] = 0,
    sectors: Annotated[str | None, typer.Option(help="X0:X1,Z0:Z1, half open; sector (i, j) covers [64 i, 64 i + 64) m.")] = None,
    seed: Annotated[int, typer.Option(min=0, help="Same source, settings and seed give the same bytes.")] = 0,
    knob: Annotated[list[str] | None, typer.Option(help="A setting of the preset, NAME=VALUE as in basis=cube; repeatable.")] = None,
    restart: Annotated[bool, typer.Option("--restart/--resume", help="Bake finished sectors again, or keep them.")] = False,
    target_error: Annotated[
        float | None,
        typer.Option(help="Place probes until the bake's estimate of its error near surfaces is below, as in 0.04; at most 1000 a sector."),
    ] = None,
    report: Annotated[
        bool | None,
        typer.Option(
            help=f"Measure the bake against the path tracer when done, some ten seconds; unset: from {REPORTED_SECTORS} sectors on."
        ),
    ] = None,
) -> None:
    """Bake a city into a dataset. Interrupted with Ctrl-C, it keeps the sectors that are finished, and the same command bakes the rest."""
    chosen = None if sectors is None else parse_sectors(sectors)
    try:
        from bake_jobs.runner import bake as run

        with writing(output):
            world = run(source, output, quality, jobs, chosen, seed, restart, knobs=knob or (), target_error=target_error)
    except KeyboardInterrupt:
        kept = sum(1 for _ in output.glob("sectors/*.gisec"))
        again = " (without --restart)" if restart else ""
        fail(f"interrupted; {output} holds {kept} finished sectors, and the same command{again} bakes the rest", INTERRUPTED)
    with_probes = sum(1 for facts in world.sectors.values() if facts.probes)
    wanted = with_probes >= REPORTED_SECTORS if report is None else report and with_probes > 0
    if wanted and world.error_report is None:
        _measure(output, source if chosen else None, is_asked=report is True)


def _measure(output: Path, source: str | None, is_asked: bool) -> None:
    """Have a bake that is whole measured; where nobody asked for it a machine that cannot is told, and no failure."""
    try:
        from bake_jobs.cli_compare import report_bake

        report_bake(output, source)
    except KeyboardInterrupt:
        fail(f"interrupted; {output} is whole, and `sectorlight compare {output}` measures it", INTERRUPTED)
    except (InputError, KernelBuildError) as error:
        if is_asked:
            raise
        print(f"sectorlight: {output} is whole, but was not measured: {error}", file=sys.stderr)


@app.command(context_settings={"ignore_unknown_options": True})  # -1,0 is a sector
def info(
    dataset: Annotated[Path, typer.Argument(help="A baked dataset's folder.")],
    sector: Annotated[str | None, typer.Argument(help="X,Z: one sector in detail.")] = None,
) -> None:
    """What a dataset holds: counts, bytes, settings, its error report."""
    from server.cli_info import show_dataset, show_sector

    if sector is None:
        show_dataset(dataset)
    else:
        show_sector(dataset, sector)


app.command()(serve)
app.command()(loadtest)


@app.command()
def compare(
    dataset: Annotated[Path, typer.Argument(help="A baked dataset's folder.")],
    states: Annotated[
        str, typer.Option(help="Comma-separated: noon, low_sun, overcast, night, snow, or NAME=TIME/WEATHER as in dusk=20:45/fog.")
    ] = "noon,low_sun,overcast,night,snow",
    sectors: Annotated[str, typer.Option(help="X0:X1,Z0:Z1 (half open), a number of sectors to draw at random, or all.")] = "9",
    points: Annotated[
        int, typer.Option(min=1, max=100_000, help="Points of each kind per sector; more: less chance in the figures.")
    ] = 100,
    samples: Annotated[int, typer.Option(min=16, max=1 << 20, help="Paths per reference value; more: less noise, as 1 / sqrt.")] = 4096,
    seed: Annotated[int, typer.Option(min=0, help="Of points, paths and the draw of sectors.")] = 0,
    source: Annotated[
        str | None, typer.Option(help="What was baked, wanted when --sectors of the bake left out what surrounds these sectors.")
    ] = None,
    lamps: Annotated[
        Path | None, typer.Option(metavar="FILE.toml", help="Take this world file's lamps instead of the dataset's own; nothing is baked.")
    ] = None,
    json_path: Annotated[Path | None, typer.Option("--json", metavar="OUT", help="Write the report here.")] = None,
    plot_path: Annotated[Path | None, typer.Option("--plot", metavar="OUT.png", help="Draw medians and 95th percentiles here.")] = None,
    store: Annotated[
        bool, typer.Option("--store/--no-store", help="Keep the report in the dataset, for info and servers; never one with other --lamps.")
    ] = True,
    device: DeviceOption = None,
) -> None:
    """Measure a dataset's error against the path tracer: at probes, at voxels, and at shaded points as a client samples them."""
    from bake_jobs import cli_compare

    chosen = cli_compare.sectors_of(dataset, parse_sectors(sectors) if ":" in sectors else sectors, seed)
    try:
        with writing(json_path or plot_path):
            named = cli_compare.split_states(states)
            cli_compare.run(dataset, named, chosen, points, samples, seed, source, lamps, json_path, plot_path, device, store)
    except KeyboardInterrupt:
        fail("interrupted; nothing was written", INTERRUPTED)


@app.command()
def tradeoff(
    source: Annotated[str, typer.Argument(help="What to bake, as `bake` takes it.")],
    output: Annotated[
        Path, typer.Option("--output", "-o", metavar="OUTDIR", help="For the table, JSON, plot, and what a rerun goes on from.")
    ],
    variants: Annotated[
        str,
        typer.Option(
            help="Comma-separated presets, groups (rays, cells, placement, spacing, sky, feedback, basis, voxels, sun), knobs of standard, "
            "or ideas: talk with each of standard's added alone."
        ),
    ] = "",
    sectors: Annotated[str | None, typer.Option(help="X0:X1,Z0:Z1, half open; without it four in the middle.")] = None,
    states: Annotated[str, typer.Option(help="Moments, as `compare` takes them.")] = "noon,low_sun,overcast",
    points: Annotated[int, typer.Option(min=1, max=100_000, help="Of each kind per sector.")] = 60,
    samples: Annotated[int, typer.Option(min=16, max=1 << 20, help="Paths per reference value.")] = 1024,
    seed: Annotated[int, typer.Option(min=0, help="Of points and paths.")] = 0,
    jobs: Annotated[int, typer.Option(min=0, max=1024, help="Processes of a bake; 0 means one per core.")] = 0,
    restart: Annotated[bool, typer.Option("--restart/--resume", help="Measure all anew, or keep the rows that are there.")] = False,
    device: DeviceOption = None,
) -> None:
    """Bake a few sectors in many ways and show what each costs: error against bytes, bake seconds and tick microseconds."""
    from bake_jobs import cli_compare, cli_tradeoff
    from server.encoded_light import ENCODINGS

    names = [name.strip() for name in variants.split(",") if name.strip()]
    chosen = None if sectors is None else parse_sectors(sectors)
    try:
        with writing(output):
            moments = cli_compare.split_states(states)
            cli_tradeoff.sweep(source, output, names, chosen, moments, points, samples, seed, jobs, restart, device, ENCODINGS)
    except KeyboardInterrupt:
        fail("interrupted; finished variants are kept: the same command goes on from there", INTERRUPTED)


@app.command()
def strip(
    dataset: Annotated[Path, typer.Argument(help="A baked dataset's folder.")],
    eye: Annotated[str, typer.Option(metavar="X,Y,Z", help="Where the camera is, in metres.")],
    look: Annotated[str, typer.Option(metavar="X,Y,Z", help="What it looks at, in metres.")],
    output: Annotated[Path, typer.Option("--output", "-o", metavar="OUT.png", help="The sheet.")],
    kind: Annotated[str, typer.Option(help="day: 24 hours; weather: every preset; settings: every knob of the artists' panel.")] = "day",
    time: Annotated[str, typer.Option(help="Of the weathers: local time.")] = "13:00",
    weather: Annotated[str, typer.Option(help="Of the hours and the settings.")] = "clear",
    fov: Annotated[float, typer.Option(min=1, max=150, help="Horizontal angle in degrees.")] = 75,
    width: Annotated[int, typer.Option(min=16, max=960, help="Of one picture, in pixels.")] = 240,
    device: DeviceOption = None,
) -> None:
    """Draw one street in many lights, as one sheet of small labelled pictures."""
    from server import strip as sheets

    with writing(output):
        sheets.run(dataset, sheets.camera_of(eye, look, fov, width), kind, time, weather, output, device)


@app.command()
def bench(
    json_path: Annotated[Path | None, typer.Option("--json", metavar="OUT", help="Write the measurements here.")] = None,
    device: DeviceOption = None,
    quick: Annotated[bool, typer.Option("--quick", help="A few repeats of each: shows that all works, not how fast.")] = False,
) -> None:
    """Time relighting, volumes and their formats, decoding, baking and HTTP, each beside its baseline in the same run."""
    from tempfile import TemporaryDirectory

    from rich.console import Console

    import bake_jobs.bench
    import gi_core.bench
    import server.bench
    import server.bench_pack
    from bake_jobs.runner import bake as run_bake
    from gi_core.outputs import expect_file
    from server import cli_bench

    if json_path is not None:
        expect_file(json_path, "--json")
    try:
        with writing(json_path), Console(stderr=True).status("relight, volume, decode") as status:
            measured = gi_core.bench.run(device, quick)
            status.update("bake")
            measured.append(bake_jobs.bench.bench_bake(1 if quick else 5))
            status.update("pack, http")
            with TemporaryDirectory(prefix="sectorlight-bench-") as folder:
                run_bake(BENCH_SOURCE, Path(folder) / "city", "draft", 1, console=Console(quiet=True))
                measured += server.bench_pack.bench_pack(Path(folder) / "city", device, 3 if quick else 100)
                measured.append(server.bench.bench_http(Path(folder) / "city", device, *((2, 20) if quick else ())))
        cli_bench.show(measured)
        if json_path is not None:
            cli_bench.write_json(json_path, measured)
    except KeyboardInterrupt:
        fail("interrupted; nothing was written", INTERRUPTED)


if __name__ == "__main__":
    main()

"""``sectorlight tradeoff``: options to a sweep, its progress, and what it leaves in its folder."""

import io
import json
from collections.abc import Mapping, Sequence
from pathlib import Path

from rich.console import Console

from bake_jobs.runner import SectorRange
from bake_jobs.scene_source import load_scene
from bake_jobs.tradeoff import Sweep, Variant, middle_block, plan, run
from bake_jobs.tradeoff_report import draw, table
from bake_jobs.tradeoff_serve import Encoding, with_serving
from gi_core.container import write_atomic
from gi_core.outputs import expect_folder


def sweep(
    source: str,
    output: Path,
    names: Sequence[str],
    sectors: SectorRange | None,
    states: Sequence[str],
    points: int,
    samples: int,
    seed: int,
    jobs: int,
    restart: bool,
    device: str | None,
    encodings: Mapping[str, Encoding],
) -> None:
    """Run a sweep, leave ``tradeoff.md``, ``tradeoff.json`` and ``tradeoff.png`` beside its rows and datasets, and print the table.

    Raises InputError for what cannot be swept, and as ``tradeoff.run`` does.
    """
    expect_folder(output, "--output")
    variants = plan(names)
    scene = load_scene(source)
    task = Sweep(source, scene, sectors or middle_block(scene), tuple(states), points, samples, seed)
    with Console(stderr=True).status("") as status:

        def show(variant: Variant, what: str) -> None:
            status.update(f"{variants.index(variant) + 1} of {len(variants)}, {variant.name}: {what}")

        rows = run(task, variants, output, jobs or None, device, restart, show)
        rows = with_serving(task, variants, rows, output, encodings, device, restart, show)
    name = Path(source).name
    picture = io.BytesIO()
    draw(rows, name).save(picture, "PNG")
    text = table(rows, name)
    write_atomic(output / "tradeoff.json", (json.dumps(rows, indent=1, sort_keys=True) + "\n").encode())
    write_atomic(output / "tradeoff.md", text.encode())
    write_atomic(output / "tradeoff.png", picture.getvalue())
    print(text, end="")

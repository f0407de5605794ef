"""What serving trades: bytes and error of a basis and an encoding, and how fast bounces settle."""

from pathlib import Path

import numpy as np
import pytest

from bake_jobs import tradeoff_serve
from bake_jobs.scene_source import load_scene
from bake_jobs.tradeoff import Sweep, plan, run
from bake_jobs.tradeoff_report import table
from bake_jobs.tradeoff_serve import PASSES, with_serving
from gi_core.constants import VOLUME_SHAPE

# A sweep of bakes takes a dozen seconds.
pytestmark = pytest.mark.slow

SOURCE = "procedural:midtown?blocks=1x1&seed=1"
COLOURS = int(np.prod(VOLUME_SHAPE))


def exact(values):
    return values.nbytes, values


def halved(values):
    """A bad encoding: a byte a number, and half of the light."""
    return values.size, values / 2


ENCODINGS = {"exact": exact, "halved": halved, "rgb9e5": exact}


@pytest.fixture(scope="module")
def sweep():
    # Noon and overcast are at one time of day.
    return Sweep(SOURCE, load_scene(SOURCE), ((0, 1), (0, 1)), ("noon", "overcast"), points=12, samples=64)


@pytest.fixture(scope="module")
def swept(sweep, tmp_path_factory):
    output = tmp_path_factory.mktemp("sweep")
    variants = plan(["draft", "basis=sh1"])
    return output, variants, run(sweep, variants, output, 1)


@pytest.fixture(scope="module")
def rows(sweep, swept):
    output, variants, found = swept
    return with_serving(sweep, variants, found, output, ENCODINGS)


def test_presets_alone_are_served(rows):
    assert [sorted({"served", "bounces"} & set(row)) for row in rows] == [["bounces", "served"], []]


def test_bytes_and_error_of_each_encoding(rows):
    ways = {way["encoding"]: way for way in rows[0]["served"]}
    assert set(ways) == set(ENCODINGS)
    assert {way["basis"] for way in ways.values()} == {"cube"}
    assert (ways["exact"]["bytes"], ways["halved"]["bytes"]) == (6 * COLOURS * 12, 6 * COLOURS * 3)
    assert ways["exact"]["changed"] == 0
    assert ways["halved"]["changed"] == pytest.approx(0.5, abs=0.01)
    assert ways["halved"]["median"] > 2 * ways["exact"]["median"]


def test_exact_serving_has_the_error_that_compare_found(rows):
    found, compared = rows[0]["served"][0], rows[0]["error"]
    for name in ("median", "p95"):
        assert found[name] == pytest.approx(compared[name], rel=1e-9)  # the same points, light and paths


def test_harmonics_are_served_poorer_and_never_without_their_sign(sweep, swept):
    output, variants, _ = swept
    dataset = tradeoff_serve.Dataset.open(output / "datasets" / variants[1].folder)
    tracer = tradeoff_serve.PathTracer(sweep.scene.vertices, sweep.scene.triangles, sweep.scene.albedo, sweep.scene.emission)
    ways = tradeoff_serve.served(sweep, dataset, sorted(dataset.world.sectors), tracer, {}, ENCODINGS, None)
    assert [(way["basis"], way["encoding"]) for way in ways] == [
        ("cube", "exact"), ("cube", "halved"), ("cube", "rgb9e5"), ("sh1", "exact"), ("sh1", "halved"),
    ]  # fmt: skip
    assert ways[3]["bytes"] == 4 * COLOURS * 12


def test_every_pass_brings_light_closer_to_where_its_bounces_end(rows):
    found = rows[0]["bounces"]
    assert [row["passes"] for row in found] == list(PASSES)
    for name in ("median", "p95"):
        errors = [row[name] for row in found]
        assert errors == sorted(errors, reverse=True)
        assert errors[-1] < 0.1 * errors[0]
    assert found[0]["median"] > 0.05
    assert all(row["microseconds"] > 1 for row in found)


def test_a_second_run_takes_what_is_there_unless_another_is_asked_for(sweep, swept, rows, monkeypatch):
    output, variants, found = swept

    def never(*_, **__):
        raise AssertionError("served again")

    monkeypatch.setattr(tradeoff_serve, "served", never)
    assert with_serving(sweep, variants, found, output, ENCODINGS) == rows
    for encodings, restart in (({"exact": exact}, False), (ENCODINGS, True)):
        with pytest.raises(AssertionError, match="served again"):
            with_serving(sweep, variants, found, output, encodings, restart=restart)
    path = output / "served" / f"{variants[0].folder}.json"
    kept = path.read_bytes()
    for damaged in (b"", b"[]", kept[:-9]):
        path.write_bytes(damaged)
        with pytest.raises(AssertionError, match="served again"):
            with_serving(sweep, variants, found, output, ENCODINGS)
    path.write_bytes(kept)


def test_tables_say_what_is_known_of_serving(rows):
    text = table(rows, Path(SOURCE).name)
    serving, bounces = text.split("Serving:")[1].split("Bounces:")
    assert "| draft | cube | halved |" in serving
    assert " 50.0" in serving
    assert f"| draft | {PASSES[-1]} |" in bounces
    for part in (serving, bounces):
        assert len({line.count("|") for line in part.splitlines() if line.startswith("|")}) == 1
    plain = table([{name: value for name, value in row.items() if name not in ("served", "bounces")} for row in rows], "city")
    assert "Serving:" not in plain
    assert "Bounces:" not in plain

"""The sweep of presets and knobs: what is planned, what beats what, and that a run goes on from where it was cut off."""

import json
from dataclasses import replace
from itertools import combinations
from pathlib import Path

import numpy as np
import pytest

from bake_jobs import runner, tradeoff
from bake_jobs.config import PRESETS, settings_for, with_knobs
from bake_jobs.scene_source import load_scene
from bake_jobs.tradeoff import KNOBS, Sweep, Variant, asked, error_of, middle_block, pareto, plan, run
from bake_jobs.tradeoff_report import LABEL, _beside, draw, table
from gi_core.errors import InputError

SOURCE = "procedural:midtown?blocks=1x1&seed=1"


def row(name: str, price: float, median: float, preset: str = "standard") -> dict:
    figures = {"n": 9, "median": median, "p95": 5 * median, "bias": -median / 2}
    states = {"noon": {"probes": figures, "near": figures, "mid": {"n": 0, "median": None}, "shaded": figures}}
    return {
        "variant": name, "preset": preset, "knobs": [], "probes": 300.0, "bytes": 1e3 * price, "bake_seconds": price, "tick_us": price,
        "sectors": [[0, 0]], "states": states, "error": error_of(states, "shaded"), "asked": {"points": 9, "samples": 64},
    }  # fmt: skip


def test_every_preset_and_each_knob_alone_is_planned():
    variants = plan()
    assert [v.name for v in variants[: len(PRESETS)]] == list(PRESETS)
    turned = [v for v in variants if v.knobs]
    assert [v.knobs for v in turned] == [tuple(knobs.split()) for group in KNOBS.values() for knobs in group]
    assert len({v.folder for v in variants}) == len(variants)
    standard = settings_for("standard")
    for variant in turned:
        assert with_knobs(standard, variant.knobs).to_json() | {"preset": ""} != standard.to_json() | {"preset": ""}, variant.name


def test_some_are_chosen_by_preset_group_or_knob():
    assert [v.name for v in plan(["talk", "basis"])] == ["talk", "standard + basis=cube", "standard + basis=sh1"]
    assert plan(["sky_patches=48"]) == [Variant("standard + sky_patches=48", "standard", ("sky_patches=48",))]
    with pytest.raises(InputError, match=r"--variants 'speed': expected some of draft, talk, .*, or a knob as in sky_patches=48"):
        plan(["talk", "speed"])


def test_ideas_are_added_to_talk_one_by_one_and_all_of_them_make_standard():
    talk, *alone = plan(["talk", "ideas"])
    assert talk == Variant("talk", "talk")
    assert {variant.preset for variant in alone} == {"talk"}
    assert len({variant.folder for variant in alone}) == len(alone)
    knobs = [knob for variant in alone for knob in variant.knobs if knob != "feedback_probes=3"]
    # Rays, trial light and budgets are the same in both presets: only the ideas tell them apart.
    assert replace(with_knobs(settings_for("talk"), knobs), preset="standard") == settings_for("standard")


def test_the_front_is_what_nothing_beats():
    rows = [row("a", 3, 0.02), row("b", 1, 0.05), row("c", 2, 0.06), row("d", 2, 0.03), row("e", 9, 0.02), row("f", 8, 0.01)]
    assert [rows[i]["variant"] for i in pareto(rows, "bytes")] == ["b", "d", "a", "f"]


def test_errors_are_medians_over_states_and_bias_has_no_sign():
    states = {
        name: {"shaded": {"median": m, "p95": 2 * m, "bias": b}} for name, m, b in (("x", 1.0, -3.0), ("y", 2.0, 1.0), ("z", 9.0, 2.0))
    }
    assert error_of(states, "shaded") == {"median": 2.0, "p95": 4.0, "bias": 2.0}
    assert error_of(states, "shaded_fine") is None


def test_the_table_and_the_plot_show_every_variant():
    rows = [row("talk", 1, 0.05, "talk"), row("standard", 2, 0.03), row("standard + basis=cube", 1.5, 0.06)]
    text = table(rows, "city.glb")
    lines = [line for line in text.splitlines() if line.startswith("|")]
    assert len(lines) == 2 + len(rows)
    assert lines[2].startswith("| talk * | 300 | 1 | 1.00 | 1 | 1.00 | 5.0 / 25 / 2.5 |")
    assert lines[4].startswith("| standard + basis=cube | 300 |")  # beaten by talk in every price
    assert len({line.count("|") for line in lines}) == 1
    picture = np.asarray(draw(rows, "city.glb"))
    assert picture.shape[1] == 3 * 430
    for panel in range(3):  # dots of both presets in each
        colours = {tuple(c) for c in picture[40:390, panel * 430 : (panel + 1) * 430].reshape(-1, 3)}
        assert {(0xD0, 0x8A, 0x3C), (0x48, 0x78, 0xA8), (0xB8, 0x5A, 0x5A)} <= colours


def test_one_price_alike_for_all_is_no_trouble():
    draw([row("talk", 1, 0.05), row("standard", 1, 0.05)], "flat")
    draw([row("talk", 1, 0.05)], "one")


def test_a_row_without_shaded_points_is_told_and_not_drawn():
    blind = row("standard", 1, 0.01) | {"error": None}
    rows = [row("talk", 1, 0.05), blind]
    assert pareto(rows, "bytes") == [0]
    assert "| standard | 300 |" in table(rows, "city.glb")
    draw(rows, "city.glb")
    draw([blind], "city.glb")


def test_numbers_beside_dots_that_coincide_do_not():
    places = np.array(_beside([(100.0, 100.0)] * 6 + [(108.0, 100.0)]))
    apart = np.abs(places[:, None] - places[None])
    assert all(x >= LABEL[0] or y >= LABEL[1] for i, j in combinations(range(len(places)), 2) for x, y in [apart[i, j]])


def test_a_row_of_another_scene_or_baker_is_another(monkeypatch):
    scene, other = load_scene(SOURCE), load_scene(SOURCE.replace("seed=1", "seed=2"))
    (draft,) = plan(["draft"])
    first = asked(Sweep(SOURCE, scene, ((0, 1), (0, 1))), draft)
    assert asked(Sweep(SOURCE, scene, ((0, 1), (0, 1))), draft) == first
    assert asked(Sweep(SOURCE, other, ((0, 1), (0, 1))), draft) != first
    monkeypatch.setattr(runner, "BAKER_VERSION", runner.BAKER_VERSION + 1)
    assert asked(Sweep(SOURCE, scene, ((0, 1), (0, 1))), draft) != first


def test_the_middle_of_a_city_is_swept():
    scene = load_scene("procedural:midtown?blocks=3x3&seed=1")
    (x0, x1), (z0, z1) = middle_block(scene)
    assert (x1 - x0, z1 - z0) == (2, 2)
    centre = (scene.bounds[0] + scene.bounds[1]) / 2 / 64
    assert x0 < centre[0] < x1
    assert z0 < centre[2] < z1


@pytest.mark.slow
def test_a_sweep_keeps_its_rows_and_goes_on_from_them(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    sweep = Sweep(SOURCE, load_scene(SOURCE), ((0, 1), (0, 1)), ("noon",), points=3, samples=16)
    said: list[str] = []
    rows = run(sweep, plan(["draft", "talk"]), tmp_path, 1, progress=lambda variant, what: said.append(f"{variant.name}: {what}"))
    assert [r["variant"] for r in rows] == ["draft", "talk"]
    for found in rows:
        assert found["bytes"] > 1e4
        assert found["bake_seconds"] > 0.01
        assert found["tick_us"] > 1
        assert 0 < found["error"]["median"] < 10
    assert rows[0]["probes"] < rows[1]["probes"]
    # Points off the probes are the bakes' in common, and so is what the path tracer said of them.
    floors = [r["states"]["noon"]["floor"] for r in rows]
    assert floors[0] == floors[1]
    assert "draft: bake" in said

    def never(*_: object, **__: object) -> None:
        raise AssertionError("baked again")

    monkeypatch.setattr(tradeoff, "bake", never)
    again = run(sweep, plan(["draft", "talk"]), tmp_path, 1)
    assert [{**r, "tick_us": 0} for r in again] == [{**r, "tick_us": 0} for r in rows]
    other = Sweep(SOURCE, sweep.scene, sweep.sectors, ("noon",), points=4, samples=16)
    with pytest.raises(AssertionError, match="baked again"):
        run(other, plan(["draft"]), tmp_path, 1)
    path = tmp_path / "rows" / "talk.json"
    path.write_text(path.read_text()[:-9])
    with pytest.raises(AssertionError, match="baked again"):
        run(sweep, plan(["talk"]), tmp_path, 1)
    assert json.loads((tmp_path / "rows" / "draft.json").read_text())["variant"] == "draft"

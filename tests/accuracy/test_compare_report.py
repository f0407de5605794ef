"""Statistics of known errors, and what is written of them."""

import io
import json
import math

import numpy as np
import pytest
from rich.console import Console

from bake_jobs.compare_report import CHART_SIZE, StageSamples, draw_chart, report_table, summarise, write_json
from bake_jobs.path_tracer import Estimate

STAGES = ("probes", "near", "mid", "shaded", "floor")


def samples(served, reference, standard_error=0.0):
    reference = np.repeat(np.asarray(reference, np.float64)[:, None], 3, axis=1)
    gathered = StageSamples()
    gathered.add(
        np.repeat(np.asarray(served, np.float32)[:, None], 3, axis=1), Estimate(reference, np.full_like(reference, standard_error))
    )
    return gathered


def report(**medians):
    """A report of two states whose medians are as given for the first and ten times that for the second."""
    found = {}
    for factor, state in ((1, "noon"), (10, "low_sun")):
        numbers = {"n": 600, "p95": 0.5, "bias": -0.03, "nrmse": 0.2, "noise": 0.007, "median_ci": [0.01, 0.02]}
        found[state] = {stage: {**numbers, "median": factor * medians.get(stage, 0.01)} for stage in STAGES}
    return {
        "preset": "talk", "basis": "cube", "states": found, "sectors": [[0, 0]], "seed": 0, "samples": 64,
        "open_air_called_solid": 0.015, "floor_fill": "filled",
    }  # fmt: skip


def test_a_tenth_too_bright_is_ten_percent_everywhere():
    numbers = summarise(samples(1.1 * np.arange(50.0, 150.0), np.arange(50.0, 150.0), standard_error=1.0))
    # Served light is float32.
    assert numbers["median"] == pytest.approx(0.1, rel=1e-5)
    assert numbers["p95"] == pytest.approx(0.1, rel=1e-5)
    assert numbers["bias"] == pytest.approx(0.1, rel=1e-5)
    assert numbers["nrmse"] == pytest.approx(0.1 * np.sqrt(np.mean(np.arange(50.0, 150.0) ** 2)) / 99.5, rel=1e-5)
    assert numbers["noise"] == pytest.approx(1 / 99.5, rel=1e-3)
    assert numbers["n"] == 100


def test_errors_that_cancel_have_no_bias():
    numbers = summarise(samples([80, 120], [100, 100]))
    assert numbers["bias"] == pytest.approx(0, abs=1e-9)
    assert numbers["median"] == pytest.approx(0.2)
    assert numbers["nrmse"] == pytest.approx(0.2)


def test_a_black_point_is_divided_by_two_percent_of_the_mean():
    # The mean is 50, so what counts as darkest is 1 lx.
    numbers = summarise(samples([0.5, 100.0], [0.0, 100.0]))
    assert numbers["p95"] == pytest.approx(0.95 * 0.5)
    assert numbers["median"] == pytest.approx(0.25)


def test_luminance_weighs_the_channels():
    gathered = StageSamples()
    reference = np.array([[100.0, 100.0, 100.0]])
    gathered.add(np.array([[100.0, 150.0, 100.0]]), Estimate(reference, 0 * reference))
    assert summarise(gathered)["median"] == pytest.approx(0.5 * 0.7152)


@pytest.mark.parametrize("gathered", [StageSamples(), samples([0.0, 0.0], [0.0, 0.0])])
def test_nothing_to_compare_is_none_not_nan(gathered):
    numbers = summarise(gathered)
    assert numbers["n"] == gathered.count
    assert numbers["median"] is None
    json.dumps(numbers, allow_nan=False)


def test_json_is_the_report(tmp_path):
    write_json(tmp_path / "out.json", report())
    assert json.loads((tmp_path / "out.json").read_text()) == report()


def test_table_names_every_stage_and_rounds_to_a_tenth_of_a_percent():
    console = Console(file=io.StringIO(), width=200)
    console.print(report_table(report(near=0.0987)))
    text = " ".join(console.file.getvalue().split())  # the caption is wrapped
    assert all(stage in text for stage in STAGES)
    for expected in ("9.9 %", "98.7 %", "-3.0 %", "0.7 %", "1.5% of open-air voxels"):
        assert expected in text


def test_table_and_chart_bear_an_empty_stage():
    empty = report()
    empty["states"]["noon"]["mid"] = {"n": 0, "median": None, "p95": None, "bias": None, "nrmse": None, "noise": None, "median_ci": None}
    console = Console(file=io.StringIO(), width=200)
    console.print(report_table(empty))
    assert draw_chart(empty).size == CHART_SIZE


def test_chart_bars_are_logarithmic():
    # Bars of 1 % and 10 % end a quarter of the four decades apart.
    pixels = np.asarray(draw_chart(report()))[40:-65]
    first = np.flatnonzero((pixels == [0x48, 0x78, 0xA8]).all(axis=-1).sum(axis=1) > 100)
    second = np.flatnonzero((pixels == [0xD0, 0x8A, 0x3C]).all(axis=-1).sum(axis=1) > 100)
    assert first[0] - second[0] == pytest.approx((CHART_SIZE[1] - 100) / math.log10(10 / 0.001), abs=1.5)


@pytest.mark.slow
def test_the_confidence_interval_holds_the_true_median_and_narrows_with_more_points():
    """Errors drawn from a known distribution, many times: the interval misses its median as seldom as it says."""
    rng, widths = np.random.default_rng(1), {}
    for count, noise in ((50, 0.0), (800, 0.0), (800, 0.3)):
        held, width = 0, []
        for _ in range(60):
            reference = np.full((count, 3), 100.0)
            served = reference * (1 + rng.exponential(0.1, count)[:, None])  # median 0.1 ln 2
            samples = StageSamples()
            noisy = reference * (1 + noise * 0.1 * rng.standard_normal(count)[:, None])
            samples.add(served, Estimate(noisy, np.full((count, 3), noise * 10.0)))
            low, high = summarise(samples)["median_ci"]
            held += low <= 0.1 * np.log(2) <= high
            width.append(high - low)
        widths[count, noise] = np.mean(width)
        if noise == 0:
            assert held >= 52
    assert widths[800, 0.0] < widths[50, 0.0] / 2.5
    assert widths[800, 0.3] > widths[800, 0.0]


def drawn(rng, points, faces, noise):
    """Light that is off by a normal error of 5 %, the same for all faces of a point, beside a reference of that relative noise."""
    truth = rng.uniform(50, 150, (points, faces))
    served = truth * (1 + 0.05 * rng.standard_normal((points, 1)))
    seen = truth * (1 + noise * rng.standard_normal(truth.shape))
    gathered = StageSamples()
    served, seen, error = (np.repeat(values[..., None], 3, axis=2) for values in (served, seen, noise * truth))
    gathered.add(served, Estimate(seen, error))
    return summarise(gathered)


@pytest.mark.parametrize(("faces", "noise"), [(1, 0.03), (6, 0.01)])
def test_the_interval_allows_for_noise_and_for_faces_that_err_together(faces, noise):
    rng = np.random.default_rng(5)
    true_median = 0.05 * 0.67449  # of the absolute value of a normal variate
    found = [drawn(rng, 80, faces, noise) for _ in range(60)]
    held = sum(numbers["median_ci"][0] <= true_median <= numbers["median_ci"][1] for numbers in found)
    # Intervals of 80 points hold in 88 to 94 % of cases (200 draws each); of 60 at 88 %, 46 or more do in 99 of 100.
    assert held >= 46
    ends = np.array([numbers["median_ci"] for numbers in found])
    assert np.median(ends[:, 1] - ends[:, 0]) < 0.6 * true_median
    if noise == 0.03:  # it lies about the true error where the median itself is too large
        too_large = np.mean([numbers["median"] for numbers in found]) - true_median
        assert too_large > 0.12 * true_median
        assert abs(ends.mean() - true_median) < 0.7 * too_large


def test_a_median_that_is_all_noise_is_not_in_the_interval():
    rng = np.random.default_rng(2)
    truth = np.full((400, 3), 100.0)
    gathered = StageSamples()
    gathered.add(truth, Estimate(truth * (1 + 0.1 * rng.standard_normal((400, 1))), 0.1 * truth))
    numbers = summarise(gathered)
    assert numbers["median"] > 0.06
    assert numbers["median_ci"][1] < 0.85 * numbers["median"]

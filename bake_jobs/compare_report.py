"""What ``compare`` says: error statistics, a table, JSON and a chart.

Errors are of luminance, relative: |served - reference| / max(reference, 2 % of the mean reference), over all six faces for probes and
voxels.

    n       values compared (a cube counts six)
    median, p95   of the relative error
    bias    sum(served - reference) / sum(reference)
    nrmse   root mean square of (served - reference), over the mean reference
    median_ci   95 % confidence interval of the error's median without that noise, as far as the choice of points goes
    noise   median relative standard error of the reference itself; an error near it is not resolved
"""

import json
import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image, ImageDraw
from rich.table import Table

from bake_jobs.path_tracer import Estimate
from gi_core.arrays import AnyArray, Float64
from gi_core.container import write_atomic
from gi_core.error_report import DARKEST_SHARE_OF_MEAN, expected_error
from gi_core.spectrum import LUMINANCE_FROM_RGB

BAR_COLOURS = ("#4878a8", "#d08a3c", "#5f9e5a", "#9a6fb0", "#b85a5a", "#6f8f98")
CHART_SIZE = (900, 420)
CHART_MARGIN = (60, 40, 20, 60)  # left, top, right, bottom
CHART_DECADES = (0.001, 10.0)


@dataclass
class StageSamples:
    """Luminances [lx] of one state and stage, gathered over sectors: (points, values of a point) each."""

    served: list[Float64] = field(default_factory=list)
    reference: list[Float64] = field(default_factory=list)
    standard_error: list[Float64] = field(default_factory=list)

    def add(self, served: AnyArray, reference: Estimate) -> None:
        """Served values (..., 3) [lx] beside their reference."""
        self.served.append(_luminance(served))
        self.reference.append(_luminance(reference.mean))
        # One path carries all channels, so their errors move together and add.
        self.standard_error.append(_luminance(reference.standard_error))

    def lacks_light(self, by_day: bool) -> bool:
        """Whether what was added last has a value that is no number or, by day, one of exactly zero where the reference has light."""
        if not self.served or not self.served[-1].size:
            return False
        served, reference = self.served[-1], self.reference[-1]
        lit = reference > DARKEST_SHARE_OF_MEAN * reference.mean()
        return not np.isfinite(served).all() or (by_day and bool((served == 0)[lit].any()))

    @property
    def count(self) -> int:
        return sum(values.size for values in self.reference)


FIGURES = ("median", "p95", "bias", "nrmse", "noise", "median_ci")
_RESAMPLES = 400


def summarise(samples: StageSamples) -> dict[str, Any]:
    """``n`` and FIGURES of one stage; all but n are None where there is nothing, or no light, to compare, or no number."""
    if samples.count == 0:
        return {"n": 0} | dict.fromkeys(FIGURES)
    served, reference, error = (np.concatenate(v) for v in (samples.served, samples.reference, samples.standard_error))
    mean = float(reference.mean())
    if not mean > 0 or not np.isfinite(served).all():
        return {"n": served.size} | dict.fromkeys(FIGURES)
    relative = _relative(served, reference)
    return {
        "n": served.size,
        "median": float(np.median(relative)),
        "p95": float(np.quantile(relative, 0.95)),
        "bias": float((served - reference).sum() / reference.sum()),
        "nrmse": float(np.sqrt(np.mean((served - reference) ** 2)) / mean),
        "noise": float(np.median(error / _scale(reference))),
        "median_ci": _confidence(served, reference, error),
    }


def _confidence(served: Float64, reference: Float64, error: Float64) -> list[float]:
    """Where the median relative error lies with 95 % confidence: percentiles over draws of the points with replacement (Efron and
    Tibshirani, "An Introduction to the Bootstrap", 1993, 13), each point with all its values, since a probe's six faces err together.

    The reference's noise is in the median already, and in its spread. It also makes errors look larger than they are: by about as much as
    noise of the same size, added once more, adds to them. The interval is moved back by that, so it holds what a reference without noise
    would find, and may lie below a median that is mostly noise.
    """
    rng = np.random.default_rng(0)
    drawn, noisier = np.empty((2, _RESAMPLES))
    for i in range(_RESAMPLES):
        some = rng.integers(0, len(served), len(served))
        off = error[some] * rng.standard_normal(error.shape)
        drawn[i] = np.median(_relative(served[some], reference[some]))
        noisier[i] = np.median(_relative(served[some], reference[some] + off))
    low, high = np.quantile(drawn, (0.025, 0.975)) - (noisier - drawn).mean()
    return [max(float(low), 0.0), max(float(high), 0.0)]


def _scale(reference: Float64) -> Float64:
    """What errors are relative to. Never 0, though all of a draw's points may be in the dark."""
    darkest = max(DARKEST_SHARE_OF_MEAN * float(reference.mean()), float(np.finfo(np.float32).tiny))
    return np.asarray(np.maximum(reference, darkest))


def _relative(served: Float64, reference: Float64) -> Float64:
    return np.asarray(np.abs(served - reference) / _scale(reference))


def report_table(report: dict[str, Any]) -> Table:
    """The report for a terminal, in percent."""
    table = Table(title=f"{report['preset']}, {report['basis']}: error against the path tracer")
    table.add_column("state")
    table.add_column("stage")
    for name in ("n", "median", "95 % sure", "p95", "bias", "nrmse", "noise"):
        table.add_column(name, justify="right")
    for state, stages in report["states"].items():
        for row, (stage, numbers) in enumerate(stages.items()):
            percents = [_percent(numbers[name], signed=name == "bias") for name in ("median", "p95", "bias", "nrmse", "noise")]
            percents.insert(1, _range(numbers["median_ci"]))
            table.add_row(state if row == 0 else "", stage, f"{numbers['n']:,}", *percents, end_section=row == len(stages) - 1)
    sectors = len(report["sectors"])
    table.caption = (
        f"{sectors} sector{'s' if sectors > 1 else ''}, seed {report['seed']}, {report['samples']} paths per reference value. "
        f"95 % sure: of the median, less what the reference's own noise adds to it. "
        f"{report['open_air_called_solid']:.1%} of open-air voxels are called solid. floor: {report['floor_fill']}"
    )
    return table


def write_json(path: Path, report: dict[str, Any]) -> None:
    """Write the report; the file is whole or not there."""
    write_atomic(path, (json.dumps(report, indent=1, allow_nan=False) + "\n").encode())


def draw_chart(report: dict[str, Any]) -> Image.Image:
    """A bar to the median and a whisker to the 95th percentile for each stage and state, on a logarithmic scale."""
    image = Image.new("RGB", CHART_SIZE, "white")
    draw = ImageDraw.Draw(image)
    left, top, right, bottom = CHART_MARGIN
    width, height = CHART_SIZE[0] - left - right, CHART_SIZE[1] - top - bottom
    low, high = (math.log10(v) for v in CHART_DECADES)

    def row_of(value: float) -> float:
        share = (math.log10(min(max(value, CHART_DECADES[0]), CHART_DECADES[1])) - low) / (high - low)
        return top + height * (1 - share)

    for decade in range(round(low), round(high) + 1):
        y = row_of(10.0**decade)
        draw.line([(left, y), (left + width, y)], fill="#dddddd")
        draw.text((left - 8, y), f"{100 * 10.0**decade:g} %", fill="black", anchor="rm")
    states = report["states"]
    stages = list(next(iter(states.values())))
    group = width / len(stages)
    bar = 0.8 * group / len(states)
    for place, stage in enumerate(stages):
        draw.text((left + group * (place + 0.5), top + height + 10), stage, fill="black", anchor="ma")
        for number, numbers in enumerate(states.values()):
            if numbers[stage]["median"] is None:
                continue
            x = left + group * (place + 0.1) + bar * number
            colour = BAR_COLOURS[number % len(BAR_COLOURS)]
            draw.rectangle([x, row_of(numbers[stage]["median"]), x + 0.85 * bar, top + height], fill=colour)
            middle = x + 0.425 * bar
            draw.line([(middle, row_of(numbers[stage]["median"])), (middle, row_of(numbers[stage]["p95"]))], fill=colour, width=2)
    title = f"{report['preset']}, {report['basis']}: relative error of luminance, median (bar) and p95 (whisker)"
    draw.text((left, 12), title, fill="black")
    for number, state in enumerate(states):
        x = left + 130 * number
        draw.rectangle([x, CHART_SIZE[1] - 24, x + 12, CHART_SIZE[1] - 12], fill=BAR_COLOURS[number % len(BAR_COLOURS)])
        draw.text((x + 18, CHART_SIZE[1] - 18), state, fill="black", anchor="lm")
    return image


def _luminance(values: AnyArray) -> Float64:
    """(points, ..., 3) -> (points, values of a point) float64."""
    luminance = np.asarray(np.asarray(values, np.float64) @ LUMINANCE_FROM_RGB)
    return luminance.reshape(len(luminance), math.prod(luminance.shape[1:]))


def _range(ends: list[float] | None) -> str:
    return "-" if ends is None else " - ".join(f"{100 * end:.1f}" for end in ends)


def stored(report: dict[str, Any], own_basis: str) -> dict[str, Any]:
    """The report as world.json keeps it: without what that says itself, and with the error that a volume's reader may expect."""
    kept = {name: value for name, value in report.items() if name not in ("preset", "basis", "dataset", "floor_fill")}
    expected = expected_error(report, own_basis, own_basis)
    return kept if expected is None else kept | {"expected_error": expected}


def _percent(value: float | None, signed: bool = False) -> str:
    return "-" if value is None else f"{100 * value:+.1f} %" if signed else f"{100 * value:.1f} %"

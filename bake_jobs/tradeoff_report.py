"""What ``tradeoff`` says: one table, and one plot of error against each price."""

import math
from collections.abc import Sequence
from typing import Any

from PIL import Image, ImageDraw

from bake_jobs.tradeoff import error_of, pareto

Row = dict[str, Any]
PRICES = {"bytes": ("kB a sector", 1e-3), "bake_seconds": ("core seconds a sector", 1.0), "tick_us": ("tick [us]", 1.0)}
STAGES = {
    "probes": "at probes",
    "near": "near",
    "mid": "mid",
    "shaded": "shaded",
    "shaded_cube": "served as cube",
    "shaded_fine": "cascade -1",
}
PANEL, MARGIN, LEGEND_ROW = (430, 430), (52, 40, 16, 44), 15  # margin: left, top, right, bottom
# Room for a label [pixels], and how far from its point its middle may be.
LABEL, LABEL_DISTANCES = (14, 11), (16.0, 26.0, 38.0, 52.0, 68.0)
PRESET_COLOURS = {"draft": "#888888", "talk": "#d08a3c", "standard": "#4878a8", "reference": "#5f9e5a"}
FRONT = "#b85a5a"


def table(rows: Sequence[Row], source: str) -> str:
    """Markdown: a row for each variant. Errors are medians over the states, in per cent: median / 95th percentile / size of bias."""
    first = rows[0]
    states, asked = ", ".join(first["states"]), first["asked"]
    titles = ("variant", "probes", "kB", "bake [core s]", "tick [us]", "of talk's", *STAGES.values())
    lines = [
        f"{source}, {len(first['sectors'])} sectors; medians over {states} of the median / 95th percentile / |bias| in per cent; "
        f"{asked['points']} points of a kind and sector, {asked['samples']} paths. On the front of some price: *.",
        "",
        f"| {' | '.join(titles)} |",
        "|---" * len(titles) + "|",
    ]
    on_front = {number for price in PRICES for number in pareto(rows, price)}
    talk = next((row["tick_us"] for row in rows if row["variant"] == "talk"), None)
    for number, row in enumerate(rows):
        cells = [
            row["variant"] + (" *" if number in on_front else ""),
            f"{row['probes']:.0f}",
            f"{row['bytes'] / 1e3:.0f}",
            f"{row['bake_seconds']:.2f}",
            f"{row['tick_us']:.0f}",
            "" if talk is None else f"{row['tick_us'] / talk:.2f}",
            *(_figures(error_of(row["states"], stage)) for stage in STAGES),
        ]
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join([*lines, *_served(rows), *_bounces(rows)]) + "\n"


def _served(rows: Sequence[Row]) -> list[str]:
    """What a volume's basis and encoding trade; nothing where no row knows."""
    served = [(row["variant"], way) for row in rows for way in row.get("served", ())]
    cells = [
        [
            name,
            w["basis"],
            w["encoding"],
            f"{w['bytes'] / 1e3:.0f}",
            *(_percent(w[n], d) for n, d in (("median", 1), ("p95", 1), ("changed", 3))),
        ]
        for name, w in served
    ]
    titles = ("variant", "served as", "encoding", "kB a volume", "shaded", "p95", "changed")
    said = (
        "Serving: the basis and the encoding of a volume. changed: the 99th percentile of what the encoding alone does to a shaded point."
    )
    return ["", said, "", *_lines(titles, cells)] if cells else []


def _bounces(rows: Sequence[Row]) -> list[str]:
    """How fast light settles; nothing where no row knows."""
    cells = [
        (row["variant"], str(found["passes"]), _percent(found["median"], 1), _percent(found["p95"], 1), f"{found['microseconds']:.0f}")
        for row in rows
        for found in row.get("bounces", ())
    ]
    said = "Bounces: how far probes' faces are from where theirs end, so many passes after the light came on in the dark; a tick makes one."
    return ["", said, "", *_lines(("variant", "passes", "median", "p95", "a sector [us]"), cells)] if cells else []


def _lines(titles: Sequence[str], cells: Sequence[Sequence[str]]) -> list[str]:
    return [f"| {' | '.join(titles)} |", "|---" * len(titles) + "|", *(f"| {' | '.join(row)} |" for row in cells)]


def _percent(value: float | None, digits: int) -> str:
    return "-" if value is None else f"{100 * value:.{digits}f} %"


def _figures(error: dict[str, float] | None) -> str:
    return "" if error is None else f"{100 * error['median']:.1f} / {100 * error['p95']:.0f} / {100 * error['bias']:.1f}"


def draw(rows: Sequence[Row], source: str) -> Image.Image:
    """A panel for each price: median error on surfaces against it, both logarithmic, the front joined by a line; numbers name variants."""
    legend = 24 + LEGEND_ROW * math.ceil(len(rows) / len(PRICES))
    image = Image.new("RGB", (PANEL[0] * len(PRICES), PANEL[1] + legend), "white")
    pen = ImageDraw.Draw(image)
    for panel, (price, (label, scale)) in enumerate(PRICES.items()):
        _draw_panel(pen, panel * PANEL[0], rows, price, label, scale)
    pen.text(
        (MARGIN[0], 12), f"{source}: median error of shaded points, median over states; the line joins what nothing beats", fill="black"
    )
    for number, row in enumerate(rows):
        column, line = divmod(number, math.ceil(len(rows) / len(PRICES)))
        at = (column * PANEL[0] + MARGIN[0], PANEL[1] + 8 + line * LEGEND_ROW)
        pen.text(at, f"{number + 1:2d}  {row['variant']}", fill=PRESET_COLOURS.get(row["preset"], "black"))
    return image


def _draw_panel(pen: ImageDraw.ImageDraw, left: int, rows: Sequence[Row], price: str, label: str, scale: float) -> None:
    judged = [number for number, row in enumerate(rows) if row["error"] is not None]
    if not judged:
        return
    prices, errors = [rows[n][price] * scale for n in judged], [100 * rows[n]["error"]["median"] for n in judged]
    x_of, y_of = _axis(prices, left + MARGIN[0], left + PANEL[0] - MARGIN[2]), _axis(errors, PANEL[1] - MARGIN[3], MARGIN[1])
    bottom, right = PANEL[1] - MARGIN[3], left + PANEL[0] - MARGIN[2]
    for value in _ticks(errors):
        pen.line([(left + MARGIN[0], y_of(value)), (right, y_of(value))], fill="#dddddd")
        pen.text((left + MARGIN[0] - 6, y_of(value)), f"{value:g} %", fill="black", anchor="rm")
    for value in _ticks(prices):
        pen.line([(x_of(value), MARGIN[1]), (x_of(value), bottom)], fill="#dddddd")
        pen.text((x_of(value), bottom + 6), f"{value:g}", fill="black", anchor="ma")
    pen.text(((left + MARGIN[0] + right) / 2, bottom + 22), label, fill="black", anchor="ma")
    points = {number: (x_of(p), y_of(e)) for number, p, e in zip(judged, prices, errors, strict=True)}
    pen.line([points[number] for number in pareto(rows, price)], fill=FRONT, width=2)
    for (number, (x, y)), (label_x, label_y) in zip(points.items(), _beside(list(points.values())), strict=True):
        colour = PRESET_COLOURS.get(rows[number]["preset"], "black")
        if math.hypot(label_x - x, label_y - y) > LABEL_DISTANCES[0]:
            pen.line([(x, y), (label_x, label_y)], fill="#bbbbbb")
        pen.ellipse([x - 4, y - 4, x + 4, y + 4], fill=colour)
        pen.text((label_x, label_y), str(number + 1), fill=colour, anchor="mm")


def _beside(points: Sequence[tuple[float, float]]) -> list[tuple[float, float]]:
    """Middles of the points' labels: as near as they go without covering a point or another label."""
    taken = list(points)
    found = []
    for x, y in points:
        steps = (1, 3, 5, 7, 0, 2, 4, 6)
        ring = [(x + r * math.cos(math.pi * k / 4), y - r * math.sin(math.pi * k / 4)) for r in LABEL_DISTANCES for k in steps]
        free = [at for at in ring if all(abs(at[0] - tx) >= LABEL[0] or abs(at[1] - ty) >= LABEL[1] for tx, ty in taken)]
        found.append((free or ring)[0])
        taken.append(found[-1])
    return found


def _axis(values: Sequence[float], start: float, end: float) -> Any:
    """Where a value goes on a logarithmic axis that has a little room at both ends."""
    low, high = (math.log(max(v, 1e-9)) for v in (min(values), max(values)))
    room = max(0.08 * (high - low), 0.1)
    return lambda value: start + (end - start) * (math.log(max(value, 1e-9)) - low + room) / (high - low + 2 * room)


def _ticks(values: Sequence[float]) -> list[float]:
    """Round numbers, 1 2 3 5 times a power of ten, within the values' range."""
    low, high = max(min(values), 1e-9), max(values)
    decades = range(math.floor(math.log10(low)), math.ceil(math.log10(high)) + 1)
    return [
        step * 10.0**decade for decade in decades for step in (1, 1.5, 2, 3, 4, 5, 7) if low * 0.95 <= step * 10.0**decade <= high * 1.05
    ]

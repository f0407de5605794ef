"""A load test as a picture: tick time, volume latency, bytes, mishaps and the server's memory, second by second."""

from collections.abc import Sequence
from typing import Any

from PIL import Image, ImageDraw

SIZE = (900, 940)
MARGIN = (70, 40, 20, 30)  # left, top, right, bottom
GAP = 34  # between panels, for their titles
GRID, AXIS = "#dddddd", "black"
COLOURS = ("#4878a8", "#d08a3c", "#5f9e5a", "#b85a5a", "#7a68a6")

Series = Sequence[float | None]


def draw(report: dict[str, Any]) -> Image.Image:
    """Five panels over the seconds of the test; grey bands are seconds around a jump of the world's clock."""
    rows = report["per_second"]

    def column(name: str, factor: float = 1.0) -> list[float | None]:
        return [None if row[name] is None else factor * row[name] for row in rows]

    panels: list[tuple[str, dict[str, Series], float | None]] = [
        (
            "tick [ms]; line: the time between two ticks",
            _pair("tick_ms", column) | {"late p99": column("lateness_ms_p99")},
            1e3 / report["tick_rate"] if report["tick_rate"] else None,
        ),
        (f"volume latency since {report['volume_ms_since']} [ms]", _pair("volume_ms", column), None),
        ("stream [Mbit/s per player]", {"mean": column("bytes_per_player", 8e-6)}, None),
        ("in each second", {name: column(name) for name in _COUNTS}, None),
        ("the server's memory [MB]", {"resident": column("memory_bytes", 1e-6)}, None),
    ]
    image = Image.new("RGB", SIZE, "white")
    pen = ImageDraw.Draw(image)
    pen.text((MARGIN[0], 10), _title(report), fill=AXIS)
    height = (SIZE[1] - MARGIN[1] - MARGIN[3]) // len(panels) - GAP
    for number, (title, series, limit) in enumerate(panels):
        top = MARGIN[1] + GAP + number * (height + GAP)
        box = (MARGIN[0], top, SIZE[0] - MARGIN[2], top + height)
        _panel(pen, box, title, series, limit, [bool(row["jump"]) for row in rows])
    return image


def _pair(name: str, column: Any) -> dict[str, Series]:
    return {"p50": column(f"{name}_p50"), "p99": column(f"{name}_p99")}


def _title(report: dict[str, Any]) -> str:
    counts = ", ".join(f"{report[name] if report[name] is not None else '?'} {name.replace('_', ' ')}" for name in _COUNTS)
    return f"{report['players']} players at {report['speed']:g} m/s, {report['mode']}, {report['seconds']:.0f} s: {counts}"


_COUNTS = ("late_ticks", "skipped", "misses", "pops", "errors")


def _panel(
    pen: ImageDraw.ImageDraw, box: tuple[int, int, int, int], title: str, series: dict[str, Series], limit: float | None, jumps: list[bool]
) -> None:
    """One plot over seconds, from zero to a round number above everything in it."""
    left, top, right, bottom = box
    step = (right - left) / max(len(jumps), 1)
    highest = max([value for values in series.values() for value in values if value is not None], default=0.0)
    full = _round_up(max(highest, limit or 0.0))

    def at(second: float, value: float) -> tuple[float, float]:
        return left + step * second, bottom - (bottom - top) * min(value / full, 1.0)

    for second, jumped in enumerate(jumps):
        if jumped:
            pen.rectangle([at(second, full), at(second + 1, 0)], fill="#eeeeee")
    for share in (0.0, 0.5, 1.0):
        y = at(0, share * full)[1]
        pen.line([(left, y), (right, y)], fill=GRID)
        pen.text((left - 6, y), f"{share * full:g}", fill=AXIS, anchor="rm")
    pen.text((left, top - 18), title, fill=AXIS)
    if limit is not None:
        pen.line([at(0, limit), at(len(jumps), limit)], fill=COLOURS[3])
    for number, (name, values) in enumerate(series.items()):
        pen.text((right - 80 * (len(series) - number), top - 18), name.replace("_", " "), fill=COLOURS[number])
        points = [at(second + 0.5, value) for second, value in enumerate(values) if value is not None]
        if len(points) == 1:
            pen.point(points, fill=COLOURS[number])
        elif points:
            pen.line(points, fill=COLOURS[number], width=2)
    pen.text((right, bottom + 4), f"{len(jumps)} s", fill=AXIS, anchor="ra")


def _round_up(value: float) -> float:
    """The least of 1, 2, 5, 10, 20, ... times a power of ten that is no less; 1 for nothing."""
    if value <= 0:
        return 1.0
    decade = 1.0
    while decade < value:
        decade *= 10
    while decade / 10 >= value:
        decade /= 10
    return next(part * decade for part in (0.1, 0.2, 0.5, 1.0) if part * decade >= value)

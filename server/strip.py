"""``sectorlight strip``: one street in many lights, as one sheet of small labelled pictures."""

import io
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, get_args

import numpy as np
from PIL import Image
from rich.console import Console
from rich.progress import track

from gi_core.arrays import Float32, UInt8
from gi_core.container import write_atomic
from gi_core.dataset import Dataset
from gi_core.engine import Engine
from gi_core.errors import InputError
from gi_core.outputs import expect_file
from gi_core.settings import NEUTRAL, Settings
from gi_core.settings_table import EXAMPLES
from gi_core.weather import weather_presets
from server import tonemap
from server.camera import Camera
from server.dependencies import parse_vector
from server.labels import PAPER_GRAY, labelled
from server.preview import city_radiance
from server.preview_scene import PreviewScenes

Kind = Literal["day", "weather", "settings"]
KINDS: tuple[Kind, ...] = get_args(Kind)
COLUMNS: dict[Kind, int] = {"day": 6, "weather": 4, "settings": 4}
# Each pixel is the mean of this many by this many, so that windows and kerbs do not flicker from picture to picture.
SAMPLES = 2
# Closer than this a direction is noise.
MIN_VIEW_M = 1e-3


@dataclass(frozen=True)
class Frame:
    """One picture of a sheet. It is exposed as its neutral one would be: under a meter of its own a knob might not show."""

    label: str
    time: str
    weather: str
    settings: Settings = NEUTRAL


def camera_of(eye: str, look: str, fov_degrees: float, width: int) -> Camera:
    """A camera from text; InputError when a place is not three numbers, or both are the same."""
    places = []
    for option, text in (("--eye", eye), ("--look", look)):
        try:
            places.append(parse_vector(text))
        except ValueError as error:
            raise InputError(f"{option} {text[:60]!r}: expected {error}") from error
    if np.linalg.norm(places[1] - places[0]) < MIN_VIEW_M:
        raise InputError(f"--look: expected a place at least {1000 * MIN_VIEW_M:g} mm from --eye")
    return Camera(places[0], places[1], fov_degrees, width)


def plan_frames(kind: Kind, time: str, weather: str, has_lamps: bool) -> list[Frame]:
    """The pictures of a sheet, in order. ``time`` is the hour of the weathers, ``weather`` that of the day's hours and the settings."""
    if kind == "day":
        return [Frame(f"{hour:02d}:00", f"{hour:02d}:00", weather) for hour in range(24)]
    if kind == "weather":
        return [Frame(f"{preset} {time}", time, preset) for preset in weather_presets()]
    chosen = [example for example in EXAMPLES if has_lamps or not example.needs_lamps]
    return [Frame(f"{example.time} {example.label}", example.time, weather, example.settings) for example in chosen]


def sheet(engine: Engine, scenes: PreviewScenes, camera: Camera, frames: list[Frame], columns: int) -> UInt8:
    """All frames on one sheet: (rows, columns, 3) uint8 sRGB. Raises CorruptFileError."""
    scene = scenes.around(camera.eye, camera.look)
    fine = Camera(camera.eye, camera.look, camera.fov_degrees, camera.width * SAMPLES)

    def radiance(frame: Frame, settings: Settings) -> Float32:
        return reduced(city_radiance(engine, scene, fine, engine.lighting(frame.time, frame.weather), settings=settings), camera.height)

    cells = [_cell(frame, radiance, engine.lighting(frame.time, frame.weather).exposure) for frame in _shown(frames)]
    height, width = cells[0].shape[:2]
    rows = -(-len(cells) // columns)
    paper = np.full((rows * height, columns * width, 3), PAPER_GRAY, np.uint8)
    for number, cell in enumerate(cells):
        y, x = number // columns * height, number % columns * width
        paper[y : y + height, x : x + width] = cell
    return paper


def _cell(frame: Frame, radiance: Callable[[Frame, Settings], Float32], sky_exposure: float) -> UInt8:
    picture = radiance(frame, frame.settings)
    metered = picture if frame.settings == NEUTRAL else radiance(frame, NEUTRAL)
    ev100 = tonemap.metered(metered, sky_exposure)
    return labelled(tonemap.developed(picture, ev100), f"{frame.label}  EV {ev100:.1f}")


def _shown(frames: list[Frame]) -> Iterator[Frame]:
    yield from track(frames, "drawing", console=Console(stderr=True), transient=True)


def reduced(radiance: Float32, height: int) -> Float32:
    """The mean of each SAMPLES x SAMPLES pixels of (rows, columns, 3): (height, columns / SAMPLES, 3). Rows beyond are left out."""
    rows = radiance[: height * SAMPLES]
    return np.asarray(rows.reshape(height, SAMPLES, -1, SAMPLES, 3).mean(axis=(1, 3)), np.float32)


def png(picture: UInt8) -> bytes:
    """A PNG of a picture (rows, columns, 3): all its colours, as small as it gets."""
    out = io.BytesIO()
    Image.fromarray(picture).save(out, "PNG", optimize=True)
    return out.getvalue()


def run(dataset: Path, camera: Camera, kind: str, time: str, weather: str, output: Path, device: str | None) -> None:
    """Draw a sheet of a dataset into a file. Raises InputError, and what opening a dataset and a device does."""
    if kind not in KINDS:
        raise InputError(f"--kind {kind[:40]}: expected {' or '.join(KINDS)}")
    expect_file(output, "--output")
    opened = Dataset.open(dataset)
    engine = Engine(opened, device)
    frames = plan_frames(kind, time, weather, bool(engine.lamps))
    for frame in frames:  # a bad time or weather is said at once
        engine.lighting(frame.time, frame.weather)
    write_atomic(output, png(sheet(engine, PreviewScenes(opened), camera, frames, COLUMNS[kind])))

"""A second judge of the judge: Radiance, on the terms that daylight comes in: light of the sky alone, and what one bounce adds.

Both see the same triangles under the same sky, which grows towards the zenith and towards one side, so that no turned or mirrored frame
passes. Radiance counts bounces (``-ab``). The path tracer does not: with all albedos scaled by a small e and the same random paths,
(E(e) - E(0)) / e is its first bounce, and a share of about e of the second.
"""

import os
import subprocess
from pathlib import Path

import numpy as np
import pytest

from bake_jobs.path_tracer import PathTracer
from gi_core.lighting import DirectionalLight, Lighting

radiance = pytest.importorskip("pyradiance", reason="pyradiance is not installed: pip install 'sectorlight[judge]'")
pytestmark = pytest.mark.slow

BIN = Path(radiance.__file__).parent / "bin"
ZENITH = 3000.0  # cd m^-2
SIDEWAYS = np.array([0.5, 1.0, -0.3])  # the sky is 1 + this . direction, times ZENITH / 2
OUR_SAMPLES, AMBIENT_DIVISIONS = 1 << 19, 1 << 18
SMALL = 0.01


def street() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Vertices (v, 3), triangles (m, 3) and albedo (m,) of a street that runs askew, with an overhang."""
    trimesh = pytest.importorskip("trimesh")
    parts = []
    for size, at, turn, albedo in (
        ((120, 1, 120), (0, -0.5, 0), 0, 0.25),
        ((30, 24, 12), (-2, 12, -14), 8, 0.5),
        ((26, 16, 12), (4, 8, 13), 8, 0.6),
        ((10, 30, 10), (28, 15, 2), 30, 0.8),
        ((12, 1, 8), (2, 5, 3), 0, 0.4),
    ):
        mesh = trimesh.creation.box(size)
        mesh.apply_transform(trimesh.transformations.rotation_matrix(np.radians(turn), (0, 1, 0)))
        parts.append((mesh.vertices + np.asarray(at), np.asarray(mesh.faces), albedo))
    firsts = np.cumsum([0, *(len(v) for v, _, _ in parts)])
    triangles = np.concatenate([f + first for (_, f, _), first in zip(parts, firsts, strict=False)]).astype(np.int32)
    return np.concatenate([v for v, _, _ in parts]), triangles, np.concatenate([np.full(len(f), a) for _, f, a in parts])


POINTS = np.array([[0, 0, 0], [10, 0, 2], [2, 0, 3], [-12, 6, -5.5], [-8, 14, -6.7], [14, 3, 5.2], [0, 24, -14], [22.2, 12, -1.4]], float)
NORMALS = np.array([[0, 1, 0]] * 3 + [[0.14, 0, 0.99], [0.14, 0, 0.99], [-0.14, 0, -0.99], [0, 1, 0], [-0.87, 0, -0.5]], float)
NORMALS /= np.linalg.norm(NORMALS, axis=1, keepdims=True)
STARTS = POINTS + 0.25 * NORMALS  # off the walls, wherever exactly these are


def traced(albedo_scale: float) -> np.ndarray:
    """Our irradiance (n,) [lx]."""
    vertices, triangles, albedo = street()
    polar = np.pi * (np.arange(64) + 0.5)[:, None] / 64
    azimuth = 2 * np.pi * (np.arange(128) + 0.5)[None, :] / 128
    x, y, z = np.sin(polar) * np.cos(azimuth), np.cos(polar) + 0 * azimuth, np.sin(polar) * np.sin(azimuth)
    sky = ZENITH / 2 * (1 + SIDEWAYS[0] * x + SIDEWAYS[1] * y + SIDEWAYS[2] * z)
    sky[32:] = 0
    dark = DirectionalLight(np.array([0.0, 1.0, 0.0]), np.zeros(3))
    lighting = Lighting("", "", dark, dark, np.repeat(sky[..., None], 3, axis=2).astype(np.float32), np.zeros((6, 3)), 0.0, 0.0, 0.0)
    colour = np.repeat((albedo_scale * albedo)[:, None], 3, axis=1).astype(np.float32)
    tracer = PathTracer(vertices, triangles, colour, np.zeros_like(colour))
    return tracer.surface_irradiance(STARTS, NORMALS, lighting, samples=OUR_SAMPLES, seed=7).mean[:, 1]


def judged(folder: Path, bounces: int) -> np.ndarray:
    """Radiance's irradiance (n,) [lx] after so many ambient bounces; the first is the sky's own light."""
    vertices, triangles, albedo = street()
    (folder / "sky.cal").write_text(f"bright = {ZENITH / 2} * (1 + {SIDEWAYS[0]}*Dx + {SIDEWAYS[1]}*Dy + {SIDEWAYS[2]}*Dz);\n")
    lines = ["void brightfunc dome 2 bright sky.cal 0 0", "dome glow sky_glow 0 0 4 1 1 1 0", "sky_glow source sky 0 0 4 0 1 0 180"]
    for value in np.unique(albedo):
        lines.append(f"void plastic m{100 * value:.0f} 0 0 5 {value} {value} {value} 0 0")
    for number, (corners, value) in enumerate(zip(vertices[triangles], albedo, strict=True)):
        lines.append(f"m{100 * value:.0f} polygon t{number} 0 0 9 " + " ".join(f"{c:.9g}" for c in corners.ravel()))
    (folder / "scene.rad").write_text("\n".join(lines) + "\n")
    environment = {**os.environ, "RAYPATH": f".:{BIN.parent / 'lib'}", "PATH": f"{BIN}:{os.environ['PATH']}"}
    scene = subprocess.run([BIN / "oconv", "scene.rad"], cwd=folder, env=environment, capture_output=True, check=True).stdout
    (folder / "scene.oct").write_bytes(scene)
    places = "\n".join(" ".join(f"{v:.9g}" for v in (*p, *n)) for p, n in zip(STARTS, NORMALS, strict=True)) + "\n"
    options = f"-h -I -ab {bounces} -aa 0 -ad {AMBIENT_DIVISIONS} -as 0 -lw 1e-8 -lr 8 -u+ -dt 0".split()
    done = subprocess.run(
        [BIN / "rtrace", *options, "scene.oct"], cwd=folder, env=environment, input=places.encode(), capture_output=True, check=True
    )
    return np.array([[float(v) for v in line.split()] for line in done.stdout.decode().splitlines()])[:, 1]


def test_light_of_the_sky_alone_agrees(tmp_path):
    ours, theirs = traced(0.0), judged(tmp_path, 1)
    assert ours.min() > 100
    np.testing.assert_allclose(ours, theirs, rtol=0.005)  # 0.2 % found


def test_one_bounce_agrees(tmp_path):
    ours = (traced(SMALL) - traced(0.0)) / SMALL
    theirs = judged(tmp_path, 2) - judged(tmp_path, 1)
    assert (ours / traced(0.0)).max() > 0.3
    # 0.8 % found; a roof that sees hardly any surface has noise of the sky's light instead.
    np.testing.assert_allclose(ours, theirs, rtol=0.02, atol=0.001 * traced(0.0).max())

"""The judge's judge: Mitsuba 3, an independent path tracer, on streets, two cities and a room. Both see the same mesh, sky and sun.

Traps met on the way. Mitsuba's envmap looks along -Z at u = 0 and our sky along +X at column 0: a quarter turn. It interpolates
texels where we take the nearest, so it is fed an enlarged map, constant but for a seam of one in ``SKY_ENLARGEMENT``. A directional
emitter's delta is never hit by the cosine rays of an irradiancemeter, so direct sun is excluded there as here. ``direction`` points
away from the light. Meters are rendered one at a time, each in its own scene.
"""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from scipy import stats

from bake_jobs.path_tracer import Estimate, PathTracer
from bake_jobs.scene_source import load_scene
from gi_core.ambient_cube import FACE_DIRECTIONS
from gi_core.lighting import DirectionalLight, Lighting

mi = pytest.importorskip("mitsuba", reason="mitsuba is not installed: pip install 'sectorlight[judge]'")
trimesh = pytest.importorskip("trimesh")
pytestmark = pytest.mark.slow

SHARED = Path(__file__).resolve().parents[2].parent / "shared" / "data"
MUNICH, MIDTOWN = SHARED / "munich.glb", SHARED / "midtown.geojson"
# What is left of the interpolation under the open sky: 0.06 % at 8, 0.04 % at 16, against noise of 0.05 to 0.14 % here.
SKY_ENLARGEMENT = 16
METER_SIZE_M = 1e-3
REPLICATES = 16
MITSUBA_SAMPLES = 64 * 1024
OUR_SAMPLES = 128 * 1024
# Replicates of both sides give about 30 degrees of freedom: |t| > 5 has odds of 1 in 40 000, and under 300 values are compared.
Z_MAX = 5.0


@dataclass
class Material:
    vertices: np.ndarray
    triangles: np.ndarray
    albedo: tuple[float, float, float]
    emission: tuple[float, float, float] = (0.0, 0.0, 0.0)


def block(size, at, turn=0.0, **material):
    mesh = trimesh.creation.box(size)
    mesh.apply_transform(trimesh.transformations.rotation_matrix(np.radians(turn), (0, 1, 0)))
    return Material(mesh.vertices + np.asarray(at), np.asarray(mesh.faces), **material)


def street():
    """Coloured blocks along a street that runs askew, an overhang, and a lamp: a closed box, so that it shines outwards only."""
    return [
        block((120, 1, 120), (0, -0.5, 0), albedo=(0.25, 0.22, 0.2)),
        block((30, 24, 12), (-2, 12, -14), 8, albedo=(0.6, 0.3, 0.2)),
        block((26, 16, 12), (4, 8, 13), 8, albedo=(0.5, 0.55, 0.7)),
        block((10, 30, 10), (28, 15, 2), 30, albedo=(0.8, 0.8, 0.75)),
        block((12, 1, 8), (2, 5, 3), albedo=(0.4, 0.4, 0.1)),
        block((1, 0.5, 1), (-8, 4, 0), albedo=(0.1, 0.1, 0.1), emission=(40_000.0, 30_000.0, 10_000.0)),
    ]


def interior():
    """A room of 12 x 4 x 10 m in walls of 0.3 m, with a window along one side, a door in another, and a ceiling lamp."""
    wall, lamp = {"albedo": (0.7, 0.65, 0.55)}, {"albedo": (0.2, 0.2, 0.2), "emission": (9_000.0, 8_000.0, 6_000.0)}
    return [
        block((80, 1, 80), (0, -0.5, 0), albedo=(0.3, 0.35, 0.25)),
        block((12.6, 0.3, 10.6), (0, 4.15, 0), albedo=(0.8, 0.8, 0.8)),
        block((0.3, 4, 10.6), (6.15, 2, 0), **wall),
        block((12.6, 4, 0.3), (0, 2, -5.15), **wall),
        block((0.3, 0.5, 10.6), (-6.15, 0.25, 0), **wall),  # below the window, and above it
        block((0.3, 0.4, 10.6), (-6.15, 3.8, 0), **wall),
        block((4.9, 4, 0.3), (-3.85, 2, 5.15), **wall),  # to either side of the door, and above it
        block((5.9, 4, 0.3), (3.35, 2, 5.15), **wall),
        block((1.8, 1.6, 0.3), (-0.5, 3.2, 5.15), **wall),
        block((2.0, 0.2, 2.0), (1, 3.85, 1), **lamp),
    ]


def midtown_crop(centre=(135.0, 185.0), reach_m=180.0):
    """All triangles with a corner within ``reach_m`` of a point on an avenue, as the product reads the city, by albedo."""
    scene = load_scene(str(MIDTOWN))
    corners = scene.vertices[scene.triangles][:, :, [0, 2]]
    near = (np.linalg.norm(corners - np.asarray(centre), axis=2) < reach_m).any(axis=1)
    albedo, which = np.unique(scene.albedo[near], axis=0, return_inverse=True)
    return [Material(scene.vertices, scene.triangles[near][which.ravel() == n], tuple(a)) for n, a in enumerate(albedo.tolist())]


def munich_crop(centre=(-90.0, 60.0), reach_m=150.0):
    """All triangles with a corner within ``reach_m`` of a point among narrow courtyards, by material."""
    materials = []
    for mesh in trimesh.load(MUNICH).dump():
        corners = mesh.triangles[:, :, [0, 2]]
        near = (np.linalg.norm(corners - np.asarray(centre), axis=2) < reach_m).any(axis=1)
        if near.any():
            albedo = tuple(np.asarray(mesh.visual.material.baseColorFactor[:3], np.float64) / 255)
            materials.append(Material(np.asarray(mesh.vertices), np.asarray(mesh.faces)[near], albedo))
    ground = np.array([[-9e2, -0.05, -9e2], [-9e2, -0.05, 9e2], [9e2, -0.05, 9e2], [9e2, -0.05, -9e2]])
    materials.append(Material(ground, np.array([[0, 1, 2], [0, 2, 3]]), (0.3, 0.3, 0.3)))
    return materials


def lopsided_sky():
    """Strong gradients in both angles, so that a turned or mirrored map cannot pass; zero below the horizon."""
    polar = np.pi * (np.arange(64) + 0.5)[:, None] / 64
    azimuth = 2 * np.pi * (np.arange(128) + 0.5)[None, :] / 128
    glow = np.exp(2 * np.sin(polar) * np.cos(azimuth - 2.2))
    sky = 2000 * np.stack([glow, 1 + np.cos(polar) + 0 * azimuth, 2 - 0.8 * np.sin(azimuth + polar)], axis=-1)
    sky[32:] = 0
    return sky.astype(np.float32)


def daylight():
    towards = np.array([0.35, 0.55, 0.45])
    sun = DirectionalLight(towards / np.linalg.norm(towards), np.array([80_000.0, 72_000.0, 60_000.0]))
    moon = DirectionalLight(np.array([0.0, 1.0, 0.0]), np.zeros(3))
    return Lighting("", "", sun, moon, lopsided_sky(), np.zeros((6, 3)), 0.0, 0.0, 0.0)


def our_tracer(materials):
    starts = np.cumsum([0, *(len(m.vertices) for m in materials)])
    triangles = np.concatenate([m.triangles + start for m, start in zip(materials, starts, strict=False)]).astype(np.int32)
    per_triangle = [len(m.triangles) for m in materials]
    albedo = np.repeat(np.array([m.albedo for m in materials], np.float32), per_triangle, axis=0)
    emission = np.repeat(np.array([m.emission for m in materials], np.float32), per_triangle, axis=0)
    return PathTracer(np.concatenate([m.vertices for m in materials]), triangles, albedo, emission)


class MitsubaJudge:
    def __init__(self, materials, light, folder, samples):
        self.samples = samples
        mi.set_variant("scalar_rgb")
        self.parts = {}
        for number, material in enumerate(materials):
            path = folder / f"{number}.ply"
            trimesh.Trimesh(material.vertices, material.triangles, process=False).export(path)
            reflectance = {"type": "rgb", "value": list(material.albedo)}
            part = {
                "type": "ply",
                "filename": str(path),
                "face_normals": True,
                "bsdf": {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": reflectance}},
            }
            if any(material.emission):
                part["emitter"] = {"type": "area", "radiance": {"type": "rgb", "value": list(material.emission)}}
            self.parts[f"mesh{number}"] = mi.load_dict(part)
        large = light.sky_radiance.repeat(SKY_ENLARGEMENT, axis=0).repeat(SKY_ENLARGEMENT, axis=1)
        turned = np.ascontiguousarray(np.roll(large, large.shape[1] // 4, axis=1))
        self.parts["sky"] = mi.load_dict({"type": "envmap", "bitmap": mi.Bitmap(turned)})
        self.parts["sun"] = mi.load_dict(
            {
                "type": "directional",
                "direction": list(-light.sun.direction),
                "irradiance": {"type": "rgb", "value": list(light.sun.irradiance)},
            }
        )

    def irradiance(self, points, normals) -> Estimate:
        meters = [self._meter(point, normal) for point, normal in zip(points, normals, strict=True)]
        values = np.array(meters)  # (n, replicates, 3)
        return Estimate(values.mean(axis=1), values.std(axis=1, ddof=1) / np.sqrt(REPLICATES))

    def _meter(self, point, normal):
        up = [1, 0, 0] if abs(normal[1]) > 0.9 else [0, 1, 0]
        pose = mi.ScalarTransform4f().look_at(origin=list(point), target=list(point + normal), up=up)
        film = {
            "type": "hdrfilm",
            "width": 1,
            "height": 1,
            "rfilter": {"type": "box"},
            "pixel_format": "rgb",
            "component_format": "float32",
        }
        sensor = {"type": "irradiancemeter", "film": film, "sampler": {"type": "independent"}}
        meter = {"type": "rectangle", "to_world": pose @ mi.ScalarTransform4f().scale(METER_SIZE_M / 2), "sensor": sensor}
        scene = mi.load_dict({"type": "scene", "integrator": {"type": "path"}, **self.parts, "meter": meter})
        spp = self.samples // REPLICATES
        return [np.array(mi.render(scene, spp=spp, seed=seed)).reshape(3) for seed in range(REPLICATES)]


def receivers(tracer, low, high, count, seed, most_blocked=0.8):
    """Points in a box from which at most so much of the sky is hidden: in air (count, 3), and where a ray from them first meets a surface,
    with normals."""
    rng = np.random.default_rng(seed)
    points = rng.uniform(low, high, (count * 16, 3))
    upward = rng.normal(size=(32, 3))
    upward[:, 1] = np.abs(upward[:, 1])
    upward /= np.linalg.norm(upward, axis=1, keepdims=True)
    blocked = tracer.rays.occluded(np.repeat(points, 32, axis=0), np.tile(upward, (len(points), 1))).reshape(-1, 32)
    points = points[blocked.mean(axis=1) <= most_blocked][:count]
    ray = rng.normal(size=(count, 3))
    ray[:, 1] = -np.abs(ray[:, 1]) - 0.3  # steep enough to end on the ground at the latest
    ray /= np.linalg.norm(ray, axis=1, keepdims=True)
    hits = tracer.rays.closest(points, ray)
    assert hits.hit.all()
    return points, points + ray * hits.distance[:, None], hits.normal.astype(np.float64)


def compare(ours, theirs, title):
    """Every value within Z_MAX combined standard errors, their squares chi-squared, and no common bias."""
    noise = np.hypot(ours.standard_error, theirs.standard_error)
    z = (ours.mean - theirs.mean) / np.where(noise > 0, noise, 1)
    relative = np.abs(ours.mean - theirs.mean) / theirs.mean.mean()
    # The channels of one path share its noise: judge the set by one channel each, and all by the largest.
    green = z[..., 1].ravel()
    chi_squared = stats.chi2(len(green)).sf((green**2 * (28 / 30)).sum())  # variance of t with 30 degrees of freedom is 30 / 28
    bias = (ours.mean.sum() - theirs.mean.sum()) / theirs.mean.sum()
    bias_noise = np.sqrt((noise[..., 1] ** 2).sum()) / theirs.mean[..., 1].sum()
    print(
        f"{title}: n {green.size}, largest |z| {np.abs(z).max():.2f}, chi-squared p {chi_squared:.3f}, "
        f"bias {bias:+.3%} (noise {bias_noise:.3%}), median difference {np.median(relative):.3%} of the mean"
    )
    assert np.abs(z).max() < Z_MAX
    assert chi_squared > 1e-3
    assert abs(bias) < 4 * bias_noise
    assert bias_noise < 0.003  # or agreement would mean little


@dataclass
class Case:
    materials: Callable[[], list[Material]]
    low: tuple[float, float, float]
    high: tuple[float, float, float]
    needs: Path | None = None
    most_blocked: float = 0.8
    effort: int = 1


CASES = {
    "street": Case(street, (-20, 0.5, -7), (20, 20, 7)),
    "munich": Case(munich_crop, (-122, 2, 28), (-58, 25, 92), MUNICH),
    "midtown": Case(midtown_crop, (105, 2, 155), (165, 25, 215), MIDTOWN),
    "interior": Case(interior, (-5, 0.5, -4), (5, 3.5, 4), most_blocked=1.0, effort=6),
}


@pytest.mark.parametrize("name", CASES)
def test_agrees_with_mitsuba_within_noise(name, tmp_path):
    case = CASES[name]
    if case.needs is not None and not case.needs.exists():
        pytest.skip(f"needs the shared city {case.needs.name}")
    materials = case.materials()
    light, tracer = daylight(), our_tracer(materials)
    air, surface, normals = receivers(tracer, case.low, case.high, count=10, seed=7, most_blocked=case.most_blocked)
    judge = MitsubaJudge(materials, light, tmp_path, case.effort * MITSUBA_SAMPLES)

    ours = tracer.cube_irradiance(air, light, samples=case.effort * OUR_SAMPLES, replicates=REPLICATES)
    six = judge.irradiance(np.repeat(air, 6, axis=0), np.tile(FACE_DIRECTIONS.astype(np.float64), (len(air), 1)))
    compare(ours, Estimate(six.mean.reshape(-1, 6, 3), six.standard_error.reshape(-1, 6, 3)), f"{name}, six faces in air")

    ours = tracer.surface_irradiance(surface, normals, light, samples=case.effort * OUR_SAMPLES, replicates=REPLICATES)
    compare(ours, judge.irradiance(surface + 2e-3 * normals, normals), f"{name}, on surfaces")

"""Lamps on surfels in NumPy: twin of trace_shadows.cl and light_surfels.cl, float32 as they are."""

import numpy as np

from gi_core.arrays import AnyArray, Bool, Float32, Float64
from gi_core.layout import (
    AREA_SHADOW_RAYS,
    LAMP_RADIUS_M,
    LOCAL_AREA,
    LOCAL_POINT,
    LOCAL_SPOT,
    SHADOW_END_M,
    SHADOW_START_M,
    SHADOW_TRIANGLE,
)
from gi_core.light_geometry import ShadowGeometry
from gi_core.light_plan import TouchingLamp
from gi_core.sector import Sector

# As in lights.h and trace_shadows.cl.
AREA_IS_POINT_FROM = np.float32(32)
EDGE_SLACK = np.float32(1e-5)


# What lamps need of a surfel: its place [m], sector-local, and its unit normal.
PLACE = np.dtype([("position", np.float32, 3), ("normal", np.float32, 3)])


def surfel_places(sector: Sector) -> AnyArray:
    """(S,) records of PLACE."""
    places = np.zeros(sector.surfel_count, PLACE)
    places["position"], places["normal"] = sector.surfel_position, sector.surfel_normal
    return places


def shadow_triangles(shadows: ShadowGeometry, touching: TouchingLamp, origin: Float64) -> AnyArray:
    """(n,) records of layout.SHADOW_TRIANGLE, local to ``origin`` (3,) [m]: all that can come between a lamp and what it lights."""
    corners = shadows.triangles_in(touching.low, touching.high) - origin
    records = np.zeros(len(corners), SHADOW_TRIANGLE.dtype)
    records["corner"] = corners[:, 0]
    records["edge_a"], records["edge_b"] = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    return records


def ray_targets(light: AnyArray) -> Float32:
    """(rays, 3) [m]: where shadow rays to one record of layout.LOCAL_LIGHT end."""
    if light["kind"] != LOCAL_AREA:
        return np.array(light["position"][None], np.float32)
    sides = np.array([[-0.5, -0.5], [0.5, -0.5], [-0.5, 0.5], [0.5, 0.5]], np.float32)
    return np.asarray(light["position"] + sides @ np.stack([light["half_u"], light["half_v"]]), np.float32)


def reaches(light: AnyArray, places: AnyArray, target: Float32) -> Bool:
    """(S,): which surfels a light shines towards at all."""
    from_light = places["position"] - light["position"]
    squared = _dot(from_light, from_light)
    along = _dot(from_light, light["axis"])
    faces = _dot(places["normal"], target - places["position"]) > 0
    ahead = {
        LOCAL_POINT: np.ones(len(places), bool),
        LOCAL_SPOT: along > light["cos_outer"] * np.sqrt(squared),
        LOCAL_AREA: along > 0,
    }[int(light["kind"])]
    return np.asarray((squared < light["range"] ** 2) & faces & ahead)


def trace_shadows(light: AnyArray, places: AnyArray, triangles: AnyArray) -> Bool:
    """(rays, S): which surfels see one light's ray targets past (n,) layout.SHADOW_TRIANGLE."""
    targets = ray_targets(light)
    open_ = np.stack([reaches(light, places, target) for target in targets])
    for ray, target in enumerate(targets):
        lit = np.flatnonzero(open_[ray])
        start = places["position"][lit] + places["normal"][lit] * np.float32(SHADOW_START_M)
        way = target - start
        distance = np.sqrt(_dot(way, way))
        far = distance > SHADOW_END_M
        way *= (1 - np.float32(SHADOW_END_M) / np.where(far, distance, 1))[:, None]
        for triangle in triangles:
            open_[ray, lit[far & _blocks(start, way, triangle)]] = False
    return np.asarray(open_)


def _blocks(start: Float32, way: Float32, triangle: AnyArray) -> Bool:
    edge_a, edge_b = triangle["edge_a"], triangle["edge_b"]
    p = np.cross(way, edge_b)
    determinant = _dot(edge_a, p)
    hits = np.abs(determinant) >= 1e-12
    inverse = 1 / np.where(hits, determinant, 1)
    from_corner = start - triangle["corner"]
    q = np.cross(from_corner, edge_a)
    u, v, t = _dot(from_corner, p) * inverse, _dot(way, q) * inverse, _dot(q, edge_b) * inverse
    inside = (u >= -EDGE_SLACK) & (v >= -EDGE_SLACK) & (u + v <= 1 + EDGE_SLACK)
    return np.asarray(hits & inside & (t >= 0) & (t <= 1))


def unshadowed(light: AnyArray, places: AnyArray) -> Float32:
    """(S,) irradiance [lx] per unit of a light's intensity, nothing in between."""
    to_light = light["position"] - places["position"]
    squared = _dot(to_light, to_light)
    window = np.maximum(1 - (squared / light["range"] ** 2) ** 2, 0) ** 2
    bounded = np.maximum(np.sqrt(squared), np.float32(LAMP_RADIUS_M))
    cosine = np.maximum(_dot(places["normal"], to_light), 0) / bounded
    leaving = -_dot(to_light, light["axis"]) / bounded
    if light["kind"] == LOCAL_POINT:
        return np.asarray(window * cosine / bounded**2, np.float32)
    if light["kind"] == LOCAL_SPOT:
        edge = np.clip((leaving - light["cos_outer"]) / (light["cos_inner"] - light["cos_outer"]), 0, 1)
        return np.asarray(window * edge * edge * (3 - 2 * edge) * cosine / bounded**2, np.float32)
    u, v = light["half_u"], light["half_v"]
    distant = squared > AREA_IS_POINT_FROM**2 * (u @ u + v @ v)
    corners = np.stack([to_light + u + v, to_light - u + v, to_light - u - v, to_light + u - v], axis=1)
    area = 4 * np.linalg.norm(u) * np.linalg.norm(v)
    exact = polygon_irradiance(corners, places["normal"])
    value = window * np.where(distant, area * leaving * cosine / np.where(distant, squared, 1), exact)
    return np.asarray(np.where(leaving > 0, value, 0), np.float32)


def polygon_irradiance(corners: Float32, normal: Float32) -> Float32:
    """(S,) irradiance [lx] of convex polygons of radiance 1: corners (S, k, 3) relative to surfels with normals (S, 3).

    Lambert's sum over edges; each edge is cut at the horizon, and the cut ends are joined by an edge along it.
    """
    count = corners.shape[1]
    height = np.einsum("skc,sc->sk", corners, normal)
    total = np.zeros(len(corners), np.float32)
    falls = rises = np.zeros((len(corners), 3), np.float32)
    for i in range(count):
        a, b = corners[:, i], corners[:, (i + 1) % count]
        height_a, height_b = height[:, i, None], height[:, (i + 1) % count, None]
        below_a, below_b = height_a < 0, height_b < 0
        crosses = below_a != below_b
        at_horizon = a + (b - a) * (height_a / np.where(crosses, height_a - height_b, 1))
        falls = np.where(crosses & below_b, at_horizon, falls)
        rises = np.where(crosses & below_a, at_horizon, rises)
        start, end = np.where(crosses & below_a, at_horizon, a), np.where(crosses & below_b, at_horizon, b)
        total += np.where((below_a & below_b)[:, 0], 0, _edge(start, end, normal))
    total += _edge(falls, rises, normal)
    return np.asarray(np.abs(total) / 2, np.float32)


def _edge(a: Float32, b: Float32, normal: Float32) -> Float32:
    turn = np.cross(a, b)
    sine = np.sqrt(_dot(turn, turn))
    return np.asarray(_dot(turn, normal) / np.where(sine > 0, sine, 1) * np.arctan2(sine, _dot(a, b)), np.float32)


def visible_share(light: AnyArray, places: AnyArray, open_: Bool) -> Float32:
    """(S,): of the shadow rays that start above a surfel's horizon, the share that arrives. ``open_`` as trace_shadows gives it."""
    if light["kind"] != LOCAL_AREA:
        return np.asarray(open_[0], np.float32)
    above = np.stack([_dot(places["normal"], target - places["position"]) > 0 for target in ray_targets(light)]).sum(axis=0)
    assert len(open_) == AREA_SHADOW_RAYS
    return np.asarray(open_.sum(axis=0) / np.maximum(above, 1), np.float32)


def light_surfels(lights: AnyArray, places: AnyArray, triangles: list[AnyArray]) -> Float32:
    """(S, 3) [lx]: all lights (n,), each with the triangles near it, on all surfels."""
    total = np.zeros((len(places), 3), np.float32)
    for light, near in zip(lights, triangles, strict=True):
        share = visible_share(light, places, trace_shadows(light, places, near))
        total += (share * unshadowed(light, places))[:, None] * light["intensity"]
    return total


def _dot(a: Float32, b: Float32) -> Float32:
    return np.asarray(np.einsum("...i,...i->...", a, b), np.float32)

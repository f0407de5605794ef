"""What a bake may trade. A preset is a set of values of these knobs; the file format knows none of them."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, fields, replace
from typing import Any, Literal, get_args

from gi_core.constants import BASIS_SIZES, CUBE_FACES, MAX_PROBES_PER_SECTOR, MAX_SKY_PATCHES, VOXEL_SIZE_M
from gi_core.errors import InputError
from gi_core.sector_file import MAX_BLENDED_PROBES
from gi_core.sky_patches import MIN_PATCHES, SKY_SCHEMES

Preset = Literal["draft", "talk", "standard", "reference"]
PRESETS: tuple[str, ...] = get_args(Preset)
KNOB_CHOICES: dict[str, tuple[str, ...]] = {
    "basis": tuple(BASIS_SIZES),
    "sky": SKY_SCHEMES,
    "placement": ("grid", "adaptive"),
    "voxel_weights": ("nearest", "fitted"),
    "wall_weights": ("nearest", "fitted"),
    "far_feedback": ("closest", "likest"),
}
# Columns of voxels beyond a sector's borders that the bake knows: solid voxels take the nearest air of these too, as the neighbour's own
# would, and adaptive placement shares probes with neighbours no farther out.
FILL_MARGIN = 2
MAX_ADAPTIVE_MARGIN_M = FILL_MARGIN * VOXEL_SIZE_M
# What a knob may be where it is not any length, angle or number of 0.01 to 10 000.
KNOB_RANGES = {
    "sky_patches": (MIN_PATCHES, MAX_SKY_PATCHES),
    "feedback_probes": (1, MAX_BLENDED_PROBES),
    "voxel_probes": (1, MAX_BLENDED_PROBES),
    "voxel_candidates": (1, 256),
    "rays_per_face_edge": (2, 256),
    "trial_rays_per_face_edge": (2, 64),
    "fit_candidates": (1, 256),
    "probe_budget": (1, MAX_PROBES_PER_SECTOR),
    "grid_spacing_m": (0.5, 1e3),
    "wall_spacing_m": (0.5, 1e3),
    "voxel_levels": (1, 2),
    "reader_probes": (0, 1000),
    "probe_worth": (1e-5, 1e4),
    "fit_ridge": (1e-6, 1e4),
    "target_error": (1e-3, 1.0),
    "sun_declination_step_degrees": (1, 46),
    "sun_hour_step_degrees": (1, 90),
}
# Without which a knob does nothing, whatever it is turned to; turned off it needs nothing.
KNOB_NEEDS = {
    "wall_weights": "voxel_weights=fitted",
    "far_feedback": "voxel_weights=fitted",
    "target_error": "placement=adaptive",
    "reader_probes": "placement=adaptive",
}
TURNED_OFF = (None, "nearest", "closest", 0)


@dataclass(frozen=True)
class BakeSettings:
    """Knobs of a bake. "More" says what a larger value buys, after the unit.

    basis : of the probes' light, cube, sh1 or sh2 (gi_core.basis); sh2: right for facades at any angle, half as many bytes again as the
        cube
    sky : faces, the talk's six scalars a probe, or patches, sources like any brick: right for a sky that is not uniform
    sky_patches : of sky="patches"; more: a sharper sky, more factors
    rays_per_face_edge : rays along an edge of a probe's cube map face; more: smoother factors, slower bake
    grid_spacing_m [m] : ray-cast grid of probes; less: more probes
    probe_height_m [m] : probes stand this high above what the grid's ray hit
    head_room_m [m] : a hit with less free air above gets no probe
    wall_spacing_m [m] : probes along walls, sideways and up to wall_doubling_m; less: more probes
    wall_doubling_m [m] : above this height over the scene's lowest point, the upward spacing doubles at every step
    wall_offset_m [m] : wall probes stand this far off their wall
    margin_m [m] : probes are also placed this far beyond the sector's border, by the same rule, so that no seam shows; of the grid more
        than half of wall_spacing_m, or walls that cross a border have no probe beyond it
    cells_double_beyond_m [m] : surfel and brick cells double with every doubling of the closest probe's distance beyond this; more:
        more surfels. The slides give 1 m and 4 m, and no word on the distance; their 49 surfels a probe are out of reach without it
    sun_declination_step_degrees, sun_hour_step_degrees : spacing of the baked sun directions; less: sharper shadows, larger files
    voxel_probes : probes that a voxel blends at most
    voxel_candidates : nearest probes that are tested for visibility from a voxel
    voxel_levels : 1, the talk's voxels of 3.125 m; 2, near surfaces also some of half that, for volumes of cascade -1
    feedback_probes : probes that light a surfel, the closest of those that see it; more: smoother bounces, more to do at each relight
    far_feedback : what lights surfels far from all probes, "closest", the closest that sees them, as near ones; "likest", that whose trial
        light is likest, where voxel weights are fitted too (bake_jobs/far_feedback.py)
    placement : "grid", ground grid and walls; "adaptive", where light changes (bake_jobs/adaptive.py)
    voxel_weights : "nearest", visible probes by distance; "fitted", to trial light (bake_jobs/fit.py)
    wall_weights : of voxels in walls, "nearest", those of the nearest air; "fitted", to what surfaces that read them need, where voxel
        weights are fitted too (bake_jobs/surface_fit.py)
    reader_probes : with fitted wall weights, probes of a sector at most that stand where surfaces are lit as no blend of the others is, in
        light wells and between walls (bake_jobs/reader_probes.py); more: better lit walls there
    trial_rays_per_face_edge : of the trial light at every voxel; more: less noise in what placement and weights follow
    probe_worth : adaptive placement goes on until a probe takes less than this off the squared relative errors of the voxels that see it,
        summed; less: more probes
    probe_budget : adaptive probes of a sector at most, margin included
    band_m [m] : adaptive probes stand up to this high above the street; above, a few carry the light
    fit_candidates : visible probes that a voxel's weights are fitted over
    fit_ridge : pull of fitted weights towards inverse distance; more: smoother, less exact
    target_error : probes are added until the bake's own estimate of the error near surfaces, measured at a few voxels, is below; 0:
        probe_worth alone decides
    """

    preset: str = "talk"
    basis: str = "cube"
    sky: str = "faces"
    sky_patches: int = 48
    rays_per_face_edge: int = 16
    grid_spacing_m: float = 4.0
    probe_height_m: float = 1.5
    head_room_m: float = 2.0
    wall_spacing_m: float = 8.0
    wall_doubling_m: float = 12.0
    wall_offset_m: float = 1.0
    margin_m: float = 4.75
    cells_double_beyond_m: float = 8.0
    sun_declination_step_degrees: float = 15.0
    sun_hour_step_degrees: float = 15.0
    voxel_probes: int = 4
    voxel_candidates: int = 8
    voxel_levels: int = 1
    feedback_probes: int = 1
    far_feedback: str = "closest"
    placement: str = "grid"
    voxel_weights: str = "nearest"
    wall_weights: str = "nearest"
    reader_probes: int = 0
    trial_rays_per_face_edge: int = 8
    probe_worth: float = 0.01
    probe_budget: int = 1000
    band_m: float = 28.0
    fit_candidates: int = 12
    fit_ridge: float = 0.001
    target_error: float = 0.0

    @property
    def sky_sources(self) -> int:
        """Sources that factors of the sky may read."""
        return len(CUBE_FACES) if self.sky == "faces" else self.sky_patches

    def to_json(self) -> dict[str, Any]:
        """The knobs as a JSON object; those that do nothing here are left out."""
        knobs = asdict(self)
        if self.sky == "faces":
            del knobs["sky_patches"]
        if self.voxel_levels == 1:
            del knobs["voxel_levels"]
        if "nearest" in (self.wall_weights, self.voxel_weights):
            del knobs["wall_weights"]
        if self.far_feedback == "closest" or self.voxel_weights == "nearest":
            del knobs["far_feedback"]
        if not self.reader_probes or "wall_weights" not in knobs or self.placement == "grid":
            del knobs["reader_probes"]
        return knobs


def with_knobs(settings: BakeSettings, knobs: Sequence[str]) -> BakeSettings:
    """Settings with some knobs turned: texts such as ``basis=sh2`` or ``feedback_probes=6``.

    The preset's name tells of them. Raises InputError for a knob that there is none of, and for a value that it cannot have.
    """
    known = {field.name: field.type for field in fields(BakeSettings) if field.name != "preset"}
    turned: dict[str, str | int | float] = {}
    for knob in knobs:
        name, _, value = knob.partition("=")
        if name not in known:
            raise InputError(f"knob {knob[:60]!r}: expected NAME=VALUE with a name of {', '.join(known)}")
        try:
            turned[name] = {str: str, int: int, float: float}[type(getattr(settings, name))](value)
        except ValueError as error:
            raise InputError(f"knob {knob[:60]!r}: expected a number") from error
        choices = KNOB_CHOICES.get(name)
        low, high = KNOB_RANGES.get(name, (0.01, 1e4))
        if choices is not None and value not in choices:
            raise InputError(f"knob {knob[:60]!r}: expected {' or '.join(choices)}")
        if choices is None and not low <= float(value) <= high:
            raise InputError(f"knob {knob[:60]!r}: expected {low:g} to {high:g}")
    found = replace(settings, preset=", ".join([settings.preset, *knobs]), **turned)  # type: ignore[arg-type]
    _expect_effect(found, turned)
    return found


def _expect_effect(settings: BakeSettings, turned: Mapping[str, object]) -> None:
    """Raise InputError for a knob that was turned and that others leave without effect, and for a margin that placement cannot have."""
    for name, need in KNOB_NEEDS.items():
        other, _, wanted = need.partition("=")
        if turned.get(name) not in TURNED_OFF and getattr(settings, other) != wanted:
            raise InputError(f"knob {name}={turned[name]}: does nothing without {need}")
    if settings.placement == "adaptive" and settings.margin_m > MAX_ADAPTIVE_MARGIN_M:
        raise InputError(
            f"knob placement=adaptive: expected margin_m of {MAX_ADAPTIVE_MARGIN_M:g} at most, found {settings.margin_m:g}; "
            f"as in margin_m={ADAPTIVE['margin_m']:g}"
        )


# What placement="adaptive" and voxel_weights="fitted" want of the other knobs: both tuned together (gi_core/MATH.md).
ADAPTIVE: dict[str, Any] = {
    "placement": "adaptive",
    "voxel_weights": "fitted",
    "wall_weights": "fitted",
    "far_feedback": "likest",
    "voxel_candidates": 24,
    "margin_m": 3.2,
}
# Light errs most at hours between those that are baked. Half the talk's steps both ways take a tenth off that error and its 95th
# percentile, for an eighth more bytes and not a microsecond of a tick (docs/TRADEOFF.md, "Any sun").
FINE_SUNS: dict[str, Any] = {"sun_declination_step_degrees": 8.0, "sun_hour_step_degrees": 7.5}


def with_target_error(settings: BakeSettings, target_error: float, knobs: Sequence[str] = ()) -> BakeSettings:
    """Settings that place probes adaptively until an error is met; no other probes are added.

    Raises InputError for an error that no bake can be asked for, and where ``knobs``, which were turned, are among those that it sets.
    """
    if not 0.001 <= target_error <= 1.0:
        raise InputError(f"--target-error {target_error:g}: expected a relative error of 0.001..1, as in 0.04")
    wanted = ADAPTIVE | {"target_error": target_error, "reader_probes": 0}
    for name in (knob.partition("=")[0] for knob in knobs):
        if name in wanted and getattr(settings, name) != wanted[name]:
            raise InputError(f"--target-error: takes {name}={wanted[name]}, which the knob {name}={getattr(settings, name)} contradicts")
    return replace(settings, **wanted)


def settings_for(preset: str) -> BakeSettings:
    """Settings of a preset. Raises InputError for a name that is not one."""
    if preset == "talk":
        return BakeSettings()
    if preset == "draft":
        return BakeSettings(
            preset="draft",
            rays_per_face_edge=8,
            grid_spacing_m=8.0,
            margin_m=8.75,
            wall_spacing_m=16.0,
            sun_declination_step_degrees=16.0,
            sun_hour_step_degrees=15.0,
        )
    if preset == "standard":
        # One feedback probe: with probes as close together as these, more of them were no better (MATH.md, "What each idea is worth").
        # Cells that double from 4 m on: a fifth fewer bytes and a quarter off a tick, for no error that `tradeoff` can tell. Rays: as many
        # bytes less as FINE_SUNS take.
        less: dict[str, Any] = {"rays_per_face_edge": 12, "cells_double_beyond_m": 4.0}
        return BakeSettings(preset="standard", basis="sh2", sky="patches", sky_patches=96, **less, **ADAPTIVE, **FINE_SUNS)
    if preset == "reference":
        more: dict[str, Any] = {"probe_worth": 0.001, "voxel_levels": 2, "reader_probes": 150}
        return BakeSettings(preset="reference", basis="sh2", sky="patches", sky_patches=96, **more, **ADAPTIVE, **FINE_SUNS)
    raise InputError(f"quality {preset!r}: expected one of {', '.join(PRESETS)}")

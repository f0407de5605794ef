"""Presets and their knobs: each idea is one switch, and what a knob cannot be is refused by name."""

import pytest

from bake_jobs.config import PRESETS, settings_for, with_knobs, with_target_error
from gi_core.errors import InputError


def test_a_knob_changes_one_setting_and_the_name():
    talk = settings_for("talk")
    turned = with_knobs(talk, ["basis=sh2", "feedback_probes=6", "cells_double_beyond_m=16"])
    assert (turned.basis, turned.feedback_probes, turned.cells_double_beyond_m) == ("sh2", 6, 16.0)
    assert turned.preset == "talk, basis=sh2, feedback_probes=6, cells_double_beyond_m=16"
    changed = {"preset", "basis", "feedback_probes", "cells_double_beyond_m"}
    assert {k: v for k, v in turned.to_json().items() if k not in changed} == {k: v for k, v in talk.to_json().items() if k not in changed}


def test_standard_is_the_talk_and_its_ideas():
    placed = ["placement=adaptive", "voxel_weights=fitted", "wall_weights=fitted", "far_feedback=likest"]
    placed += ["voxel_candidates=24", "margin_m=3.2", "sun_hour_step_degrees=7.5", "sun_declination_step_degrees=8"]
    fewer = ["cells_double_beyond_m=4", "rays_per_face_edge=12"]
    ideas = with_knobs(settings_for("talk"), ["basis=sh2", "sky=patches", "sky_patches=96", *fewer, *placed]).to_json()
    assert settings_for("standard").to_json() | {"preset": ""} == ideas | {"preset": ""}


def test_reference_is_standard_and_more_of_it():
    more = with_knobs(
        settings_for("standard"),
        ["cells_double_beyond_m=8", "rays_per_face_edge=16", "probe_worth=0.001", "voxel_levels=2", "reader_probes=150"],
    ).to_json()
    assert settings_for("reference").to_json() | {"preset": ""} == more | {"preset": ""}


@pytest.mark.parametrize(
    ("knob", "said"),
    [
        ("basis", "expected cube or sh1 or sh2"),
        ("basis=sh9", "expected cube or sh1 or sh2"),
        ("sky=none", "expected faces or patches"),
        ("placement=random", "expected grid or adaptive"),
        ("voxel_weights=1", "expected nearest or fitted"),
        ("wall_weights=none", "expected nearest or fitted"),
        ("far_feedback=none", "expected closest or likest"),
        ("sky_patches=2", "expected 4 to 1024"),
        ("feedback_probes=33", "expected 1 to 32"),
        ("voxel_levels=3", "expected 1 to 2"),
        ("probe_worth=0", "expected 1e-05 to 10000"),
        ("feedback_probes=six", "expected a number"),
        ("wall_offset_m=nan", "expected 0.01 to 10000"),
        ("grid_spacing_m=0", "expected 0.5 to 1000"),
        ("trial_rays_per_face_edge=10000", "expected 2 to 64"),
        ("preset=best", "expected NAME=VALUE"),
        ("speed=11", "expected NAME=VALUE"),
    ],
)
def test_a_knob_that_cannot_be_is_refused(knob, said):
    with pytest.raises(InputError, match=said):
        with_knobs(settings_for("talk"), [knob])


def test_a_knob_that_does_nothing_is_not_part_of_a_bake():
    assert "sky_patches" not in settings_for("talk").to_json()
    assert settings_for("standard").to_json()["sky_patches"] == settings_for("standard").sky_sources
    assert settings_for("talk").sky_sources == 6
    assert "voxel_levels" not in settings_for("standard").to_json()
    assert "wall_weights" not in settings_for("talk").to_json()
    assert "far_feedback" not in with_knobs(settings_for("standard"), ["voxel_weights=nearest"]).to_json()
    assert "reader_probes" in settings_for("reference").to_json()
    assert "reader_probes" not in with_knobs(settings_for("reference"), ["wall_weights=nearest"]).to_json()
    assert {settings_for(name).preset for name in PRESETS} == set(PRESETS)


@pytest.mark.parametrize(
    ("preset", "knobs", "said"),
    [
        ("talk", ["wall_weights=fitted"], "wall_weights=fitted: does nothing without voxel_weights=fitted"),
        ("talk", ["far_feedback=likest"], "far_feedback=likest: does nothing without voxel_weights=fitted"),
        ("talk", ["target_error=0.05"], "target_error=0.05: does nothing without placement=adaptive"),
        ("talk", ["reader_probes=20"], "reader_probes=20: does nothing without placement=adaptive"),
        ("draft", ["placement=adaptive"], "expected margin_m of 6.25 at most, found 8.75; as in margin_m=3.2"),
        ("standard", ["margin_m=7"], "expected margin_m of 6.25 at most, found 7"),
    ],
)
def test_a_knob_without_effect_is_refused(preset, knobs, said):
    with pytest.raises(InputError, match=said):
        with_knobs(settings_for(preset), knobs)


def test_what_turns_an_idea_off_may_leave_others_idle():
    assert with_knobs(settings_for("standard"), ["voxel_weights=nearest"]).wall_weights == "fitted"
    assert with_knobs(settings_for("reference"), ["reader_probes=0"]).reader_probes == 0


def test_a_target_error_is_not_asked_for_with_a_knob_that_it_sets():
    grid = ["placement=grid", "voxel_weights=nearest"]
    with pytest.raises(InputError, match=r"--target-error: takes placement=adaptive, which the knob placement=grid contradicts"):
        with_target_error(with_knobs(settings_for("standard"), grid), 0.05, grid)
    rays = ["rays_per_face_edge=8", "voxel_weights=fitted"]
    found = with_target_error(with_knobs(settings_for("reference"), rays), 0.05, rays)
    assert (found.target_error, found.rays_per_face_edge, found.reader_probes) == (0.05, 8, 0)

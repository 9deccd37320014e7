"""Scenes that are right: examples load, defaults and sizes resolve, dict and hash round trip.

Source of the numbers: Sasayama & Inagaki 2018 (Jeffery periods, effective stiffness, Reynolds
number of a bead); tolerance: the digits that are printed there or rounding.
"""

from __future__ import annotations

import copy
import dataclasses
import json
import math
import tomllib
from pathlib import Path
from typing import Any

import pytest

from tests.scene_text import ONE_FIBER, SHEAR_CELL, cell, fiber
from warpfiber.scene import SceneError, load_scene, scene_from_dict
from warpfiber.scene import derived as dv


def test_shear_cell_resolves_every_default() -> None:
    """The cell loads and has all sizes and defaults."""
    scene = cell()
    group, numerics = scene.fibers[0], scene.numerics
    assert scene.notes == ()
    assert (scene.seed, scene.title, scene.path, scene.name) == (1, "", "scene.toml", "scene")
    assert scene.box is not None and scene.box.volume == pytest.approx(1.25e-10)
    assert group.count == 446
    assert group.volume_fraction == 0.056
    assert group.volume_fraction_achieved == pytest.approx(446 * math.pi * 25e-12 * 2e-4 / 1.25e-10)
    assert (group.radius, group.aspect_ratio, group.segments) == (5e-6, 20.0, 3)
    assert group.length == pytest.approx(2e-4)
    assert group.centerline_length == pytest.approx(1.9e-4)
    assert group.bead_spacing == pytest.approx(19 / 3)
    assert group.reduced_beads == pytest.approx(16 / 3)
    assert group.axial_modulus == group.bending_modulus == group.youngs_modulus
    assert (group.position, group.orientation, group.initial_velocity) == (
        "random",
        "isotropic",
        "flow",
    )
    assert scene.flow is not None and scene.flow.origin == (2.5e-4, 2.5e-4, 2.5e-4)
    assert scene.contact.law == "exponential"
    assert scene.contact.strength == pytest.approx(1000 * 100 * 100 * 25e-12)
    assert scene.contact.decay == 50.0
    assert (numerics.closure, numerics.torque_weights) == ("consistent", "end_weighted")
    assert (numerics.dt, numerics.workers, numerics.skin) == (None, None, None)
    assert (numerics.dt_fraction, numerics.lubrication_step) == (0.5, "limited")
    assert (scene.record.frames, scene.record.scalars) == (100, 1000)
    assert scene.stages[0].name == "flow" and scene.stages[0].time_limit is None
    assert dv.interaction_range(scene) == pytest.approx(1.5e-5)
    assert dv.longest_segment(scene) == pytest.approx(1.9e-4 / 3)


def test_single_fiber_has_no_box_and_lies_at_the_origin() -> None:
    """Without a box one fiber stands at 0 along its direction."""
    scene = fiber()
    group = scene.fibers[0]
    assert scene.box is None and group.volume_fraction_achieved is None
    assert group.position == ((0.0, 0.0, 0.0),)
    assert group.direction == (1.0, 0.0, 0.0)
    assert (group.count, group.segments, group.bead_spacing, group.reduced_beads) == (1, 49, 1, 0)
    assert scene.flow is not None and scene.flow.origin == (0.0, 0.0, 0.0)
    assert dv.interaction_range(scene) == 0.0
    assert dv.crowding(scene, group) is None


@pytest.mark.parametrize(
    ("ratio", "fraction", "count"),
    [(10, 0.122, 1942), (10, 0.201, 3199), (20, 0.056, 446), (30, 0.037, 196)],
)
def test_fiber_counts_of_the_papers_cubes(ratio: float, fraction: float, count: int) -> None:
    """The default volume rule gives the fiber counts of the 500 um cubes, 196 to 3,199."""
    scene = cell(fibers__0__aspect_ratio=ratio, fibers__0__volume_fraction=fraction)
    assert scene.fibers[0].count == dv.fiber_count(scene) == count


@pytest.mark.parametrize(
    ("rule", "counted"),
    [("cylinder", 2e-4), ("capsule", 1.9e-4 + 4 / 3 * 5e-6), ("centerline", 1.9e-4)],
)
def test_volume_rules(rule: str, counted: float) -> None:
    """Each rule counts its length of the fiber."""
    assert dv.fiber_volume(rule, 1e-5, 2e-4) == pytest.approx(math.pi * 25e-12 * counted)
    group = cell(box__volume_rule=rule).fibers[0]
    assert group.count == round(0.056 * 1.25e-10 / (math.pi * 25e-12 * counted))


def test_a_tiny_volume_fraction_is_one_fiber_and_says_so() -> None:
    """At least one fiber; the note tells what fraction that is."""
    scene = cell(fibers__0__volume_fraction=1e-7)
    assert scene.fibers[0].count == 1
    assert any("volume_fraction" in note for note in scene.notes)


@pytest.mark.parametrize(
    ("key", "value"), [("aspect_ratio", 20), ("length", 2e-4), ("centerline_length", 1.9e-4)]
)
def test_three_ways_to_give_the_length(key: str, value: float) -> None:
    """Aspect ratio, length and centerline length mean the same fiber."""
    group = cell(**{f"fibers__0__{key}": value}).fibers[0]
    assert group.aspect_ratio == 20.0
    assert group.length == pytest.approx(2e-4, rel=1e-14)
    assert group.centerline_length == pytest.approx(1.9e-4, rel=1e-14)


@pytest.mark.parametrize(
    ("key", "value", "segments"),
    [
        ("segments", 49, 49),
        ("segments", [15], 15),
        ("segment_length", 1e-5, 49),
        ("segment_length", 1e-4, 5),
        ("segment_length", 1.0, 1),
        ("reduced_beads", 0, 49),
        ("reduced_beads", 6, 7),
        ("reduced_beads", 48, 1),
    ],
)
def test_three_ways_to_give_the_segments(key: str, value: object, segments: int) -> None:
    """Number, length and reduced beads; the bead spacing M is real and at least 1."""
    group = fiber(**{f"numerics__{key}": value}).fibers[0]
    assert group.segments == segments
    assert group.bead_spacing == pytest.approx(49 / segments) and group.bead_spacing >= 1.0


def test_unreduced_chain_of_a_broken_ratio_keeps_beads_apart() -> None:
    """r_f = 20.7: 19 segments, M = 19.7/19 and not 20 with M < 1."""
    group = fiber(fibers__0__aspect_ratio=20.7, numerics__reduced_beads=0).fibers[0]
    assert group.segments == 19 and group.bead_spacing == pytest.approx(19.7 / 19)


def test_segments_per_group() -> None:
    """A list gives one number per group."""
    tables = tomllib.loads(SHEAR_CELL)
    tables["fibers"].append(dict(tables["fibers"][0], aspect_ratio=10))
    tables["numerics"]["segments"] = [3, 1]
    assert [group.segments for group in scene_from_dict(tables).fibers] == [3, 1]


@pytest.mark.parametrize(
    ("flow", "gradient", "rate"),
    [
        ({"kind": "simple_shear", "shear_rate": 2}, [[0, 0, 2], [0, 0, 0], [0, 0, 0]], 2),
        ({"kind": "planar_extension", "extension_rate": 2}, [[2, 0, 0], [0] * 3, [0, 0, -2]], 2),
        (
            {"kind": "uniaxial_extension", "extension_rate": -2},
            [[-2, 0, 0], [0, 1, 0], [0, 0, 1]],
            2,
        ),
        (
            {"kind": "gradient", "gradient": [[0, 0, 3], [0, 0, 0], [0, 0, 0]]},
            [[0, 0, 3], [0] * 3, [0] * 3],
            3,
        ),
        ({"kind": "rest"}, [[0] * 3] * 3, 0),
    ],
)
def test_velocity_gradients(flow: dict[str, Any], gradient: list[list[float]], rate: float) -> None:
    """Each flow kind has its L_ij = du_i/dx_j and its strain rate."""
    tables = tomllib.loads(ONE_FIBER)
    tables["flow"] = dict(flow, viscosity=1)
    tables["stage"] = [{"kind": "flow", "end_time": 1}]
    scene = scene_from_dict(tables)
    assert scene.flow is not None
    assert scene.flow.velocity_gradient == tuple(tuple(row) for row in gradient)
    assert scene.flow.rate == pytest.approx(rate)
    assert dv.total_strain(scene) == pytest.approx(rate)


def test_schedule_is_linear_between_its_pairs() -> None:
    """The factor is constant outside the pairs and linear between."""
    flow = fiber(flow__schedule=[[10, 1], [20, 3]]).flow
    assert flow is not None
    assert [flow.factor(s) for s in (0, 10, 15, 20, 99)] == [1, 1, 2, 3, 3]


def test_strain_step_becomes_dt() -> None:
    """dt = strain step/rate; "auto" is None; a number stays."""
    assert fiber(numerics__strain_step=1e-3).numerics.dt == pytest.approx(1e-5)
    assert fiber(numerics__dt="auto").numerics.dt is None
    assert fiber(numerics__dt=2e-5).numerics.dt == 2e-5


def test_repeats_are_written_out() -> None:
    """Stages a b c with c repeating from b: a b c b c b c."""
    tables = tomllib.loads(ONE_FIBER)
    tables["stage"] = [{"kind": "flow", "name": name, "end_strain": 1} for name in ("a", "b", "c")]
    tables["stage"][2] |= {"repeat_from": "b", "repeat": 3}
    scene = scene_from_dict(tables)
    assert "".join(stage.name for stage in scene.stage_sequence) == "abcbcbc"
    assert dv.total_strain(scene) == 7.0


def test_nested_repeats_are_written_out() -> None:
    """An inner repeat is part of the outer block."""
    tables = tomllib.loads(ONE_FIBER)
    tables["stage"] = [{"kind": "flow", "name": name, "end_strain": 1} for name in ("a", "b")]
    tables["stage"][0] |= {"repeat_from": "a", "repeat": 2}
    tables["stage"][1] |= {"repeat_from": "a", "repeat": 2}
    assert "".join(s.name for s in scene_from_dict(tables).stage_sequence) == "aabaab"


def test_ignored_keys_are_noted_not_refused() -> None:
    """Known keys that do nothing here are told, the scene loads."""
    scene = cell(
        fibers__0__bond_damping=0.03,
        contact__damping=0.1,
        flow__extension_rate=3.0,
        numerics__integrator="bdf2",
    )
    for key in ("bond_damping", "contact.damping", "flow.extension_rate", "numerics.integrator"):
        assert sum(key in note for note in scene.notes) == 1


def test_long_fibers_are_noted() -> None:
    """Longer than half the periodic box, or than the gap between walls: a note."""
    half = cell(fibers__0__aspect_ratio=30)
    assert any("half the box" in note for note in half.notes)
    whole = cell(fibers__0__aspect_ratio=60)
    assert any("longer than the box" in note for note in whole.notes)
    assert any("between the walls" in note for note in whole.notes)


def test_node_file_replaces_count_and_length(tmp_path: Path) -> None:
    """The file is found beside the scene; its sizes are left to who reads it."""
    text = ONE_FIBER.replace("count = 1\naspect_ratio = 50\n", 'node_file = "nodes.csv"\n')
    text = text.replace("segments = 49\n", "")
    (tmp_path / "nodes.csv").write_text("fiber,x,y,z\n")
    (tmp_path / "scene.toml").write_text(text)
    group = load_scene(tmp_path / "scene.toml").fibers[0]
    assert group.node_file == str(tmp_path / "nodes.csv")
    assert (group.count, group.segments, group.aspect_ratio, group.bead_spacing) == (0, 0, 0, 0)


def test_dict_round_trips_through_json() -> None:
    """as_dict is JSON and makes the same scene again; so is its hash."""
    tensor = [0.5, 0.3, 0.2, 0.1, 0, 0]
    scenes = [
        cell(),
        fiber(),
        cell(fibers__0__orientation=tensor, gravity__fluid_density=1000, title="A"),
        fiber(flow__schedule=[[0, 1], [5, 2]], fibers__0__initial_velocity=[0, 0, 1]),
    ]
    for scene in scenes:
        again = scene_from_dict(json.loads(json.dumps(scene.as_dict(), allow_nan=False)))
        assert again == scene
        assert again.hash == scene.hash
    tables = cell().as_dict()
    assert tables["fibers"][0]["count"] == 446 and tables["stage"][0]["end_strain"] == 60.0


def test_dict_of_another_version_is_refused() -> None:
    """A recorded scene with a field too much or missing is a fault, not a crash."""
    for change in ({"viscous": 1}, {"viscosity": None}):
        tables = copy.deepcopy(cell().as_dict())
        tables["flow"] |= change
        tables["flow"] = {key: value for key, value in tables["flow"].items() if value is not None}
        with pytest.raises(SceneError, match="another version"):
            scene_from_dict(tables)
    with pytest.raises(SceneError, match="recorded scene"):
        scene_from_dict(cell().as_dict(), overrides={"seed": 2})


def test_hash_is_of_what_is_simulated() -> None:
    """The same physics has the same hash, however it is written and wherever it lies."""
    scene = cell()
    assert len(scene.hash) == 16 and int(scene.hash, 16) >= 0
    assert scene.hash == cell(title="another").hash
    assert scene.hash == scene_from_dict(tomllib.loads(SHEAR_CELL), "elsewhere/b.toml").hash
    assert scene.hash != cell(seed=2).hash
    assert scene.hash != cell(numerics__segments=1).hash


def test_scene_is_frozen() -> None:
    """Nothing can be changed after reading."""
    with pytest.raises(dataclasses.FrozenInstanceError):
        cell().seed = 2  # type: ignore[misc]

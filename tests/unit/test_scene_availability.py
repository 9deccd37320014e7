"""Scenes of later versions: every key of the schema is known, what cannot run yet says so."""

from __future__ import annotations

import tomllib

import pytest

from tests.scene_text import GONE, changed, faults_of
from warpfiber.scene import scene_from_dict
from warpfiber.scene.availability import unavailable

BONDED_SPHERES = """
[box]
size = [0.06, 0.06, 0.3]
boundary = ["periodic", "periodic", "wall"]
[gravity]
[[fibers]]
count = 300
centerline_length = 0.06283
diameter = 2.4e-3
density = 1340
youngs_modulus = 7.5e5
bond_damping = 0.0335
shape = { kind = "s", curvature = 100 }
[contact]
friction = 1.4
wall_friction = 0.6
damping = 0.113
[[stage]]
kind = "settle"
damping = 8
end_speed = 1e-3
save = true
[[stage]]
name = "load"
kind = "compress"
wall = "z+"
speed = 0.1
end_volume_fraction = 0.41
[[stage]]
kind = "unload"
wall = "z+"
speed = 0.1
end_pressure = 0
repeat_from = "load"
repeat = 3
[numerics]
method = "bonded_spheres"
segments = 26
"""


NOT_YET: list[tuple[dict[str, object], str]] = [
    ({"numerics.contact": "unilateral"}, "numerics.contact"),
    ({"flow.kind": "field", "flow.file": "a.npz"}, "flow.kind"),
    ({"fibers.0.inextensible": True}, "fibers.0.inextensible"),
    ({"fibers.0.shape": {"kind": "ring"}}, "fibers.0.shape.kind"),
    ({"contact.law": "hertz", "contact.lubrication": GONE}, "contact.law"),
    ({"contact.law": "linear", "contact.stiffness": 1}, "contact.law"),
    ({"contact.friction": 0.3}, "contact.friction"),
    ({"contact.wall_friction": 0.3}, "contact.wall_friction"),
    ({"stage.0.end_speed": 0.1}, "stage.0.end_speed"),
    ({"stage.0.save": True}, "stage.0.save"),
    ({"stage.0.kind": "settle"}, "stage.0.kind"),
    ({"record.quantities": ["inclination"]}, "record.quantities"),
]


@pytest.mark.parametrize(("changes", "key"), NOT_YET)
def test_known_but_not_available(changes: dict[str, object], key: str) -> None:
    """Keys of later versions, or of other methods, are known; an alternative is told."""
    faults = faults_of(changed(changes))
    assert [fault.key for fault in faults] == [key], [str(fault) for fault in faults]
    table, _, name = key.rpartition(".")
    value = changes.get(key)
    value = tuple(value) if isinstance(value, list) else value
    of_none = unavailable(table.split(".")[0], name, value)
    where = "this version" if of_none else "method bead_chain"
    assert f"not available in {where}; " in faults[0].remedy


OVERDAMPED: dict[str, object] = {
    "numerics.method": "overdamped",
    "contact.law": "none",
    "contact.lubrication": GONE,
    "box.boundary": ["periodic", "periodic", "periodic"],
    "fibers.0.density": GONE,
}

RODS = OVERDAMPED | {"numerics.method": "rigid_rod", "numerics.segments": GONE}

CONTACT_FAULTS: list[tuple[dict[str, object], str, str]] = [
    ({"box.boundary": ["periodic", "wall", "wall"]}, "contact.law", "walls push by contact"),
    ({"contact.law": "linear"}, "contact.stiffness", "missing"),
    ({"contact.law": "linear", "contact.stiffness": 0}, "contact.stiffness", "a number > 0"),
    (
        {"contact.law": "exponential", "contact.friction": 0.3, "numerics.contact": "penalty"},
        "contact.friction",
        "penalties are frictionless",
    ),
    (
        {"contact.law": "exponential", "contact.wall_friction": 1, "numerics.contact": "penalty"},
        "contact.wall_friction",
        'use numerics.contact = "unilateral"',
    ),
    ({"contact.friction": -0.1}, "contact.friction", ">= 0"),
    ({"contact.lubrication": "paper"}, "contact.lubrication", "switches off all pairs"),
    ({"numerics.contact_tolerance": 0}, "numerics.contact_tolerance", "a number > 0"),
    ({"numerics.contact_tolerance": -1e-3}, "numerics.contact_tolerance", "a number > 0"),
    ({"numerics.linearizations": 0}, "numerics.linearizations", ">= 1 and < 3"),
    ({"numerics.linearizations": 3}, "numerics.linearizations", ">= 1 and < 3"),
    ({"numerics.contact": "hard"}, "numerics.contact", "unilateral"),
]

NOT_OVERDAMPED: list[tuple[dict[str, object], str, str]] = [
    *CONTACT_FAULTS,
    ({"numerics.closure": "paper"}, "numerics.closure", 'use closure = "consistent"'),
    ({"numerics.integrator": "bdf2", "numerics.tolerance": 1e-3}, "numerics.tolerance", "sdirk2"),
    (
        {"contact.law": "exponential", "numerics.integrator": "bdf2"},
        "numerics.integrator",
        'contact needs a method of one step; use "sdirk2"',
    ),
    (
        {"flow.kind": "rest", "stage.0.end_time": 1, "numerics.tolerance": 0.1},
        "numerics.tolerance",
        "give dt in s",
    ),
    ({"gravity": {}}, "fibers.0.density", "missing"),
    ({"flow": GONE, "stage.0.end_time": 1}, "flow", "missing: overdamped moves fibers by drag"),
]


def test_overdamped_loads() -> None:
    """The scene that the cases below change loads, with a list of words left to the method."""
    scene = scene_from_dict(changed(OVERDAMPED))
    assert scene.numerics.integrator == "sdirk2"
    assert scene.fibers[0].density is None
    free = scene_from_dict(changed(OVERDAMPED | {"fibers.0.inextensible": True}))
    assert free.fibers[0].inextensible


@pytest.mark.parametrize("given", [OVERDAMPED, RODS])
def test_friction_loads(given: dict[str, object]) -> None:
    """Of contacts that are not penalties; without a law it is told to be of no effect."""
    rubbing = {"contact.friction": 0.3, "contact.wall_friction": 0.2}
    scene = scene_from_dict(changed(given | {"contact.law": "exponential"} | rubbing))
    assert (scene.contact.friction, scene.contact.wall_friction) == (0.3, 0.2)
    idle = scene_from_dict(changed(given | rubbing))
    assert any("contact.friction has no effect" in note for note in idle.notes)


@pytest.mark.parametrize("method", ["overdamped", "rigid_rod"])
@pytest.mark.parametrize(
    "contact",
    [
        {},
        {"law": "exponential"},
        {"law": "linear", "stiffness": 1.0},
        {"lubrication": "paper"},
        {"lubrication": "shifted"},
    ],
)
def test_contact_and_walls_load(method: str, contact: dict[str, object]) -> None:
    """Fibers that meet one another and walls; they overlap only if a penalty is asked for."""
    given = OVERDAMPED if method == "overdamped" else RODS
    tables = changed(given | {"box.boundary": ["periodic", "wall", "wall"]})
    tables["contact"] = contact
    assert scene_from_dict(tables).numerics.contact == "unilateral"
    tables["numerics"] |= {"contact": "penalty", "linearizations": 2, "contact_tolerance": 1e-4}
    scene = scene_from_dict(tables)
    assert scene.numerics.contact == "penalty"
    assert scene.numerics.linearizations == 2 and scene.numerics.contact_tolerance == 1e-4


@pytest.mark.parametrize(("changes", "key", "advice"), NOT_OVERDAMPED)
def test_what_overdamped_cannot_run(changes: dict[str, object], key: str, advice: str) -> None:
    """Other closures, and what does not go with contact, are refused with what to do instead."""
    faults = faults_of(changed(OVERDAMPED | changes))
    assert [fault.key for fault in faults] == [key], [str(fault) for fault in faults]
    assert advice in faults[0].remedy


NOT_RODS: list[tuple[dict[str, object], str, str]] = [
    *CONTACT_FAULTS,
    ({"numerics.closure": "paper"}, "numerics.closure", 'use closure = "consistent"'),
    ({"numerics.segments": 3}, "numerics.segments", "a rod is one segment"),
    ({"numerics.reduced_beads": 4}, "numerics.reduced_beads", "a rod is one segment"),
    ({"fibers.0.aspect_ratio": 1.5}, "fibers.0.aspect_ratio", "too short for one segment"),
    ({"gravity": {}}, "fibers.0.density", "missing"),
    ({"flow": GONE, "stage.0.end_time": 1}, "flow", "missing: rigid_rod moves fibers by drag"),
]


def test_rods_have_one_segment_and_nothing_to_solve() -> None:
    given = {"numerics.integrator": "bdf2", "fibers.0.inextensible": True}
    scene = scene_from_dict(changed(RODS | given))
    assert scene.numerics.segments == scene.fibers[0].segments == 1
    assert scene.numerics.closure == "consistent"
    assert scene.numerics.integrator is None and scene.numerics.tolerance is None
    for key in ("numerics.integrator", "fibers.0.inextensible"):
        assert any(note.startswith(f"{key} has no effect") for note in scene.notes)


@pytest.mark.parametrize(("changes", "key", "advice"), NOT_RODS)
def test_what_rods_cannot_run(changes: dict[str, object], key: str, advice: str) -> None:
    faults = faults_of(changed(RODS | changes))
    assert [fault.key for fault in faults] == [key], [str(fault) for fault in faults]
    assert advice in faults[0].remedy


SPHERES: dict[str, object] = {
    "numerics.method": "bonded_spheres",
    "flow": GONE,
    "contact.law": "none",
    "contact.lubrication": GONE,
    "stage.0.kind": "settle",
    "stage.0.end_strain": GONE,
    "stage.0.end_time": 1.0,
    "fibers.0.aspect_ratio": 10,
}

NOT_SPHERES: list[tuple[dict[str, object], str, str]] = [
    ({"flow": {"kind": "rest", "viscosity": 1.0}}, "flow", "no fluid; remove the table"),
    ({"contact.law": "exponential"}, "contact.law", '"hertz"'),
    ({"stage.0.kind": "flow"}, "stage.0.kind", 'use kind = "settle"'),
    ({"stage": [{"kind": "settle", "end_strain": 1}]}, "stage.0.end_strain", "end_time"),
    ({"stage.0.kind": "pour"}, "stage.0.kind", "add [gravity] that points down"),
    ({"numerics.strain_step": 0.1}, "numerics.strain_step", "give dt in s"),
    ({"fibers.0.bending_modulus": 0}, "fibers.0.bending_modulus", "give > 0"),
    ({"fibers.0.poisson_ratio": 0.6}, "fibers.0.poisson_ratio", "0.5"),
    ({"fibers.0.density": GONE}, "fibers.0.density", "missing"),
    ({"fibers.0.inextensible": True}, "fibers.0.inextensible", "axial_modulus"),
]


def test_bonded_spheres_without_pairs() -> None:
    """The scene that the cases below change loads, with the method's own defaults."""
    scene = scene_from_dict(changed(SPHERES | {"load": [{"force": [1, 0, 0]}]}))
    assert scene.numerics.bond_shear == "rbf"
    assert scene.numerics.dt_fraction == 0.3
    assert scene.box is not None and scene.box.volume_rule == "capsule"
    assert scene.loads[0].node == -1 and scene.loads[0].hold == "free"
    assert scene_from_dict(scene.as_dict()) == scene
    settled: dict[str, object] = {"stage": [{"kind": "settle", "end_speed": 1e-3}]}
    still = {key: value for key, value in SPHERES.items() if not key.startswith("stage")}
    scene = scene_from_dict(changed(still | settled))
    assert scene.stages[0].time_limit == 100.0
    assert any("time_limit" in note for note in scene.notes)


@pytest.mark.parametrize(("changes", "key", "advice"), NOT_SPHERES)
def test_what_bonded_spheres_cannot_run(changes: dict[str, object], key: str, advice: str) -> None:
    """Fluids, pairs, other stages and loads on nothing are refused with what to do instead."""
    faults = faults_of(changed(SPHERES | changes))
    assert [fault.key for fault in faults] == [key], [str(fault) for fault in faults]
    assert advice in faults[0].remedy


def test_start_is_known() -> None:
    """Fibers in a flow do not start from a saved stage, and are told no more than that."""
    faults = faults_of(changed({"start": {"from": "results/a", "stage": "load"}}))
    assert [fault.key for fault in faults] == ["start"]
    assert "not available in method bead_chain; give [[fibers]]" in str(faults[0])


def test_bonded_spheres_scene_is_read() -> None:
    """Three cycles after a stage that is saved."""
    scene = scene_from_dict(tomllib.loads(BONDED_SPHERES))
    assert [stage.save for stage in scene.stages] == [True, False, False]
    assert len(scene.stage_sequence) == 7

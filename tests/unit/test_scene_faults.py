"""Scenes that are wrong: every fault names file, key, value and remedy; all come together.

Each case changes one thing in a scene that loads, so the fault list must be exactly that one.
"""

from __future__ import annotations

import pytest

from tests.scene_text import GONE, cell_tables, changed, faults_of
from warpfiber.scene import (
    Fault,
    SceneError,
    scene_from_dict,
)

VALUES: list[tuple[str, object, str, str]] = [
    # key, value, how the value is shown, a piece of the remedy
    ("fibers.0.diameter", "10 um", '"10 um"', "write 1e-5 "),
    ("fibers.0.diameter", "10µm", '"10µm"', "write 1e-5 "),
    ("fibers.0.diameter", "1e-5", '"1e-5"', "write 1e-5 "),
    ("fibers.0.diameter", "thin", '"thin"', "give a number > 0 in m"),
    ("fibers.0.diameter", "5 s", '"5 s"', "give a number > 0 in m"),
    ("fibers.0.diameter", -1e-5, "-1e-5", "> 0 in m"),
    ("fibers.0.diameter", 0, "0", "> 0 in m"),
    ("fibers.0.diameter", True, "true", "not a number"),
    ("fibers.0.diameter", float("nan"), "nan", "finite"),
    ("fibers.0.diameter", [1e-5], "[1e-5]", "a list is not a number"),
    ("fibers.0.youngs_modulus", "30 GPa", '"30 GPa"', "write 30000000000 "),
    ("fibers.0.youngs_modulus", float("inf"), "inf", "finite"),
    ("fibers.0.youngs_modulus", 10**400, "1000", "finite"),
    ("fibers.0.density", "2.5 g/cm^3", '"2.5 g/cm^3"', "write 2500 "),
    ("fibers.0.bending_modulus", -1, "-1", ">= 0 in Pa"),
    ("fibers.0.count", 3.0, "3", "write 3"),
    ("fibers.0.count", 2.5, "2.5", "whole number"),
    ("fibers.0.count", 0, "0", ">= 1"),
    ("fibers.0.aspect_ratio", 1, "1", "> 1"),
    ("fibers.0.orientation", "alinged", '"alinged"', 'did you mean "aligned"'),
    ("fibers.0.orientation", [1, 1, 1, 0, 0, 0], "[1, 1, 1, 0, 0, 0]", "must be 1"),
    ("fibers.0.orientation", [0.5, 0.5, 0, 0.9, 0, 0], "[0.5, 0.5", "eigenvalues"),
    ("fibers.0.orientation", [1, 0, 0], "[1, 0, 0]", "3 entries instead of 6"),
    ("fibers.0.direction", [0, 0, 0], "[0, 0, 0]", "no direction"),
    ("fibers.0.position", [[1e-4, 1e-4]], "[[0.0001, 0.0001]]", "instead of 3"),
    ("fibers.0.initial_velocity", "flw", '"flw"', 'did you mean "flow"'),
    ("fibers.0.inextensible", "no", '"no"', "true or false (no quotes)"),
    ("fibers.0.shape", "straight", '"straight"', "{kind = ..."),
    ("box.size", [5e-4, 5e-4], "[0.0005, 0.0005]", "2 entries instead of 3"),
    ("box.size", [5e-4, 5e-4, "5 mm"], "5 mm", "entry 2: a text is not a number; write 0.005"),
    ("box.size", 5e-4, "0.0005", "a number is not a list"),
    ("box.boundary", ["periodic", "periodic", "wal"], '"wal"', 'did you mean "wall"'),
    ("box.volume_rule", 3, "3", '"cylinder"'),
    ("flow.kind", "simple_sheer", '"simple_sheer"', 'did you mean "simple_shear"'),
    ("flow.shear_rate", 0, "0", "> 0 in 1/s"),
    ("flow.viscosity", "100 mPa s", '"100 mPa s"', "write 0.1 "),
    ("flow.origin", [0, 0, 0, 0], "[0, 0, 0, 0]", "4 entries instead of 3"),
    ("flow.schedule", [[1, 1], [1, 2]], "[[1, 1], [1, 2]]", "strains must grow"),
    ("flow.schedule", [[0, 0], [1, 1]], "[[0, 0], [1, 1]]", "factors must be > 0"),
    ("contact.lubrication", "papper", '"papper"', 'did you mean "paper"'),
    ("contact.strength", -1, "-1", "> 0 in N"),
    ("gravity.acceleration", 9.81, "9.81", "a list of 3"),
    ("stage.0.end_strain", -60, "-60", "> 0"),
    ("record.quantities", ["orientation", "overlaps"], '"overlaps"', 'did you mean "overlap"'),
    ("record.quantities", ["energy", "energy"], '"energy"', "twice"),
    ("record.checkpoint_every", "10 min", '"10 min"', "write 600 "),
    ("numerics.segments", 0, "0", ">= 1"),
    ("numerics.segments", 20, "20", "at most 19"),
    ("numerics.segments", [3, 3], "[3, 3]", "one per group"),
    ("numerics.device", "gpu", '"gpu"', '"cuda:N"'),
    ("numerics.device", "cuda:x", '"cuda:x"', '"cuda:N"'),
    ("numerics.dt", "fast", '"fast"', '"auto"'),
    ("numerics.dt", "5 us", '"5 us"', "write 5e-6 "),
    ("numerics.dt", 0, "0", "> 0 in s"),
    ("numerics.workers", 0, "0", ">= 1"),
    ("numerics.precision", "double", '"double"', "float32, float64"),
    ("numerics.closure", "consistant", '"consistant"', 'did you mean "consistent"'),
    ("seed", -1, "-1", ">= 0"),
    ("title", 5, "5", "a text in quotes"),
]


@pytest.mark.parametrize(("key", "value", "shown", "remedy"), VALUES)
def test_wrong_values(key: str, value: object, shown: str, remedy: str) -> None:
    """One wrong value is one line with file, key, value and what to write."""
    faults = faults_of(changed({key: value}))
    lines = [str(fault) for fault in faults]
    assert len(lines) == 1, lines
    assert lines[0].startswith(f"cell.toml: {key} = ")
    assert shown in lines[0] and remedy in lines[0]
    assert "\n" not in lines[0] and faults[0].value == value or value != value


KEYS: list[tuple[dict[str, object], str, str]] = [
    # changes, key of the fault, a piece of the remedy
    ({"flow.viscocity": 3}, "flow.viscocity", "did you mean 'viscosity'?"),
    ({"fibers.0.lenght": 1e-3}, "fibers.0.lenght", "did you mean 'length'?"),
    ({"fibers.0.viscosity": 1}, "fibers.0.viscosity", "it belongs to [flow]"),
    ({"numerics.Device": "cpu"}, "numerics.Device", "did you mean 'device'?"),
    ({"box.xyzzy": 1}, "box.xyzzy", "known here: size, boundary, volume_rule"),
    ({"fibers.0.shape": {"kind": "straight", "q": 1}}, "fibers.0.shape.q", "known here: kind"),
    ({"fibers.0.shape": {}}, "fibers.0.shape.kind", 'missing; give one of "straight"'),
    ({"titel": "x"}, "titel", "did you mean title?"),
    ({"shear_rate": 5}, "shear_rate", "move it below [flow]"),
    ({"fibres": [{}]}, "fibres", "did you mean [[fibers]]?"),
    ({"foo": {"a": 1}}, "foo", "unknown table; known:"),
    ({"fibers": cell_tables()["fibers"][0]}, "fibers", "write the heading [[fibers]]"),
    ({"flow": [cell_tables()["flow"]]}, "flow", "write the heading [flow]"),
    ({"numerics": [cell_tables()["numerics"]]}, "numerics", "write the heading [numerics]"),
    ({"fibers": []}, "fibers", "missing; add at least one [[fibers]]"),
    ({"stage": GONE}, "stage", "missing; add a [[stage]]"),
    ({"flow": GONE}, "flow", 'kind = "rest"'),
    ({"flow.viscosity": GONE}, "flow.viscosity", "missing; give a number > 0 in Pa s"),
    ({"flow.shear_rate": GONE}, "flow.shear_rate", "missing with kind = simple_shear"),
    ({"fibers.0.density": GONE}, "fibers.0.density", "missing; give a number > 0 in kg/m3"),
    ({"numerics.segments": GONE}, "numerics", "exactly one of segments, segment_length"),
    ({"stage.0.end_strain": GONE}, "stage.0", "at least one of end_strain, end_time"),
    ({"fibers.0.count": GONE}, "fibers.0", "exactly one of count, volume_fraction"),
    ({"fibers.0.aspect_ratio": GONE}, "fibers.0", "exactly one of aspect_ratio, length"),
    ({"fibers.0.volume_fraction": 0.1}, "fibers.0.volume_fraction", "given together with count"),
    ({"fibers.0.length": 2e-4}, "fibers.0.length", "given together with aspect_ratio"),
    ({"numerics.reduced_beads": 1}, "numerics.reduced_beads", "given together with segments"),
    ({"record.frames": 1, "record.every_time": 1}, "record.every_time", "together with frames"),
    ({"numerics.dt": "auto", "numerics.strain_step": 1}, "numerics.strain_step", "together with"),
]


@pytest.mark.parametrize(("changes", "key", "remedy"), KEYS)
def test_wrong_keys(changes: dict[str, object], key: str, remedy: str) -> None:
    """Unknown, misplaced, missing and doubled keys are told once, with the nearest known one."""
    faults = faults_of(changed(changes))
    assert [fault.key for fault in faults] == [key], [str(fault) for fault in faults]
    assert remedy in str(faults[0])


TOGETHER: list[tuple[dict[str, object], str, str]] = [
    # changes, key of the fault, a piece of the remedy
    ({"fibers.0.aspect_ratio": 1.5}, "fibers.0.aspect_ratio", "aspect ratio of 2 or more"),
    (
        {"fibers.0.aspect_ratio": GONE, "fibers.0.length": 5e-6},
        "fibers.0.length",
        "not longer than diameter",
    ),
    (
        {"fibers.0.aspect_ratio": GONE, "fibers.0.length": 200},
        "fibers.0.length",
        "powers of ten",
    ),
    (
        {"numerics.segments": GONE, "numerics.segment_length": 9e-6},
        "numerics.segment_length",
        "at least 1e-5",
    ),
    (
        {"numerics.segments": GONE, "numerics.reduced_beads": 19},
        "numerics.reduced_beads",
        "at most 18",
    ),
    ({"box.size": [7e-5, 5e-4, 5e-4]}, "box.size", "edge x is shorter than a segment"),
    ({"box.size": [5e-4, 5e-4, 5e-6]}, "fibers.0.diameter", "between the walls along z"),
    (
        {"fibers.0.orientation": "aligned", "fibers.0.direction": [0, 0, 2],
         "box.size": [5e-4, 5e-4, 1.5e-4]},
        "fibers.0.aspect_ratio",
        "between the walls along z",
    ),
    (
        {"fibers.0.orientation": "aligned", "box.size": [1.9e-4, 5e-4, 5e-4]},
        "fibers.0.aspect_ratio",
        "overlaps its own image",
    ),
    (
        {"box.boundary": ["periodic", "wall", "periodic"]},
        "box.boundary",
        "along the periodic axis z",
    ),
    (
        {"box.boundary": ["periodic", "open", "periodic"]},
        "box.boundary",
        "along the periodic axis z of a box with open axes",
    ),
    ({"fibers.0.count": 8000}, "fibers.0.count", "fill 1.01 of the box"),
    (
        {"fibers.0.count": GONE, "fibers.0.volume_fraction": 0.95},
        "fibers.0.volume_fraction",
        "stay below 0.9",
    ),
    (
        {"fibers.0.count": GONE, "fibers.0.volume_fraction": 0.1, "box.size": [5, 5, 5]},
        "fibers.0.volume_fraction",
        "check powers of ten",
    ),
    ({"contact.law": "none"}, "contact.lubrication", "switches off all pairs"),
    ({"fibers.0.position": [0, 0, 1e-4]}, "fibers.0.position", "one center per fiber"),
    (
        {"fibers.0.count": 1, "fibers.0.position": [0, 0, 1]},
        "fibers.0.position",
        "outside the box along z",
    ),
    (
        {"flow.kind": "gradient", "flow.gradient": [[1, 0, 0], [0, 0, 0], [0, 0, 0]], "box": GONE,
         "fibers.0.count": 1},
        "flow.gradient",
        "must be 0",
    ),
    (
        {"flow.kind": "gradient", "flow.gradient": [[0, 0, 0], [0, 0, 0], [0, 0, 0]],
         "contact.strength": 1},
        "flow.gradient",
        'use kind = "rest"',
    ),
    ({"stage.0.repeat": 2}, "stage.0.repeat", "needs repeat_from"),
    ({"stage.0.repeat_from": "flaw"}, "stage.0.repeat_from", 'known: "flow"'),
    ({"flow.kind": "rest", "contact.strength": 1}, "stage.0.end_strain", "end the stage by end_t"),
    (
        {"flow.kind": "rest", "stage": [{"kind": "flow", "end_time": 1}]},
        "contact.strength",
        "give N",
    ),
    ({"fibers.0.node_file": "nodes.txt", "fibers.0.count": GONE, "fibers.0.aspect_ratio": GONE},
     "fibers.0.node_file", ".npz or .csv"),
    ({"fibers.0.node_file": "no.npz", "fibers.0.count": GONE, "fibers.0.aspect_ratio": GONE},
     "fibers.0.node_file", "no such file"),
]  # fmt: skip


@pytest.mark.parametrize(("changes", "key", "remedy"), TOGETHER)
def test_values_that_do_not_go_together(changes: dict[str, object], key: str, remedy: str) -> None:
    """Rules between tables are one fault with the key to change."""
    tables = changed(changes)
    faults = faults_of(tables)
    assert [fault.key for fault in faults] == [key], [str(fault) for fault in faults]
    assert remedy in str(faults[0])


def test_volume_fraction_and_random_need_a_box() -> None:
    """Without a box there is no fraction of it and no random place in it."""
    gone: dict[str, object] = {"box": GONE, "fibers.0.position": "random"}
    gone |= {"fibers.0.count": GONE, "fibers.0.volume_fraction": 0.1}
    faults = faults_of(changed(gone))
    assert [f.key for f in faults] == ["fibers.0.volume_fraction", "fibers.0.position"]
    shared = faults_of(changed({"box": GONE}))
    assert [f.key for f in shared] == ["fibers.0.position"]
    assert "or a [box]" in str(shared[0])


def test_all_faults_come_together() -> None:
    """Faults of structure, value, key and sense in one list, one line each, exit code 2."""
    tables = changed(
        {
            "flow.viscosity": "100 Pa s",
            "fibers.0.lenght": 1e-3,
            "numerics.segments": 50,
            "numerics.device": "gpu",
            "box.boundary": ["periodic", "periodic"],
            "stage.0.end_strain": True,
            "nonsense": 1,
        }
    )
    with pytest.raises(SceneError) as caught:
        scene_from_dict(tables, "cell.toml")
    error = caught.value
    assert error.exit_code == 2
    assert {fault.key for fault in error.faults} == {
        "flow.viscosity",
        "fibers.0.lenght",
        "numerics.segments",
        "numerics.device",
        "box.boundary",
        "stage.0.end_strain",
        "nonsense",
    }
    assert len(str(error).splitlines()) == len(error.faults) == 7


def test_an_empty_scene_says_what_is_missing() -> None:
    """Nothing at all: the tables and keys to add."""
    keys = {fault.key for fault in faults_of({})}
    assert keys == {"numerics.method", "numerics", "fibers", "stage"}


def test_fault_lines() -> None:
    """A fault is one line; empty parts are left out, long values are cut."""
    assert str(Fault("a.toml", "k", 1e-6, "wrong; do")) == "a.toml: k = 1e-6: wrong; do"
    assert str(Fault("", "--out", "results/a", "exists")) == '--out = "results/a": exists'
    assert str(Fault("a.toml", "", None, "no such file")) == "a.toml: no such file"
    assert len(str(Fault("a", "k", list(range(1000)), "r"))) < 80

"""[[load]] tables and frozen groups: what is read, refused with advice, or without effect."""

from __future__ import annotations

from typing import Any

import pytest

from tests.scene_text import GONE, changed, faults_of
from warpfiber.scene import scene_from_dict

PUSH = [0.0, 0.0, 1e-6]
FREE: dict[str, object] = {
    "numerics.method": "overdamped",
    "contact.law": "none",
    "contact.lubrication": GONE,
    "box": GONE,
    "fibers.0.position": [[0, 0, 0]],
}


def tables(*loads: dict[str, Any], **changes: object) -> dict[str, Any]:
    """Tables of ten fibers of three segments with these loads; `a__b=1` changes the key a.b."""
    keys = {key.replace("__", "."): value for key, value in changes.items()}
    return changed({**FREE, "load": list(loads), **keys})


def test_loads_are_read() -> None:
    """Defaults: group 0, fiber 0, the last node, free; the record gives the same scene."""
    scene = scene_from_dict(
        tables({"force": PUSH}, {"fiber": -1, "node": 0, "hold": "clamp", "velocity": [1, 0, 0]})
    )
    first, second = scene.loads
    assert (first.group, first.fiber, first.node, first.hold) == (0, 0, -1, "free")
    assert first.force == (0.0, 0.0, 1e-6) and first.velocity is None
    assert (second.fiber, second.node, second.hold) == (-1, 0, "clamp")
    assert second.velocity == (1.0, 0.0, 0.0)
    assert scene_from_dict(scene.as_dict()) == scene
    assert scene.hash != scene_from_dict(tables({"force": PUSH})).hash


FAULTS: list[tuple[list[dict[str, Any]], str, str]] = [
    ([{"group": 1, "force": PUSH}], "load.0.group", "no such group; there are 1"),
    ([{"group": -1, "force": PUSH}], "load.0.group", "no such group"),
    ([{"fiber": 10, "force": PUSH}], "load.0.fiber", "10 in fibers.0; give 0 ... 9"),
    ([{"fiber": -11, "force": PUSH}], "load.0.fiber", "out of range"),
    ([{"node": 4, "force": PUSH}], "load.0.node", "4 in fibers.0 per fiber; give 0 ... 3"),
    ([{"node": 4, "hold": "clamp"}], "load.0.node", "out of range"),
    ([{}], "load.0", "does nothing"),
    ([{"velocity": [1, 0, 0]}], "load.0.velocity", 'add hold = "position" or "clamp"'),
    ([{"hold": "position", "force": PUSH}], "load.0.force", "feels no force"),
    ([{"hold": "clamp", "force": PUSH}], "load.0.force", "feels no force"),
    ([{"hold": "fixed"}], "load.0.hold", "allowed: free, position, clamp"),
    ([{"force": [1, 2]}], "load.0.force", "2 entries instead of 3"),
    ([{"force": PUSH}, {"node": 3, "force": PUSH}], "load.1", "load.0 is on this node already"),
    ([{"node": 2, "hold": "clamp"}, {"hold": "position"}], "load.1", "load.0 is on this node"),
    ([{"fiber": 9, "node": 2, "hold": "clamp"}, {"fiber": -1, "force": PUSH}], "load.1", "keep"),
]


@pytest.mark.parametrize(("loads", "key", "advice"), FAULTS)
def test_faults_of_loads(loads: list[dict[str, Any]], key: str, advice: str) -> None:
    faults = faults_of(tables(*loads))
    assert [fault.key for fault in faults] == [key], [str(fault) for fault in faults]
    assert advice in faults[0].remedy


def test_two_held_points_of_what_cannot_stretch() -> None:
    rows = [{"node": 0, "hold": "position"}, {"hold": "position"}]
    scene_from_dict(tables(*rows))
    faults = faults_of(tables(*rows, fibers__0__inextensible=True))
    assert [fault.key for fault in faults] == ["load.1.hold"]
    assert "use inextensible = false" in faults[0].remedy
    rows[1]["fiber"] = 1
    scene_from_dict(tables(*rows, fibers__0__inextensible=True))


def test_frozen_groups() -> None:
    """At rest, or moved as a whole; fiber and node have no effect, density is not needed."""
    changes: dict[str, object] = {"fibers__0__frozen": True, "fibers__0__density": GONE}
    scene = scene_from_dict(tables(gravity={}, **changes))
    assert scene.fibers[0].frozen and scene.loads == ()
    moved = scene_from_dict(tables({"velocity": [1, 0, 0], "node": 99}, **changes))
    assert moved.loads[0].velocity == (1.0, 0.0, 0.0)
    assert any("load.0.node has no effect" in note for note in moved.notes)
    for rows, key, advice in (
        ([{"force": PUSH}], "load.0.force", "is frozen and feels no force"),
        ([{"hold": "position"}], "load.0.velocity", "is frozen: give m/s"),
        ([{"velocity": [1, 0, 0]}, {"velocity": [2, 0, 0]}], "load.1", "on this group already"),
    ):
        faults = faults_of(tables(*rows, **changes))
        assert [fault.key for fault in faults] == [key], [str(fault) for fault in faults]
        assert advice in faults[0].remedy


@pytest.mark.parametrize(
    ("changes", "key"),
    [({"load": [{"force": PUSH}]}, "load"), ({"fibers.0.frozen": True}, "fibers.0.frozen")],
)
def test_methods_without_loads(changes: dict[str, object], key: str) -> None:
    faults = faults_of(changed(changes))
    assert [fault.key for fault in faults] == [key], [str(fault) for fault in faults]
    assert 'not available in method bead_chain; use method = "overdamped"' in faults[0].remedy


RODS: dict[str, Any] = {"numerics__method": "rigid_rod", "numerics__segments": GONE}


def test_rods_take_forces_alone() -> None:
    """On their two nodes; what would hold them is refused."""
    scene = scene_from_dict(tables({"force": PUSH}, {"node": 0, "force": PUSH}, **RODS))
    assert [load.node for load in scene.loads] == [-1, 0]
    for row, key, advice in (
        ({"hold": "clamp"}, "load.0.hold", "not available in method rigid_rod; use method"),
        ({"velocity": [1, 0, 0]}, "load.0.velocity", "give force in N"),
        ({}, "load.0", "does nothing; give force in N"),
        ({"node": 2, "force": PUSH}, "load.0.node", "2 in fibers.0 per fiber; give 0 ... 1"),
    ):
        faults = faults_of(tables(row, **RODS))
        assert [fault.key for fault in faults] == [key], [str(fault) for fault in faults]
        assert advice in faults[0].remedy and "position" not in faults[0].remedy
    faults = faults_of(tables(**RODS, fibers__0__frozen=True))
    assert [fault.key for fault in faults] == ["fibers.0.frozen"]

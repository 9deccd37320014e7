"""Rules of [[load]] tables and frozen groups: what is loaded exists, and one thing acts on it.

Limits: fibers of a node file are counted when they are placed.
"""

from __future__ import annotations

from warpfiber.scene.draft import Draft
from warpfiber.scene.keys import Values

LOADED_METHODS = ("overdamped", "rigid_rod", "bonded_spheres")
"""Methods that know forces on nodes."""
HOLDING_METHODS = ("overdamped", "bonded_spheres")
"""Methods that know held nodes and frozen fibers too."""
ADVICE = 'use method = "overdamped", without a fluid "bonded_spheres"'


def check_loads(draft: Draft) -> None:
    """Run all rules; faults and notes go to the draft's list."""
    refusal = f"not available in method {draft.method}; {ADVICE}, or remove it"
    if draft.method not in HOLDING_METHODS and draft.method is not None:
        for index, group in enumerate(draft.fibers):
            if group["frozen"]:
                draft.blame(f"fibers.{index}.frozen", refusal)
        for index, load in enumerate(draft.loads):
            if draft.method in LOADED_METHODS and load["hold"] not in ("free", None):
                draft.blame(f"load.{index}.hold", refusal)
    if draft.method not in LOADED_METHODS and draft.method is not None:
        if draft.loads:
            draft.faults.add("load", None, refusal)
        return
    taken: dict[tuple[int, int, int], int] = {}
    for index, load in enumerate(draft.loads):
        path = f"load.{index}"
        if draft.faulty(path):
            continue
        if not 0 <= load["group"] < len(draft.fibers):
            if draft.fibers:
                count = len(draft.fibers)
                remedy = f"no such group; there are {count}, counted from 0 in their order"
                draft.faults.add(f"{path}.group", load["group"], remedy)
            continue
        group = draft.fibers[load["group"]]
        if group["frozen"]:
            _check_frozen(draft, load, path)
        else:
            _check_action(draft, load, path)
        if group["frozen"] or _in_range(draft, group, load, path):
            for node in _nodes(group, load):
                other = taken.setdefault(node, index)
                if other != index:
                    what = "node" if node[2] >= 0 else "group"
                    remedy = f"load.{other} is on this {what} already; keep one of them"
                    draft.faults.add(path, None, remedy)
                    break
    _check_inextensible(draft)


def _check_action(draft: Draft, load: Values, path: str) -> None:
    """A free node has a force and no given motion, a held one the reverse."""
    held = load["hold"] != "free"
    if held and load["force"] is not None:
        remedy = f'a node with hold = "{load["hold"]}" feels no force; remove force or hold'
        draft.blame(f"{path}.force", remedy)
    elif not held and load["velocity"] is not None:
        remedy = 'a free node has no given velocity; add hold = "position" or "clamp"'
        if draft.method not in HOLDING_METHODS:
            remedy = "a free node has no given velocity; give force in N"
        draft.blame(f"{path}.velocity", remedy)
    elif not held and load["force"] is None:
        held_too = ', or hold = "position"' if draft.method in HOLDING_METHODS else ""
        draft.faults.add(path, None, f"does nothing; give force in N{held_too}")


def _check_frozen(draft: Draft, load: Values, path: str) -> None:
    """A frozen group has a velocity only; all its fibers move together."""
    if load["force"] is not None:
        remedy = f"fibers.{load['group']} is frozen and feels no force; give velocity"
        draft.blame(f"{path}.force", remedy)
    elif load["velocity"] is None:
        remedy = f"missing; fibers.{load['group']} is frozen: give m/s, or remove the table"
        draft.faults.add(f"{path}.velocity", None, remedy)
    for key in ("fiber", "node", "hold"):
        if draft.is_given(f"{path}.{key}"):
            draft.note(f"{path}.{key} has no effect; a frozen group moves as a whole")


def _in_range(draft: Draft, group: Values, load: Values, path: str) -> bool:
    """Tell whether fiber and node exist, as far as the scene shows; blame what does not."""
    counts = {"fiber": group["count"], "node": (group["segments"] or -1) + 1}
    good = True
    for key, count in counts.items():
        if count and not -count <= load[key] < count:
            whose = f"fibers.{load['group']}" + (" per fiber" if key == "node" else "")
            remedy = f"out of range: {count} in {whose}; give 0 ... {count - 1}, or -1 the last"
            draft.faults.add(f"{path}.{key}", load[key], remedy)
            good = False
    return good and all(counts.values())


def _nodes(group: Values, load: Values) -> list[tuple[int, int, int]]:
    """(group, fiber, node) that a load is about; (group, -1, -1) of a frozen group."""
    if group["frozen"]:
        return [(load["group"], -1, -1)]
    last = group["segments"]
    fiber, node = load["fiber"] % group["count"], load["node"] % (last + 1)
    begin = min(node, last - 1) if load["hold"] == "clamp" else node
    end = begin + (2 if load["hold"] == "clamp" else 1)
    return [(load["group"], fiber, at) for at in range(begin, end)]


def _check_inextensible(draft: Draft) -> None:
    """Two held points of a straight fiber that cannot stretch: its tension has no value."""
    held: dict[tuple[int, int], int] = {}
    for index, load in enumerate(draft.loads):
        if load["hold"] == "free" or draft.faulty(f"load.{index}"):
            continue
        group = draft.fibers[load["group"]]
        if not group["inextensible"] or group["frozen"] or group["node_file"] is not None:
            continue
        fiber = (load["group"], load["fiber"] % (group["count"] or 1))
        other = held.setdefault(fiber, index)
        if other != index:
            remedy = f"load.{other} holds this straight fiber too, and it cannot stretch;"
            draft.blame(f"load.{index}.hold", f"{remedy} use inextensible = false")

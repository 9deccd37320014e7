"""[[wall]] with kind = "plane": a wall of the box that is altered, or another plane in the box.

Either may have a friction of its own and a `velocity` in the plane, as that of a belt. Walls of the
box move along their normal as stages say, other planes keep their place. A container may have its
own friction too; all others: `contact.wall_friction`.
Symbols: faces of the walls x-, x+, y- ..., of the container and of other planes: friction, velocity
    (m/s).
Limits: method bonded_spheres. Other planes have no ends; they stand across no periodic axis.
"""

from __future__ import annotations

from warpfiber.scene.containers import CYLINDER
from warpfiber.scene.draft import Draft
from warpfiber.scene.keys import Values
from warpfiber.scene.pressing import WALL_NAMES
from warpfiber.scene.scene import Scene
from warpfiber.scene.tables import Wall

PLANE = "plane"
UPRIGHT = 1e-9  # rounding of a direction
Face = tuple[float, float, float, float]


def wall_faces(scene: Scene) -> list[Face]:
    """Friction and velocity (m/s) of the walls x-, x+, y- ..., of a container, of other planes."""
    others = [wall.name for wall in free_planes(scene)]
    places = [*WALL_NAMES, CYLINDER, *others]
    faces = [(scene.contact.wall_friction, 0.0, 0.0, 0.0)] * len(places)
    for wall in scene.walls:
        if wall.kind not in (PLANE, CYLINDER):
            continue
        side = places.index(CYLINDER if wall.kind == CYLINDER else wall.name)
        friction = faces[side][0] if wall.friction is None else wall.friction
        x, y, z = wall.velocity if isinstance(wall.velocity, tuple) else (0.0, 0.0, 0.0)
        faces[side] = (friction, x, y, z)
    return faces


def present_faces(scene: Scene) -> list[Face]:
    """Those of the walls that the scene has."""
    boundary = scene.box.boundary if scene.box is not None else ("open",) * 3
    here = [boundary[side // 2] == "wall" for side in range(len(WALL_NAMES))]
    here.append(any(wall.kind == CYLINDER for wall in scene.walls))
    here += [True] * len(free_planes(scene))
    return [face for face, present in zip(wall_faces(scene), here, strict=True) if present]


def free_planes(scene: Scene) -> list[Wall]:
    """Planes that are no walls of the box."""
    return [wall for wall in scene.walls if wall.kind == PLANE and wall.name not in WALL_NAMES]


def rubs(scene: Scene) -> bool:
    """Whether some wall has friction."""
    return any(face[0] > 0.0 for face in present_faces(scene))


def slides(scene: Scene) -> bool:
    """Whether some wall with friction moves in its plane."""
    return any(face[0] > 0.0 and any(face[1:]) for face in present_faces(scene))


def check_planes(draft: Draft) -> None:
    """Run all rules; faults and notes go to the draft's list."""
    taken: dict[str, int] = {}
    for index, wall in enumerate(draft.walls):
        path = f"wall.{index}"
        if draft.faulty(path) or wall["kind"] != PLANE:
            continue
        if draft.method not in (None, "bonded_spheres"):
            remedy = f'planes of method {draft.method} come from box.boundary = "wall" alone'
            draft.faults.add(f"{path}.kind", None, f"{remedy}; remove the table")
            continue
        other = taken.setdefault(wall["name"], index)
        if other != index:
            draft.blame(f"{path}.name", f"wall.{other} has this name already; keep one of them")
            continue
        if wall["name"] in WALL_NAMES:
            _check_wall_of_box(draft, wall, path)
        elif wall["name"] == CYLINDER:
            draft.blame(f"{path}.name", "the name of a kind; give another one")
        else:
            _check_free(draft, wall, path)
        if wall["velocity"] == "flow":
            draft.blame(f"{path}.velocity", "nothing flows in this method; give a velocity in m/s")
        friction = wall["friction"]
        friction = draft.contact["wall_friction"] if friction is None else friction
        if isinstance(wall["velocity"], tuple) and any(wall["velocity"]) and friction == 0.0:
            draft.note(f"{path}.velocity has no effect; the wall is frictionless")


def _check_free(draft: Draft, wall: Values, path: str) -> None:
    """It has a place, goes through the box as through its images, and slides along itself."""
    for key in ("normal", "position"):
        if wall[key] is None:
            known = ", ".join(WALL_NAMES)
            remedy = f"a plane that is no wall of the box ({known}) needs it; add it"
            draft.faults.add(f"{path}.{key}", None, remedy)
    normal = wall["normal"]
    if normal is None:
        return
    if draft.box is None and draft.start is None:
        draft.faults.add(path, None, "a plane stands in a [box]; add one around it")
    for axis, _ in draft.axes("periodic"):
        if abs(normal[axis]) > UPRIGHT:
            remedy = f"stands across the periodic axis {'xyz'[axis]}; turn it, or make that open"
            draft.blame(f"{path}.normal", remedy)
            return
    velocity = wall["velocity"]
    if isinstance(velocity, tuple):
        away = sum(v * n for v, n in zip(velocity, normal, strict=True))
        if abs(away) > UPRIGHT * max(abs(v) for v in velocity):
            draft.blame(f"{path}.velocity", "moves in its plane alone; make it normal to `normal`")
    if normal[2] < -UPRIGHT and any(stage["kind"] == "pour" for stage in draft.stages):
        remedy = "fibers are poured from above the box, where this plane lets none in"
        draft.blame(f"{path}.normal", f"{remedy}; settle them instead")


def _check_wall_of_box(draft: Draft, wall: Values, path: str) -> None:
    """It stands for a wall of the box and moves in its plane."""
    walled = [axis for axis, _ in draft.axes("wall")]
    known = [name for k, name in enumerate(WALL_NAMES) if k // 2 in walled]
    if wall["name"] not in known:
        remedy = 'no box.boundary is "wall"' if not known else f"walls are {' '.join(known)}"
        if draft.box is not None and not draft.faulty("box"):
            draft.blame(f"{path}.name", f"a plane alters a wall of the box; {remedy}")
        return
    for key in ("normal", "position"):
        if wall[key] is not None:
            draft.blame(f"{path}.{key}", "remove it; a wall of the box has its place by box.size")
    axis = WALL_NAMES.index(wall["name"]) // 2
    if isinstance(wall["velocity"], tuple) and wall["velocity"][axis] != 0.0:
        remedy = f"moves in its plane alone: {'xyz'[axis]} is 0; stages move walls along it"
        draft.blame(f"{path}.velocity", remedy)

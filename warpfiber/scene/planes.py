"""[[wall]] with kind = "plane": a wall of the box with a friction or a sliding motion of its own.

A plane keeps its place, or moves along its normal as stages say; `velocity` lies in the plane, as
that of a belt. A container may have its own friction too; all others: `contact.wall_friction`.
Symbols: faces of the walls x-, x+, y- ... and of the container: friction, and velocity (m/s).
Limits: planes of the box of method bonded_spheres, no other ones.
"""

from __future__ import annotations

from warpfiber.scene.containers import CYLINDER
from warpfiber.scene.draft import Draft
from warpfiber.scene.keys import Values
from warpfiber.scene.pressing import WALL_NAMES
from warpfiber.scene.scene import Scene

PLANE = "plane"
Face = tuple[float, float, float, float]


def wall_faces(scene: Scene) -> list[Face]:
    """Friction and velocity (m/s) of the walls x-, x+, y- ... and of the container, if any."""
    faces = [(scene.contact.wall_friction, 0.0, 0.0, 0.0)] * (len(WALL_NAMES) + 1)
    for wall in scene.walls:
        if wall.kind not in (PLANE, CYLINDER):
            continue
        side = len(WALL_NAMES) if wall.kind == CYLINDER else WALL_NAMES.index(wall.name)
        friction = faces[side][0] if wall.friction is None else wall.friction
        x, y, z = wall.velocity if isinstance(wall.velocity, tuple) else (0.0, 0.0, 0.0)
        faces[side] = (friction, x, y, z)
    return faces


def present_faces(scene: Scene) -> list[Face]:
    """Those of the walls that the scene has."""
    boundary = scene.box.boundary if scene.box is not None else ("open",) * 3
    here = [boundary[side // 2] == "wall" for side in range(len(WALL_NAMES))]
    here.append(any(wall.kind == CYLINDER for wall in scene.walls))
    return [face for face, present in zip(wall_faces(scene), here, strict=True) if present]


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
        _check_plane(draft, wall, path)


def _check_plane(draft: Draft, wall: Values, path: str) -> None:
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
    if wall["velocity"] == "flow":
        draft.blame(f"{path}.velocity", "nothing flows in this method; give a velocity in m/s")
        return
    axis = WALL_NAMES.index(wall["name"]) // 2
    if wall["velocity"] is not None and wall["velocity"][axis] != 0.0:
        remedy = f"moves in its plane alone: {'xyz'[axis]} is 0; stages move walls along it"
        draft.blame(f"{path}.velocity", remedy)
    friction = wall["friction"]
    friction = draft.contact["wall_friction"] if friction is None else friction
    if wall["velocity"] is not None and any(wall["velocity"]) and friction == 0.0:
        draft.note(f"{path}.velocity has no effect; the wall is frictionless")

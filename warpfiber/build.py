"""Scene -> (Model, State): place the fibers, choose the run's units, allocate on the device.

Units: length = radius of the first group, time = 1 / rate of the flow (without a rate: the time in
which drag stops a bead; without a fluid: in which sound passes a radius), force = eta rate a^2
(without a fluid: m a / time^2).
"""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import numpy as np
import warp as wp

from warpfiber.laws.closure import galerkin_entries, galerkin_inverse_pivots
from warpfiber.model import (
    STATUS_SIZE,
    Domain,
    Model,
    Precision,
    State,
    Units,
    precision,
)
from warpfiber.passes.kernel_module import FUSED, foresee_modules
from warpfiber.passes.precision import group_struct
from warpfiber.placement import Placement, place_fibers, split_tables
from warpfiber.placement.bend import BENT, largest_bend
from warpfiber.scene import FiberGroup, Scene
from warpfiber.scene.arrays import wall_arrays
from warpfiber.scene.derived import INERTIALESS


def choose_units(scene: Scene) -> Units:
    """Scales that bring radii, rates and drag forces of the scene to about one."""
    group = scene.fibers[0]
    a = group.radius
    mass = 4.0 / 3.0 * math.pi * a**3 * (group.density or 1.0)
    eta = scene.flow.viscosity if scene.flow else 0.0
    rate = scene.flow.rate if scene.flow else 0.0
    if rate == 0.0 and eta > 0.0:
        rate = 6.0 * math.pi * eta * a / mass
    elif rate == 0.0:
        rate = math.sqrt(group.youngs_modulus / (group.density or 1.0)) / a
    force = eta * rate * a * a if eta > 0.0 else mass * a * rate * rate
    return Units(length=a, time=1.0 / rate, force=force)


def _group_row(scene: Scene, group: FiberGroup, units: Units) -> dict[str, Any]:
    """Constants of one group in run units (see `model.group_struct`)."""
    a_si, m = group.radius, group.bead_spacing
    stress = units.force / units.length**2
    a = a_si / units.length
    eta = (scene.flow.viscosity if scene.flow else 0.0) / (stress * units.time)
    bead = 4.0 / 3.0 * math.pi * a_si**3
    density = group.density or 0.0
    gravity = np.zeros(3)
    if scene.gravity is not None:
        weight = bead * (density - scene.gravity.fluid_density)
        gravity = weight * np.asarray(scene.gravity.acceleration) / units.force
    reduced = m - 1.0
    has_inertia = scene.numerics.method not in INERTIALESS
    keeps_length = group.inextensible or scene.numerics.method == "rigid_rod"
    stretching = math.pi * a * (group.axial_modulus / stress) / (2.0 * m)
    inner = max(1, round(reduced)) if reduced > 1e-9 else 0
    return {
        "radius": a,
        "rest": 2.0 * a * m,
        "spacing": m,
        "stretching": stretching,
        "compliance": 0.0 if keeps_length else 1.0 / stretching,
        "bending": math.pi * a**3 * (group.bending_modulus / stress) / (8.0 * m),
        "mass": bead * density / units.mass if has_inertia else 0.0,
        "drag": 6.0 * math.pi * eta * a,
        "torque": 8.0 * math.pi * eta * a**3,
        "weight": m,
        "weight_excess": 0.5 if scene.numerics.torque_weights == "end_weighted" else 0.0,
        "body_force": gravity,
        "coupling": galerkin_entries(m)[2],
        "segments": group.segments - (group.shape.kind == "ring"),  # the closing one is not listed
        "inner_beads": inner,
        "bead_weight": reduced / inner if inner else 0.0,
    }


def _domain(scene: Scene, placement: Placement, units: Units) -> Domain:
    nodes = placement.node_pos / units.length
    low = nodes.min(axis=0) - 1.0
    size = nodes.max(axis=0) + 1.0 - low
    if scene.box is None:
        return Domain(tuple(low), tuple(size), (False,) * 3, (False,) * 3)
    periodic = tuple(kind == "periodic" for kind in scene.box.boundary)
    wall = tuple(kind == "wall" for kind in scene.box.boundary)
    edges = tuple(edge / units.length for edge in scene.box.size)
    flow = scene.flow
    moving = all(periodic) and flow is not None and flow.rate > 0.0
    shear_axes = None
    if moving and flow is not None and flow.velocity_gradient is not None:
        entries = np.argwhere(np.asarray(flow.velocity_gradient) != 0.0)
        if len(entries) == 1 and entries[0][0] != entries[0][1]:
            shear_axes = (int(entries[0][0]), int(entries[0][1]))
    arrays = tuple((w / units.length, r / units.length) for w, r in wall_arrays(scene))
    return Domain((0.0, 0.0, 0.0), edges, periodic, wall, moving, shear_axes, arrays)  # type: ignore[arg-type]


def device_groups(rows: list[dict[str, Any]], p: Precision, device: str) -> tuple[Any, Any]:
    """Group structs and the Thomas pivots they point into."""
    Group = group_struct(p.name)
    structs: list[Any] = []
    pivots: list[float] = []
    for row in rows:
        struct = Group()
        row["pivot_start"] = len(pivots)
        for key in Group.vars:
            if key == "body_force":
                struct.body_force = p.vec3(*row[key])
            else:
                setattr(struct, key, row[key])
        pivots += galerkin_inverse_pivots(row["spacing"], row["segments"])
        structs.append(struct)
    return (
        wp.array(structs, dtype=Group, device=device),
        wp.array(np.asarray(pivots, dtype=p.numpy), dtype=p.real, device=device),
    )


def initial_velocity(scene: Scene, placement: Placement) -> np.ndarray:
    """(N, 3) m/s at the start: the flow at every node, rest, or a given vector per group."""
    velocity = np.zeros_like(placement.node_pos)
    counts = np.diff(placement.fiber_node_start)
    node_group = np.repeat(placement.fiber_group, counts)
    for index, group in enumerate(scene.fibers):
        mine = node_group == index
        kind = group.initial_velocity
        if isinstance(kind, str):
            if kind == "flow" and scene.flow is not None:
                gradient = scene.flow.factor(0.0) * np.asarray(scene.flow.velocity_gradient)
                away = placement.node_pos[mine] - np.asarray(scene.flow.origin)
                velocity[mine] = away @ gradient.T
        elif kind is not None:
            velocity[mine] = np.asarray(kind)
    return velocity


def realized_scene(scene: Scene, placement: Placement) -> Scene:
    """The scene with the sizes of groups whose nodes came from a file.

    M follows from the mean segment length, N_seg from the nodes per fiber.
    """
    groups = list(scene.fibers)
    start = np.asarray(placement.fiber_node_start)
    for index, group in enumerate(groups):
        if group.node_file is None:
            continue
        mine = np.flatnonzero(np.asarray(placement.fiber_group) == index)
        segments = int(start[mine[0] + 1] - start[mine[0]]) - 1
        nodes = placement.node_pos[start[mine[0]] : start[mine[-1] + 1]]
        edges = np.diff(nodes.reshape(len(mine), segments + 1, 3), axis=1)
        centerline = float(np.linalg.norm(edges, axis=2).sum(axis=1).mean())
        groups[index] = dataclasses.replace(
            group,
            count=len(mine),
            segments=segments,
            centerline_length=centerline,
            length=centerline + group.diameter,
            aspect_ratio=centerline / group.diameter + 1.0,
        )
    return dataclasses.replace(scene, fibers=tuple(groups))


def _closing_segments(scene: Scene) -> np.ndarray:
    """(G,) segments that close the fibers of a group and may meet others."""
    meets = scene.contact.law != "none"
    closed = [meets and g.shape.kind == "ring" and g.node_file is None for g in scene.fibers]
    return np.asarray(closed, dtype=np.int32)


def foresee_kernels(scene: Scene, device: str) -> None:
    """Begin to compile for a scene whose fibers are still to be placed, where all is to be done."""
    if device.startswith("cpu"):
        foresee_modules(*([FUSED] if scene.numerics.method == "bonded_spheres" else []))


def build(
    scene: Scene, device: str, placement: Placement | None = None
) -> tuple[Model, State, dict[str, Any]]:
    """Model and state of a scene on `device`, and the report of the placement."""
    scene = split_tables(scene)
    placement = placement or place_fibers(scene)
    p = precision(scene.numerics.precision)
    units = choose_units(scene)
    domain = _domain(scene, placement, units)
    rows = [_group_row(scene, group, units) for group in scene.fibers]
    groups, pivots = device_groups(rows, p, device)
    start = np.asarray(placement.fiber_node_start, dtype=np.int32)
    fiber_count, node_count = len(start) - 1, int(start[-1])
    closed = _closing_segments(scene)[np.asarray(placement.fiber_group)]
    counts = np.diff(start) - 1 + closed
    segment_start = np.concatenate([[0], np.cumsum(counts)]).astype(np.int32)
    segment_fiber = np.repeat(np.arange(fiber_count, dtype=np.int32), counts)
    at = np.arange(len(segment_fiber)) - segment_start[segment_fiber]
    segment_node = (start[segment_fiber] + at).astype(np.int32)
    closing = segment_node + 1 == start[segment_fiber + 1]
    segment_end = np.where(closing, start[segment_fiber], segment_node + 1).astype(np.int32)
    host = {
        "fiber_node_start": start,
        "fiber_group": np.asarray(placement.fiber_group, dtype=np.int32),
        "segment_fiber": segment_fiber,
        "segment_node": segment_node,
        "segment_end": segment_end,
    }

    def put(values: np.ndarray, dtype: Any) -> Any:
        return wp.array(values, dtype=dtype, device=device)

    model = Model(
        precision=p,
        device=device,
        units=units,
        domain=domain,
        group_rows=rows,
        groups=groups,
        pivots=pivots,
        fiber_node_start=put(start, wp.int32),
        fiber_group=put(host["fiber_group"], wp.int32),
        segment_node=put(segment_node, wp.int32),
        segment_end=put(segment_end if closed.any() else segment_end[:0], wp.int32),
        segment_fiber=put(segment_fiber, wp.int32),
        fiber_segment_start=put(segment_start, wp.int32),
        fiber_count=fiber_count,
        node_count=node_count,
        segment_count=len(segment_fiber),
        starts_bent=_starts_bent(scene, placement),
        host=host,
    )
    state = make_state(model)
    state.node_pos.assign((placement.node_pos / units.length).astype(p.numpy))
    velocity = initial_velocity(scene, placement) / units.velocity
    state.node_velocity.assign(velocity.astype(p.numpy))
    state.list_pos.assign(state.node_pos)
    return model, state, placement.report


def _starts_bent(scene: Scene, placement: Placement) -> bool:
    if placement.starts_bent is not None:
        return placement.starts_bent
    bend = largest_bend(placement.node_pos, placement.fiber_node_start)
    return bend > BENT * min(group.radius for group in scene.fibers)


def make_state(model: Model) -> State:
    """Allocate a state at rest with the undeformed lattice."""
    p, device = model.precision, model.device

    def zeros(count: int, dtype: Any) -> Any:
        return wp.zeros(count, dtype=dtype, device=device)

    lattice = np.diag(np.asarray(model.domain.size))
    return State(
        node_pos=zeros(model.node_count, p.vec3),
        node_velocity=zeros(model.node_count, p.vec3),
        node_force=zeros(model.node_count, p.vec3),
        fiber_image=zeros(model.fiber_count, wp.vec3i),
        status=zeros(STATUS_SIZE, wp.int32),
        step=zeros(1, wp.int64),
        time=zeros(1, wp.float64),
        strain=zeros(1, wp.float64),
        lattice=wp.array([lattice], dtype=wp.mat33d, device=device),
        deformation=wp.array([np.eye(3)], dtype=wp.mat33d, device=device),
        gradient=zeros(1, p.mat33),
        lattice_now=wp.array([lattice.astype(p.numpy)], dtype=p.mat33, device=device),
        list_pos=zeros(model.node_count, p.vec3),
        list_lattice=wp.array([lattice], dtype=wp.mat33d, device=device),
    )

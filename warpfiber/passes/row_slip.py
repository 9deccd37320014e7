"""Friction of contact rows: how far surfaces would slip without contact, forces of the last step.

A row beside its normal force has a tangential one on its partner, in the plane of the contact. One
thread owns a segment and its rows, as in `row_fill`.

Source: law `surface_slip`, with the geometry at the start of the step and the motion of the step
    without contact, of an image with that of its box vector. A fiber has no unknown for the angle
    about its axis: without contact the fluid turns it by dt Omega.p, averaged over its beads, which
    is the balance of their torques; contact adds a turn against 8 pi eta a^3 of each. Walls, arrays
    too, move in their planes as the fluid does at them.
Symbols: Omega spin of the flow, mean of both stages of the step; slip (R) vec3 of the partner over
    the owner, its part along the normal without meaning.
Limits: a fiber turns about its axis as one, stiff in torsion and free of memory; frozen ones do
    not. First order in dt.
"""

from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
import warp as wp

from warpfiber.laws.flow import make_flow
from warpfiber.laws.surface_slip import make_surface_slip
from warpfiber.model import HALT, Model, precision
from warpfiber.passes.array_rows import KEY as ARRAY_KEY
from warpfiber.passes.executor import Launch
from warpfiber.passes.pairs import PairFeatures, make_pair_geometry
from warpfiber.passes.precision import group_struct


@dataclass(frozen=True)
class Friction:
    """Coefficients between fibers and on walls, and the flow of the step."""

    fibers: float
    walls: float
    stage_gradient: Any  # (2,) mat33
    flow_origin: np.ndarray
    fiber_frozen: Any = None  # (F,) uint8


@cache
def make_row_slip(name: str, periodic: bool, has_frozen: bool, module: str = "unique"):
    """`carry_friction`, `free_spin`, `fill_slip`, by name; a thread per segment, fiber, segment."""
    p = precision(name)
    real, vec3, mat33 = p.real, p.vec3, p.mat33
    Group = group_struct(name)
    flow_velocity, flow_spin = make_flow(name)
    surface_turn, surface_roll, _ = make_surface_slip(name)
    _, image_shift, _, _ = make_pair_geometry(name, PairFeatures(periodic=periodic))
    zero, half = real(0.0), real(0.5)
    options = {"module": module, "enable_backward": False, "grid_stride": False}

    @wp.kernel(**options)
    def carry_friction(
        offset: wp.int32,
        row_out_start: wp.array(dtype=wp.int32),
        row_friction: wp.array(dtype=vec3),
        status: wp.array(dtype=wp.int32),
        carried_friction_out: wp.array(dtype=vec3),
    ):
        if status[wp.static(HALT)] != 0:
            return
        i = wp.tid() + offset
        for r in range(row_out_start[i], row_out_start[i + 1]):
            carried_friction_out[r] = row_friction[r]

    @wp.kernel(**options)
    def free_spin(
        offset: wp.int32,
        step_size: wp.array(dtype=wp.float64),
        stage_gradient: wp.array(dtype=mat33),
        groups: wp.array(dtype=Group),
        fiber_node_start: wp.array(dtype=wp.int32),
        fiber_group: wp.array(dtype=wp.int32),
        fiber_frozen: wp.array(dtype=wp.uint8),
        node_back: wp.array(dtype=vec3),
        status: wp.array(dtype=wp.int32),
        fiber_spin_out: wp.array(dtype=real),
    ):
        """Angle that the fluid turns a fiber about its axis."""
        if status[wp.static(HALT)] != 0:
            return
        fiber = wp.tid() + offset
        if wp.static(has_frozen):
            if fiber_frozen[fiber] != wp.uint8(0):
                fiber_spin_out[fiber] = zero
                return
        g = groups[fiber_group[fiber]]
        first = fiber_node_start[fiber]
        axis = vec3()
        beads = zero
        for k in range(g.segments):
            weight = g.weight
            if k == 0:
                weight += g.weight_excess
            if k == g.segments - 1:
                weight += g.weight_excess
            axis += weight * wp.normalize(node_back[first + k + 1] - node_back[first + k])
            beads += weight
        spin = flow_spin(stage_gradient[0]) + flow_spin(stage_gradient[1])
        turned = half * real(step_size[0]) * wp.dot(spin, axis)
        fiber_spin_out[fiber] = turned / beads

    @wp.func
    def wall_motion(
        key: wp.int32,
        touched: vec3,
        low: vec3,
        high: vec3,
        dt: real,
        flow_origin: vec3,
        stage_gradient: wp.array(dtype=mat33),
    ) -> vec3:
        """Motion of the wall of a row in its plane; keys as `row_fill` and `array_rows` make."""
        wall = key / 2
        if key >= wp.static(ARRAY_KEY):
            wall = (key - wp.static(ARRAY_KEY)) / 8
        across = vec3(real(wall / 2 == 0), real(wall / 2 == 1), real(wall / 2 == 2))
        face = low
        if wall % 2 == 1:
            face = high
        x = touched + wp.dot(across, face - touched) * across
        u = flow_velocity(stage_gradient[0], flow_origin, x)
        u += flow_velocity(stage_gradient[1], flow_origin, x)
        return (half * dt) * (u - wp.dot(across, u) * across)

    @wp.kernel(**options)
    def fill_slip(
        offset: wp.int32,
        low: vec3,
        high: vec3,
        flow_origin: vec3,
        stage_gradient: wp.array(dtype=mat33),
        step_size: wp.array(dtype=wp.float64),
        groups: wp.array(dtype=Group),
        fiber_group: wp.array(dtype=wp.int32),
        segment_node: wp.array(dtype=wp.int32),
        segment_fiber: wp.array(dtype=wp.int32),
        out_start: wp.array(dtype=wp.int32),
        pair_image: wp.array(dtype=wp.int32),
        lattice_back: wp.array(dtype=mat33),
        lattice_now: wp.array(dtype=mat33),
        node_back: wp.array(dtype=vec3),
        node_pos: wp.array(dtype=vec3),
        fiber_spin: wp.array(dtype=real),
        carried_start: wp.array(dtype=wp.int32),
        carried_j: wp.array(dtype=wp.int32),
        carried_key: wp.array(dtype=wp.int32),
        carried_friction: wp.array(dtype=vec3),
        row_need: wp.array(dtype=wp.int32),
        row_out_start: wp.array(dtype=wp.int32),
        pair_row: wp.array(dtype=wp.int32),
        pair_row_count: wp.array(dtype=wp.int32),
        row_j: wp.array(dtype=wp.int32),
        row_key: wp.array(dtype=wp.int32),
        row_s: wp.array(dtype=real),
        row_t: wp.array(dtype=real),
        row_normal: wp.array(dtype=vec3),
        status: wp.array(dtype=wp.int32),
        row_slip_out: wp.array(dtype=vec3),
        row_friction_out: wp.array(dtype=vec3),
    ):
        if status[wp.static(HALT)] != 0 or row_need[0] > 0:
            return
        i = wp.tid() + offset
        begin = row_out_start[i]
        end = row_out_start[i + 1]
        if begin == end:
            return
        fiber_i = segment_fiber[i]
        radius_i = groups[fiber_group[fiber_i]].radius
        node_i = segment_node[i]
        xi = node_back[node_i]
        edge_i = node_back[node_i + 1] - xi
        length_i = wp.length(edge_i)
        axis_i = edge_i / length_i
        move_i = node_pos[node_i] - xi
        turn_i = node_pos[node_i + 1] - node_back[node_i + 1] - move_i
        for r in range(begin, end):
            n = row_normal[r]
            slip = surface_turn(n, axis_i, radius_i / length_i, turn_i)
            slip += fiber_spin[fiber_i] * surface_roll(n, axis_i, radius_i)
            row_slip_out[r] = slip - move_i - row_s[r] * turn_i
            force = vec3()
            for q in range(carried_start[i], carried_start[i + 1]):
                if carried_j[q] == row_j[r] and carried_key[q] == row_key[r]:
                    force = carried_friction[q]
                    break
            row_friction_out[r] = force
            if row_j[r] < 0:
                touched = xi + row_s[r] * edge_i + radius_i * n
                key = row_key[r]
                dt = real(step_size[0])
                moved = wall_motion(key, touched, low, high, dt, flow_origin, stage_gradient)
                row_slip_out[r] = row_slip_out[r] + moved
        for k in range(out_start[i], out_start[i + 1]):
            count = pair_row_count[k]
            if count == 0:
                continue
            first = pair_row[k]
            j = row_j[first]
            fiber_j = segment_fiber[j]
            radius_j = groups[fiber_group[fiber_j]].radius
            node_j = segment_node[j]
            edge_j = node_back[node_j + 1] - node_back[node_j]
            length_j = wp.length(edge_j)
            axis_j = edge_j / length_j
            move_j = node_pos[node_j] - node_back[node_j]
            turn_j = node_pos[node_j + 1] - node_back[node_j + 1] - move_j
            if wp.static(periodic):
                code = pair_image[k]
                move_j += image_shift(code, lattice_now[0]) - image_shift(code, lattice_back[0])
            for r in range(first, first + count):
                n = row_normal[r]
                slip = surface_turn(n, axis_j, radius_j / length_j, turn_j)
                slip += fiber_spin[fiber_j] * surface_roll(n, axis_j, radius_j)
                row_slip_out[r] = row_slip_out[r] + slip + move_j + row_t[r] * turn_j

    return {"carry_friction": carry_friction, "free_spin": free_spin, "fill_slip": fill_slip}


class RowSlip:
    """Arrays of the rows of one step and the launches around `fill_rows`.

    Rows (capacity): `slip` without contact, `force` on the partner; `fiber_spin` (F) angle without
    contact.
    """

    def __init__(self, model: Model, friction: Friction) -> None:
        self.model, self.friction = model, friction
        p, device = model.precision, model.device
        self.has_frozen = friction.fiber_frozen is not None
        none = wp.zeros(0, dtype=wp.uint8, device=device)
        self.fiber_frozen = friction.fiber_frozen if self.has_frozen else none
        self.fiber_spin = wp.zeros(model.fiber_count, dtype=p.real, device=device)
        self.allocate(0)

    def allocate(self, capacity: int) -> None:
        """Room for as many rows."""
        vec3, device = self.model.precision.vec3, self.model.device
        self.slip, self.force, self.carried = (
            wp.zeros(capacity, dtype=vec3, device=device) for _ in range(3)
        )

    def put(self, force: np.ndarray) -> None:
        """Forces of the last rows."""
        whole = np.zeros(self.force.shape + (3,), dtype=self.model.precision.numpy)
        whole[: len(force)] = force
        self.force.assign(whole)

    def carry(self, kernels: dict[str, Any], rows: Any) -> Launch:
        """Before the rows of the last step are lost."""
        inputs = [rows.row_out_start, self.force, rows.state.status, self.carried]
        dim = self.model.segment_count
        return Launch("carry_friction", kernels["carry_friction"], dim, inputs, split=True)

    def fill(self, kernels: dict[str, Any], rows: Any) -> list[Launch]:
        """After the rows are there."""
        model, friction, vec3 = self.model, self.friction, self.model.precision.vec3
        low = np.asarray(model.domain.low)
        high = low + np.asarray(model.domain.size)
        spun = [
            rows.step_size,
            friction.stage_gradient,
            model.groups,
            model.fiber_node_start,
            model.fiber_group,
            self.fiber_frozen,
            rows.node_back,
            rows.state.status,
            self.fiber_spin,
        ]
        inputs = [
            vec3(*low),
            vec3(*high),
            vec3(*friction.flow_origin),
            friction.stage_gradient,
            rows.step_size,
            model.groups,
            model.fiber_group,
            model.segment_node,
            model.segment_fiber,
            rows.pairs.out_start,
            rows.pairs.pair_image,
            rows.lattice_back,
            rows.lattice_now,
            rows.node_back,
            rows.state.node_pos,
            self.fiber_spin,
            rows.carried_start,
            rows.carried_j,
            rows.carried_key,
            self.carried,
            rows.row_need,
            rows.row_out_start,
            rows.pair_row,
            rows.pair_row_count,
            rows.row_j,
            rows.row_key,
            rows.row_s,
            rows.row_t,
            rows.row_normal,
            rows.state.status,
            self.slip,
            self.force,
        ]
        kernel, dim = kernels["fill_slip"], model.segment_count
        return [
            Launch("free_spin", kernels["free_spin"], model.fiber_count, spun, split=True),
            Launch("fill_slip", kernel, dim, inputs, split=True),
        ]

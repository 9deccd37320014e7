"""The launches of one step of bonded spheres, with the arguments of every kernel."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import warp as wp

from warpfiber.passes.bond_drift import make_bond_drift
from warpfiber.passes.bonds import make_bond_sweep
from warpfiber.passes.capsule_hits import make_capsule_hits
from warpfiber.passes.capsule_pairs import make_capsule_pairs
from warpfiber.passes.clock import make_clock
from warpfiber.passes.executor import Launch

REACH_MARGIN = 1.0 + 1e-5  # the reach of a pair is summed on the device

if TYPE_CHECKING:
    from warpfiber.methods.bonded_spheres import BondedSpheres


def clock_launch(spheres: BondedSpheres) -> Launch:
    """Time and step."""
    state, model = spheres.state, spheres.model
    inputs = [
        wp.float64(spheres.dt),
        wp.float64(0.0),
        wp.mat33d(),
        wp.array(spheres.schedule, dtype=wp.vec2d, device=model.device),
        state.status,
        state.step,
        state.time,
        state.strain,
        state.gradient,
        state.lattice,
        state.lattice_now,
        state.deformation,
    ]
    return Launch("clock", make_clock(model.precision.name, False, False), 1, inputs)


def drift_launch(spheres: BondedSpheres) -> Launch:
    """Half kick and drift of all nodes."""
    model, state = spheres.model, spheres.state
    assert spheres.list is not None
    inputs = [
        model.precision.real(spheres.dt),
        spheres.list.skin_out,
        model.fiber_node_start,
        state.list_pos,
        spheres.place,
        state.node_pos,
        state.node_velocity,
        spheres.node_turn,
        spheres.node_spin,
        spheres.node_rate,
        spheres.node_spin_rate,
        state.status,
    ]
    kernel = make_bond_drift(model.precision.name)
    return Launch("drift", kernel, model.fiber_count, inputs, split=True)


def pair_launches(spheres: BondedSpheres, dt: float) -> list[Launch]:
    """Which listed pairs may touch, and what they do; memories of friction move on by dt."""
    model, state, p = spheres.model, spheres.state, spheres.model.precision
    contacts, pairs = spheres.contacts, spheres.list
    assert contacts is not None and pairs is not None
    parts = contacts.hit_count.shape[0]
    hits = [contacts.hit_pair, contacts.hit_closest, contacts.hit_count]
    inputs = [
        wp.int32(parts),
        p.real(REACH_MARGIN * pairs.reach),
        model.segment_node,
        model.segment_end,
        state.lattice_now,
        pairs.pair_i,
        pairs.pair_j,
        pairs.pair_image,
        spheres.place,
        state.status,
        contacts.acts,
        *hits,
    ]
    near = Launch("hits", make_capsule_hits(p.name, contacts.features), parts, inputs, split=True)
    inputs = [
        wp.int32(parts),
        p.real(dt),
        p.real(spheres.scene.contact.damping),
        p.real(spheres.scene.contact.friction),
        spheres.groups,
        spheres.pair_groups,
        model.fiber_node_start,
        model.fiber_group,
        model.segment_node,
        model.segment_fiber,
        state.lattice_now,
        pairs.out_start,
        pairs.pair_i,
        pairs.pair_j,
        pairs.pair_image,
        *hits,
        spheres.place,
        state.node_velocity,
        spheres.node_spin,
        state.step,
        contacts.acts,
        contacts.force,
        contacts.arms,
        contacts.pair_hit,
        contacts.moment,
        contacts.beside,
        contacts.record,
        contacts.memory,
        contacts.written,
        state.status,
    ]
    kernel = make_capsule_pairs(p.name, contacts.features)
    # one that begins to act reads the memories of others, which they wrote a step ago
    return [near, Launch("pairs", kernel, parts, inputs, split=True, follows=True)]


def bond_launch(spheres: BondedSpheres, *, drifts: bool, kicks: bool) -> Launch:
    """Loads of bonds, walls and gathered pairs, and the kicks (see `make_bond_sweep`)."""
    model, state, p = spheres.model, spheres.state, spheres.model.precision
    none_i = wp.zeros(0, dtype=wp.int32, device=model.device)
    none_3 = wp.zeros(0, dtype=p.vec3, device=model.device)
    gathered: list[Any] = [*[none_i] * 5, none_3]
    kinds = (p.vec4, wp.uint8, wp.int32, p.vec3, p.vec3, wp.int32, p.vec3, p.vec3)
    gathered += [wp.zeros(0, dtype=kind, device=model.device) for kind in kinds]
    if spheres.contacts is not None:
        pairs, contacts = spheres.contacts.search.list, spheres.contacts
        gathered = [pairs.out_start, pairs.in_start, pairs.in_pair, pairs.pair_i, pairs.pair_j]
        gathered += [contacts.force, contacts.arms, contacts.acts]
        gathered += [contacts.pair_hit, contacts.moment, contacts.beside]
        gathered += [contacts.acting, contacts.node_force, contacts.node_moment]
    inputs = [
        p.real(spheres.dt),
        spheres.press.place,
        spheres.press.velocity,
        spheres.press.fiber_push,
        p.real(spheres.scene.contact.damping),
        spheres.wall_face,
        spheres.stage,
        spheres.groups,
        model.fiber_node_start,
        model.fiber_segment_start,
        model.fiber_group,
        spheres.bond_axis,
        spheres.bond_length,
        spheres.holds.hold,
        spheres.holds.load,
        spheres.grips.node_grip,
        *gathered,
        spheres.wall_memory,
        spheres.wall_depth,
        spheres.place,
        state.node_pos,
        state.node_velocity,
        spheres.node_turn,
        spheres.node_spin,
        spheres.node_rate,
        spheres.node_spin_rate,
        spheres.still_steps,
        state.status,
    ]
    kernel = make_bond_sweep(p.name, spheres.features, drifts, kicks)
    return Launch("bonds", kernel, model.fiber_count, inputs, split=True)

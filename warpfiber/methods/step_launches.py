"""The launches of one explicit step of a bead chain, with the arguments of every kernel."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp

from warpfiber.passes.clock import make_clock
from warpfiber.passes.executor import Launch
from warpfiber.passes.kernel_module import kernel_module
from warpfiber.passes.native import LANES, PREFETCH_NODES, PREFETCH_SHARED
from warpfiber.passes.native_nodes import (
    fiber_blocks,
    make_native_node_sweep,
    native_nodes_apply,
)
from warpfiber.passes.native_pairs import make_native_pair_sweep, native_chunks
from warpfiber.passes.nodes import NodeFeatures, make_node_sweep
from warpfiber.passes.pairs import make_pair_sweep

if TYPE_CHECKING:
    from warpfiber.methods.bead_chain import BeadChain

# The reach of every single pair is computed on the device; its bound must not be smaller by
# rounding.
REACH_MARGIN = 1.0 + 1e-5


def step_launches(chain: BeadChain) -> list[Launch]:
    """Clock, pairs (where there are any) and nodes, in this order."""
    launches = [clock_launch(chain)]
    if chain.list is not None:
        launches.append(pair_launch(chain))
    launches.append(node_launch(chain))
    return launches


def clock_launch(chain: BeadChain) -> Launch:
    """Time, strain, velocity gradient and lattice of the step."""
    model, state = chain.model, chain.state
    scheduled = len(chain.schedule) > 1
    clock = make_clock(model.precision.name, model.domain.sheared, scheduled, _node_module(chain))
    return Launch(
        "clock",
        clock,
        1,
        [
            wp.float64(chain.dt),
            wp.float64(chain.flow_rate),
            wp.mat33d(*chain.full_gradient.ravel()),
            wp.array(chain.schedule, dtype=wp.vec2d, device=model.device),
            state.status,
            state.step,
            state.time,
            state.strain,
            state.gradient,
            state.lattice,
            state.lattice_now,
            state.deformation,
        ],
    )


def _node_module(chain: BeadChain) -> str:
    """The clock and the node sweep are launched together; pairs serve many node sweeps."""
    model = chain.model
    scheduled = len(chain.schedule) > 1
    name, sheared = model.precision.name, model.domain.sheared
    return kernel_module(
        "nodes", name, node_features(chain), _has_native_nodes(chain), sheared, scheduled
    )


def _has_native_nodes(chain: BeadChain) -> bool:
    return chain.native_nodes and native_nodes_apply(chain.model, node_features(chain))


def pair_launch(chain: BeadChain) -> Launch:
    """Forces of all listed pairs: by blocks of pairs on the CPU, else one by one."""
    model, state, p, pairs = chain.model, chain.state, chain.model.precision, chain.list
    assert pairs is not None
    inputs = [
        p.real(_lubrication_dt(chain)),
        p.real(chain.strength),
        p.real(chain.decay),
        p.real(REACH_MARGIN * pairs.reach),
        model.groups,
        model.fiber_node_start,
        model.fiber_group,
        model.segment_node,
        model.segment_fiber,
        state.gradient,
        state.lattice_now,
        pairs.pair_i,
        pairs.pair_j,
        pairs.pair_image,
        state.node_pos,
        state.node_velocity,
        state.status,
        chain.pair_acts,
        chain.pair_force,
        chain.pair_closest,
        chain.pair_arm_i,
        chain.pair_arm_j,
    ]
    if chain.native:
        kernel = make_native_pair_sweep(p.name, chain.pair_features)
        chunks = native_chunks(model.segment_count)
        return Launch(
            "pairs", kernel, chunks, [chunks, _ahead(chain), *inputs], split=True, stolen=True
        )
    kernel = make_pair_sweep(p.name, chain.pair_features)
    return Launch("pairs", kernel, pairs.pair_capacity, inputs, split=True)


def _ahead(chain: BeadChain) -> int:
    """Nodes from which sweeps ask for memory before they need it."""
    return PREFETCH_NODES if chain.workers == 1 else PREFETCH_SHARED


def _lubrication_dt(chain: BeadChain) -> float:
    """dt of the limited resistance; 0 leaves the published one.

    Twice the step: a bead may have four partners at the smallest gap and still not be turned
    round.
    """
    return 2.0 * chain.dt if chain.scene.numerics.lubrication_step == "limited" else 0.0


def node_launch(chain: BeadChain) -> Launch:
    """Internal and gathered forces, closure and the step of every fiber."""
    if _has_native_nodes(chain):
        return native_node_launch(chain)
    return plain_node_launch(chain)


def node_features(chain: BeadChain) -> NodeFeatures:
    """What the node sweep of this chain contains."""
    model = chain.model
    closure = chain.scene.numerics.closure
    if all(abs(row["spacing"] - 1.0) < 1e-12 for row in model.group_rows):
        closure = "none"  # every factor is 1 and A is the identity
    return NodeFeatures(
        closure=closure,
        pairs=chain.pair_features.storage if chain.list is not None else "none",
        walls=model.domain.wall if chain.strength > 0.0 else (False, False, False),
        gravity=chain.scene.gravity is not None,
    )


def plain_node_launch(chain: BeadChain) -> Launch:
    """The node sweep with one thread per fiber."""
    model = chain.model
    sweep = make_node_sweep(model.precision.name, node_features(chain), _node_module(chain))
    return Launch("nodes", sweep, model.fiber_count, _node_inputs(chain), split=True)


def native_node_launch(chain: BeadChain) -> Launch:
    """The node sweep with one SIMD block per thread; a block is never split between workers."""
    model, pairs = chain.model, chain.list
    name = model.precision.name
    fibers, own = fiber_blocks(model.host["fiber_group"], LANES[name])
    none_i = wp.zeros(0, dtype=wp.int32, device=model.device)
    inputs = [
        _ahead(chain),
        *_node_inputs(chain),
        pairs.pair_i if pairs else none_i,
        pairs.pair_j if pairs else none_i,
        wp.array(fibers.ravel(), dtype=wp.int32, device=model.device),
        wp.array(own, dtype=wp.int32, device=model.device),
    ]
    sweep = make_native_node_sweep(name, node_features(chain), _node_module(chain))
    return Launch("nodes", sweep, len(own), inputs, split=True, stolen=True)


def _node_inputs(chain: BeadChain) -> list[Any]:
    """Arguments that every node sweep takes."""
    model, state, p, pairs = chain.model, chain.state, chain.model.precision, chain.list
    low = np.asarray(model.domain.low)
    none_i = wp.zeros(0, dtype=wp.int32, device=model.device)
    return [
        p.real(chain.dt),
        p.vec3(*chain.flow_origin),
        p.vec3(*low),
        p.vec3(*(low + np.asarray(model.domain.size))),
        p.real(chain.strength),
        p.real(chain.decay),
        pairs.skin_out if pairs else wp.zeros(0, dtype=p.real, device=model.device),
        model.groups,
        model.pivots,
        model.fiber_node_start,
        model.fiber_group,
        state.gradient,
        state.deformation,
        pairs.out_start if pairs else none_i,
        pairs.in_start if pairs else none_i,
        pairs.in_pair if pairs else none_i,
        chain.pair_acts,
        chain.pair_force,
        chain.pair_closest,
        chain.pair_arm_i,
        chain.pair_arm_j,
        state.list_pos,
        state.node_pos,
        state.node_velocity,
        state.node_force,
        state.status,
    ]

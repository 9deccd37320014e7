"""The launches of one explicit step of a bead chain, with the arguments of every kernel."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import warp as wp

from warpfiber.passes.clock import make_clock
from warpfiber.passes.executor import Launch
from warpfiber.passes.nodes import NodeFeatures, make_node_sweep
from warpfiber.passes.pairs import make_pair_sweep

if TYPE_CHECKING:
    from warpfiber.methods.bead_chain import BeadChain


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
    clock = make_clock(model.precision.name, model.domain.sheared, scheduled)
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


def pair_launch(chain: BeadChain) -> Launch:
    """Forces of all listed pairs."""
    model, state, p, pairs = chain.model, chain.state, chain.model.precision, chain.list
    assert pairs is not None
    return Launch(
        "pairs",
        make_pair_sweep(p.name, chain.pair_features),
        model.segment_count,
        [
            p.real(_lubrication_dt(chain)),
            p.real(chain.strength),
            p.real(chain.decay),
            model.groups,
            model.fiber_node_start,
            model.fiber_group,
            model.segment_node,
            model.segment_fiber,
            state.gradient,
            state.lattice_now,
            pairs.out_start,
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
        ],
        split=True,
    )


def _lubrication_dt(chain: BeadChain) -> float:
    """dt of the limited resistance; 0 leaves the published one.

    Twice the step: a bead may have four partners at the smallest gap and still not be turned
    round.
    """
    return 2.0 * chain.dt if chain.scene.numerics.lubrication_step == "limited" else 0.0


def node_launch(chain: BeadChain) -> Launch:
    """Internal and gathered forces, closure and the step of every fiber."""
    model, state, p, pairs = chain.model, chain.state, chain.model.precision, chain.list
    closure = chain.scene.numerics.closure
    if all(abs(row["spacing"] - 1.0) < 1e-12 for row in model.group_rows):
        closure = "none"  # every factor is 1 and A is the identity
    features = NodeFeatures(
        closure=closure,
        pairs=chain.pair_features.storage if pairs is not None else "none",
        walls=model.domain.wall if chain.strength > 0.0 else (False, False, False),
        gravity=chain.scene.gravity is not None,
    )
    low = np.asarray(model.domain.low)
    none_i = wp.zeros(0, dtype=wp.int32, device=model.device)
    return Launch(
        "nodes",
        make_node_sweep(p.name, features),
        model.fiber_count,
        [
            p.real(chain.dt),
            p.vec3(*chain.flow_origin),
            p.vec3(*low),
            p.vec3(*(low + np.asarray(model.domain.size))),
            p.real(chain.strength),
            p.real(chain.decay),
            pairs.skin_out if pairs else wp.zeros(0, dtype=p.real, device=model.device),
            p.real(pairs.stretch_allowed if pairs else 0.0),
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
        ],
        split=True,
    )

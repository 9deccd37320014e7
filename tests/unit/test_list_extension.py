"""Segments listed as much longer as each of them slides along itself.

Tolerance: 1e-12 of the numbers (float64), 1e-5 (float32) as rounding; which pairs are listed is
compared with all pairs.
"""

from __future__ import annotations

import numpy as np
import pytest
import warp as wp

from tests.cell import Kind, bent_fiber
from tests.reference.segments import find_pairs
from tests.row_cell import Start, never, row_cell
from warpfiber.passes.contact_check import ContactCheck
from warpfiber.passes.executor import Executor
from warpfiber.passes.list_extension import FLOOR, SPARE
from warpfiber.passes.neighbors import NeighborList

LONGEST, REACH, SKIN = 2.0, 2.5, 0.5


@pytest.mark.parametrize("precision", ["float64", "float32"])
def test_each_has_room_to_slide(start: Start, precision: str) -> None:
    rng = np.random.default_rng(3)
    kinds = (Kind(1, 9.0),)
    fibers = [bent_fiber(kinds[0], rng, 20.0 * rng.random(3)) for _ in range(30)]
    cell = row_cell(start, kinds, fibers, [0] * 30, precision=precision, reach=REACH)
    model, state, p = cell.sim.model, cell.sim.state, cell.sim.model.precision
    origin = np.array([1.0, 2.0, 3.0])
    pairs = NeighborList(
        model, state, reach=REACH, skin=SKIN, longest_rest=18.0, slide_origin=origin
    )
    pairs.set_extension(LONGEST)
    nodes = state.node_pos.numpy().astype(float)
    gradient = state.gradient.numpy()[0].astype(float)
    first = model.host["segment_node"]
    axis = nodes[first + 1] - nodes[first]
    axis /= np.linalg.norm(axis, axis=1)[:, None]
    speed = rng.normal(size=30)
    velocity = (nodes - origin) @ gradient.T
    for end in (0, 1):
        velocity[first + end] += speed[:, None] * axis
    across = rng.normal(size=(30, 3))  # moves no end along the line
    across -= (across * axis).sum(1)[:, None] * axis
    velocity[first + 1] += across
    state.node_velocity.assign(velocity.astype(p.numpy))
    pairs.build()
    share = np.minimum(1.0, FLOOR + SPARE * np.abs(speed) / np.abs(speed).max())
    eps = 1e-12 if precision == "float64" else 1e-5
    room = pairs.segment_extension.numpy().astype(float)
    assert np.abs(room - LONGEST * share).max() < eps * 30.0
    assert room.min() < 0.3 * LONGEST

    check = ContactCheck(
        model,
        state,
        pairs,
        node_back=cell.node_back,
        lattice_back=cell.lattice_back,
        lattice_now=cell.lattice_now,
    )
    built = state.list_pos.numpy().astype(float)
    listed = set(zip(*(a.tolist() for a in pairs.host_pairs()[:2]), strict=True))
    still = wp.array(np.eye(3)[None], dtype=wp.mat33d)
    for beyond, held in ((-0.01, True), (0.2, True), (0.3, False)):
        moved = built.copy()
        along = ((room + beyond) * np.sign(speed))[:, None] * axis
        moved[first] += along
        moved[first + 1] += along
        nodes_now = wp.array(moved.astype(p.numpy), dtype=p.vec3)
        executor = Executor(check.list_launches(nodes_now, still, np.zeros(3)), "cpu")
        executor.run(1, never)
        executor.close()
        assert held == (not check.list_short.numpy()[0])
        near = find_pairs(moved, cell.sim.fiber_node_start, REACH, radius=1.0, rest_length=18.0)
        assert not held or {(pair.i, pair.j) for pair in near} <= listed

    # a list that is built again as it was keeps what each had
    state.node_velocity.zero_()
    pairs.build(wrap=False)
    assert (pairs.segment_extension.numpy() == room.astype(p.numpy)).all()

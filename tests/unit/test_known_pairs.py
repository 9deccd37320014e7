"""What is known of listed pairs from the step before: it saves looking at them, and nothing else.

Also the motion that it rests on, by vectors and by fibers. Tolerance 1e-12 (float64) or 3e-5
(float32) of lengths of 10: rounding of some ten operations.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
import warp as wp

from tests.meeting_cell import METHODS, Meeting, contact_rows
from warpfiber.passes.list_bound import make_list_bound
from warpfiber.passes.pair_motion import make_pair_motion

EPS = {"float64": 1e-11, "float32": 3e-4}


@pytest.fixture
def meeting() -> Iterator[Meeting]:
    """Cells that are closed at the end of the test."""
    made = Meeting([])
    yield made
    for simulation in made.running:
        simulation.close()


@pytest.mark.parametrize("precision", ["float64", "float32"])
@pytest.mark.parametrize("method", METHODS)
def test_steps_are_the_same_without(meeting: Meeting, method: str, precision: str) -> None:
    """To the last bit, over several lists; some pairs are passed over in this dense cell."""
    knows, looks = (meeting(method, 75, numerics={"precision": precision}) for _ in range(2))
    passed = []
    for _ in range(30):
        contact_rows(looks).pairs_known.zero_()
        known = bool(contact_rows(knows).pairs_known.numpy()[0])
        # what contact moved in the step before is taken off twice where a pair is looked at again
        shifts = [dual.segment_shift.numpy() for _, dual in knows.method.contact.solves]
        twice = 2.0 * sum(float(shift.max()) for shift in shifts)
        for sim in (knows, looks):
            sim.step()
        positions = [sim.state.node_pos.numpy() for sim in (knows, looks)]
        assert (positions[0] == positions[1]).all()
        pairs = knows.method.list.pair_count  # type: ignore[union-attr]
        clear = [contact_rows(sim).pair_clear.numpy()[:pairs] for sim in (knows, looks)]
        if known:
            assert (clear[0] <= clear[1] + twice + EPS[precision]).all()
            passed.append(float((clear[0] != clear[1]).mean()))
    assert len(passed) > 10
    assert np.mean(passed) > 0.05


@pytest.mark.parametrize("precision", ["float64", "float32"])
def test_block_passes_over_the_same(meeting: Meeting, precision: str) -> None:
    sim = meeting("overdamped", 75, numerics={"precision": precision})
    sim.step(10)
    sim.method.prepare()
    rows, pairs = contact_rows(sim), sim.method.list.pair_count  # type: ignore[union-attr]
    launch = rows._motion(sim.state.node_pos, rows.pair_clear)
    before = rows.pair_clear.numpy().copy()
    found = []
    for native in (False, True):
        rows.pair_clear.assign(before)
        rows.pairs_known.fill_(1)
        kernel = make_pair_motion(precision, True, native=native)
        dim = launch.dim if native else sim.model.segment_count
        wp.launch(kernel, dim=dim, inputs=[0, *launch.inputs], device=sim.model.device)
        found.append(rows.pair_clear.numpy()[:pairs].astype(float))
    moved = rows.segment_moved.numpy().astype(float)
    i, j, _ = sim.method.list.host_pairs()  # type: ignore[union-attr]
    least = (1.0 - float(rows.step_strain.numpy()[0])) * before[:pairs] - moved[i] - moved[j]
    far = least > 2.3
    assert far.any() and not far.all()
    assert np.abs(found[0] - found[1]).max() < EPS[precision]
    assert np.abs(found[1][far] - least[far]).max() < EPS[precision]


@pytest.mark.parametrize("precision", ["float64", "float32"])
def test_block_bounds_the_list_as_the_plain_kernel(meeting: Meeting, precision: str) -> None:
    sim = meeting("overdamped", 75, numerics={"precision": precision})
    while True:  # to the middle of a list
        sim.step()
        check = sim.method.contact.check
        if check.list_share.numpy()[0] > 0.1:
            break
    sim.method.prepare()
    model = sim.model
    origin = np.asarray([0.3, -0.2, 0.5])
    deformation = wp.array([np.eye(3) + 0.05 * np.eye(3, k=2)], dtype=wp.mat33d)
    launch = check.list_launches(sim.state.node_pos, deformation, origin)[0]
    found: list[list[Any]] = []
    for native in (False, True):
        kernel = make_list_bound(precision, native=native)["bound_fibers"]
        dim = launch.dim if native else model.fiber_count
        inputs = [*launch.inputs]
        use, share = (
            wp.zeros(dim, dtype=array.dtype, device=model.device) for array in inputs[-2:]
        )
        inputs[-3:] = [wp.zeros(dim, dtype=wp.int64, device=model.device), use, share]
        wp.launch(kernel, dim=dim, inputs=[0, *inputs], device=model.device)
        short = float(inputs[-3].numpy().any())
        most = use.numpy().max(axis=0), share.numpy().max(), short
        moved = check.segment_moved.numpy().astype(float)
        found.append([*most, moved.copy(), float(check.step_strain.numpy()[0])])
    for plain, block in zip(*found, strict=True):
        assert np.abs(np.asarray(plain) - np.asarray(block)).max() < EPS[precision]
    # and the motion beside the flow restated
    back, now = check.node_back.numpy().astype(float), sim.state.node_pos.numpy().astype(float)
    push = deformation.numpy()[0] @ np.linalg.inv(sim.state.deformation.numpy()[0])
    beside = np.linalg.norm(now - origin - (back - origin) @ push.T, axis=1)
    first = model.host["segment_node"]
    moved = np.maximum(beside[first], beside[first + 1])
    for _, dual in check.solves:
        moved += dual.segment_shift.numpy()
    assert np.abs(found[1][3] - moved).max() < EPS[precision]
    assert found[1][4] == pytest.approx(np.abs(push + push.T - 2.0 * np.eye(3)).sum(1).max() / 2.0)

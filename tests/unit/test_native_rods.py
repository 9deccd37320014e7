"""Steps of many rods at a time are those of one after the other.

Tolerance: 1e-13 of lengths of 30 (float64), 1e-5 (float32): rounding of some ten operations.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest
import warp as wp

from tests.meeting_cell import Meeting
from warpfiber.model import BAD_FIBER, TORN
from warpfiber.passes.native_rod_apply import make_native_rod_apply
from warpfiber.passes.rigid_rods import CHUNK, make_native_rod_step, make_rod_step
from warpfiber.passes.rod_response import make_rod_apply

EPS = {"float64": 3e-12, "float32": 3e-4}


@pytest.fixture
def meeting() -> Iterator[Meeting]:
    """Cells that are closed at the end of the test."""
    made = Meeting([])
    yield made
    for simulation in made.running:
        simulation.close()


@pytest.mark.parametrize("precision", ["float64", "float32"])
@pytest.mark.parametrize("keeps", [0, 1])
def test_block_is_the_plain_kernel(meeting: Meeting, precision: str, keeps: int) -> None:
    sim = meeting("rigid_rod", 75, numerics={"precision": precision})
    sim.step(3)
    sim.method.prepare()
    model, state = sim.model, sim.state
    launch = next(x for x in sim.method.executor.launches if x.name == "fibers")  # type: ignore
    assert launch.kernel is not None and launch.dim == -(-75 // CHUNK)
    inputs = [keeps, *launch.inputs[1:]]
    names = "node_pos node_velocity node_back velocity_back".split()
    arrays = dict(zip(names, inputs[-5:-1], strict=True))
    start = {name: array.numpy().copy() for name, array in arrays.items()}
    maps = inputs[2].numpy()
    maps["settling"][0] = (0.3, -0.2, 0.5)
    inputs[2].assign(maps)
    plain, block = make_rod_step(precision, False), make_native_rod_step(precision)
    found = []
    for kernel, dim in ((plain, model.fiber_count), (block, launch.dim)):
        for name, array in arrays.items():
            array.assign(start[name])
        wp.launch(kernel, dim=dim, inputs=[0, *inputs], device=model.device)
        found.append({name: array.numpy().astype(float) for name, array in arrays.items()})
    for name in names:
        assert np.abs(found[0][name] - found[1][name]).max() < EPS[precision]
    moved = np.abs(found[1]["node_pos"] - start["node_pos"]).max()
    assert moved > 0.1
    kept = start["node_pos"] if keeps else start["node_back"]
    assert (found[1]["node_back"] == kept.astype(float)).all()
    assert not state.status.numpy()[TORN]
    nodes = arrays["node_pos"].numpy()
    nodes[2 * 70] = np.nan
    wp.launch(block, dim=launch.dim, inputs=[0, *inputs], device=model.device)
    assert state.status.numpy()[TORN] == 1 and state.status.numpy()[BAD_FIBER] == 70


@pytest.mark.parametrize("precision", ["float64", "float32"])
def test_applied_shifts_are_those_of_the_plain_kernel(meeting: Meeting, precision: str) -> None:
    sim = meeting("rigid_rod", 75, numerics={"precision": precision})
    sim.step(3)
    sim.method.prepare()
    launch = next(x for x in sim.method.executor.launches if x.name == "rod_apply")  # type: ignore
    assert launch.dim == -(-75 // CHUNK)
    names = "node_shift node_pos node_velocity segment_shift".split()
    places = [4, 6, 7, 8]
    arrays = {name: launch.inputs[at] for name, at in zip(names, places, strict=True)}
    shift = 0.3 * np.random.default_rng(4).standard_normal((75, 2, 3))
    still = np.arange(75) % 4 == 1
    shift[still] = 0.0
    arrays["node_shift"].assign(shift.reshape(-1, 3))
    arrays["segment_shift"].fill_(7.0)
    start = {name: array.numpy().copy() for name, array in arrays.items()}
    found = []
    plain, block = make_rod_apply(precision), make_native_rod_apply(precision)
    for kernel, dim in ((plain, 75), (block, launch.dim)):
        for name, array in arrays.items():
            array.assign(start[name])
        wp.launch(kernel, dim=dim, inputs=[0, *launch.inputs], device="cpu")
        found.append({name: array.numpy().astype(float) for name, array in arrays.items()})
    for name in names:
        assert np.abs(found[0][name] - found[1][name]).max() < 10.0 * EPS[precision]
    at_rest = np.repeat(still, 2)
    assert (found[1]["node_pos"][at_rest] == start["node_pos"][at_rest]).all()
    assert (found[1]["segment_shift"] > 0.0).sum() == 75 - still.sum()

"""Flexible fibers in vectors against one fiber after the other.

Tolerance: rounding of two eliminations, K eps of the size of the cell; of tensions, K eps of what a
displacement of that size would make of them.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from tests.cell import Kind, bent_fiber
from warpfiber.methods.overdamped import FILLED
from warpfiber.model import BAD_FIBER, TORN
from warpfiber.passes.native_chain import MOST_NODES, chain_blocks
from warpfiber.simulation import Simulation

Start = Callable[..., Simulation]
KINDS = [Kind(1, 9.0), Kind(3, 2.3), Kind(7, 1.0, modulus=30.0), Kind(12, 2.71, modulus=2e7)]
COUNTS = [3, 17, 9, 20]
SHEAR = {"kind": "simple_shear", "viscosity": 1.0, "shear_rate": 1.0}
EPS = {"float64": 2.0**-52, "float32": 2.0**-23}
K = 3e3


def cell(start: Start, native: bool, **numerics: Any) -> Simulation:
    """Fibers of several kinds, far apart, their numbers no multiples of a vector."""
    rng = np.random.default_rng(7)
    which = np.repeat(np.arange(len(KINDS)), COUNTS)
    fibers = [bent_fiber(KINDS[k], rng, 20.0 * rng.random(3), stretch=0.002) for k in which]
    keys = {"method": "overdamped"} | numerics
    if "tolerance" not in numerics:
        keys["dt"] = 0.05
    sim = start(KINDS, fibers, which.tolist(), numerics=keys, flow=SHEAR)
    assert sim.method.native  # type: ignore[attr-defined]
    sim.method.native = native  # type: ignore[attr-defined]
    return sim


def compared(
    start: Start, steps: int = 1, push: float = 0.0, **keys: Any
) -> list[dict[str, np.ndarray]]:
    """Positions, velocities, tensions and errors after some steps, plain and in vectors.

    `push`: compression that every third fiber begins with.
    """
    found = []
    for native in (False, True):
        sim = cell(start, native, **keys)
        method: Any = sim.method
        third = sim.model.host["segment_fiber"] % 3 == 0
        method.tension.assign(np.where(third, -push, 0.0).astype(sim.model.precision.numpy))
        sim.step(steps)
        arrays = {"node_pos": sim.state.node_pos, "node_velocity": sim.state.node_velocity}
        arrays |= {"tension": method.tension, "fiber_error": method.fiber_error}
        if method.keeps:
            arrays |= {"node_back": method.node_back, "velocity_back": method.velocity_back}
        found.append({name: array.numpy().astype(float).copy() for name, array in arrays.items()})
    return found


@pytest.mark.parametrize("precision", ["float64", "float32"])
@pytest.mark.parametrize("keys", [{}, {"tolerance": 1e-2}], ids=["fixed", "adaptive"])
def test_vectors_are_the_plain_step(start: Start, precision: str, keys: dict[str, Any]) -> None:
    plain, native = compared(start, steps=2, precision=precision, **keys)
    assert np.abs(plain["node_velocity"]).max() > 1.0
    assert plain["fiber_error"].max() > 1e-6
    for name, values in plain.items():
        size = max(np.abs(values).max(), 40.0)
        if name == "tension":
            size += 2e7  # stiffness of the stiffest times a radius
        assert np.abs(native[name] - values).max() < K * EPS[precision] * size, name


def test_buckling_fibers_are_solved_again(start: Start) -> None:
    """Compressed so far that pivots turn negative in some lanes, which are solved without it."""
    plain, native = compared(start, push=3e3)
    free, _ = compared(start)
    moved = np.abs(plain["node_pos"] - free["node_pos"]).max(axis=1)
    assert (moved == 0.0).any() and (moved > 1e-6).any()
    assert np.abs(native["node_pos"] - plain["node_pos"]).max() < 1e-9
    assert np.abs(native["tension"] - plain["tension"]).max() < 1e-9 * 2e7


def test_torn_fiber_is_named(start: Start) -> None:
    told = []
    for native in (False, True):
        sim = cell(start, native)
        velocity = sim.state.node_velocity.numpy()
        velocity[-1] = np.nan
        sim.state.node_velocity.assign(velocity)
        sim.method.prepare()
        assert not sim.method.advance(1)
        status = sim.state.status.numpy()
        told.append((int(status[TORN]), int(status[BAD_FIBER])))
    assert told == [(1, sum(COUNTS) - 1)] * 2


def test_blocks() -> None:
    """Runs of one group, of eight at most in float64; none reaches into the next group."""
    group = np.repeat([0, 2, 1], [17, 1, 8])
    assert chain_blocks("float64", group).tolist() == [0, 8, 16, 17, 18, 26]
    assert chain_blocks("float32", group).tolist() == [0, 16, 17, 18, 26]


@pytest.mark.parametrize(
    ("segments", "count", "native"),
    [(MOST_NODES - 1, FILLED, True), (MOST_NODES, FILLED, False), (3, FILLED - 1, False)],
)
def test_long_and_few_fibers_are_left_to_the_plain_step(
    start: Start, segments: int, count: int, native: bool
) -> None:
    kind, rng = Kind(segments, 1.0), np.random.default_rng(1)
    fibers = [bent_fiber(kind, rng, 20.0 * rng.random(3)) for _ in range(count)]
    numerics = {"method": "overdamped", "dt": 0.05}
    sim = start([kind], fibers, [0] * count, numerics=numerics, flow=SHEAR)
    assert sim.method.native == native  # type: ignore[attr-defined]

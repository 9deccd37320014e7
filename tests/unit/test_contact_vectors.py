"""Rows and overlaps of many pairs at a time are those of one pair after the other.

Tolerance: 1e-11 (float64) or 3e-4 (float32), rounding of some ten operations on lengths of 30;
which pairs overlap, cross or have a row is exact but for gaps as small as that.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
import warp as wp

from tests.meeting_cell import METHODS, Meeting, contact_rows
from warpfiber.passes.check_sweeps import make_check_sweeps
from warpfiber.passes.native_row_fill import fill_pairs
from warpfiber.passes.pairs import NO_IMAGE
from warpfiber.passes.row_fill import make_row_fill
from warpfiber.simulation import Simulation

EPS = {"float64": 1e-11, "float32": 3e-4}


@pytest.fixture
def meeting() -> Iterator[Meeting]:
    """Cells that are closed at the end of the test."""
    made = Meeting([])
    yield made
    for simulation in made.running:
        simulation.close()


def filled(sim: Simulation, native: bool) -> list[np.ndarray]:
    """Rows of pairs of the last step, written anew."""
    rows = contact_rows(sim)
    for array in rows.written():
        array.fill_(77)
    if native:
        fill_pairs(rows)[0].run(sim.model.device)
    else:
        features = dataclasses.replace(rows.features, filled=False)
        kernel = make_row_fill(sim.model.precision.name, features)
        inputs = [0, *rows._fill_inputs()]
        wp.launch(kernel, dim=sim.model.segment_count, inputs=inputs, device=sim.model.device)
    count = int(rows.row_count.numpy()[0])
    return [array.numpy()[:count].astype(float) for array in rows.written()]


def compare(sim: Simulation) -> np.ndarray:
    """Whether both are the same; normals of the rows."""
    plain, block = filled(sim, False), filled(sim, True)
    eps = EPS[sim.scene.numerics.precision]
    for one, other in zip(plain, block, strict=True):
        assert np.abs(one - other).max() < eps
    return block[5]


@pytest.mark.parametrize("precision", ["float64", "float32"])
@pytest.mark.parametrize("method", METHODS)
def test_rows_are_filled_the_same(meeting: Meeting, method: str, precision: str) -> None:
    sim = meeting(method, 75, numerics={"precision": precision})
    compared = 0
    for _ in range(12):
        sim.step(3)
        builds = sim.method.list.build_count  # type: ignore[union-attr]
        sim.step()
        sim.method.prepare()
        if sim.method.list.build_count > builds:  # type: ignore[union-attr]
            continue  # it has other pairs by now
        compared += 1
        rows, slots = contact_rows(sim), contact_rows(sim).pair_slots.numpy()
        count = int(rows.row_count.numpy()[0])
        assert count > 50
        assert len(np.unique(rows.row_key.numpy()[:count] % 16)) > 2
        assert slots.any()
        compare(sim)
        assert (rows.row_force.numpy()[:count] > 0.0).any()  # carried from the step before
    assert compared >= 6


def test_lines_that_cross_or_coincide(meeting: Meeting) -> None:
    """There the normal is that of both lines."""
    sim = meeting("rigid_rod", 75)
    sim.step(9)
    sim.method.prepare()
    rows, model = contact_rows(sim), sim.model
    i, j, code = sim.method.list.host_pairs()  # type: ignore[union-attr]
    slots = rows.pair_slots.numpy()[: len(i)]
    pair = int(np.flatnonzero((slots == 1) & (code == NO_IMAGE))[0])
    number = int(rows.pair_row.numpy()[pair])
    first = model.host["segment_node"]
    nodes = rows.node_back.numpy()
    for end, expected in (((2.0, 1.0, 3.0), (0.0, 0.0, 1.0)), ((1.0, 2.0, 3.0), None)):
        nodes[first[i[pair]]], nodes[first[i[pair]] + 1] = (1.0, 2.0, 3.0), (3.0, 2.0, 3.0)
        nodes[first[j[pair]]] = end
        nodes[first[j[pair]] + 1] = (2.0, 3.0, 3.0) if expected else (3.0, 2.0, 3.0)
        normal = compare(sim)[number]
        if expected:
            assert np.abs(normal - expected).max() < 1e-12
        assert np.linalg.norm(normal) == pytest.approx(1.0)
        assert abs(normal[0]) < 1e-12


@pytest.mark.parametrize("precision", ["float64", "float32"])
@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("walls", [False, True])
def test_overlaps_are_checked_the_same(
    meeting: Meeting, method: str, precision: str, walls: bool
) -> None:
    """Also where fibers jumped through each other, and one is nowhere."""
    box = {"size": [26.0, 24.0, 25.0], "boundary": ["periodic", "periodic", "wall"]}
    tables: dict[str, Any] = {"box": box} if walls else {}
    sim = meeting(method, 75, numerics={"precision": precision}, **tables)
    sim.step(12)
    sim.method.prepare()
    check, model = sim.method.contact.check, sim.model  # type: ignore[attr-defined]
    assert check.features.picked
    features = dataclasses.replace(check.features, picked=False)
    plain = make_check_sweeps(precision, features)["check_segments"]
    arrays = [check.overlap, check.overlap_partner, check.crossed, check.crossed_partner]
    contact_rows(sim).pair_clear.fill_(-1e6)
    rng = np.random.default_rng(5)
    nodes, home = sim.state.node_pos.numpy(), sim.state.node_pos.numpy().copy()
    starts = model.host["fiber_node_start"]
    for jump in (0.0, 3.0):
        for fiber in range(0, model.fiber_count, 3):
            part = slice(starts[fiber], starts[fiber + 1])
            nodes[part] = home[part] + jump * rng.normal(size=3)
        if jump > 0.0:
            nodes[0] = np.nan
        launches = [launch for launch in check.launches() if launch.name.startswith("check_")]
        assert [launch.name for launch in launches] == ["check_pairs", "check_segments"]
        found = []
        for native in (True, False):
            for array in arrays:
                array.fill_(77)
            if native:
                for launch in launches:
                    launch.run(model.device)
            else:
                inputs = [0, *launches[1].inputs]
                wp.launch(plain, dim=model.segment_count, inputs=inputs, device=model.device)
            found.append([array.numpy().astype(float) for array in arrays])
        (overlap, partner, crossed, by), (overlap_, partner_, crossed_, by_) = found
        assert np.abs(overlap - overlap_).max() < EPS[precision]
        assert (partner == partner_)[overlap > EPS[precision]].all()
        assert (crossed == crossed_).all() and (by == by_).all()
        assert (overlap > 0.0).any()
        if jump > 0.0:
            assert crossed.any() and overlap.max() > 0.99e30
        else:
            assert walls or not crossed.any()

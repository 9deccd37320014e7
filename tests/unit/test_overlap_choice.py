"""A second solve for fibers that the first left overlapping: which, what it does, what it checks.

Tolerance: marks are exact; overlaps that a check looks at again are those of a check of all pairs
but for rounding, which vectors do in another order: 1e-12, some ten operations on lengths of 100.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest

from tests.meeting_cell import rejected
from tests.physics.test_packed_cells import packed_scene
from warpfiber.methods.contact import SLACK, ImplicitContact
from warpfiber.passes.contact_check import ContactCheck
from warpfiber.passes.executor import Executor
from warpfiber.passes.native_row_slots import LOOK
from warpfiber.passes.overlap_choice import OverlapChoice
from warpfiber.simulation import Simulation

TOLERANCE = 1e-2


def packed(limit: float | None = None) -> Simulation:
    """979 packed chains in a thin layer; `limit` of the choice, radii."""
    averages = (4.15e-4, 7.65e-4)
    scene = packed_scene(2e-3, averages, height=3e-4, shortest=5e-5, contact_tolerance=TOLERANCE)
    sim = Simulation(scene, workers=1)
    if limit is not None:
        choice = contact_of(sim).choice
        assert choice is not None
        choice.limit = limit
    return sim


def contact_of(sim: Simulation) -> ImplicitContact:
    contact: ImplicitContact = sim.method.contact  # type: ignore[attr-defined]
    return contact


@pytest.fixture(scope="module")
def cell() -> Iterator[Simulation]:
    """The cell on the way."""
    sim = packed()
    sim.step(3)
    yield sim
    sim.close()


def chosen(sim: Simulation, limit: float) -> OverlapChoice:
    """The choice for the overlaps of the last step, launched on the present list."""
    contact = contact_of(sim)
    rows = contact.solves[1][0]
    rows.launches()  # room for the pairs of the list
    rows.pair_slots.fill_(1)
    choice = OverlapChoice(sim.model, sim.state, limit)
    launches = choice.launches(contact.check, contact.solves[0][0], rows)
    executor = Executor([*launches], "cpu")
    executor.run(1, lambda: False)
    executor.close()
    return choice


def test_pairs_of_marked_fibers_are_chosen(cell: Simulation) -> None:
    """Against marks by brute force."""
    check, fiber = contact_of(cell).check, cell.model.host["segment_fiber"]
    overlap, partner = check.overlap.numpy(), check.overlap_partner.numpy()
    limit = 0.5 * float(overlap.max())
    deep = np.flatnonzero(overlap > limit)
    with_partner = deep[partner[deep] >= 0]
    marked = set(fiber[deep]) | set(fiber[partner[with_partner]])
    choice = chosen(cell, limit)
    assert set(np.flatnonzero(choice.fiber_marked.numpy())) == marked
    assert 0 < len(marked) < 0.5 * cell.model.fiber_count
    i, j, _ = cell.method.list.host_pairs()  # type: ignore[union-attr]
    is_marked = np.isin(fiber, list(marked))
    near = is_marked[i] | is_marked[j]
    slots = contact_of(cell).solves[1][0].pair_slots.numpy()[: len(i)]
    assert (slots == np.where(near, LOOK, 0)).all()
    segments = is_marked.copy()
    segments[i[near]] = True
    assert (choice.segment_chosen.numpy().astype(bool) == segments).all()


def test_nothing_is_chosen_of_a_step_that_is_repeated_anyway(cell: Simulation) -> None:
    """Center lines that crossed, rows that did not fit, fibers that are nowhere; small overlaps."""
    check, rows = contact_of(cell).check, contact_of(cell).solves[0][0]
    largest = check.largest.numpy().copy()
    limit = 0.5 * float(largest[0])
    assert chosen(cell, limit).segment_chosen.numpy().any()
    assert not chosen(cell, 1.01 * float(largest[0])).segment_chosen.numpy().any()
    found = check.found.numpy().copy()
    for array, value in ((check.found, 1), (rows.row_need, 1), (check.largest, 1e30)):
        kept = array.numpy().copy()
        spoiled = kept.copy()
        spoiled[0] = value
        array.assign(spoiled)
        assert not chosen(cell, limit).segment_chosen.numpy().any()
        array.assign(kept)
    assert (check.found.numpy() == found).all()


def test_fibers_are_pushed_apart_once_more() -> None:
    """Without the second solve more steps are taken again."""
    found = {}
    for name, limit in (("once", 1e9), ("twice", None)):
        sim = packed(limit)
        contact = contact_of(sim)
        assert contact.overlap == SLACK * TOLERANCE
        largest, pushed = [], []
        taken_again = rejected(sim)
        while sim.strain < 1.5:
            sim.step(1)
            largest.append(contact.check.largest.numpy()[0])
            pushed.append(int(contact.solves[1][0].row_count.numpy()[0]))
        taken_again = rejected(sim) - taken_again
        found[name] = np.array(largest), np.array(pushed), taken_again
        sim.close()
    (once, unpushed, often), (twice, pushed, seldom) = found.values()
    assert not unpushed.any() and 0 < (pushed > 0).sum() < len(pushed)
    assert max(once.max(), twice.max()) <= SLACK * TOLERANCE
    assert seldom < 0.5 * often


def test_check_of_what_moved_again_sees_the_same() -> None:
    """Overlaps and crossings after a second solve are those of all pairs."""
    sim = packed(limit=0.02)
    contact = contact_of(sim)
    check = contact.check
    whole = ContactCheck(
        sim.model,
        sim.state,
        sim.method.list,  # type: ignore[arg-type]
        node_back=check.node_back,
        lattice_back=check.lattice_back,
        lattice_now=check.lattice_now,
        tears=True,
    )
    again = 0
    for _ in range(25):
        builds = sim.method.list.build_count  # type: ignore[union-attr]
        sim.step()
        if sim.method.list.build_count > builds:  # type: ignore[union-attr]
            continue  # it has other pairs by now, and fibers may have been wrapped
        executor = Executor(whole.launches(), "cpu")
        executor.run(1, lambda: False)
        executor.close()
        assert abs(check.largest.numpy()[0] - whole.largest.numpy()[0]) < 1e-12
        assert (check.crossed.numpy() == whole.crossed.numpy()).all()
        kept, all_pairs = check.overlap.numpy(), whole.overlap.numpy()
        assert np.abs(kept - all_pairs)[kept > 0.0].max(initial=0.0) < 1e-12
        again += int(contact.solves[1][0].row_count.numpy()[0]) > 0
    assert again > 3
    sim.close()

"""Kinked crowds of bonded spheres: loads of nodes by vectors and pair by pair.

Bound: as of the pair sweeps in `test_native_bonds`, of the largest force; sums are in another
order, and powers are by series.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from tests.bonded_crowd import RADIUS, crowd
from tests.unit.test_native_bonds import PAIR_BOUND
from warpfiber.methods.bonded_launches import pair_launches
from warpfiber.passes import native_capsules_source
from warpfiber.passes.executor import load_kernels
from warpfiber.passes.native_capsules import make_native_capsule_pairs
from warpfiber.passes.native_capsules_source import LANES, LINE, PARTS, RUNS


def kinked(precision: str, seed: int) -> Any:
    """Method of a crowd whose nodes are moved at random: kinks everywhere."""
    sim = crowd(precision)
    sim.prepare()
    method: Any = sim.method
    unit = sim.model.units.length
    moves = np.random.default_rng(seed).normal(size=(sim.model.node_count, 3)) * 0.25 * RADIUS
    method.place.assign(method.place.numpy() + moves / unit)
    if method.place is not sim.state.node_pos:
        sim.state.node_pos.assign(method.place.numpy().astype(np.float32))
    method.rebuild_list()
    method.contacts.allocate_scratch()
    return sim


def plain_loads(sim: Any) -> tuple[np.ndarray, np.ndarray]:
    """Forces on nodes by the plain sweeps, pair by pair, and the marks of pairs."""
    method = sim.method
    launches = pair_launches(method, 0.0)
    load_kernels([launch.kernel for launch in launches], "cpu")
    for launch in launches:
        launch.run("cpu")
    contacts = method.contacts
    i, j, _ = method.list.host_pairs()
    node = sim.model.segment_node.numpy()
    hits, marks = contacts.pair_hit.numpy(), contacts.acts.numpy()[: len(i)]
    loads = np.zeros((sim.model.node_count, 3))
    for k in np.flatnonzero(marks):
        first = node[i[k]], node[j[k]]
        force = contacts.force.numpy()[k].astype(float)
        s, t = contacts.arms.numpy()[k][:2].astype(float)
        for at, part, on in zip(first, (s, t), (force, -force), strict=True):
            loads[at : at + 2] += np.array([[1.0 - part], [part]]) * on
        for at, couple in zip(first, contacts.beside.numpy()[2 * hits[k] :], strict=False):
            loads[at] += couple
            loads[at + 1] -= couple
    return loads, marks


def vector_loads(sim: Any) -> np.ndarray:
    """The same by vectors."""
    native, nodes = sim.method.native, sim.model.node_count
    native.contact_touch.zero_()
    launch = native.pair_launch(0.0)
    load_kernels([launch.kernel], "cpu")
    launch.run("cpu")
    lines = native.contact_load.numpy().reshape(-1, LINE)[1:].reshape(PARTS, nodes, LINE)
    touched = native.contact_touch.numpy().reshape(PARTS, nodes, 1) != 0
    total: np.ndarray = np.where(touched, lines, 0.0).sum(axis=0)
    return total[:, :3].astype(float)


@pytest.mark.parametrize("precision", PAIR_BOUND)
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_loads(precision: str, seed: int) -> None:
    """Forces of nodes, many of them by pairs that share a patch."""
    sim = kinked(precision, seed)
    expected, marks = plain_loads(sim)
    assert (marks != 0).sum() > 60
    found = vector_loads(sim)
    assert np.abs(found - expected).max() < PAIR_BOUND[precision] * np.abs(expected).max()
    sim.close()


@pytest.mark.parametrize("precision", PAIR_BOUND)
def test_laws_in_a_row(precision: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """What a pair does is the same bits whichever pairs wait for their law with it."""
    found = []
    for runs in (RUNS, 1):
        monkeypatch.setattr(native_capsules_source, "RUNS", runs)
        make_native_capsule_pairs.cache_clear()
        sim = kinked(precision, 1)
        loads = vector_loads(sim)
        contacts, native = sim.method.contacts, sim.method.native
        native.pair_launch(sim.method.dt, keeps=True).run("cpu")
        acts = contacts.acts.numpy().astype(bool)
        pairs = [array.numpy()[..., acts, :] for array in (contacts.force, contacts.arms)]
        found.append((loads, acts, *pairs, contacts.memory.numpy()[:, acts]))
        sim.close()
    make_native_capsule_pairs.cache_clear()
    # of four kinds: one at least that did not wait for the end of its part
    assert found[0][1].sum() > PARTS * 4 * LANES
    for loads, *pairs in found[1:]:
        eps = np.finfo(precision).eps
        assert np.abs(loads - found[0][0]).max() < 64.0 * eps * np.abs(loads).max()
        for one, other in zip(pairs, found[0][1:], strict=True):
            np.testing.assert_array_equal(one, other)

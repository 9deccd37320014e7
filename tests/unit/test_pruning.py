"""Lists pruned from a wider one: exact at every step, the same however they are made.

Sets of pairs are compared exactly with brute force, arrays with the plain kernels.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from tests.cell import Kind, listed_pairs
from tests.pair_list import SHEAR, Start, brute_force, cell, random_fibers
from warpfiber.methods import bead_chain, pair_search
from warpfiber.methods.skin import (
    PAIR_COST,
    PLAIN_COSTS,
    PLAIN_PAIR_COST,
    SIMD_COSTS,
    SkinChoice,
)
from warpfiber.passes import pruning as passes_pruning
from warpfiber.passes.neighbors import NeighborList
from warpfiber.passes.pruning import Pruning
from warpfiber.simulation import Simulation

KIND = Kind(3, 4.0, modulus=3000.0)
FLOWS = {
    "rest": {"kind": "rest", "viscosity": 1.0},
    "shear": SHEAR,
    "extension": {"kind": "planar_extension", "extension_rate": 1.0, "viscosity": 1.0},
}


@pytest.fixture(autouse=True)
def every_list_is_pruned(monkeypatch: pytest.MonkeyPatch) -> None:
    """Also the small ones of these tests."""
    monkeypatch.setattr(pair_search, "PRUNED_FROM", 0)


def crowd(start: Start, flow: str = "shear", **keys: Any) -> Simulation:
    """Stiff fibers that turn, and at rest also drift, through one another's reach."""
    edges = [46.0, 42.0, 48.0]
    fibers, _ = random_fibers((KIND,), 70, edges, seed=50, spread=5.0)
    velocity = None
    if flow == "rest":
        drift = np.random.default_rng(1).normal(size=(len(fibers), 3))
        velocity = np.repeat(30.0 * drift, KIND.segments + 1, axis=0)
    contact = {"law": "exponential", "strength": 20.0, "decay": 5.0}
    given = {"flow": FLOWS[flow], "box": {"size": edges}, "velocity": velocity, "contact": contact}
    keys.setdefault("numerics", {"dt": 2e-3})
    return cell(start, (KIND,), fibers, **given, **keys)


def pruning(sim: Simulation) -> Pruning:
    found = sim.method.list.pruning  # type: ignore[union-attr]
    assert found is not None
    return found


@pytest.mark.parametrize("flow", FLOWS)
@pytest.mark.parametrize("native", [True, False])
def test_no_pair_is_missed(
    start: Start, monkeypatch: pytest.MonkeyPatch, flow: str, native: bool
) -> None:
    """At every step all pairs within reach are listed; a new list has all within reach + skin."""
    monkeypatch.setattr(bead_chain, "NATIVE", native)
    sim = crowd(start, flow)
    pairs, renewed = sim.method.list, 0
    assert pairs is not None and pairs.native == native
    margins = set()
    for _ in range(150 if native else 90):
        before = pruning(sim).count
        sim.step()
        listed = listed_pairs(sim)
        assert not brute_force(sim, pairs.reach) - listed
        if pruning(sim).count > before:
            renewed += 1
            assert listed == brute_force(sim, pairs.reach + pairs.skin)
        margins.add(pairs.margin)
    assert renewed >= 5
    assert pairs.build_count >= 2
    if flow == "extension":  # the box grows flat: it has room for the first skin alone
        assert max(margins) == 0.0
    else:
        assert sim.method.search.prune_count >= 3 and max(margins) > 0.0


@pytest.mark.parametrize("workers", [1, 2, 3])
@pytest.mark.parametrize("native", [True, False])
def test_the_same_as_listed_at_once(start: Start, workers: int, native: bool) -> None:
    """Pruned at moved positions: every array of the list that a build there makes at once."""
    sim = crowd(start)
    used = sim.method.list
    assert used is not None
    given = {
        "reach": used.reach,
        "skin": used.skin,
        "longest_rest": used.longest_rest,
        "stretch": used.stretch_allowed,
    }
    wide = NeighborList(
        sim.model, sim.state, **given, workers=workers, native=native, flow_origin=np.zeros(3)
    )
    wide.set_skin(used.skin, 1.5)
    wide.build(wrap=False)
    nodes = sim.state.node_pos.numpy()
    moved = nodes + np.random.default_rng(51).uniform(-0.4, 0.4, nodes.shape)
    sim.state.node_pos.assign(moved.astype(nodes.dtype))
    assert wide.pruning is not None
    wide.pruning.prune()
    n = wide.pair_count
    names = "out_start", "in_start", "pair_i", "pair_j", "pair_image", "in_pair"
    got = {name: getattr(wide, name).numpy().copy() for name in names}
    once = NeighborList(sim.model, sim.state, **given, native=False)
    once.build(wrap=False)
    assert n == once.pair_count > 50
    for name, value in got.items():
        size = None if name.endswith("start") else n
        assert (value[:size] == getattr(once, name).numpy()[:size]).all(), name
    wide.close()
    once.close()


def test_the_margin_bounds_every_node(start: Start) -> None:
    """The wide list holds while no node has moved more than half the margin beside the flow."""
    sim = crowd(start)
    pairs, nodes = sim.method.list, sim.state.node_pos.numpy().copy()
    assert pairs is not None
    sim.method.search.set_skin(0.6, 1.2)
    sim.method.refresh_list(wrap=False)
    for part, holds in ((0.49, True), (0.51, False)):
        moved = nodes.copy()
        moved[17, 1] += part * pairs.margin
        sim.state.node_pos.assign(moved)
        assert pruning(sim).prune() == holds
    # pure shear by F: a node carried by it has not moved, but the margin shrinks with its strain
    for strain, holds in ((0.2, True), (0.8, False)):
        carried = np.eye(3)
        carried[0, 2] = strain
        origin = sim.method.flow_origin
        sim.state.node_pos.assign((origin + (nodes - origin) @ carried.T).astype(nodes.dtype))
        sim.state.deformation.assign(carried[None])
        pruning(sim).wide_deformation.assign(np.eye(3)[None])
        assert pruning(sim).prune() == holds
    sim.state.node_pos.assign(nodes)
    assert not pruning(sim).prune()


def test_a_list_without_pairs(start: Start) -> None:
    """Nothing is near: all starts are 0, and fibers that meet later are listed."""
    kind = Kind(1, 4.0)
    fibers, _ = random_fibers((kind,), 70, [30.0] * 3, seed=52)
    sim = cell(start, (kind,), fibers)
    pairs = sim.method.list
    assert pairs is not None
    nodes = sim.state.node_pos.numpy().copy()
    far = nodes + 500.0 * np.repeat(np.arange(70), 2)[:, None].astype(nodes.dtype)
    sim.state.node_pos.assign(far)
    pruning(sim).prune()  # from the old wide list
    assert pairs.pair_count == 0
    assert not pairs.out_start.numpy().any() and not pairs.in_start.numpy().any()
    sim.state.node_pos.assign(nodes)
    sim.method.refresh_list(wrap=False)
    assert listed_pairs(sim) == brute_force(sim, pairs.reach + pairs.skin) != set()


@pytest.mark.parametrize("at", [1, 9, 33])
def test_restore(start: Start, at: int) -> None:
    """Snapshots between two prunings: the restored run prunes, builds and moves alike."""
    run = crowd(start)
    run.step(at)
    saved = run.snapshot()
    run.step(80 - at)
    again = crowd(start, workers=2)
    again.restore(saved)
    assert again.method.list.margin == pytest.approx(saved["skin"][4])  # type: ignore[union-attr]
    again.step(80 - at)
    for name, value in run.snapshot().items():
        assert value.tobytes() == again.snapshot()[name].tobytes(), name
    assert listed_pairs(run) == listed_pairs(again)


def test_capacities_grow(start: Start) -> None:
    """From room for one pair, the wide list and the pruned one become those of a roomy list."""
    sim = crowd(start)
    pairs = sim.method.list
    assert pairs is not None
    tight = NeighborList(
        sim.model,
        sim.state,
        reach=pairs.reach,
        skin=pairs.skin,
        longest_rest=pairs.longest_rest,
        stretch=pairs.stretch_allowed,
        pair_capacity=1,
        flow_origin=np.zeros(3),
    )
    tight.set_skin(pairs.skin, pairs.margin)
    expected = pairs.host_pairs()
    assert tight.build(wrap=False)
    assert tight.grow_count > 0
    for got, want in zip(tight.host_pairs(), expected, strict=True):
        assert got.tobytes() == want.tobytes()
    tight.close()


def test_the_wide_list_is_loose(start: Start) -> None:
    """It holds what is within reach of it, and beyond only what float32 cannot tell."""
    sim = crowd(start)
    pairs = sim.method.list
    assert pairs is not None
    sim.method.search.set_skin(0.6, 1.2)
    sim.method.refresh_list(wrap=False)
    wide = pairs.reach + pairs.skin + pairs.margin
    found = pruning(sim)
    columns = (a.numpy()[: pairs.kept_count] for a in (found.wide_i, found.wide_j))
    loose = set(zip(*(column.tolist() for column in columns), strict=True))
    assert {pair[:2] for pair in brute_force(sim, wide)} <= loose
    assert loose <= {pair[:2] for pair in brute_force(sim, wide + 0.05)}


def test_room_for_kept_pairs_grows(start: Start, monkeypatch: pytest.MonkeyPatch) -> None:
    """More pairs than the plain kernels would sort: all of them are sorted before any is used."""
    lists = []
    for room in (0.0, 3.0):
        monkeypatch.setattr(passes_pruning, "ROOM", room)
        monkeypatch.setattr(bead_chain, "NATIVE", False)
        sim = crowd(start)
        pairs = sim.method.list
        assert pairs is not None
        sim.method.search.set_skin(0.6, 1.2)
        sim.method.refresh_list(wrap=False)
        assert pairs.pair_count > 80
        lists.append([*pairs.host_pairs(), pairs.in_start.numpy().copy()])
        lists[-1].append(pairs.in_pair.numpy()[: pairs.pair_count].copy())
        sim.close()
    for got, want in zip(*lists, strict=True):
        assert got.tobytes() == want.tobytes()


def choice(**keys: Any) -> SkinChoice:
    """Of segments of 5 diameters that use up 0.035 diameters of skin per step."""
    given: dict[str, Any] = {
        "skin": 0.6,
        "start": 0.6,
        "largest": 4.0,
        "least": 0.3,
        "radius": 1.0,
        "reach": 2.001,
        "core": 2.0,
        "length": 10.0,
        "pieces_per_segment": 1.0,
        "use": 0.07,
        "pruned": True,
    }
    return SkinChoice(**given | keys)


def test_skin_and_margin_are_chosen_together() -> None:
    """Pruned, a thinner skin costs least, beside a wide list that no single list would have."""
    pruned, single = choice(), choice(pruned=False)
    thin, thick = (c.choose(9, 0.8, 0.07) for c in (pruned, single))
    assert thin < 0.8 * thick
    margin = pruned.choose_margin(thin, 0.8)
    assert thin + margin > 1.2 * thick
    assert pruned.cost(thin, 0.8) < 0.9 * single.cost(thick, 0.8)


@pytest.mark.parametrize("native", [True, False])
def test_costs_of_the_kernels_in_use(
    start: Start, monkeypatch: pytest.MonkeyPatch, native: bool
) -> None:
    """Skins are chosen by what lists and pairs cost with vectors, or without."""
    monkeypatch.setattr(bead_chain, "NATIVE", native)
    skin = crowd(start).method.skin
    assert skin.costs is (SIMD_COSTS if native else PLAIN_COSTS)
    assert skin.pair_cost == (PAIR_COST if native else PLAIN_PAIR_COST)


def test_margin_has_room_in_the_box() -> None:
    """The wide list is as thick as the box allows at most; without room there is no margin."""
    for largest in (0.6, 1.0, 1.4, 2.0):
        small = choice(largest=largest)
        margin = small.choose_margin(0.6, 0.8)
        assert 0.0 <= margin <= largest - 0.6
        assert (margin == 0.0) == (largest < 1.26)
        small.set_skin(0.6, 10.0)
        assert small.margin == pytest.approx(largest - 0.6)

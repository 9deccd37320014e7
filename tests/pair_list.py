"""What the tests of the neighbor list share: cells with weak forces, and brute force beside them.

Brute force is `tests.reference.segments`, which looks at any image of any box.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from tests.cell import Kind, bent_fiber, listed_pairs
from tests.reference import segments as sg
from warpfiber.passes.neighbors import NeighborList
from warpfiber.simulation import Simulation

Start = Callable[..., Simulation]
Pairs = set[tuple[int, int, tuple[int, int, int]]]
SHEAR = {"kind": "simple_shear", "shear_rate": 1.0, "viscosity": 1.0}


def cell(
    start: Start,
    kinds: tuple[Kind, ...],
    fibers: list[np.ndarray],
    which: Any = None,
    **keys: Any,
) -> Simulation:
    """Cell with pairs but weak forces, its list built."""
    keys.setdefault("contact", {"law": "exponential", "strength": 1.0, "decay": 2.0})
    sim = start(kinds, fibers, which, **keys)
    sim.method.prepare()
    return sim


def brute_force(sim: Simulation, reach: float) -> Pairs:
    """Pairs within `reach` (run units) of the present state."""
    kinds = [sim.model.group_rows[g] for g in sim.model.host["fiber_group"]]
    box = sim.scene.box
    found = sg.find_pairs(
        sim.state.node_pos.numpy().astype(float),
        sim.fiber_node_start,
        reach,
        radius=np.array([row["radius"] for row in kinds]),
        rest_length=np.array([row["rest"] for row in kinds]),
        lattice=None if box is None else sim.state.lattice.numpy()[0],
        periodic=sim.model.domain.periodic,
    )
    rows = set()
    for pair in found:
        image = pair.shift
        if pair.i == pair.j and image < (0, 0, 0):
            image = (-image[0], -image[1], -image[2])
        rows.add((pair.i, pair.j, image))
    return rows


def plain_list(pairs: NeighborList) -> NeighborList:
    """The list of the present state by the kernels that also run on CUDA."""
    plain = NeighborList(
        pairs.model,
        pairs.state,
        reach=pairs.reach,
        skin=pairs.skin,
        longest_rest=pairs.longest_rest,
        native=False,
    )
    plain.set_stretch(pairs.stretch_allowed)
    plain.build(wrap=False)
    return plain


def check_list(sim: Simulation, least: int = 1) -> Pairs:
    """The list holds exactly what is within reach + skin; the plain kernels make the same one."""
    pairs = sim.method.list
    assert pairs is not None
    listed = listed_pairs(sim)
    assert listed == brute_force(sim, pairs.reach + pairs.skin)
    plain = plain_list(pairs)
    for name in ("out_start", "in_start"):
        assert (getattr(plain, name).numpy() == getattr(pairs, name).numpy()).all()
    n = len(listed)
    assert plain.pair_count == n
    for name in ("pair_i", "pair_j", "pair_image", "in_pair"):
        assert (getattr(plain, name).numpy()[:n] == getattr(pairs, name).numpy()[:n]).all()
    assert len(listed) >= least
    return listed


def random_fibers(
    kinds: tuple[Kind, ...], count: int, edges: Any, seed: int, spread: float = 1.0
) -> tuple[list[np.ndarray], np.ndarray]:
    rng = np.random.default_rng(seed)
    which = np.arange(count) % len(kinds)
    size = np.asarray(edges, float)
    return [bent_fiber(kinds[k], rng, size * rng.random(3), spread) for k in which], which

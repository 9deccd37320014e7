"""Pairs that may touch: all that the listed ones hold, packed by parts, whatever the parts are."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import warp as wp

from tests.bonded_crowd import crowd
from tests.physics.test_ring_contacts import RUBBING, circle, hoop
from tests.rods import start_rods
from warpfiber.methods import bonded_spheres
from warpfiber.methods.bonded_launches import pair_launches
from warpfiber.simulation import Simulation


def closest(p: np.ndarray, a: np.ndarray, q: np.ndarray, b: np.ndarray) -> tuple[float, float]:
    """Fractions of a from p and b from q: the best of the inner minimum and the four borders."""

    def at(s: float, t: float) -> float:
        return float(np.sum((q + t * b - p - s * a) ** 2))

    def beside(point: np.ndarray, start: np.ndarray, edge: np.ndarray) -> float:
        return float(np.clip((point - start) @ edge / (edge @ edge), 0.0, 1.0))

    tries = [(s, beside(p + s * a, q, b)) for s in (0.0, 1.0)]
    tries += [(beside(q + t * b, p, a), t) for t in (0.0, 1.0)]
    inner = np.linalg.lstsq(np.stack([a, -b], axis=1), q - p, rcond=None)[0]
    if 0.0 <= inner.min() and inner.max() <= 1.0:
        tries.append((float(inner[0]), float(inner[1])))
    return min(tries, key=lambda st: at(*st))


def hits_of(sim: Simulation, parts: int) -> dict[int, np.ndarray]:
    """Closest points by pair, of a launch with so many parts."""
    method: Any = sim.method
    contacts, pairs = method.contacts, method.list
    contacts.hit_count = wp.zeros(parts, dtype=wp.int32)
    contacts.acts.fill_(1)
    launch = pair_launches(method, method.dt)[0]
    launch.run("cpu")
    counts, numbers = contacts.hit_count.numpy(), contacts.hit_pair.numpy()
    assert not contacts.acts.numpy()[: pairs.pair_count].any()
    found = {}
    for part, count in enumerate(counts):
        begin = part * pairs.pair_count // parts
        for slot in range(begin, begin + count):
            found[int(numbers[slot])] = contacts.hit_closest.numpy()[slot].copy()
    assert len(found) == counts.sum()
    return found


@pytest.mark.parametrize("rings", [False, True])
def test_hits(rings: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """Against pairs one by one."""
    monkeypatch.setattr(bonded_spheres, "NATIVE", False)
    sim = crowd()
    if rings:
        rods = [hoop(circle([0.0, 0.0, 2.0e-3 * n], 0.2 * n)) for n in range(4)]
        sim = start_rods(rods, contact=RUBBING)
    sim.prepare()
    method: Any = sim.method
    model, pairs = sim.model, method.list
    nodes = method.place.numpy()
    first, second = model.host["segment_node"], model.host["segment_end"]
    lattice = sim.state.lattice_now.numpy()[0]
    found, left_out = hits_of(sim, 7), 0
    for k, (i, j, code) in enumerate(zip(*pairs.host_pairs(), strict=True)):
        image = [((int(code) >> bits) & 1023) - 512 for bits in (0, 10, 20)]
        a, b = nodes[second[i]] - nodes[first[i]], nodes[second[j]] - nodes[first[j]]
        q = nodes[first[j]] + lattice @ image
        s, t = closest(nodes[first[i]], a, q, b)
        distance = np.linalg.norm(q + t * b - nodes[first[i]] - s * a)
        is_point = (a @ b) ** 2 < 0.7499 * (a @ a) * (b @ b)
        assert (k in found) == (distance < pairs.reach)
        left_out += k not in found
        if k in found and is_point:
            assert found[k] == pytest.approx([s, t], abs=1e-9)
    assert len(found) > 10 and left_out > 0
    for parts in (1, 64):
        again = hits_of(sim, parts)
        assert again.keys() == found.keys()
        assert all(np.array_equal(again[k], found[k]) for k in found)

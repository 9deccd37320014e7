"""Near pairs: all that may touch before some node has used up its own skin, and no others."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from tests.bonded_crowd import crowd
from warpfiber.passes.native_capsules_source import TIP_BITS
from warpfiber.passes.near_pairs import ENOUGH, LASTING, LEAST, part_starts
from warpfiber.scene import SceneError
from warpfiber.simulation import Simulation


def distances(sim: Simulation, i: np.ndarray, j: np.ndarray, code: np.ndarray) -> np.ndarray:
    """Of segments i and images of j, run units: least over edges and inner points, one by one."""
    method: Any = sim.method
    x = method.native.near.pos.numpy()
    first = sim.model.host["segment_node"]
    images = np.stack([(code >> bits & 1023) - 512 for bits in (0, 10, 20)], axis=1)
    shift = images @ sim.state.lattice.numpy()[0].T
    a, b = x[first[i] + 1] - x[first[i]], x[first[j] + 1] - x[first[j]]
    d = x[first[j]] - x[first[i]] + shift
    best = np.full(len(i), np.inf)
    dot = lambda u, v: (u * v).sum(axis=1)  # noqa: E731
    aa, bb, ab, da, db = dot(a, a), dot(b, b), dot(a, b), dot(d, a), dot(d, b)
    candidates = [(s, np.clip((s * ab - db) / bb, 0.0, 1.0)) for s in (0.0, 1.0)]
    candidates += [(np.clip((t * ab + da) / aa, 0.0, 1.0), t) for t in (0.0, 1.0)]
    den = aa * bb - ab * ab
    inner_s, inner_t = (da * bb - db * ab) / den, (da * ab - db * aa) / den
    inside = (inner_s > 0) & (inner_s < 1) & (inner_t > 0) & (inner_t < 1)
    candidates.append((np.where(inside, inner_s, 0.0), np.where(inside, inner_t, 0.0)))
    for s, t in candidates:
        c = d + np.broadcast_to(t, len(i))[:, None] * b - np.broadcast_to(s, len(i))[:, None] * a
        best = np.minimum(best, np.linalg.norm(c, axis=1))
    return best


@pytest.mark.parametrize("steps", [0, 33])
def test_near_pairs(steps: int) -> None:
    """Those of the list nearer than reach and both skins; skins by speed and what the list has."""
    sim = crowd()
    sim.step(steps) if steps else sim.prepare()
    method: Any = sim.method
    near, pairs = method.native.near, method.list
    lasts = near.lasts()
    near.find()
    skin, x = near.skin.numpy(), method.place.numpy()
    np.testing.assert_array_equal(near.pos.numpy(), x)
    np.testing.assert_array_equal(near.block_skin.numpy()[near.blocks.slot], skin)
    in_blocks = near.block_pos.numpy().reshape(len(near.blocks.nodes), 3, -1)
    own = np.zeros(near.blocks.nodes.size, dtype=bool)
    own[near.blocks.slot] = True
    own = own.reshape(near.blocks.nodes.shape)
    np.testing.assert_array_equal(in_blocks.transpose(0, 2, 1)[own], x[near.blocks.nodes[own]])
    pace = method.dt * np.linalg.norm(sim.state.node_velocity.numpy(), axis=1)
    room = 0.5 * pairs.skin - np.linalg.norm(x - sim.state.list_pos.numpy(), axis=1)
    least = LEAST * 2.0 * method.contacts.search.radius
    wanted = np.minimum(least + LASTING * pace, room)
    assert skin == pytest.approx(np.maximum(wanted, 0.0), rel=1e-12)
    assert lasts == bool((wanted > ENOUGH * pace).all())
    assert skin.max() > 2.0 * skin.min()
    i, j, code = pairs.host_pairs()
    first = sim.model.host["segment_node"]
    mine = np.maximum(skin[first], skin[first + 1])
    reach = pairs.reach + mine[i] + mine[j]
    apart = distances(sim, i, j, code)
    begin, count = pairs.out_start.numpy()[near.part_start.numpy()], near.count.numpy()
    found = np.concatenate(
        [near.pair.numpy()[b : b + n] for b, n in zip(begin, count, strict=False)]
    )
    clear = np.abs(apart - reach) > 1e-4
    assert set(found) >= set(np.flatnonzero((apart < reach) & clear))
    assert set(found).isdisjoint(np.flatnonzero((apart > reach) & clear))
    assert (np.diff(found) > 0).all() and len(found) < len(i)
    nodes = near.i.numpy()[begin[0] : begin[0] + count[0]] >> TIP_BITS
    np.testing.assert_array_equal(nodes, first[i[found[: count[0]]]])


def test_skins_of_a_list_that_is_used_up() -> None:
    """Where a node has moved by half of the list's skin, nothing is left for its own."""
    sim = crowd()
    sim.prepare()
    near = sim.method.native.near  # type: ignore[attr-defined]
    assert near.lasts() and near.lasts_a_step()
    listed = sim.state.list_pos.numpy()
    listed[5, 0] += 100.0
    sim.state.list_pos.assign(listed)
    assert not near.lasts() and not near.lasts_a_step()
    assert near.skin.numpy()[5] == 0.0


def test_parts_have_as_many_pairs() -> None:
    """With a partner j > i equally likely, parts of segments i are equally full."""
    starts = part_starts(1000)
    assert starts[0] == 0 and starts[-1] == 1000
    per_segment = 999 - np.arange(1000)
    counts = np.add.reduceat(per_segment, starts[:-1])
    assert np.ptp(counts) < 0.01 * counts.mean()


def test_too_fast_for_any_skin() -> None:
    """Nodes that outrun the fixed skin in one step are an error that says what helps."""
    sim = crowd(numerics={"skin": 1e-6, "method": "bonded_spheres", "segments": [8, 12]})
    with pytest.raises(SceneError, match="farther in one step"):
        sim.step(20)

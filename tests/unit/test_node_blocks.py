"""Numbers of nodes in vectors: every node has its own slot, and vectors begin at cache lines."""

import numpy as np
import warp as wp

from warpfiber.passes.native_nodes import fiber_blocks
from warpfiber.passes.node_blocks import CACHE_LINE, NodeBlocks, aligned_zeros

LANES = 4


def blocks_of() -> tuple[NodeBlocks, np.ndarray]:
    """Eleven fibers of two lengths in mixed order."""
    group = np.array([0, 1, 0, 0, 1, 0, 0, 1, 0, 0, 1])
    start = np.concatenate([[0], np.cumsum(np.where(group == 0, 3, 5))])
    return NodeBlocks.of(*fiber_blocks(group, LANES), start), start


def test_slots() -> None:
    """A node's number is where the block of its fiber has that place and lane."""
    blocks, start = blocks_of()
    assert len(set(blocks.slot)) == start[-1]
    np.testing.assert_array_equal(blocks.nodes.ravel()[blocks.slot], np.arange(start[-1]))
    # two blocks of seven fibers of 3 nodes, one of four of 5
    assert blocks.start.tolist() == [0, 3, 6] and len(blocks.nodes) == 11
    # fibers 0, 2, 3, 5 are the lanes of the first block
    assert blocks.nodes[1].tolist() == [start[fiber] + 1 for fiber in (0, 2, 3, 5)]
    # the last fiber fills the lane that is left over
    assert blocks.nodes[3].tolist() == [start[fiber] for fiber in (6, 8, 9, 9)]


def test_filled() -> None:
    """One vector per number of a node, in the order of the places in the fiber."""
    blocks, start = blocks_of()
    values = np.arange(3.0 * start[-1]).reshape(-1, 3)
    array = blocks.zeros(3, wp.float64, "cpu")
    blocks.fill(array, values)
    found = array.numpy().reshape(len(blocks.nodes), 3, LANES)
    for place, nodes in enumerate(blocks.nodes):
        np.testing.assert_array_equal(found[place], values[nodes].T)
    lane = blocks.slot % LANES
    first = 3 * (blocks.slot - lane) + lane
    for number in range(3):
        np.testing.assert_array_equal(array.numpy()[first + LANES * number], values[:, number])


def test_aligned() -> None:
    """Vectors of either precision begin at a cache line, whatever the allocator gives."""
    for kind in (wp.float32, wp.float64):
        for size in (1, 7, 1000):
            array = aligned_zeros(size, kind, "cpu")
            assert array.ptr % CACHE_LINE == 0 and array.shape == (size,)
            assert not array.numpy().any()

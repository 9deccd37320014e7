"""Numbers of nodes kept in vectors: per block of fibers and node one vector for each of them.

Symbols: a block has one fiber per lane, all of the same number of nodes; the slot of a node is that
    of its first number where nodes have one number each.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp

CACHE_LINE = 64  # bytes


def aligned_zeros(size: int, kind: Any, device: str) -> Any:
    """An array that begins at a cache line, so that vectors are read and written as one."""
    number = wp.types.type_size_in_bytes(kind)
    array = wp.zeros(size + CACHE_LINE // number, dtype=kind, device=device)
    begin = -array.ptr % CACHE_LINE // number
    return array[begin : begin + size]


@dataclass
class NodeBlocks:
    """Where the nodes of fibers (B, lanes) are; lanes without a fiber of their own repeat one."""

    start: np.ndarray  # (B,) nodes of the blocks before
    nodes: np.ndarray  # (n, lanes) node by place and lane
    slot: np.ndarray  # (N,) by node

    @classmethod
    def of(cls, fibers: np.ndarray, own: np.ndarray, node_start: np.ndarray) -> NodeBlocks:
        """Blocks of these fibers, of which the first `own` (B,) of a block are its own."""
        counts = np.diff(node_start)[fibers[:, 0]]
        start = np.concatenate([[0], np.cumsum(counts)])
        rows = [
            node_start[:-1][block][None] + np.arange(count)[:, None]
            for block, count in zip(fibers, counts, strict=True)
        ]
        nodes = np.concatenate(rows)
        lanes = fibers.shape[1]
        mine = np.repeat(np.arange(lanes)[None] < own[:, None], counts, axis=0)
        slot = np.zeros(node_start[-1], dtype=np.int32)
        slot[nodes[mine]] = np.flatnonzero(mine)
        return cls(start[:-1].astype(np.int32), nodes, slot)

    def zeros(self, numbers: int, kind: Any, device: str) -> Any:
        """Room for so many numbers per node."""
        return aligned_zeros(numbers * self.nodes.size, kind, device)

    def fill(self, array: Any, values: np.ndarray) -> None:
        """Bring values (N,) or (N, c) of nodes into their blocks."""
        rows = values.reshape(len(values), -1)[self.nodes]  # place, lane, number
        array.assign(np.ascontiguousarray(rows.transpose(0, 2, 1)).ravel())

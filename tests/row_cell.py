"""What tests of contact rows share: a cell with its list, a step taken, its rows as tuples."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp

from tests.cell import BOX_IMAGES, Kind, bent_fiber
from tests.reference.chain_rows import PairRow, Side, pair_rows
from warpfiber.passes.contact_rows import ContactRows
from warpfiber.passes.executor import Executor
from warpfiber.passes.neighbors import NeighborList
from warpfiber.simulation import Simulation

Start = Callable[..., Simulation]
NEAR = 0.5  # radii: rows with a smaller predicted gap are looked at


def never() -> bool:
    """Nothing halts."""
    return False


@dataclass
class RowCell:
    """A cell at the start of a step and what it moves to; built by `row_cell`."""

    sim: Simulation
    pairs: NeighborList
    node_back: Any
    lattice_back: Any
    lattice_now: Any
    step_size: Any

    @property
    def real(self) -> Any:
        """NumPy type of the run."""
        return self.sim.model.precision.numpy

    def rows(self, **keys: Any) -> ContactRows:
        """Rows of this cell, not yet made."""
        return ContactRows(
            self.sim.model,
            self.sim.state,
            self.pairs,
            node_back=self.node_back,
            lattice_back=self.lattice_back,
            lattice_now=self.lattice_now,
            step_size=self.step_size,
            **({"keep": NEAR} | keys),
        )

    def made(self, workers: int = 1, **keys: Any) -> ContactRows:
        """Rows of this cell, grown until they fit."""
        rows = self.rows(**keys)
        while True:
            run(rows, workers)
            if not rows.grow():
                return rows

    def radius(self, segment: int) -> float:
        """Radius of a segment's fiber."""
        return float(self.group(segment)["radius"])

    def group(self, segment: int) -> dict[str, Any]:
        """Constants of a segment's fiber."""
        host = self.sim.model.host
        group = host["fiber_group"][host["segment_fiber"][segment]]
        return self.sim.model.group_rows[int(group)]

    def listed(self) -> list[tuple[int, int, np.ndarray]]:
        """(i, j, image numbers) in the order of the list."""
        found = []
        for i, j, code in zip(*self.pairs.host_pairs(), strict=True):
            bits = [(int(code) >> turn) % (2 * BOX_IMAGES) - BOX_IMAGES for turn in (0, 10, 20)]
            found.append((int(i), int(j), np.array(bits, float)))
        return found

    def offsets(self, image: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Image offset at the start and at the end of the step."""
        both = [a.numpy()[0].astype(float) @ image for a in (self.lattice_back, self.lattice_now)]
        return both[0], both[1]

    def side(self, segment: int, offset: np.ndarray, alone: bool) -> tuple[Side, np.ndarray]:
        """A segment at the start and the motion of its two nodes; `alone`: as if a rod."""
        host = self.sim.model.host
        nodes = self.node_back.numpy().astype(float)
        moved = self.sim.state.node_pos.numpy().astype(float) - nodes
        node = int(host["segment_node"][segment])
        fiber = int(host["segment_fiber"][segment])
        begin, end = host["fiber_node_start"][fiber : fiber + 2]
        last = node + 2 == end or alone
        side = Side(
            nodes[node] + offset,
            nodes[node + 1] + offset,
            None if node == begin or alone else nodes[node - 1] + offset,
            None if last else nodes[node + 2] + offset,
        )
        return side, moved[node : node + 2]

    def expected(
        self, keep: float = NEAR, near_now: float = -np.inf
    ) -> list[tuple[int, int, tuple[int, ...], PairRow]]:
        """Rows of pairs by the restatement, in the order of the list."""
        found = []
        fiber = self.sim.model.host["segment_fiber"]
        for i, j, image in self.listed():
            back, now = self.offsets(image)
            alone = bool(fiber[i] == fiber[j] and not image.any())
            side_i, motion_i = self.side(i, np.zeros(3), alone)
            side_j, motion_j = self.side(j, back, alone)
            radii = (self.radius(i), self.radius(j))
            turn = tuple(int(m) for m in image)
            motion_j = motion_j + (now - back)
            for row in pair_rows(side_i, side_j, motion_i, motion_j, radii, keep, near_now):
                found.append((i, j, turn, row))
        return found


def run(rows: ContactRows, workers: int = 1) -> None:
    """One pass over the launches."""
    executor = Executor(rows.launches(), rows.model.device, workers)
    executor.run(1, never)
    executor.close()


def row_cell(
    start: Start,
    kinds: tuple[Kind, ...],
    fibers: list[np.ndarray],
    which: Any = None,
    *,
    move: Any = None,
    precision: str = "float64",
    reach: float = 4.0,
    lattice: np.ndarray | None = None,
    lattice_now: np.ndarray | None = None,
    step: float = 0.1,
    workers: int = 1,
    **tables: Any,
) -> RowCell:
    """Cell with a list of reach `reach`, its nodes moved by `move` (N, 3) or a function of them."""
    sim = start(kinds, fibers, which, numerics={"precision": precision}, **tables)
    model, state = sim.model, sim.state
    p, device = model.precision, model.device
    if lattice is not None:
        state.lattice.assign(lattice[None])
    longest = max(row["rest"] for row in model.group_rows)
    pairs = NeighborList(
        model, state, reach=reach, skin=0.2, longest_rest=longest, stretch=1.2, workers=workers
    )
    pairs.build()
    back = wp.clone(state.node_pos)
    nodes = back.numpy().astype(float)
    moved = np.zeros_like(nodes) if move is None else (move(nodes) if callable(move) else move)
    state.node_pos.assign((nodes + moved).astype(p.numpy))
    now = state.lattice.numpy()[0]

    def put(values: np.ndarray) -> Any:
        return wp.array(values[None].astype(p.numpy), dtype=p.mat33, device=device)

    return RowCell(
        sim,
        pairs,
        back,
        put(now),
        put(now if lattice_now is None else lattice_now),
        wp.array([step], dtype=wp.float64, device=device),
    )


def host_rows(rows: ContactRows) -> dict[str, np.ndarray]:
    """All row arrays, cut to the rows that there are."""
    n = int(rows.row_count.numpy()[0])
    names = "i j key s t normal base compliance force".split()
    return {name: getattr(rows, f"row_{name}").numpy()[:n] for name in names}


def dropped(kinds: tuple[Kind, ...], count: int, seed: int, edge: float) -> tuple[list, np.ndarray]:
    """Fibers at random in a cube; many overlap."""
    rng = np.random.default_rng(seed)
    which = np.arange(count) % len(kinds)
    return [bent_fiber(kinds[k], rng, edge * rng.random(3), spread=1.0) for k in which], which


def shaken(seed: int, size: float = 0.2) -> Any:
    """Motion of nodes over a step."""

    def move(nodes: np.ndarray) -> np.ndarray:
        return size * np.random.default_rng(seed).normal(size=nodes.shape)

    return move

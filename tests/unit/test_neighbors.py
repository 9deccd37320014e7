"""Neighbor list = brute force over all segments and images, in every kind of box.

Sets (i, j, image) are compared exactly: no distance of the seeded cells is within rounding of the
reach. Brute force is `tests.reference.segments`, which looks at any image of any box.
"""

from __future__ import annotations

import numpy as np
import pytest

from tests.cell import Kind, isotropic, straight_fiber
from tests.pair_list import SHEAR, Start, cell, check_list, random_fibers
from tests.reference import segments as sg
from warpfiber.model import BAD_FIBER, TORN
from warpfiber.passes import row_search
from warpfiber.passes.neighbors import NeighborList
from warpfiber.passes.rows import make_row_kernels
from warpfiber.simulation import Diverged

PERIODIC = ["periodic"] * 3


MIXED = (Kind(3, 3.0), Kind(6, 1.0, radius=0.6), Kind(1, 4.5))


@pytest.mark.parametrize("boundary", [None, PERIODIC, ["periodic", "open", "periodic"]])
def test_random(start: Start, boundary: list[str] | None) -> None:
    """Three kinds, two radii, bent enough to meet themselves; open, periodic, partly periodic."""
    edges = [40.0, 44.0, 36.0]
    fibers, which = random_fibers(MIXED, 90, edges, seed=1)
    tables = {} if boundary is None else {"box": {"size": edges, "boundary": boundary}}
    listed = check_list(cell(start, MIXED, fibers, which, **tables), least=50)
    images = {image for _, _, image in listed}
    wraps = [any(image[axis] for image in images) for axis in range(3)]
    assert wraps == [boundary is not None, boundary == PERIODIC, boundary is not None]


@pytest.mark.parametrize("room", [2, 4])
def test_little_room_for_midpoints(
    start: Start, monkeypatch: pytest.MonkeyPatch, room: int
) -> None:
    """Plain kernels that settle a few midpoints at a time find the same pairs."""
    monkeypatch.setattr(row_search, "ROOM", room)
    for made in (row_search.make_row_search, make_row_kernels):
        made.cache_clear()
    try:
        test_random(start, PERIODIC)
    finally:
        for made in (row_search.make_row_search, make_row_kernels):
            made.cache_clear()


def test_order_is_canonical(start: Start) -> None:
    """Sorted by owner, then partner; `out_start`, `in_start`, `in_pair` point at the right rows."""
    fibers, which = random_fibers(MIXED, 90, [40.0] * 3, seed=2)
    sim = cell(start, MIXED, fibers, which, box={"size": [40.0] * 3})
    pairs = sim.method.list
    assert pairs is not None
    i, j, _ = pairs.host_pairs()
    assert (np.diff(i.astype(np.int64) * 1000 + j) >= 0).all()
    assert (i <= j).all()
    segments = np.arange(sim.model.segment_count + 1)
    assert (pairs.out_start.numpy() == np.searchsorted(i, segments)).all()
    in_start, in_pair = pairs.in_start.numpy(), pairs.in_pair.numpy()[: len(i)]
    assert (in_start == np.searchsorted(np.sort(j), segments)).all()
    assert sorted(in_pair) == list(range(len(i)))
    assert (j[in_pair] == np.sort(j)).all()


def degenerate_fibers() -> dict[str, list[np.ndarray]]:
    rod, fine = Kind(1, 6.0), Kind(5, 2.0)
    grid = [(0.0, 2.3 * i, 2.3 * j) for i in range(4) for j in range(4)]
    return {
        "parallel": [straight_fiber(rod, (1, 0, 0), c) for c in grid],
        "shifted": [straight_fiber(rod, (1, 0, 0), (1.7 * k, 2.3 * k, 0)) for k in range(12)],
        "collinear": [straight_fiber(rod, (1, 0, 0), (13.9 * k, 20, 20)) for k in range(3)],
        "coincident": [straight_fiber(rod, (1, 1, 0), (20, 20, 20)) for _ in range(3)],
        "crossing": [straight_fiber(rod, a, (20, 20, 20)) for a in np.eye(3)],
        "on the face": [
            straight_fiber(fine, (0, 1, 0), (x, 20, z)) for x in (0, 42.0, 1.5) for z in (0, 42)
        ],
        "at the corner": [straight_fiber(fine, a, (42.0, 42.0, 0)) for a in isotropic(RNG, 6)],
        "own image": [straight_fiber(Kind(3, 6.7), (1, 0.001, 0), (0, 20, 20))],
    }


RNG = np.random.default_rng(5)
DEGENERATE = degenerate_fibers()


@pytest.mark.parametrize("name", DEGENERATE)
def test_degenerate(start: Start, name: str) -> None:
    """Parallel, collinear, coincident, crossing, on faces and corners, a rod and its own image."""
    fibers = DEGENERATE[name]
    n = len(fibers[0]) - 1
    length = float(np.linalg.norm(fibers[0][-1] - fibers[0][0]))
    kind = Kind(n, length / (2.0 * n))
    sim = cell(start, (kind,), fibers, box={"size": [42.5 if name == "own image" else 42.0] * 3})
    check_list(sim)


def test_wrapped_positions(start: Start) -> None:
    """Fibers many boxes away are wrapped; unwrapped positions stay what they were (1e-12)."""
    kind = Kind(4, 2.0)
    fibers, _ = random_fibers((kind,), 40, [30.0] * 3, seed=3)
    rng = np.random.default_rng(4)
    moved = [nodes + 30.0 * rng.integers(-7, 8, size=3) for nodes in fibers]
    sim = cell(start, (kind,), moved, box={"size": [30.0] * 3})
    check_list(sim, least=20)
    inside = sim.state.node_pos.numpy()
    assert inside.min() > -10.0 and inside.max() < 40.0
    assert np.abs(sim.node_pos - np.concatenate(moved)).max() < 1e-12 * 240


@pytest.mark.parametrize(
    ("edges", "kind", "count"),
    [
        ([12.5] * 3, Kind(8, 4.0), 3),  # fibers five boxes long
        ([24.0, 12.5, 50.0], Kind(5, 4.0), 8),  # unlike edges
        ([9.5, 9.5, 9.5], Kind(12, 2.0), 3),
    ],
)
def test_small_boxes(start: Start, edges: list[float], kind: Kind, count: int) -> None:
    """Boxes of few rows of cells: two images of one pair can both be near."""
    fibers, _ = random_fibers((kind,), count, edges, seed=7, spread=0.3)
    sim = cell(start, (kind,), fibers, box={"size": edges})
    cells = sim.method.list.cells.numpy()[0]
    assert cells.min() <= 3
    listed = check_list(sim, least=5)
    pairs = [(i, j) for i, j, _ in listed]
    assert any(i == j or pairs.count((i, j)) > 1 for i, j in pairs) or count > 3


@pytest.mark.parametrize("offset", [0.3, 0.499, 0.501, -0.7, 3.4])
def test_sheared_lattice(start: Start, offset: float) -> None:
    """Shear beyond half a box is reset to less; images then count in the new lattice."""
    kind = Kind(4, 2.0)
    edges = [30.0, 22.0, 26.0]
    fibers, _ = random_fibers((kind,), 50, edges, seed=8)
    fibers = [nodes + (0.0, 0.0, 26.0 * (k % 3 - 1)) for k, nodes in enumerate(fibers)]
    sim = start(
        (kind,),
        fibers,
        flow=SHEAR,
        box={"size": edges},
        contact={"law": "exponential", "strength": 1.0, "decay": 2.0},
    )
    lattice = np.diag(edges)
    lattice[0, 2] = offset * edges[0]
    sim.state.lattice.assign(lattice[None])
    before = np.concatenate(fibers)
    sim.method.prepare()
    now = sim.state.lattice.numpy()[0]
    assert abs(now[0, 2]) <= 0.5 * edges[0] * (1 + 1e-12)
    assert abs((lattice - now)[0, 2] / edges[0] - round(offset)) < 1e-12
    check_list(sim, least=20)
    assert np.abs(sim.node_pos - before).max() < 1e-11
    # a second time, now that fibers are counted in boxes above and below
    assert np.ptp(sim.state.fiber_image.numpy()[:, 2]) >= 2
    now[0, 2] += offset * edges[0]
    sim.state.lattice.assign(now[None])
    before = sim.node_pos
    sim.method.refresh_list()
    check_list(sim, least=20)
    assert np.abs(sim.node_pos - before).max() < 1e-11


@pytest.mark.parametrize(
    "gradient",
    [
        [[0.5, 0.0, 0.0], [0.0, 0.0, 0.0], [0.0, 0.0, -0.5]],
        [[0.4, 0.3, 0.0], [-0.2, -0.1, 0.5], [0.1, 0.0, -0.3]],
    ],
)
def test_other_lattices(start: Start, gradient: list[list[float]]) -> None:
    """Planar extension and a general flow: the lattice is F times the box, never reset."""
    kind = Kind(3, 2.0)
    edges = [30.0, 34.0, 40.0]
    fibers, _ = random_fibers((kind,), 60, edges, seed=9)
    flow = {"kind": "gradient", "gradient": gradient, "viscosity": 1.0}
    sim = cell(start, (kind,), fibers, flow=flow, box={"size": edges}, numerics={"dt": 2e-3})
    units = sim.model.units
    sim.step(300)
    sim.method.refresh_list()
    check_list(sim, least=20)
    # exp(L t) by its series, t = 0.6: 20 terms leave nothing
    x = np.asarray(gradient) * 0.6
    term = expected = np.eye(3)
    for k in range(1, 20):
        term = term @ x / k
        expected = expected + term
    lattice = sim.state.lattice.numpy()[0] * units.length
    # the clock's series stops at the fourth order: 300 steps of (L dt)^5/120
    assert np.abs(lattice - expected @ np.diag(edges)).max() < 1e-11 * 40


@pytest.mark.parametrize(("native", "workers"), [(False, 1), (True, 1), (True, 2), (True, 3)])
def test_capacities_grow(start: Start, native: bool, workers: int) -> None:
    """Rows and pairs that start at one grow until everything fits: the same list."""
    fibers, which = random_fibers(MIXED, 90, [40.0] * 3, seed=2)
    sim = cell(start, MIXED, fibers, which, box={"size": [40.0] * 3})
    roomy = sim.method.list
    assert roomy is not None
    expected = roomy.host_pairs()
    tight = NeighborList(
        sim.model,
        sim.state,
        reach=roomy.reach,
        skin=roomy.skin,
        longest_rest=roomy.longest_rest,
        row_capacity=1,
        pair_capacity=1,
        native=native,
        workers=workers,
    )
    assert tight.build()
    assert tight.grow_count >= (1 if native else 2)
    assert tight.pair_count == len(expected[0]) > 100
    for got, want in zip(tight.host_pairs(), expected, strict=True):
        assert (got == want).all()
    for name in ("out_start", "in_start"):
        assert (getattr(tight, name).numpy() == getattr(roomy, name).numpy()).all()
    tight.close()


@pytest.mark.parametrize(
    ("orientation", "aspect_ratio", "count", "edge"),
    [
        ("isotropic", 10, 1500, 110.0),
        ("planar", 10, 1500, 110.0),
        ("aligned", 10, 1500, 110.0),
        ("isotropic", 40, 1000, 200.0),
        ("planar", 25, 1200, 130.0),
        ("aligned", 4, 3000, 70.0),
    ],
)
def test_contact_count(
    start: Start, orientation: str, aspect_ratio: int, count: int, edge: float
) -> None:
    """Penetrable spherocylinders dropped at random: (F - 1) V_excluded/V touching per fiber.

    Volume fractions 0.03 to 0.21. The number of touching pairs is a sum of nearly independent rare
    events: standard deviation sqrt(n). Bound 4 of them, 2 to 7 % here.
    """
    rng = np.random.default_rng(21)
    kind = Kind(1, aspect_ratio - 1.0)
    axis = isotropic(rng, count)
    if orientation == "planar":
        angle = 2.0 * np.pi * rng.random(count)
        axis = np.stack([np.cos(angle), np.sin(angle), np.zeros(count)], axis=1)
    elif orientation == "aligned":
        axis = np.tile([1.0, 0.0, 0.0], (count, 1))
    fibers = [straight_fiber(kind, p, edge * rng.random(3)) for p in axis]
    sim = cell(start, (kind,), fibers, box={"size": [edge] * 3}, quantities=["contacts"])
    row = sim.measure()
    crossing = {"isotropic": np.pi / 4, "planar": 2 / np.pi, "aligned": 0.0}[orientation]
    # expected_contacts takes the volume fraction of spherocylinders with d = 1
    d, length = 1.0, kind.aspect_ratio - 1.0
    volume = np.pi / 4 * d**2 * length + np.pi / 6 * d**3
    fraction = (count - 1) * volume / (edge / 2.0) ** 3
    expected = sg.expected_contacts(fraction, kind.aspect_ratio, crossing)
    pairs = 0.5 * expected * count
    assert abs(row["contacts_per_fiber"] - expected) < 4.0 * expected / np.sqrt(pairs)
    assert row["coordination_number"] == row["contacts_per_fiber"]  # one segment per fiber


@pytest.mark.parametrize("native", [True, False])
@pytest.mark.parametrize("thrown", [1e12, 1e79])
def test_a_thrown_fiber_grows_no_list(start: Start, native: bool, thrown: float) -> None:
    """A diverging step may throw a whole fiber: the run stops and names it, capacities stay."""
    fibers, which = random_fibers(MIXED, 90, [40.0] * 3, seed=2)
    sim = cell(start, MIXED, fibers, which, box={"size": [40.0] * 3})
    pairs = sim.method.list
    assert pairs is not None
    tight = NeighborList(
        sim.model,
        sim.state,
        reach=pairs.reach,
        skin=pairs.skin,
        longest_rest=pairs.longest_rest,
        row_capacity=1,
        pair_capacity=1,
        native=native,
    )
    nodes = sim.state.node_pos.numpy().copy()
    mine = slice(*sim.fiber_node_start[7:9])
    nodes[mine] += thrown
    sim.state.node_pos.assign(nodes)
    tight.build()
    status = sim.state.status.numpy()
    assert status[TORN] == 1 and status[BAD_FIBER] == 7
    assert tight.pair_capacity == 1 and tight.grow_count == 0
    with pytest.raises(Diverged, match="fiber 7"):
        sim.step(1)
    tight.close()

"""Rows of contact on the device against the NumPy restatements.

Units: a = eta = 1. Rods are chains of one segment. Tolerances: float64 closest points of nearly
parallel segments are known to eps / sin^2, which random ones keep below 1e-9; float32 to
eps * size (box 30, 4e-6) over the sine of the smallest angle met, 1e-3 in all.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from tests.cell import Kind, straight_fiber
from tests.placed import segment_distance
from tests.reference.contact_rows import Line, line_rows
from tests.row_cell import NEAR, RowCell, dropped, host_rows, row_cell, run, shaken
from warpfiber.model import HALT
from warpfiber.simulation import Simulation

Start = Callable[..., Simulation]
TOLERANCE = {"float64": 1e-9, "float32": 1e-3}
SHEAR = {"kind": "simple_shear", "shear_rate": 1.0, "viscosity": 1.0}
BOX = {"size": [26.0, 22.0, 24.0]}


def check_pairs(cell: RowCell, keep: float = NEAR, least: int = 20, **keys: float) -> int:
    """Rows of pairs are those of the restatement; how many."""
    tolerance = TOLERANCE[cell.sim.model.precision.name]
    rows = cell.made(keep=keep, **keys)
    got = host_rows(rows)
    expected = cell.expected(keep, **keys)
    assert len(expected) >= least
    of_pairs = got["j"] >= 0
    assert int(of_pairs.sum()) == len(expected)
    for r, (i, j, _, row) in zip(np.flatnonzero(of_pairs), expected, strict=True):
        assert (got["i"][r], got["j"][r]) == (i, j)
        assert abs(got["s"][r] - row.s) < tolerance
        assert abs(got["t"][r] - row.t) < tolerance
        assert abs(got["normal"][r] - row.normal).max() < tolerance
        assert abs(got["base"][r] - row.base) < tolerance
    assert not got["compliance"].any()
    check_indices(rows, got)
    return len(expected)


def check_indices(rows: Any, got: dict[str, np.ndarray]) -> None:
    """The rows of every segment and pair are where the indices say."""
    start = rows.row_out_start.numpy()
    assert start[0] == 0 and start[-1] == len(got["i"])
    assert (np.repeat(np.arange(len(start) - 1), np.diff(start)) == got["i"]).all()
    count, first = rows.pair_row_count.numpy(), rows.pair_row.numpy()
    owner, partner, _ = rows.pairs.host_pairs()
    seen = np.zeros(len(got["i"]), int)
    for k in range(len(owner)):
        mine = slice(first[k], first[k] + count[k])
        if count[k]:
            assert (got["i"][mine] == owner[k]).all() and (got["j"][mine] == partner[k]).all()
            seen[mine] += 1
    assert (seen == (got["j"] >= 0)).all()


RODS = (Kind(1, 8.0),)
CHAINS = (Kind(3, 3.0), Kind(4, 1.5, radius=0.6))


@pytest.mark.parametrize("precision", ["float64", "float32"])
@pytest.mark.parametrize("kinds", [RODS, (Kind(1, 6.0), Kind(1, 9.0, radius=0.6)), CHAINS])
def test_rows_of_random_fibers(start: Start, kinds: tuple[Kind, ...], precision: str) -> None:
    fibers, which = dropped(kinds, 40, 1, 20.0)
    check_pairs(row_cell(start, kinds, fibers, which, move=shaken(2), precision=precision))


@pytest.mark.parametrize("kinds", [RODS, CHAINS])
def test_near_ends_have_rows_whatever_is_foreseen(start: Start, kinds: tuple[Kind, ...]) -> None:
    """Pairs that would move far apart; more rows the larger the gap that counts is."""
    fibers, which = dropped(kinds, 40, 1, 20.0)
    cell = row_cell(start, kinds, fibers, which, move=shaken(2, 2.0))
    counts = [check_pairs(cell)]
    counts += [check_pairs(cell, near_now=near) for near in (0.5, 1.0, 2.0)]
    assert counts[0] < counts[1] < counts[2] < counts[3]


@pytest.mark.parametrize("precision", ["float64", "float32"])
@pytest.mark.parametrize("kinds", [RODS, CHAINS])
def test_rows_of_sheared_images(start: Start, kinds: tuple[Kind, ...], precision: str) -> None:
    fibers, which = dropped(kinds, 60, 3, 24.0)
    lattice = np.diag([26.0, 22.0, 24.0])
    lattice[0, 2] = 7.0
    later = lattice.copy()
    later[0, 2] = 7.9
    cell = row_cell(
        start,
        kinds,
        fibers,
        which,
        move=shaken(4),
        precision=precision,
        lattice=lattice,
        lattice_now=later,
        box=BOX,
        flow=SHEAR,
    )
    assert sum(image[2] != 0 for _, _, image, _ in cell.expected()) > 3
    check_pairs(cell)


def rows_of(start: Start, fibers: list[np.ndarray], kinds: Any = RODS, **keys: Any) -> dict:
    which = keys.pop("which", [0] * len(fibers))
    return host_rows(row_cell(start, kinds, fibers, which, **keys).made())


def test_rods_have_the_rows_of_their_lines(start: Start) -> None:
    # the restatement for chains is that for rods where every fiber has one segment
    fibers, which = dropped(RODS, 30, 5, 16.0)
    cell = row_cell(start, RODS, fibers, which)
    expected = []
    for i, j, _ in cell.listed():
        lines = []
        for nodes in (fibers[i], fibers[j]):
            span = nodes[1] - nodes[0]
            length = float(np.linalg.norm(span))
            lines.append(Line(nodes.mean(axis=0), span / length, 0.5 * length))
        expected += [(i, j, r[3]) for r in line_rows(*lines, 1.0) if r[3] < 0.5]
    got = host_rows(cell.made())
    assert [(int(i), int(j)) for i, j in zip(got["i"], got["j"], strict=True)] == [
        (i, j) for i, j, _ in expected
    ]
    assert np.allclose(got["base"], [gap for *_, gap in expected], rtol=0.0, atol=1e-9)


def test_parallel_rods_have_the_middle_and_the_ends_of_the_overlap(start: Start) -> None:
    lower = straight_fiber(RODS[0], [1, 0, 0], [0, 0, 0])
    upper = straight_fiber(RODS[0], [1, 0, 0], [6, 0, 2.0])
    got = rows_of(start, [lower, upper])
    # the overlap is s = 6/16 ... 1; the closest points are taken at s = 1/2
    assert sorted(np.round(got["s"], 12)) == [0.375, 0.5, 1.0]
    assert np.allclose(got["base"], 0.0, atol=1e-12)
    assert np.allclose(got["normal"], [0.0, 0.0, 1.0], atol=1e-12)


def test_collinear_rods_have_one_row_at_their_tips(start: Start) -> None:
    left = straight_fiber(RODS[0], [1, 0, 0], [0, 0, 0])
    right = straight_fiber(RODS[0], [1, 0, 0], [18.1, 0, 0])
    got = rows_of(start, [left, right])
    tip = [r for r in range(len(got["s"])) if got["s"][r] == 1.0 and got["t"][r] == 0.0]
    assert len(tip) == 1
    assert abs(got["base"][tip[0]] - 0.1) < 1e-12
    assert np.allclose(got["normal"][tip[0]], [1.0, 0.0, 0.0], atol=1e-12)


@pytest.mark.parametrize("precision", ["float64", "float32"])
def test_lines_that_cross_have_the_common_normal(start: Start, precision: str) -> None:
    one = straight_fiber(RODS[0], [1, 0, 0], [0, 0, 0])
    other = straight_fiber(RODS[0], [0, 1, 0], [1, 1, 0])
    got = rows_of(start, [one, other], precision=precision)
    crossing = got["base"].argmin()
    assert abs(abs(got["normal"][crossing][2]) - 1.0) < 1e-6
    assert abs(got["base"][crossing] + 2.0) < 1e-5


def test_a_parallel_chain_has_one_row_per_joint(start: Start) -> None:
    kind = (Kind(4, 3.0),)
    lower = straight_fiber(kind[0], [1, 0, 0], [0, 0, 0])
    for along in (0.0, 0.3, -0.3):
        got = rows_of(start, [lower, straight_fiber(kind[0], [1, 0, 0], [along, 0, 2.0])], kind)
        node = got["i"] + got["s"]
        # joints at 0 ... 4, and the middles of segment pairs, whose closest points are not unique
        for joint in range(5):
            near = np.abs(node - joint) * 6.0 < 1.0
            assert near.sum() == 1, (along, joint, node)


def test_a_joint_that_touches_is_one_row(start: Start) -> None:
    kinds = (Kind(2, 4.0), Kind(1, 6.0))
    bent = np.array([[-7.0, 0.0, 4.0], [0.0, 0.0, 0.0], [7.0, 0.0, 4.0]])
    rod = straight_fiber(kinds[1], [0, 1, 0], [0, 0, -2.05])
    got = rows_of(start, [bent, rod], kinds, which=[0, 1])
    assert len(got["i"]) == 1
    assert (got["i"][0], got["s"][0], got["j"][0]) == (0, 1.0, 2)
    assert abs(got["t"][0] - 0.5) < 1e-12
    assert abs(got["base"][0] - 0.05) < 1e-12


def test_two_joints_that_touch_are_one_row(start: Start) -> None:
    kind = (Kind(2, 4.0),)
    upper = np.array([[-7.0, 0.0, 4.0], [0.0, 0.0, 0.0], [7.0, 0.0, 4.0]])
    lower = np.array([[0.0, -7.0, -6.1], [0.0, 0.0, -2.1], [0.0, 7.0, -6.1]])
    got = rows_of(start, [upper, lower], kind)
    assert len(got["i"]) == 1
    assert (got["i"][0], got["s"][0], got["j"][0], got["t"][0]) == (0, 1.0, 2, 1.0)
    assert abs(got["base"][0] - 0.1) < 1e-12


@pytest.mark.parametrize("seed", range(6))
def test_every_near_place_of_two_chains_is_covered(start: Start, seed: int) -> None:
    # nodes nearer than the rows reach, and crossings, have a row within two radii along both
    kind = (Kind(4, 2.0),)
    rng = np.random.default_rng(seed)
    fibers = []
    for height in (0.0, 2.1):
        x = np.linspace(-8, 8, 5)
        fibers.append(np.stack([x, 0.4 * rng.normal(size=5), height + 0.1 * rng.normal(size=5)], 1))
    got = rows_of(start, fibers, kind)
    arcs = 4.0 * np.stack([got["i"] + got["s"], got["j"] - 4 + got["t"]], 1)
    fine = np.linspace(0, 4, 401)
    curves = [np.stack([np.interp(fine, range(5), f[:, k]) for k in range(3)], 1) for f in fibers]
    for own, other, column in ((0, 1, 0), (1, 0, 1)):
        for node in range(5):
            distance = np.linalg.norm(curves[other] - fibers[own][node], axis=1)
            if distance.min() < 2.4:
                place = np.zeros(2)
                place[column], place[1 - column] = node, fine[distance.argmin()]
                apart = np.abs(arcs - 4.0 * place).max(axis=1)
                assert apart.min() < 2.0
    # and rows of one place are not repeated, but for a nearer one: two joints beside each other
    apart = np.abs(arcs[:, None] - arcs[None]).max(axis=2)
    assert ((apart < 0.1).sum(axis=1) <= 2).all()
    assert ((apart < 0.1).sum(axis=1) > 1).sum() <= 2


def test_rows_do_not_depend_on_the_workers(start: Start) -> None:
    fibers, which = dropped(CHAINS, 60, 11, 22.0)
    cell = row_cell(start, CHAINS, fibers, which, move=shaken(1), box=BOX, flow=SHEAR)
    one, two = (host_rows(cell.made(workers, lubrication="paper")) for workers in (1, 2))
    for name, values in one.items():
        assert (values == two[name]).all(), name


def test_a_small_capacity_grows_and_keeps_the_forces(start: Start) -> None:
    fibers, which = dropped(CHAINS, 40, 12, 18.0)
    cell = row_cell(start, CHAINS, fibers, which, move=shaken(1))
    plenty = cell.made()
    tight = cell.rows(capacity=1)
    run(tight)
    need = len(host_rows(plenty)["i"])
    assert int(tight.row_need.numpy()[0]) == need > 1
    assert not tight.row_count.numpy().any()
    assert not tight.row_out_start.numpy().any()
    assert not tight.pair_row_count.numpy()[: cell.pairs.pair_count].any()
    assert tight.grow() and not tight.grow()
    run(tight)
    for name, values in host_rows(plenty).items():
        assert (values == host_rows(tight)[name]).all(), name


def forced(rows: Any) -> np.ndarray:
    """A different force on every row."""
    values = rows.row_force.numpy()
    values[:] = 1.0 + np.arange(len(values))
    rows.row_force.assign(values)
    return host_rows(rows)["force"].copy()


def test_forces_start_from_those_of_the_last_step(start: Start) -> None:
    fibers, which = dropped(CHAINS, 40, 13, 20.0)
    cell = row_cell(start, CHAINS, fibers, which, box=BOX, flow=SHEAR)
    rows = cell.made(lubrication="paper")
    force = forced(rows)
    before = host_rows(rows)
    run(rows)
    assert (host_rows(rows)["force"] == force).all()
    # another list of the same fibers, wrapped into the box from elsewhere
    saved = rows.saved()
    state = cell.sim.state
    moved = state.node_pos.numpy() + cell.lattice_now.numpy()[0] @ [0.5, 0.5, 0.5]
    state.node_pos.assign(moved)
    cell.pairs.skin = 0.5
    cell.pairs.set_skin(0.5)
    cell.pairs.build()
    cell.node_back.assign(state.node_pos)
    again = cell.rows(lubrication="paper")
    again.restore(saved)
    run(again)
    while again.grow():
        run(again)
    after = host_rows(again)
    # the places are the same to rounding; rows at the edge of keeping may come or go
    assert abs(len(after["i"]) - len(before["i"])) <= 2
    old = {
        (int(i), int(j), int(k)): f
        for i, j, k, f in zip(before["i"], before["j"], before["key"], force, strict=True)
    }
    kept = [
        old.get((int(i), int(j), int(k))) == f
        for i, j, k, f in zip(after["i"], after["j"], after["key"], after["force"], strict=True)
    ]
    assert sum(kept) >= len(kept) - 2


def test_growing_keeps_the_forces(start: Start) -> None:
    fibers, which = dropped(CHAINS, 40, 13, 20.0)
    cell = row_cell(start, CHAINS, fibers, which)
    rows = cell.made()
    count = len(host_rows(rows)["i"])
    force = forced(rows)
    small = cell.rows(capacity=count)
    small.restore(rows.saved())
    small.keep = 1.5  # more rows than there is room for
    run(small)
    assert int(small.row_need.numpy()[0]) > count
    assert small.grow()
    small.keep = NEAR
    run(small)
    assert (host_rows(small)["force"] == force).all()


def halt(cell: RowCell, value: int) -> None:
    """Steps that do nothing from now on, or no longer."""
    words = cell.sim.state.status.numpy().copy()
    words[HALT] = value
    cell.sim.state.status.assign(words)


def test_forces_outlast_a_halted_step(start: Start) -> None:
    fibers, which = dropped(CHAINS, 40, 13, 20.0)
    cell = row_cell(start, CHAINS, fibers, which)
    rows = cell.made()
    force = forced(rows)
    again = cell.rows()
    again.restore(rows.saved())
    halt(cell, 1)
    run(again)
    halt(cell, 0)
    run(again)
    assert (host_rows(again)["force"] == force).all()


def test_a_halted_step_makes_nothing(start: Start) -> None:
    fibers, which = dropped(RODS, 30, 1, 16.0)
    cell = row_cell(start, RODS, fibers, which)
    rows = cell.made()
    before = host_rows(rows)
    halt(cell, 1)
    cell.sim.state.node_pos.assign(cell.sim.state.node_pos.numpy() + 0.5)
    run(rows)
    after = host_rows(rows)
    for name, values in before.items():
        assert (values == after[name]).all(), name


@pytest.mark.parametrize("seed", range(8))
def test_no_two_fibers_are_nearer_than_their_rows(start: Start, seed: int) -> None:
    """The least gap of two bent fibers is that of one of their rows, but for a thousandth."""
    fibers, which = dropped(CHAINS, 50, 100 + seed, 18.0)
    cell = row_cell(start, CHAINS, fibers, which)
    got = host_rows(cell.made())
    host = cell.sim.model.host
    rows: dict[tuple[int, int], float] = {}
    for i, j, gap in zip(got["i"], got["j"], got["base"], strict=True):
        pair = int(host["segment_fiber"][i]), int(host["segment_fiber"][j])
        pair = min(pair), max(pair)
        rows[pair] = min(rows.get(pair, np.inf), float(gap))
    x, node, fiber = cell.node_back.numpy(), host["segment_node"], host["segment_fiber"]
    i, j = np.triu_indices(len(node), 1)
    apart = segment_distance(x[node[i]], x[node[i] + 1], x[node[j]], x[node[j] + 1])
    radius = np.array([cell.radius(k) for k in range(len(node))])
    least: dict[tuple[int, int], float] = {}
    for k in np.flatnonzero(apart - radius[i] - radius[j] < 0.25):
        pair = int(fiber[i[k]]), int(fiber[j[k]])
        if pair[0] != pair[1]:
            gap = float(apart[k] - radius[i[k]] - radius[j[k]])
            least[pair] = min(least.get(pair, np.inf), gap)
    assert len(least) > 50
    for pair, gap in least.items():
        assert rows[pair] < gap + 2e-3, pair

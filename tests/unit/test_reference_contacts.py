"""The float64 restatement of contacts: closest points, pair list, vertex rule, forces, counts.

Source of the numbers: optimality conditions, sums without any cut, finite differences, the excluded
    volume of spherocylinders.
"""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest

from tests.reference import bead_chain as bc
from tests.reference import interactions as act
from tests.reference import segments as sg
from tests.reference.gradient import central_gradient


def assert_closest(p1: np.ndarray, q1: np.ndarray, p2: np.ndarray, q2: np.ndarray) -> None:
    """Optimality of the closest points: the distance is convex, so first order is enough."""
    s, t = sg.closest_points(p1, q1, p2, q2)
    c = (p2 + t * (q2 - p2)) - (p1 + s * (q1 - p1))
    scale = max(np.abs([p1, q1, p2, q2]).max(), 1.0) ** 2
    for slope, u in ((-2 * c @ (q1 - p1), s), (2 * c @ (q2 - p2), t)):
        assert 0.0 <= u <= 1.0
        if u > 0.0:
            assert slope <= 1e-9 * scale
        if u < 1.0:
            assert slope >= -1e-9 * scale


def test_closest_points() -> None:
    rng = np.random.default_rng(8)
    for _ in range(500):
        assert_closest(*rng.normal(size=(4, 3)) * rng.choice([0.1, 1.0, 10.0], size=(4, 1)))
    x, y = np.array([1.0, 0, 0]), np.array([0, 1.0, 0])
    zero = np.zeros(3)
    named = [
        (zero, x, y, x + y),  # parallel
        (zero, x, x + y, y),  # antiparallel
        (zero, x, 3 * x, 4 * x),  # collinear, apart
        (zero, 2 * x, x, 3 * x),  # collinear, overlapping
        (zero, x, zero, x),  # coincident
        (zero, x, x, x + y),  # touching at a node
        (zero, zero, y, y),  # both of no length
        (zero, zero, y - x, y + x),
        (y - x, y + x, zero, zero),
        (-x, x, -y, y),  # crossing
        (zero, x, 0.5 * x + y, 0.5 * x + 2 * y),
        (zero, x, y, x + y + 1e-9 * y),
    ]
    for case in named:
        assert_closest(*case)


LATTICES = {
    "cube": np.diag([6.0, 6.0, 6.0]),
    "sheared": np.array([[6.0, 0, 2.9], [0, 6.0, 0], [0, 0, 6.0]]),
    "skewed": np.array([[3.0, 1.0, 7.0], [0, 4.0, -1.0], [0.5, 0, 5.0]]),
}


def random_fibers(
    rng: np.random.Generator, fibers: int, chain: bc.Chain, size: float
) -> tuple[np.ndarray, list[int]]:
    nodes = [
        bc.walk_nodes(chain, rng, 0.3) @ np.linalg.qr(rng.normal(size=(3, 3)))[0]
        + size * rng.random(3)
        for _ in range(fibers)
    ]
    return np.concatenate(nodes), [k * (chain.segments + 1) for k in range(fibers + 1)]


@pytest.mark.parametrize("name", list(LATTICES))
def test_pair_list_is_complete(name: str) -> None:
    """Against copies of the whole system in all images, shift by shift."""
    rng = np.random.default_rng(9)
    chain = bc.Chain(3, 1.5)
    nodes, starts = random_fibers(rng, 3, chain, 6.0)
    lattice, reach = LATTICES[name], 2.0
    pairs = sg.find_pairs(
        nodes, starts, reach, radius=1.0, rest_length=chain.rest_length, lattice=lattice
    )
    found = {(p.i, p.j, p.shift): p.distance for p in pairs}
    seg = sg.list_segments(starts)
    expected = {}
    images = list(itertools.product(range(-15, 16), range(-6, 7), range(-6, 7)))
    offsets = np.array(images) @ lattice.T
    for i, j in itertools.product(range(9), repeat=2):
        apart = nodes[seg.node[j]] + offsets - nodes[seg.node[i]]
        for k in np.flatnonzero(np.abs(apart).max(axis=1) < reach + 2 * chain.rest_length):
            shift = images[k]
            if (j, shift) < (i, (0, 0, 0)) or (i == j and shift <= (0, 0, 0)):
                continue
            same = seg.fiber[i] == seg.fiber[j] and shift == (0, 0, 0)
            if same and (abs(i - j) - 1) * chain.rest_length < math.pi:
                continue
            moved = nodes[seg.node[j] : seg.node[j] + 2] + lattice @ np.array(shift)
            ends = (*nodes[seg.node[i] : seg.node[i] + 2], *moved)
            s, t = sg.closest_points(*ends)
            gap = ends[2] + t * (ends[3] - ends[2]) - ends[0] - s * (ends[1] - ends[0])
            if np.linalg.norm(gap) <= reach:
                expected[i, j, shift] = np.linalg.norm(gap)
    assert found.keys() == expected.keys()
    assert len(found) > 10
    for key, value in expected.items():
        assert found[key] == pytest.approx(value, abs=1e-12)
    # Fibers moved by whole box vectors: the same distances.
    moved = nodes.copy()
    moved[4:8] += lattice @ np.array([2.0, -3.0, 1.0])
    again = sg.find_pairs(
        moved, starts, reach, radius=1.0, rest_length=chain.rest_length, lattice=lattice
    )
    np.testing.assert_allclose(
        sorted(p.distance for p in again), sorted(found.values()), atol=1e-12
    )


def test_own_fiber_rule() -> None:
    assert sg.own_fiber_excluded(3, 4, 100.0, 1.0)
    assert sg.own_fiber_excluded(0, 2, 2.0, 1.0)  # SBCM: next-nearest segments are 2a apart
    assert not sg.own_fiber_excluded(0, 3, 2.0, 1.0)
    assert not sg.own_fiber_excluded(2, 0, 3.2, 1.0)
    straight = bc.straight_nodes(bc.Chain(10, 1.0), (1, 0, 0), (0, 0, 0))
    assert not sg.find_pairs(straight, [0, 11], 2.001, radius=1.0, rest_length=2.0)


@pytest.mark.parametrize("degrees", [90, 40, 15])
def test_vertex_rule_keeps_force_constant(degrees: float) -> None:
    """A fiber dragged along a straight one across its nodes: one contact, one force."""
    chain = bc.Chain(6, 3.0)
    lower = bc.straight_nodes(chain, (1, 0, 0), (0, 0, 0))
    angle = math.radians(degrees)
    upper = bc.straight_nodes(chain, (math.cos(angle), math.sin(angle), 0), (0, 0, 1.95))
    # The upper fiber always crosses at its middle node, the lower one at some of its nodes.
    for slide in np.linspace(-7.3, 7.1, 37):
        system = act.make_system(
            np.concatenate([lower, upper + [slide, 0, 0]]), [0, 7, 14], spacing=3.0
        )
        result = act.repulsion(system, 10.0, 50.0)
        assert len(result.pairs) == 1
        size = 10 * math.exp(-50 * (1.95 / 2 - 1))
        np.testing.assert_allclose(result.force[7:].sum(0), [0, 0, size], rtol=1e-9, atol=1e-9)


def test_vertex_rule_over_a_node() -> None:
    """Exactly at a joint of both fibers, naive counting sees four contacts."""
    chain = bc.Chain(2, 3.0)
    first = bc.straight_nodes(chain, (1, 0, 0), (0, 0, 0))
    second = bc.straight_nodes(chain, (0, 1, 0), (0, 0, 1.9))
    system = act.make_system(np.concatenate([first, second]), [0, 3, 6], spacing=3.0)
    assert len(act.pairs_within(system, act.CONTACT_RANGE)) == 4
    assert len(act.repulsion(system, 1.0, 50.0).pairs) == 1


def test_expected_contacts() -> None:
    """Random overlapping spherocylinders in a periodic box: mean within 4 standard errors."""
    rng = np.random.default_rng(10)
    fibers, box, aspect = 40, 22.0, 6.0  # radius 1
    chain = bc.Chain(1, aspect - 1)
    volume = 2 * math.pi * (aspect - 1) + 4 / 3 * math.pi
    # Each fiber meets fibers - 1 others at the density of the box.
    fraction = (fibers - 1) * volume / box**3
    means = []
    for _ in range(24):
        nodes = np.concatenate(
            [
                bc.straight_nodes(chain, rng.normal(size=3), box * rng.random(3))
                for _ in range(fibers)
            ]
        )
        pairs = sg.find_pairs(
            nodes,
            list(range(0, 2 * fibers + 1, 2)),
            2.0,
            radius=1.0,
            rest_length=chain.rest_length,
            lattice=np.eye(3) * box,
        )
        means.append(2 * len(pairs) / fibers)
    error = np.std(means, ddof=1) / math.sqrt(len(means))
    expected = sg.expected_contacts(fraction, aspect, math.pi / 4)
    assert abs(np.mean(means) - expected) < 4 * error
    assert error < 0.05 * expected


def dense_system(spacing: float = 2.5, unequal: bool = False, box: float = 9.0) -> act.System:
    rng = np.random.default_rng(11)
    chain = bc.Chain(3, spacing)
    nodes, starts = random_fibers(rng, 5, chain, box)
    gradient = bc.shear_gradient(1.0)
    return act.make_system(
        nodes,
        starts,
        node_vel=rng.normal(size=nodes.shape),
        radius=np.array([1.0, 1.3, 0.8, 1.1, 0.9]) if unequal else 1.0,
        spacing=spacing,
        bead_mass=0.4,
        lattice=np.array([[box, 0, 1.5], [0, box, 0], [0, 0, box]]),
        gradient=gradient,
    )


@pytest.mark.parametrize("unequal", [False, True])
def test_interactions_conserve_momentum(unequal: bool) -> None:
    system = dense_system(unequal=unequal)
    push = act.repulsion(system, 2.0, 5.0)
    drag = act.lubrication(system, 1.0)
    assert len(push.pairs) > 5
    assert drag.bead_pairs > 5
    assert drag.power < 0
    for force in (push.force, drag.force):
        np.testing.assert_allclose(force.sum(0), 0, atol=1e-12 * np.abs(force).max())
    # Torque of one pair, without images.
    open_system = system._replace(lattice=None, gradient=None)
    for force in (
        act.repulsion(open_system, 2.0, 5.0).force,
        act.lubrication(open_system, 1).force,
    ):
        torque = np.cross(system.node_pos, force).sum(0)
        np.testing.assert_allclose(torque, 0, atol=1e-11 * max(np.abs(force).max(), 1))


def test_repulsion_is_a_gradient() -> None:
    """Two crossed segments, closest points inside: F = -dU/dx with unequal radii."""
    nodes = np.array([[-3.0, 0.2, 0.1], [4, -0.3, 0], [0.3, -5, 2.1], [0.5, 4, 2.3]])

    def system(x: np.ndarray) -> act.System:
        return act.make_system(x, [0, 2, 4], radius=np.array([1.0, 1.4]), spacing=3.0)

    result = act.repulsion(system(nodes), 3.0, 20.0)
    gradient = central_gradient(lambda x: act.repulsion(system(x), 3.0, 20.0).energy, nodes, 1e-4)
    np.testing.assert_allclose(result.force, -gradient, rtol=1e-8, atol=1e-8)


def test_repulsion_law() -> None:
    assert act.repulsion_magnitude(2.0, 2.0, 7.0, 50.0) == pytest.approx(7.0)
    assert act.repulsion_magnitude(1.9, 2.0, 7.0, 50.0) == pytest.approx(7 * math.exp(2.5))
    assert act.repulsion_magnitude(2.0009, 2.0, 7.0, 50.0) > 0
    assert act.repulsion_magnitude(2.0011, 2.0, 7.0, 50.0) == 0
    assert act.repulsion_energy(2.001, 2.0, 7.0, 50.0) == pytest.approx(0, abs=1e-12)
    nodes = np.array([[0.0, 0, 0], [4, 0, 0], [1, 0, 1.95], [1, 3, 1.95]])
    force = act.repulsion(act.make_system(nodes, [0, 2, 4], spacing=2.0), 1.0, 50.0).force
    size = math.exp(1.25)
    # Closest points at s = 1/4 and t = 0; each fiber is pushed away from the other.
    np.testing.assert_allclose(force[:, 2], [-0.75 * size, -0.25 * size, size, 0], atol=1e-12)


def test_segment_beads() -> None:
    for spacing in (1.0, 1.2, 1.96, 2.0, 4.5, 49 / 13):
        segments = 4
        total = sum(act.segment_beads(spacing, p == 3)[1].sum() for p in range(segments))
        assert total == pytest.approx(segments * spacing + 1)
    fraction, weight = act.segment_beads(1.0, False)
    assert (fraction.tolist(), weight.tolist()) == ([0.0], [1.0])
    fraction, weight = act.segment_beads(1.2, True)
    assert fraction.tolist() == [0.0, 0.5, 1.0]
    np.testing.assert_allclose(weight, [1.0, 0.2, 1.0])
    fraction, weight = act.segment_beads(4.0, False)
    assert fraction.tolist() == [0.0, 0.25, 0.5, 0.75]
    assert weight.tolist() == [1.0, 1.0, 1.0, 1.0]


def test_lubrication_law() -> None:
    squeeze = act.lubrication_coefficient(2.4, 1.0, 1.0, 0.7, "paper")
    assert squeeze == pytest.approx(1.5 * math.pi * 0.7 / 0.4)
    assert act.lubrication_coefficient(3.0, 1.0, 1.0, 1.0, "paper") == pytest.approx(1.5 * math.pi)
    assert act.lubrication_coefficient(3.0, 1.0, 1.0, 1.0, "shifted") == pytest.approx(0)
    shifted = act.lubrication_coefficient(2.4, 1.0, 1.0, 0.7, "shifted")
    assert shifted == pytest.approx(1.5 * math.pi * 0.7 * (1 / 0.4 - 1))
    for distance in (2.0009, 3.001):
        assert act.lubrication_coefficient(distance, 1.0, 1.0, 1.0, "paper") == 0
    limited = act.limited_coefficient(5.0, 0.1, 0.2, 0.3)
    assert limited == pytest.approx(1 / (1 / 5 + 0.1 * (1 / 0.2 + 1 / 0.3)))


def test_lubrication_of_unreduced_chain_is_bead_by_bead() -> None:
    """N_R = 0: every pair of nodes of different fibers once."""
    rng = np.random.default_rng(12)
    chain = bc.Chain(5, 1.0)
    nodes, starts = random_fibers(rng, 4, chain, 5.0)
    vel = rng.normal(size=nodes.shape)
    got = act.lubrication(act.make_system(nodes, starts, node_vel=vel), 0.6)
    force = np.zeros_like(nodes)
    seen = 0
    for a, b in itertools.combinations(range(len(nodes)), 2):
        gap = nodes[b] - nodes[a]
        distance = np.linalg.norm(gap)
        own = a // 6 == b // 6
        # Ownership: segment p owns node p, the last also its end node.
        p, q = min(a % 6, 4), min(b % 6, 4)
        if (own and (abs(p - q) - 1) * 2 < math.pi) or not 2.001 <= distance <= 3:
            continue
        seen += 1
        n = gap / distance
        f = 1.5 * math.pi * 0.6 * ((vel[b] - vel[a]) @ n) / (distance - 2) * n
        force[a] += f
        force[b] -= f
    assert seen == got.bead_pairs > 3
    np.testing.assert_allclose(got.force, force, atol=1e-12 * np.abs(force).max())


def test_lubrication_ignores_affine_image_motion() -> None:
    """Fibers moved by box vectors take the velocity of their image: the same forces."""
    system = dense_system()
    result = act.lubrication(system, 1.0, "shifted", limit_dt=1e-2)
    assert system.lattice is not None
    jump = system.lattice @ np.array([1.0, 0.0, -2.0])
    pos, vel = system.node_pos.copy(), system.node_vel.copy()
    pos[4:8] += jump
    vel[4:8] += bc.shear_gradient(1.0) @ jump
    moved = act.lubrication(
        system._replace(node_pos=pos, node_vel=vel), 1.0, "shifted", limit_dt=1e-2
    )
    np.testing.assert_allclose(moved.force, result.force, atol=1e-10)


def test_limited_lubrication_does_not_reverse() -> None:
    """Two free beads, one explicit step of any length: the approach never changes its sign."""
    nodes = np.array([[0.0, 0, 0], [-50, 0, 0], [2.002, 0, 0], [52.002, 0, 0]])
    vel = np.array([[1.0, 0, 0], [1, 0, 0], [-1, 0, 0], [-1, 0, 0]])
    system = act.make_system(nodes, [0, 2, 4], node_vel=vel, spacing=25.0, bead_mass=0.4)
    for dt in (1e-6, 1e-3, 1.0, 1e3):
        force = act.lubrication(system, 1.0, limit_dt=dt).force
        after = vel[[0, 2], 0] + dt * force[[0, 2], 0] / 0.4
        assert after[0] >= after[1] - 1e-12
    explicit = act.lubrication(system, 1.0).force
    almost = act.lubrication(system, 1.0, limit_dt=1e-12).force
    np.testing.assert_allclose(explicit, almost, rtol=1e-6)


def test_wall() -> None:
    nodes = np.array([[0.0, 0, 0.9], [0, 0, 1.0], [0, 0, 1.0004], [0, 0, 1.0006], [0, 0, 3.0]])
    force = act.wall_repulsion(nodes, 1.0, (5, 5, 0), (0, 0, 2), 3.0, 50.0)
    expected = 3 * np.exp(-50 * (nodes[:3, 2] - 1))
    np.testing.assert_allclose(force[:3, 2], expected)
    np.testing.assert_array_equal(force[3:], 0)
    top = act.wall_repulsion(-nodes, 1.0, (0, 0, 0), (0, 0, -1), 3.0, 50.0)
    np.testing.assert_allclose(top, -force)


def test_counts() -> None:
    """Three parallel-stacked crossed fibers: touching, in lubrication range, apart."""
    chain = bc.Chain(1, 10.0)
    nodes = np.concatenate(
        [
            bc.straight_nodes(chain, (1, 0, 0), (0, 0, 0)),
            bc.straight_nodes(chain, (0, 1, 0), (0, 0, 1.99)),
            bc.straight_nodes(chain, (1, 0, 0), (0, 0, 1.99 + 2.5)),
        ]
    )
    system = act.make_system(nodes, [0, 2, 4, 6], spacing=10.0)
    push = act.repulsion(system, 1.0, 50.0)
    drag = act.lubrication(system, 1.0)
    assert (len(push.pairs), len(drag.pairs)) == (1, 2)
    assert act.interaction_count(3, push.pairs, drag.pairs) == pytest.approx(2.0)
    assert act.coordination_number(system) == pytest.approx(2 / 3)
    # Alone in a box shorter than itself plus a diameter, a fiber touches its own image.
    lonely = act.make_system(nodes[:2], [0, 2], spacing=10.0, lattice=np.diag([21.5, 30.0, 30.0]))
    assert act.coordination_number(lonely) == pytest.approx(2.0)
    assert act.coordination_number(lonely, images_distinct=False) == 0.0

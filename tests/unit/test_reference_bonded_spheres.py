"""The restatement of the bonded spheres against closed forms of beams, rings and vibrations."""

from __future__ import annotations

import math

import numpy as np
import pytest

from tests.reference import bonded_spheres as ref

RADIUS, LENGTH, DENSITY, MODULUS, POISSON = 1.2e-3, 62.83e-3, 1340.0, 7.5e5, 0.5
AREA, MOMENT = math.pi * RADIUS**2, 0.25 * math.pi * RADIUS**4
SHEAR_MODULUS = 0.5 * MODULUS / (1.0 + POISSON)
CLAMP = np.arange(6)  # all of the first node


def straight(n: int, **keys: object) -> ref.Rod:
    """Fiber of n segments along x."""
    rest = np.zeros((n + 1, 3))
    rest[:, 0] = np.linspace(0.0, LENGTH, n + 1)
    return ref.Rod(rest, RADIUS, DENSITY, MODULUS, POISSON, **keys)  # type: ignore[arg-type]


def ring(n: int, radius: float, **keys: object) -> ref.Rod:
    """Closed circle of n nodes in the x-y plane; segments as long as their arcs."""
    angle = 2.0 * np.pi * np.arange(n) / n
    rest = radius * np.stack([np.cos(angle), np.sin(angle), np.zeros(n)], axis=1)
    arc = 2.0 * np.pi * radius / n
    return ref.Rod(rest, RADIUS, closed=True, segment_length=arc, **keys)  # type: ignore[arg-type]


def kinked(closed: bool, seed: int = 4, spread: float = 0.8) -> tuple[ref.Rod, np.ndarray, ...]:
    """A rod with a random stress-free shape, deformed and turned at random by up to ~1 rad."""
    rng = np.random.default_rng(seed)
    n = 6
    rest = np.cumsum(rng.normal(size=(n, 3)) + [1.5, 0.0, 0.0], axis=0) * 1e-3
    rod = ref.Rod(rest, RADIUS, closed=closed, shear="ga", damping=0.1)
    x = rest + 3e-4 * rng.normal(size=(n, 3))
    q = ref.exponential(spread * rng.normal(size=(n, 3)))
    return rod, x, q, rng


@pytest.mark.parametrize("closed", [False, True])
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_forces_are_the_gradient_of_the_energy(closed: bool, seed: int) -> None:
    """Central differences: error h^2 plus rounding eps E / h, with h = 1e-6 of a length, 1e-9."""
    rod, x, q, _ = kinked(closed, seed)
    forces, moments = ref.bond_loads(rod, x, q)
    h = 1e-6
    for node in range(len(x)):
        for axis in range(3):
            move = np.zeros_like(x)
            move[node, axis] = h
            e = [ref.bond_energy(rod, x + s * rod.length * move, q).sum() for s in (1.0, -1.0)]
            force = (e[1] - e[0]) / (2.0 * h * rod.length)
            assert force == pytest.approx(forces[node, axis], abs=1e-8 * np.abs(forces).max())
            turned = [ref.product(ref.exponential(s * move), q) for s in (1.0, -1.0)]
            e = [ref.bond_energy(rod, x, other).sum() for other in turned]
            moment = (e[1] - e[0]) / (2.0 * h)
            assert moment == pytest.approx(moments[node, axis], abs=1e-8 * np.abs(moments).max())


def test_no_net_force_and_moment() -> None:
    """Bonds and dashpots conserve both momenta, whatever the state."""
    rod, x, q, rng = kinked(True)
    v, w = rng.normal(size=x.shape), 100.0 * rng.normal(size=x.shape)
    for forces, moments in (ref.bond_loads(rod, x, q), ref.damping_loads(rod, x, v, w)):
        assert np.abs(forces.sum(0)).max() < 1e-13 * np.abs(forces).max()
        turning = (np.cross(x, forces) + moments).sum(0)
        assert np.abs(turning).max() < 1e-13 * np.abs(moments).max()


def test_dashpots_only_take_energy() -> None:
    """Power of the damping is never positive, and zero in rigid motion."""
    rod, x, _, rng = kinked(False)
    for _ in range(20):
        v, w = rng.normal(size=x.shape), 100.0 * rng.normal(size=x.shape)
        forces, moments = ref.damping_loads(rod, x, v, w)
        assert (forces * v).sum() + (moments * w).sum() < 0.0
    spin = np.array([30.0, -20.0, 50.0])
    forces, moments = ref.damping_loads(rod, x, np.cross(spin, x), np.tile(spin, (len(x), 1)))
    assert np.abs(forces).max() < 1e-12 * rod.c_n


@pytest.mark.parametrize("closed", [False, True])
def test_node_order_is_of_no_account(closed: bool) -> None:
    """Nodes numbered from the other end: the same forces but for rounding."""
    rod, x, q, _ = kinked(closed)
    back = ref.Rod(rod.rest[::-1].copy(), RADIUS, closed=closed, shear="ga")
    for one, other in zip(
        ref.bond_loads(rod, x, q), ref.bond_loads(back, x[::-1], q[::-1]), strict=True
    ):
        assert np.abs(one - other[::-1]).max() < 1e-13 * np.abs(one).max()


@pytest.mark.parametrize("shear", ["ga", "rbf"])
@pytest.mark.parametrize("n", [4, 8])
def test_cantilever(shear: str, n: int) -> None:
    """P L^3 / 3 E I (1 - 1 / 4 n^2) + P L / G A; with `rbf` the bracket is 1."""
    rod = straight(n, shear=shear)
    load = np.zeros(6 * (n + 1))
    force = 1e-3 * 3.0 * MODULUS * MOMENT / LENGTH**2  # deflection of 1e-3 L: geometry 1e-6
    load[6 * n + 1] = force
    x, _ = ref.equilibrium(rod, load, CLAMP, tolerance=1e-7)
    bracket = 1.0 - 0.25 / n**2 if shear == "ga" else 1.0
    bent = force * LENGTH**3 / (3.0 * MODULUS * MOMENT) * bracket
    sheared = force * LENGTH / (SHEAR_MODULUS * AREA)
    assert x[n, 1] == pytest.approx(bent + sheared, rel=1e-5)


@pytest.mark.parametrize(("n", "most"), [(4, 5.9e-3), (16, 3.8e-4)])
def test_large_deflection(n: int, most: float) -> None:
    """P L^2 / E I = 5: tip of the rod with shear and stretch at (0.612207, 0.714514) L.

    Second order in 1 / n: errors as of an independent solution of the same rod.
    """
    rod = straight(n, shear="ga")
    load = np.zeros(6 * (n + 1))
    load[6 * n + 1] = 5.0 * MODULUS * MOMENT / LENGTH**2
    x, _ = ref.equilibrium(rod, load, CLAMP, load_steps=4, tolerance=1e-9)
    error = np.abs(x[n, :2] / LENGTH - [0.612207, 0.714514]).max()
    assert 0.5 * most < error < 2.0 * most


@pytest.mark.parametrize("axis", [2, 0])
def test_end_moment(axis: int) -> None:
    """2 pi E I / L closes the fiber to an n-gon; T L / G I_p is its twist."""
    n = 26
    rod = straight(n)
    stiff = rod.k_b if axis == 2 else rod.k_w
    turn = 2.0 * np.pi / n if axis == 2 else 0.3
    vector = np.zeros((n + 1, 3))
    vector[:, axis] = turn * np.arange(n + 1)
    q = ref.exponential(vector)
    middle = ref.exponential(vector[:-1] + 0.5 * turn * np.eye(3)[axis])
    edges = rod.rest_length[:, None] * ref.turn(middle, rod.axis)
    x = np.concatenate([np.zeros((1, 3)), np.cumsum(edges, axis=0)])
    forces, moments = ref.bond_loads(rod, x, q)
    assert np.abs(forces).max() * LENGTH < 1e-10 * stiff
    assert np.abs(moments[1:-1]).max() < 1e-10 * stiff
    if axis == 2:
        assert np.linalg.norm(x[-1] - x[0]) < 1e-10 * LENGTH
        expected = 2.0 * np.pi * MODULUS * MOMENT / LENGTH
    else:
        expected = 0.3 * n * SHEAR_MODULUS * 2.0 * MOMENT / LENGTH
    assert -moments[-1, axis] == pytest.approx(expected, rel=1e-10)


@pytest.mark.parametrize(("shear", "error"), [("rbf", -6.0), ("ga", -21.8)])
@pytest.mark.parametrize("n", [28, 40])
def test_ring_between_two_points(shear: str, error: float, n: int) -> None:
    """P R^3 / E I (pi / 4 - 2 / pi) + pi / 4 P R (1 / E A + 1 / G A), short by `error` / n^2."""
    big = 10.3e-3
    rod = ring(n, big, shear=shear)
    matrix = ref.stiffness(rod, rod.rest, np.tile(ref.IDENTITY, (n, 1)))
    load = np.zeros((n, 6))
    load[0, 0], load[n // 2, 0] = -1.0, 1.0
    move = np.linalg.lstsq(matrix, load.ravel(), rcond=1e-9)[0].reshape(n, 6)
    closing = move[n // 2, 0] - move[0, 0]
    bent = big**3 / (MODULUS * MOMENT) * (math.pi / 4.0 - 2.0 / math.pi)
    exact = bent + 0.25 * math.pi * big * (1.0 / (MODULUS * AREA) + 1.0 / (SHEAR_MODULUS * AREA))
    assert 0.25 * math.pi * big / (SHEAR_MODULUS * AREA) / exact < 0.067
    assert closing / exact - 1.0 == pytest.approx(error / n**2, rel=0.05)


def modes(rod: ref.Rod) -> tuple[np.ndarray, np.ndarray]:
    """Angular frequencies, and modes (6 n, 6 n) of unit mass in columns."""
    matrix = ref.stiffness(rod, rod.rest, np.tile(ref.IDENTITY, (len(rod.rest), 1)))
    root = np.sqrt(np.stack([rod.mass] * 3 + [rod.inertia] * 3, axis=1).ravel())
    values, vectors = np.linalg.eigh(0.5 * (matrix + matrix.T) / np.outer(root, root))
    return np.sqrt(np.maximum(values, 0.0)), vectors / root[:, None]


def test_free_vibration() -> None:
    """Timoshenko 80.135 and 219.31 rad/s; 79.7257 of the n = 26 rod with G A / l."""
    found = modes(straight(26, shear="ga"))[0]
    bending = [w for w in found if 10.0 < w < 400.0][::2]  # every one twice: y and z
    assert bending[0] == pytest.approx(79.7257, rel=1e-5)
    assert bending[:2] == pytest.approx([80.135, 219.31], rel=1e-2)
    soft = [w for w in modes(straight(26))[0] if 10.0 < w < 400.0][::2]
    assert soft[:2] == pytest.approx([80.135, 219.31], rel=1.2e-2)


def test_decay_of_the_first_mode() -> None:
    """Rayleigh quotient of the dashpots: 0.0194773 1/s for damping 0.0335."""
    rod = straight(26, shear="ga", damping=0.0335)
    found, shapes = modes(rod)
    mode = shapes[:, np.flatnonzero(found > 10.0)[0]].reshape(-1, 6)
    forces, moments = ref.damping_loads(rod, rod.rest, mode[:, :3], mode[:, 3:])
    decay = -0.5 * ((forces * mode[:, :3]).sum() + (moments * mode[:, 3:]).sum())
    assert decay == pytest.approx(0.0194773, rel=1e-4)


def test_largest_step_is_sharp() -> None:
    """2 over the highest frequency is dt_c, for both shear stiffnesses."""
    for shear in ("ga", "rbf"):
        for n in (26, 52):
            rod = straight(n, shear=shear)
            assert 2.0 / modes(rod)[0][-1] == pytest.approx(rod.largest_step(), rel=1e-3)


def test_flight_conserves() -> None:
    """Free flight: momenta to rounding, energy second order in dt."""
    errors = []
    for part in (0.2, 0.1):
        rod = straight(8)
        rng = np.random.default_rng(3)
        motion = ref.start(rod, v=0.3 * rng.normal(size=(9, 3)))
        first = ref.momentum(rod, motion)
        begin = energy = ref.kinetic_energy(rod, motion)
        steps = round(400 * 0.2 / part)
        worst = 0.0
        for _ in range(steps):
            ref.step(rod, motion, part * rod.largest_step())
            energy = ref.kinetic_energy(rod, motion)
            energy += float(ref.bond_energy(rod, motion.x, motion.q).sum())
            worst = max(worst, abs(energy / begin - 1.0))
        last = ref.momentum(rod, motion)
        scale = begin / 0.3
        assert np.abs(last[0] - first[0]).max() < 1e-12 * scale
        assert np.abs(last[1] - first[1]).max() < 1e-12 * scale * LENGTH
        errors.append(worst)
    assert errors[0] < 2e-2
    assert errors[0] / errors[1] == pytest.approx(4.0, rel=0.25)


@pytest.mark.parametrize("damping", [0.0, 0.113])
def test_bounce_off_a_wall(damping: float) -> None:
    """Head on, no attraction: e = exp(-b (pi - 2 asin b) / sqrt(1 - b^2)) at any speed."""
    rod = ref.Rod(np.array([[0.0, 0.0, 1.0], [2.4e-3, 0.0, 1.0]]), RADIUS)
    around = ref.Surroundings(
        walls=((2, 0.0, 1.0),), wall_modulus=MODULUS / (1.0 - POISSON**2), wall_damping=damping
    )
    root = math.sqrt(1.0 - damping**2)
    expected = math.exp(-damping * (math.pi - 2.0 * math.asin(damping)) / root)
    for speed in (0.05, 0.5):
        x = rod.rest - [0.0, 0.0, 1.0 - RADIUS]
        v = np.tile([0.0, 0.0, -speed], (2, 1))
        motion = ref.start(rod, around, x=x, v=v)
        while motion.v[0, 2] < 0.0 or motion.x[0, 2] < RADIUS:
            ref.step(rod, motion, 2e-6, around)
        assert motion.v[0, 2] / speed == pytest.approx(expected, rel=1e-3)

"""The sweep over bonded spheres against its restatement: loads, steps, energies, held nodes."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from tests.reference import bonded_spheres as ref
from tests.rods import rates, start_rods

EPS = {"float64": 2.2e-16, "float32": 1.2e-7}
WALLS = {"boundary": ["open", "wall", "wall"], "size": [1.0, 0.02, 0.02]}


def tangle(seed: int, n: int = 7, **keys: Any) -> tuple[ref.Rod, dict[str, np.ndarray]]:
    """A rod of random stress-free shape that touches two walls, its nodes displaced and moving.

    Turns of neighbors by up to 2.5 rad use both ways to compute a bond.
    """
    rng = np.random.default_rng(seed)
    heading = np.array([1.0, 0.0, 0.0]) + 0.6 * rng.normal(size=(n - 1, 3))
    heading *= 2.4e-3 / np.linalg.norm(heading, axis=1)[:, None]
    rest = np.concatenate([np.zeros((1, 3)), heading.cumsum(0)]) + [0.4, 0.0, 0.0]
    rest[:, 1] += 0.02 - 1.1e-3 - rest[:, 1].max()
    rest[:, 2] += 1.1e-3 - rest[:, 2].min()
    rod = ref.Rod(rest, 1.2e-3, segment_length=2.4e-3, **keys)
    spread = np.where(np.arange(n) % 3 == 0, 0.8, 0.1)[:, None]
    state = {
        "x": rest + 1e-4 * rng.normal(size=(n, 3)),
        "v": rng.normal(size=(n, 3)),
        "q": ref.exponential(spread * rng.normal(size=(n, 3))),
        "w": 100.0 * rng.normal(size=(n, 3)),
    }
    return rod, state


def around(rod: ref.Rod, **keys: Any) -> ref.Surroundings:
    """The walls of WALLS."""
    planes = tuple((axis, place, sign) for axis in (1, 2) for place, sign in ((0, 1), (0.02, -1)))
    modulus = rod.modulus / (1.0 - rod.poisson**2)
    return ref.Surroundings(walls=planes, wall_modulus=modulus, **keys)  # type: ignore[arg-type]


@pytest.mark.parametrize("precision", ["float64", "float32"])
@pytest.mark.parametrize("shear", ["rbf", "ga"])
@pytest.mark.parametrize("caps", ["capsule", "cylinder", "centerline"])
def test_accelerations(precision: str, shear: str, caps: str) -> None:
    """Bonds, dashpots, walls, weight and settling of several groups; k eps of the largest."""
    pairs = [
        tangle(seed, n, damping=damping, shear=shear, caps=caps, poisson=nu)
        for seed, n, damping, nu in ((1, 7, 0.1, 0.5), (2, 2, 0.0, 0.3), (3, 11, 0.0335, 0.0))
    ]
    rods = [rod for rod, _ in pairs]
    state = {key: np.concatenate([values[key] for _, values in pairs]) for key in "xvqw"}
    sim = start_rods(
        rods,
        **state,
        box=WALLS,
        contact={"law": "none", "damping": 0.113},
        gravity={"acceleration": [1.0, 2.0, -9.81], "fluid_density": 670},
        stage=[{"kind": "settle", "damping": 8.0, "end_time": 1.0}],
        numerics={"precision": precision},
    )
    found = rates(sim)
    motions = [
        ref.start(
            rod,
            around(rod, gravity=(0.5, 1.0, -4.905), wall_damping=0.113, settling=8.0),
            **values,
        )
        for rod, values in pairs
    ]
    for mine, name in zip(found, "ab", strict=True):
        theirs = np.concatenate([getattr(motion, name) for motion in motions])
        # positions are rounded to eps of 0.4 m against stretches of 1e-4 m
        scale = 1e4 * np.abs(theirs).max() if precision == "float32" else 1e5 * np.abs(theirs).max()
        assert np.abs(mine - theirs).max() < EPS[precision] * scale


@pytest.mark.parametrize("damping", [0.0, 0.1])
def test_steps(damping: float) -> None:
    """200 steps of one tangle between walls: the same as the restatement but for rounding."""
    rod, state = tangle(5, damping=damping)
    for key in "vw":
        state[key] *= 0.1
    state["q"] = ref.exponential(0.2 * state["q"][:, :3])
    sim = start_rods(
        [rod],
        **state,
        box=WALLS,
        contact={"law": "none", "damping": 0.113},
        gravity={},
        quantities=["energy"],
    )
    near = around(rod, gravity=(0.0, 0.0, -9.81), wall_damping=0.113)
    motion = ref.start(rod, near, **state)
    for _ in range(200):
        ref.step(rod, motion, sim.dt, near)
    sim.step(200)
    length, speed = np.abs(motion.x - rod.rest).max(), np.abs(motion.v).max()
    assert np.abs(sim.node_pos - motion.x).max() < 1e-9 * length
    assert np.abs(sim.node_velocity - motion.v).max() < 1e-9 * speed
    row = sim.measure()
    bonds = sum(row[f"energy_{part}"] for part in ("stretching", "shear", "bending", "twist"))
    assert bonds == pytest.approx(ref.bond_energy(rod, motion.x, motion.q).sum(), rel=1e-8)
    assert row["energy_kinetic"] == pytest.approx(ref.kinetic_energy(rod, motion), rel=1e-8)
    middle = np.array([0.5, 0.01, 0.01])
    weight = 9.81 * (rod.mass * (motion.x - middle)[:, 2]).sum()
    assert row["energy_gravity"] == pytest.approx(weight, rel=1e-8)


def test_wall_energy_is_that_of_the_force() -> None:
    """Push times a small way is what the wall's energy changes by; central differences."""
    rod = ref.Rod(np.array([[0.4, 0.01, 0.01], [0.4024, 0.01, 0.01]]), 1.2e-3)
    energies = []
    for depth in (1.0e-4, 1.01e-4, 1.02e-4):
        x = rod.rest - [0.0, 0.0, 0.01 - 1.2e-3 + depth]
        sim = start_rods([rod], x=x, box=WALLS, quantities=["energy"])
        energies.append(sim.measure()["energy_wall"])
        if depth == 1.01e-4:
            force = (rod.mass[:, None] * rates(sim)[0])[:, 2].sum()
    assert force > 0.0
    assert (energies[2] - energies[0]) / 2e-6 == pytest.approx(force, rel=1e-4)


def test_loads_and_held_nodes() -> None:
    """A force pulls, a held node keeps to its velocity, a clamped one does not turn either."""
    rod, state = tangle(6, n=6)
    state["v"], state["w"] = 0.1 * state["v"], 0.1 * state["w"]
    state["q"][:] = ref.IDENTITY
    loads = [
        {"node": 0, "hold": "clamp", "velocity": [0.01, 0.0, 0.0]},
        {"node": 3, "hold": "position"},
        {"node": -1, "force": [0.0, 2e-3, 0.0]},
    ]
    free, held = (start_rods([rod], **state, load=extra) for extra in ([], loads))
    plain, pulled = rates(free), rates(held)
    assert pulled[0][5, 1] - plain[0][5, 1] == pytest.approx(2e-3 / rod.mass[5], rel=1e-9)
    assert np.abs(pulled[0][[0, 3]]).max() == 0.0
    assert np.abs(pulled[1][0]).max() == 0.0
    assert np.array_equal(pulled[1][3], plain[1][3])
    held.step(50)
    moved = held.node_pos - state["x"]
    assert moved[0] == pytest.approx([0.01 * 50 * held.dt, 0.0, 0.0], abs=1e-15)
    assert np.abs(moved[3]).max() == 0.0
    turns = held.method.node_turn.numpy()  # type: ignore[attr-defined]
    assert np.abs(turns[0] - state["q"][0]).max() < 1e-15


def test_rings() -> None:
    """Two rings with a bond from the last node to the first, and 100 steps of them."""
    rng = np.random.default_rng(9)
    rods, parts = [], []
    for n in (12, 9):
        angle = 2.0 * np.pi * np.arange(n) / n
        radius = 2.5e-3 * n / (2.0 * np.pi)
        rest = radius * np.stack([np.cos(angle), np.sin(angle), 0.0 * angle], axis=1) + 0.5
        rods.append(ref.Rod(rest, 1.2e-3, closed=True, damping=0.1, segment_length=2.5e-3))
        shape = rest.shape
        parts.append(
            {
                "x": rest + 1e-5 * rng.normal(size=shape),
                "v": 0.1 * rng.normal(size=shape),
                "q": ref.exponential(0.05 * rng.normal(size=shape)),
                "w": 20.0 * rng.normal(size=shape),
            }
        )
    state = {key: np.concatenate([part[key] for part in parts]) for key in "xvqw"}
    sim = start_rods(rods, **state, quantities=["energy", "orientation"])
    motions = [ref.start(rod, **part) for rod, part in zip(rods, parts, strict=True)]
    for mine, name in zip(rates(sim), "ab", strict=True):
        theirs = np.concatenate([getattr(motion, name) for motion in motions])
        assert np.abs(mine - theirs).max() < 2.2e-11 * np.abs(theirs).max()
    for rod, motion in zip(rods, motions, strict=True):
        for _ in range(100):
            ref.step(rod, motion, sim.dt)
    sim.step(100)
    expected = np.concatenate([motion.x for motion in motions])
    assert np.abs(sim.node_pos - expected).max() < 1e-9 * np.abs(expected - state["x"]).max()
    row = sim.measure()
    bonds = sum(row[f"energy_{part}"] for part in ("stretching", "shear", "bending", "twist"))
    energy = sum(ref.bond_energy(r, m.x, m.q).sum() for r, m in zip(rods, motions, strict=True))
    assert bonds == pytest.approx(energy, rel=1e-8)


def test_memory_of_a_wall_ends() -> None:
    """A fiber that slides along a wall and leaves it keeps no memory, though never a radius away.

    It would begin again with it.
    """
    rod = ref.Rod(np.array([[0.4, 0.01, 1.1e-3], [0.4024, 0.01, 1.1e-3]]), 1.2e-3)
    v = np.tile([0.05, 0.0, 0.02], (2, 1))
    sim = start_rods([rod], v=v, box=WALLS, contact={"law": "none", "wall_friction": 0.6})
    depth = sim.method.wall_depth  # type: ignore[attr-defined]
    sim.step(1)
    assert depth.numpy().max() > 0.0
    for _ in range(200):
        if sim.node_pos[:, 2].min() > 1.2e-3:
            break
        sim.step(1)
    assert 1.2e-3 < sim.node_pos[:, 2].min() < 2.4e-3
    assert depth.numpy().max() == 0.0

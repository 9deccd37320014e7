"""What must be conserved is: momentum and energy without drag, terminal velocity with it."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from tests.cell import Kind, bent_fiber, straight_fiber
from tests.reference import bead_chain as bc
from warpfiber.simulation import Simulation

Start = Callable[..., Simulation]
# drag takes zeta t/m = 3e-14 of the motion in the longest run
VACUUM = {"kind": "rest", "viscosity": 1e-17}
KIND = Kind(7, 3.0, modulus=100.0)


def momenta(kind: Kind, sim: Simulation) -> tuple[np.ndarray, np.ndarray]:
    """Linear and angular momentum of all beads of the unreduced fiber."""
    chain = kind.chain()
    weights = bc.bead_weights(kind.segments, int(kind.spacing))
    x, v = weights @ sim.node_pos, weights @ sim.node_velocity
    return chain.mass * v.sum(axis=0), chain.mass * np.cross(x, v).sum(axis=0)


def moving_fiber() -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(2)
    nodes = bent_fiber(KIND, rng, spread=0.8, stretch=0.01)
    return nodes, 0.3 * rng.normal(size=nodes.shape)


def test_momentum(start: Start) -> None:
    """`consistent`: internal forces change neither momentum of the unreduced fiber.

    Exact also in discrete time (A is symmetric, x moves with the new v). 3000 steps of rounding:
    1e-12 of the sum of sizes of the beads' momenta. `paper` drifts by more than 1e-4 of it.
    """
    nodes, velocity = moving_fiber()
    drifts = {}
    for closure in ("consistent", "paper"):
        sim = start(
            [KIND],
            [nodes],
            velocity=velocity,
            flow=VACUUM,
            numerics={"closure": closure, "dt": 2e-2},
        )
        before = momenta(KIND, sim)
        sim.step(3000)
        after = momenta(KIND, sim)
        scale = KIND.chain().mass * np.linalg.norm(velocity, axis=1).sum() * KIND.spacing
        linear = np.abs(after[0] - before[0]).max() / scale
        angular = np.abs(after[1] - before[1]).max() / (scale * np.abs(nodes).max())
        drifts[closure] = (linear, angular)
    assert max(drifts["consistent"]) < 1e-12
    assert min(drifts["paper"]) > 1e-4


def test_energy(start: Start) -> None:
    """Kinetic + stretching + bending energy swings by O(dt) and does not drift.

    Without drag the step is symplectic: over 40 periods of the slowest mode the largest error of
    the second half is that of the first within 30 %, and half the dt gives half of it (0.4 to 0.6).
    """
    nodes, velocity = moving_fiber()
    swings = []
    for dt in (2e-2, 1e-2):
        sim = start(
            [KIND],
            [nodes],
            velocity=velocity,
            flow=VACUUM,
            numerics={"closure": "consistent", "dt": dt},
            quantities=["energy"],
        )
        errors = []
        names = ("energy_kinetic", "energy_stretching", "energy_bending")
        first = sum(sim.measure()[name] for name in names)
        for _ in range(400):
            sim.step(round(0.2 / dt))
            row = sim.measure()
            errors.append(sum(row[name] for name in names) / first - 1.0)
        early, late = np.abs(errors[:200]).max(), np.abs(errors[200:]).max()
        assert 0.7 < late / early < 1.4
        swings.append(max(early, late))
    assert 0.4 < swings[1] / swings[0] < 0.6


def test_measured_energies(start: Start) -> None:
    """Energies of a bent moving fiber equal the reference to 1e-12."""
    nodes, velocity = moving_fiber()
    sim = start([KIND], [nodes], velocity=velocity, quantities=["energy"])
    row = sim.measure()
    chain = KIND.chain()
    for name, value in (
        ("energy_kinetic", bc.kinetic_energy(chain, velocity)),
        ("energy_stretching", bc.stretching_energy(chain, nodes)),
        ("energy_bending", bc.bending_energy(chain, nodes)),
    ):
        assert abs(row[name] / value - 1.0) < 1e-12


@pytest.mark.parametrize(
    ("closure", "falling"),
    [("none", False), ("consistent", False), ("paper", True), ("consistent", True)],
)
def test_sedimentation(start: Start, closure: str, falling: bool) -> None:
    """Straight fibers fall with U = W/(6 pi eta a N) in every direction, without turning.

    Every bead carries its weight against its own drag. From rest e^-20 of U is left after 20
    relaxation times (`paper` also bends while it gets faster, so it starts falling): 1e-8 of U.
    """
    kinds = [Kind(6, 2.5), Kind(5, 1.0, radius=0.5, density=0.4)]
    places = list(zip(np.eye(3), 50.0 * np.eye(3), strict=True))
    fibers = [straight_fiber(kind, p, center) for kind in kinds for p, center in places]
    which = [0, 0, 0, 1, 1, 1]
    gravity = np.array([0.4, -0.3, -9.0])
    falls = []
    for k, nodes in zip(which, fibers, strict=True):
        chain = kinds[k].chain(fluid_density=0.05)
        fall = bc.gravity_force(chain, gravity) / chain.drag
        falls.append(np.broadcast_to(fall, nodes.shape))
    fall = np.concatenate(falls)
    assert np.abs(np.ptp(fall[:, 2])) > 0.02
    sim = start(
        kinds,
        fibers,
        which,
        velocity=fall if falling else 0.0 * fall,
        gravity={"acceleration": gravity.tolist(), "fluid_density": 0.05},
        numerics={"closure": closure, "dt": 2e-3},
    )
    sim.step(round(20.0 * 2.0 / 9.0 * 0.1 / 2e-3) + 1)
    assert np.abs(sim.node_velocity - fall).max() < 1e-8 * np.abs(fall).max()
    edges = [np.diff(nodes, axis=0) for nodes in fibers]
    begin = sim.fiber_node_start
    for first, end, edge in zip(begin[:-1], begin[1:], edges, strict=True):
        assert np.abs(np.diff(sim.node_pos[first:end], axis=0) - edge).max() < 1e-10

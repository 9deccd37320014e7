"""Node sweep against the NumPy restatement: every force on one fiber, every closure.

One step gives the acceleration exactly, v1 = v0 + dt a(x0, v0, dt) with the drag inside the step:
the only error is rounding. dt = 0.01 s takes the drag at the middle of the step, dt = 1 s is so
long that the drag alone would overshoot. Bounds: float64 sums of some 50 terms stay within 1e-12 of
the largest acceleration; float32 see `test_float32`.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from tests.cell import Kind, bent_fiber
from tests.reference import bead_chain as bc
from tests.reference import interactions as ia
from tests.reference.unit_vector import UNIT_ACCELERATION, UNIT_FORCE, UNIT_GRADIENT, UNIT_V, UNIT_X
from warpfiber.simulation import Simulation

# whole and real M, odd and even N_seg, SBCM, one segment, unequal radii and moduli
KINDS = (
    Kind(4, 2.0),
    Kind(3, 19.0 / 3.0, modulus=400.0),
    Kind(6, 1.0),
    Kind(1, 4.5),
    Kind(2, 3.3, radius=0.7, density=0.2),
    Kind(8, 1.4, radius=1.2),
    Kind(15, 49.0 / 15.0, modulus=30.0),
)
STEPS = (0.01, 1.0)
Start = Callable[..., Simulation]


def one_step(dt: float) -> dict[str, object]:
    return {"dt": dt, "allow_unstable_dt": True}


def change_per_time(sim: Simulation) -> np.ndarray:
    """(v1 - v0) / dt of the next step."""
    before = sim.node_velocity
    sim.step()
    return (sim.node_velocity - before) / sim.dt


def flow_of(gradient: np.ndarray) -> dict[str, object]:
    return {"kind": "gradient", "gradient": gradient.tolist(), "viscosity": 1.0}


def undamped(change: np.ndarray, closure: str, dt: float) -> np.ndarray:
    """Explicit acceleration of the unit chain from that of a step with the drag in it."""
    chain = Kind(4, 2.0).chain(closure)
    if closure != "paper":
        return change / bc.damping_share(chain, dt, 1.0)
    factors = bc.paper_factors(chain, UNIT_X)
    arm = UNIT_X - UNIT_X.mean(axis=0)
    radial = arm / np.linalg.norm(arm, axis=1)[:, None]
    shares = (bc.damping_share(chain, dt, beta) for beta in (factors.beta_t, factors.beta_r))
    return bc.correct(change, radial, *(1.0 / share for share in shares))


@pytest.mark.parametrize("dt", STEPS)
@pytest.mark.parametrize("closure", bc.CLOSURES)
def test_unit_vector(start: Start, closure: str, dt: float) -> None:
    """Printed numbers of 13 digits: 1e-10 absolute, 1e-12 relative."""
    sim = start(
        [Kind(4, 2.0)],
        [UNIT_X],
        velocity=UNIT_V,
        flow=flow_of(UNIT_GRADIENT),
        numerics={"closure": closure, **one_step(dt)},
    )
    got = undamped(change_per_time(sim), closure, dt)
    expected = np.array(UNIT_ACCELERATION[closure])
    np.testing.assert_allclose(got, expected, rtol=1e-12, atol=1e-10)
    if closure == "none":  # the others leave A^-1 F in the array
        force = sim.state.node_force.numpy() * sim.model.units.force
        np.testing.assert_allclose(force, UNIT_FORCE, rtol=1e-12, atol=1e-11)


def random_fibers(seed: int) -> tuple[list[np.ndarray], np.ndarray, np.ndarray]:
    """Two bent fibers of every kind, far apart, node velocities, the kind of every fiber."""
    rng = np.random.default_rng(seed)
    which = np.repeat(np.arange(len(KINDS)), 2)
    centers = 110.0 * np.stack(np.unravel_index(np.arange(len(which)), (3, 3, 3)), axis=1) + 90.0
    fibers = [bent_fiber(KINDS[k], rng, c) for k, c in zip(which, centers, strict=True)]
    return fibers, rng.normal(size=(sum(map(len, fibers)), 3)), which


def expected_acceleration(
    fibers: list[np.ndarray],
    velocity: np.ndarray,
    which: np.ndarray,
    gradient: np.ndarray,
    closure: str,
    torque: str,
    dt: float,
    extra: np.ndarray | None = None,
    gravity: tuple[float, float, float] | None = None,
) -> np.ndarray:
    rows = []
    begin = 0
    for nodes, k in zip(fibers, which, strict=True):
        mine = slice(begin, begin + len(nodes))
        chain = KINDS[k].chain(closure, torque=torque, fluid_density=0.02)
        push = None if extra is None else extra[mine]
        rows.append(bc.acceleration(chain, nodes, velocity[mine], gradient, push, gravity, dt))
        begin += len(nodes)
    return np.concatenate(rows)


GRADIENT = np.array([[0.2, -0.4, 1.0], [0.3, 0.1, 0.7], [-0.5, 0.2, -0.3]])


@pytest.mark.parametrize("closure", bc.CLOSURES)
@pytest.mark.parametrize("torque", bc.TORQUES)
@pytest.mark.parametrize("dt", STEPS)
def test_random_fibers(start: Start, closure: str, torque: str, dt: float) -> None:
    """Seven kinds of bent fibers in a general flow: 1e-12 of the largest acceleration."""
    fibers, velocity, which = random_fibers(3)
    sim = start(
        KINDS,
        fibers,
        which,
        velocity=velocity,
        flow=flow_of(GRADIENT),
        numerics={"closure": closure, "torque_weights": torque, **one_step(dt)},
    )
    got = change_per_time(sim)
    expected = expected_acceleration(fibers, velocity, which, GRADIENT, closure, torque, dt)
    scale = np.abs(expected).max()
    # positions of 300 a: the flow there is 300 times a relative velocity of order one
    assert np.abs(got - expected).max() < 1e-12 * scale


@pytest.mark.parametrize("closure", bc.CLOSURES)
def test_gravity_and_walls(start: Start, closure: str) -> None:
    """Weight, buoyancy and six walls, two fibers crossing every wall: 1e-12 of the largest."""
    fibers, velocity, which = random_fibers(4)
    edge = 440.0
    for k, (axis, plane) in enumerate((a, p) for a in range(3) for p in (0.0, edge)):
        nodes = fibers[2 * k]
        nodes[:, axis] += plane - nodes[:, axis].mean()
    gravity = (0.3, -0.2, -1.7)
    strength, decay = 3.0, 0.4  # decays slowly: nodes are up to 20 a behind the wall
    sim = start(
        KINDS,
        fibers,
        which,
        velocity=velocity,
        box={"size": [edge] * 3, "boundary": ["wall"] * 3},
        flow={**flow_of(GRADIENT), "origin": [0.0, 0.0, 0.0]},
        gravity={"acceleration": list(gravity), "fluid_density": 0.02},
        contact={"law": "exponential", "strength": strength, "decay": decay},
        numerics={"closure": closure, **one_step(0.01)},
    )
    got = change_per_time(sim)
    nodes = np.concatenate(fibers)
    radius = np.repeat([KINDS[k].radius for k in which], [len(f) for f in fibers])
    push = np.zeros_like(nodes)
    for axis in range(3):
        inward = np.eye(3)[axis]
        push += ia.wall_repulsion(nodes, radius, (0.0, 0.0, 0.0), inward, strength, decay)
        push += ia.wall_repulsion(nodes, radius, edge * inward, -inward, strength, decay)
    assert (np.abs(push).sum(axis=0) > 0.0).all()
    expected = expected_acceleration(
        fibers, velocity, which, GRADIENT, closure, "end_weighted", 0.01, push, gravity
    )
    assert np.abs(got - expected).max() < 1e-12 * np.abs(expected).max()


@pytest.mark.parametrize("closure", bc.CLOSURES)
def test_float32(start: Start, closure: str) -> None:
    """A position at |x| is known to eps |x|, a spring force to k_s eps |x|: bound 8 k_s eps |x|/m.

    The error must also be above 1e-9 of the accelerations, or the run was not single precision.
    """
    kind = Kind(4, 2.0)
    sim = start(
        [kind],
        [UNIT_X],
        velocity=UNIT_V,
        flow=flow_of(UNIT_GRADIENT),
        numerics={"closure": closure, "precision": "float32", **one_step(1.0)},
    )
    got = undamped(change_per_time(sim), closure, 1.0)
    chain = kind.chain()
    spring = chain.stretching_stiffness * np.finfo(np.float32).eps * np.abs(UNIT_X).max()
    error = np.abs(got - np.array(UNIT_ACCELERATION[closure])).max()
    assert 1e-7 < error < 8.0 * spring / chain.mass


@pytest.mark.parametrize("closure", ["none", "consistent"])
def test_folded_and_straight_joints(start: Start, closure: str) -> None:
    """Joint angles of 0, 1e-9, 1e-5, 1e-3, 1.6 and pi - 1e-4 keep theta/sin(theta): 1e-11."""
    angles = np.array([0.0, 1e-9, 1e-5, 1e-3, 1.6, np.pi - 1e-4])
    heading = np.concatenate([[0.0], angles.cumsum()])
    kind = Kind(len(heading), 2.0)
    steps = 4.0 * np.stack([np.cos(heading), np.zeros_like(heading), np.sin(heading)], axis=1)
    nodes = np.concatenate([np.zeros((1, 3)), steps.cumsum(axis=0)])
    sim = start(
        [kind],
        [nodes],
        velocity=np.zeros_like(nodes),
        numerics={"closure": closure, **one_step(0.01)},
    )
    got = change_per_time(sim)
    expected = bc.acceleration(kind.chain(closure), nodes, 0.0 * nodes, np.zeros((3, 3)), dt=0.01)
    # near pi the couple is k_b theta/(l sin theta) times a vector of size sin(theta), known to eps
    assert np.abs(got - expected).max() < 1e-11 * np.abs(expected).max()


@pytest.mark.parametrize("segments", [1, 2, 4])
def test_node_on_the_center(start: Start, segments: int) -> None:
    """Straight fiber, closure `paper`: the middle node lies on G, its factors are the limits.

    Axis and lengths are exact in binary, so the reference meets the exact zero; 1e-12 relative.
    """
    kind = Kind(segments, 2.0)
    nodes = np.zeros((segments + 1, 3))
    nodes[:, 0] = 4.0 * (np.arange(segments + 1) - segments / 2.0)
    velocity = np.random.default_rng(1).normal(size=nodes.shape)
    sim = start(
        [kind],
        [nodes],
        velocity=velocity,
        flow=flow_of(GRADIENT),
        numerics={"closure": "paper", **one_step(0.01)},
    )
    got = change_per_time(sim)
    expected = bc.acceleration(kind.chain("paper"), nodes, velocity, GRADIENT, dt=0.01)
    assert np.abs(got - expected).max() < 1e-12 * np.abs(expected).max()

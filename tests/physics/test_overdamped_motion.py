"""Fibers without inertia against closed forms: settling, relaxation, buckling; long runs, float32.

Source: weight over drag of a free-draining chain; balance of the forces on its beads; growth rates
    of small bends of a fiber along the compression axis, by the eigenvalues of the chain's own
    matrices; thresholds zeta rate L^4/(E I) of a smooth free-draining rod: 123.5 for bends in the
    plane of the extension, which the flow itself carries outward, 163.9 for those across it.
Units: a = eta = 1, rate 1.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest

from tests.cell import Kind, bent_fiber, straight_fiber
from tests.physics.test_overdamped import FLEXIBLE, SHEAR, along_x
from tests.reference import overdamped as od
from tests.reference.bead_chain import Array
from warpfiber.simulation import Simulation

Start = Callable[..., Simulation]
REST = {"kind": "rest", "viscosity": 1.0}
EXTENSION = {"kind": "planar_extension", "extension_rate": 1.0, "viscosity": 1.0}


@pytest.mark.parametrize("precision", ["float64", "float32"])
@pytest.mark.parametrize("direction", [(1, 0, 0), (0, 0, 1), (1, 2, -0.7)])
@pytest.mark.parametrize("kind", [Kind(19, density=3.0), Kind(4, 4.75, density=3.0)])
def test_settling(
    start: Start, kind: Kind, direction: tuple[float, float, float], precision: str
) -> None:
    """W/(6 pi eta a N) in every direction; a straight fiber stays straight and does not turn."""
    begin = straight_fiber(kind, direction, (0, 0, 0))
    sim = start(
        [kind],
        [begin],
        flow=REST,
        gravity={"acceleration": [0.5, 0.0, -2.0], "fluid_density": 1.0},
        numerics={"method": "overdamped", "dt": 0.5, "precision": precision},
    )
    sim.step(100)
    speed = 4.0 / 3.0 * np.pi * 2.0 / (6.0 * np.pi) * np.array([0.5, 0.0, -2.0])
    eps = float(np.finfo(precision).eps)
    # a rounding of the positions per step, and of a tension that holds the segments
    assert np.abs(sim.node_pos - begin - speed * sim.time).max() < 200 * eps * 38.0
    assert sim.node_velocity[-1] == pytest.approx(speed, abs=1e4 * eps)


@pytest.mark.parametrize("integrator", ["sdirk2", "bdf2"])
@pytest.mark.parametrize("kind", [Kind(30), Kind(7, 3.4)])
def test_relaxation_keeps_the_center(start: Start, kind: Kind, integrator: str) -> None:
    """Inner forces sum to zero: the drag does too and the center of the beads rests."""
    begin = bent_fiber(kind, np.random.default_rng(2), spread=0.15, stretch=0.01)
    chain = kind.chain()
    # a tenth of the time of the slowest mode, zeta L^4/(500.6 E I) of a free rod
    slowest = 3.0 * math.pi * chain.length**4 / (500.6 * 100.0 * math.pi / 4.0)
    numerics = {"method": "overdamped", "dt": slowest / 10.0, "integrator": integrator}
    sim = start([kind], [begin], flow=REST, numerics=numerics)
    share = chain.matrix.sum(axis=0) / chain.matrix.sum()
    length = float(chain.length)
    energy = first = od.bending_energy(chain, begin)
    for _ in range(20):
        sim.step(2)
        assert np.abs(share @ (sim.node_pos - begin)).max() < 1e-10 * length
        drag = (od.drag_matrix(chain) @ sim.node_velocity.ravel()).reshape(-1, 3)
        assert np.abs(drag.sum(axis=0)).max() < 1e-10 * np.abs(drag).max() + 1e-12
        now = od.bending_energy(chain, sim.node_pos)
        assert now < energy
        energy = now
    assert energy < 1e-2 * first


AXES = {"in the plane": 0, "across": 1}
THRESHOLD = {"in the plane": 123.5, "across": 163.9}


def buckling(kind: Kind, plane: str) -> tuple[Array, Array]:
    """Growth rates and even shapes (n,) of small bends of a fiber along z, largest rate first.

    (R + T) dy/dt = R u - (B + sum lambda/l G) y, u = y in the plane of the extension and 0 across
    it, lambda of the inextensible straight fiber: what the drag of the nodes behind a segment
    pushes.
    """
    chain = kind.chain()
    n = kind.segments + 1
    z = straight_fiber(kind, (0, 0, 1), (0, 0, 0))[:, 2]
    push = chain.drag * chain.matrix @ (-z)
    tension = push[::-1].cumsum()[::-1][1:]
    differ = np.diff(np.eye(n), axis=0)
    edge = chain.rest_length
    strength = od.torque_strength(chain, np.full(kind.segments, edge))
    resist = chain.drag * chain.matrix + differ.T @ (strength[:, None] * differ)
    second = od.second_difference(n)
    stiff = chain.bending_stiffness / edge**2 * second.T @ second
    stiff += differ.T @ ((tension / edge)[:, None] * differ)
    if plane == "in the plane":
        stiff -= chain.drag * chain.matrix
    # even shapes by the nodes of one half, orthonormal; symmetric by the Cholesky factor of R + T
    half = (np.eye(n) + np.eye(n)[::-1])[:, : (n + 1) // 2]
    half /= np.linalg.norm(half, axis=0)
    factor = np.linalg.inv(np.linalg.cholesky(half.T @ resist @ half))
    rates, modes = np.linalg.eigh(-factor @ (half.T @ stiff @ half) @ factor.T)
    shapes = half @ factor.T @ modes
    # a mode that is not a translation is orthogonal to it in the drag
    center = np.abs(chain.matrix.sum(axis=0) @ shapes) / np.linalg.norm(shapes, axis=0)
    bends = [k for k in np.argsort(-rates) if center[k] < 0.5 * center.max()]
    return rates[bends], shapes[:, bends]


def modulus_of(group: float, kind: Kind) -> float:
    """E of which zeta rate L^4 / (E I) is `group`, zeta = 3 pi eta per length, L = 2 a r_f."""
    return 3.0 * math.pi * (2.0 * kind.aspect_ratio) ** 4 / (group * math.pi / 4.0)


@pytest.mark.parametrize("plane", AXES)
def test_buckling_threshold(plane: str) -> None:
    """Chains of more and more segments approach the smooth rod, to first order in their length."""
    groups = []
    for segments in (25, 50, 100):
        low, high = 50.0, 400.0
        for _ in range(40):
            middle = math.sqrt(low * high)
            kind = Kind(segments, modulus=modulus_of(middle, Kind(segments)))
            grows = buckling(kind, plane)[0][0] > 0.0
            low, high = (low, middle) if grows else (middle, high)
        groups.append(low)
    assert 2.0 * groups[2] - groups[1] == pytest.approx(THRESHOLD[plane], rel=2e-3)


@pytest.mark.parametrize("plane", AXES)
@pytest.mark.parametrize("kind", [Kind(24), Kind(8, 3.0)])
@pytest.mark.parametrize("group", [60.0, 0.9, 1.1, 400.0])
def test_growth_of_a_bend(start: Start, kind: Kind, group: float, plane: str) -> None:
    """Both sides of the threshold: the first even shape grows or decays at its own rate."""
    group = group * THRESHOLD[plane] if group < 2.0 else group
    kind = Kind(kind.segments, kind.spacing, modulus=modulus_of(group, kind))
    rates, shapes = buckling(kind, plane)
    axis = AXES[plane]
    begin = straight_fiber(kind, (0, 0, 1), (0, 0, 0))
    shape = shapes[:, 0] / np.abs(shapes[:, 0]).max()
    begin[:, axis] = 1e-6 * shape
    sim = start(
        [kind],
        [begin],
        flow=EXTENSION,
        groups={"inextensible": True},
        numerics={"method": "overdamped", "dt": 0.01},
    )
    sim.run(0.5)
    first = float(shape @ sim.node_pos[:, axis] / (shape @ shape))
    sim.run(1.5)
    last = float(shape @ sim.node_pos[:, axis] / (shape @ shape))
    rate = math.log(last / first)
    assert (rate > 0.0) == (group > THRESHOLD[plane])
    # second order in dt, of the rate and of the compression that turns with the strain
    assert rate == pytest.approx(rates[0], rel=(0.01 * rates[0]) ** 2, abs=1e-4)
    assert np.abs(sim.node_pos[:, 1 - axis]).max() == 0.0
    assert np.abs(sim.node_pos[:, axis] - last * shape).max() < 1e-3 * abs(last)


@pytest.mark.parametrize("integrator", ["sdirk2", "bdf2"])
def test_a_thousand_strains(start: Start, integrator: str) -> None:
    """Segments that keep their length: 1e-3 at a strain of 0.1 per step, and no drift."""
    sim = along_x(start, FLEXIBLE, inextensible=True, integrator=integrator, dt=0.1)
    worst = []
    for _ in range(10):
        largest = 0.0
        for _ in range(200):
            sim.step(5)
            length = np.linalg.norm(np.diff(sim.node_pos, axis=0), axis=1)
            largest = max(largest, float(np.abs(length / 2.0 - 1.0).max()))
        worst.append(largest)
    assert max(worst) < 1e-3
    assert max(worst[5:]) < 1.5 * max(worst[:5])
    assert np.abs(sim.node_pos.mean(axis=0)).max() < 1e-11 * 98.0


# Rounding of the bending, h k_b/l^2 against the drag, grows with E dt: of 2e9 two-step differences
# at a strain of 0.05 leave 1.6e-2 L in the turn, and 2.5e-4 at 0.02.
@pytest.mark.parametrize(
    ("modulus", "integrator", "dt"),
    [
        (5e4, "sdirk2", 0.05),
        (5e4, "bdf2", 0.05),
        (7e6, "sdirk2", 0.05),
        (7e6, "bdf2", 0.05),
        (2e9, "sdirk2", 0.05),
        (2e9, "bdf2", 0.02),
        (None, "sdirk2", 0.05),
        (None, "bdf2", 0.05),
    ],
)
def test_single_precision(start: Start, modulus: float | None, integrator: str, dt: float) -> None:
    """A turn in float32 stays within 1e-3 L of float64, also if segments keep their length."""
    kind = Kind(49, modulus=modulus or 5e4)
    keys = {"integrator": integrator, "dt": dt, "inextensible": modulus is None}
    runs = [along_x(start, kind, precision=name, **keys) for name in ("float64", "float32")]
    for _ in range(24):
        for sim in runs:
            sim.step(round(5.0 / dt))
        assert np.isfinite(runs[1].node_pos).all()
        assert np.abs(runs[1].node_pos - runs[0].node_pos).max() < 1e-3 * 98.0


def test_fewer_segments(start: Start) -> None:
    """The same 49 beads by 24, 16 and 8 segments; z of the end against 48, in lengths."""
    ends = {}
    for segments in (48, 24, 16, 8):
        kind = Kind(segments, 48.0 / segments, modulus=5e4)
        sim = start(
            [kind],
            [straight_fiber(kind, (1, 0, 0), (0, 0, 0))],
            flow=SHEAR,
            numerics={"method": "overdamped", "dt": 0.02},
        )
        z = []
        for _ in range(60):
            sim.step(50)
            z.append(sim.node_pos[-1, 2])
        ends[segments] = np.array(z) / 96.0
    errors = [float(np.abs(ends[k] - ends[48]).max()) for k in (24, 16, 8)]
    assert errors == pytest.approx([3e-3, 8e-3, 5.6e-2], rel=0.3)

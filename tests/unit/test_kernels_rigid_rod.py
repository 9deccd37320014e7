"""The step of rigid rods against its float64 restatement: all linear flows, shapes, step sizes.

Tolerance 1e-13 of the largest value, some hundred roundings: of the series and its doublings.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import warp as wp

from tests.cell import Kind, isotropic, straight_fiber
from tests.reference import rigid_rod as rr
from tests.reference.bead_chain import Array
from warpfiber.methods.rigid_rod import turning_share
from warpfiber.passes.exponential import make_exponential
from warpfiber.scene.tables import strain_rate
from warpfiber.simulation import Simulation

Start = Callable[..., Simulation]
ROUGH = np.array([[0.1, 0.2, 1.0], [-0.3, 0.05, 0.1], [0.2, 0.0, -0.15]])
GENERAL = ROUGH / strain_rate(tuple(map(tuple, ROUGH)))  # rate 1: the run's units are SI
FLOWS: dict[str, dict[str, Any]] = {
    "shear": {"kind": "simple_shear", "shear_rate": 1.0},
    "planar": {"kind": "planar_extension", "extension_rate": 1.0},
    "inward": {"kind": "planar_extension", "extension_rate": -1.0},
    "uniaxial": {"kind": "uniaxial_extension", "extension_rate": 1.0},
    "gradient": {"kind": "gradient", "gradient": GENERAL.tolist()},
    "rest": {"kind": "rest"},
}
KINDS = (Kind(1, 99.0), Kind(1, 1.0), Kind(1, 4.3, radius=1.3), Kind(1, 19.0, density=2.0))
ORIGIN = (0.3, -1.0, 2.0)


def rods(start: Start, flow: str, dt: float, **keys: Any) -> tuple[Simulation, rr.Rods]:
    """Five rods of each kind, and the same for the reference (their radii differ)."""
    rng = np.random.default_rng(2)
    which = [k for k in range(len(KINDS)) for _ in range(5)]
    spread = keys.pop("spread", 5.0)
    axis, center = isotropic(rng, len(which)), spread * rng.normal(size=(len(which), 3))
    fibers = [straight_fiber(KINDS[k], p, c) for k, p, c in zip(which, axis, center, strict=True)]
    numerics = {"method": "rigid_rod", "dt": dt, **keys.pop("numerics", {})}
    sim = start(
        KINDS,
        fibers,
        which,
        flow={"viscosity": 1.0, "origin": ORIGIN} | FLOWS[flow],
        numerics=numerics,
        **keys,
    )
    beads = [KINDS[k].aspect_ratio for k in which]
    return sim, rr.make_rods(center, axis, beads)


def split(sim: Simulation, values: Array) -> tuple[Array, Array]:
    """Mean and half difference of the two nodes of every rod."""
    ends = values.reshape(-1, 2, 3)
    return ends.mean(axis=1), 0.5 * (ends[:, 1] - ends[:, 0])


def half_lengths() -> Array:
    return np.repeat([k.radius * k.spacing for k in KINDS], 5)[:, None]


@pytest.mark.parametrize("dt", [1e-3, 0.05, 3.0])
@pytest.mark.parametrize("flow", FLOWS)
def test_one_step(start: Start, flow: str, dt: float) -> None:
    """Centers, directions and velocities at the end of a step."""
    sim, before = rods(start, flow, dt)
    sim.step()
    gradient = sim.method.full_gradient
    mean = -gradient @ np.asarray(ORIGIN)
    after = rr.map_rods(before, gradient, dt, mean)
    center, arm = split(sim, sim.node_pos)
    scale = max(1.0, float(np.abs(after.center).max()))
    assert np.abs(center - after.center).max() < 1e-13 * scale
    assert np.abs(arm / half_lengths() - after.axis).max() < 1e-13 * scale
    move, turn = rr.flow_rate(after, gradient, mean)
    velocity, swing = split(sim, sim.node_velocity)
    assert np.abs(velocity - move).max() < 1e-13 * scale
    assert np.abs(swing / half_lengths() - turn).max() < 1e-13 * scale
    assert sim.step_count == 1 and sim.time == pytest.approx(dt, rel=1e-15)


@pytest.mark.parametrize("dt", [0.05, 3.0])
@pytest.mark.parametrize("flow", FLOWS)
def test_settling(start: Start, flow: str, dt: float) -> None:
    """Weight less buoyancy moves the center by bead drag, while the flow carries it."""
    sim, before = rods(
        start, flow, dt, gravity={"acceleration": [1.0, 0.0, -3.0], "fluid_density": 0.5}
    )
    sim.step()
    gradient = sim.method.full_gradient
    center, arm = split(sim, sim.node_pos)
    for k, kind in enumerate(KINDS):
        mine = slice(5 * k, 5 * k + 5)
        weight = 4.0 / 3.0 * math.pi * kind.radius**3 * (kind.density - 0.5)
        settling = weight * np.array([1.0, 0.0, -3.0]) / (6.0 * math.pi * kind.radius)
        group = rr.make_rods(before.center[mine], before.axis[mine], kind.aspect_ratio)
        after = rr.map_rods(group, gradient, dt, settling - gradient @ np.asarray(ORIGIN))
        scale = max(1.0, float(np.abs(after.center).max()))
        assert np.abs(center[mine] - after.center).max() < 1e-13 * scale
        assert np.abs(arm[mine] / half_lengths()[mine] - after.axis).max() < 1e-13 * scale


@pytest.mark.parametrize("flow", FLOWS)
def test_single_precision(start: Start, flow: str) -> None:
    """Ten steps stay within some roundings per step of float64, in the largest position."""
    found = []
    for precision in ("float64", "float32"):
        sim, _ = rods(start, flow, 0.1, numerics={"precision": precision})
        sim.step(10)
        found.append(sim.node_pos)
    largest = float(np.abs(found[0]).max())
    assert np.abs(found[1] - found[0]).max() < 10 * 4 * 6e-8 * largest


def test_start_kept_where_rods_may_meet(start: Start) -> None:
    """The start of the last step, which contact may reject; else nothing is allocated."""
    sim, _ = rods(start, "shear", 0.05, spread=1000.0, contact={"law": "exponential"})
    plain, _ = rods(start, "shear", 0.05, spread=1000.0)
    for one in (sim, plain):
        one.step(3)
    before = sim.state.node_pos.numpy().copy(), sim.state.node_velocity.numpy().copy()
    sim.step()
    plain.step()
    assert sim.method.node_back.numpy().tobytes() == before[0].tobytes()
    assert sim.method.velocity_back.numpy().tobytes() == before[1].tobytes()
    assert plain.method.node_back.shape[0] == 0
    assert plain.node_pos.tobytes() == sim.node_pos.tobytes()


def test_torque_weights() -> None:
    """mu of both weights gives r_e^2 = (1 - mu)/mu as published for the chain."""
    for n in (2.0, 10.0, 100.0):
        row = {"spacing": n - 1.0, "weight": n - 1.0, "weight_excess": 0.5}
        mu = turning_share(row)
        assert (1.0 - mu) / mu == pytest.approx((n * n + 1.0) / 2.0, rel=1e-14)
        assert 1.0 - 2.0 * mu == pytest.approx((n * n - 1.0) / (n * n + 3.0), rel=1e-14)
        plain = turning_share(row | {"weight_excess": 0.0})
        assert (1.0 - plain) / plain == pytest.approx((n * n + n + 2.0) / 2.0, rel=1e-14)


def test_exponential_change() -> None:
    """Against the series of the restatement, and against the flow of a nilpotent matrix."""
    _, exponential_change = make_exponential()

    @wp.kernel(module="unique", enable_backward=False)
    def apply(
        b: wp.array(dtype=wp.mat33d),
        change_out: wp.array(dtype=wp.mat33d),
        phi_out: wp.array(dtype=wp.mat33d),
    ):
        change, phi = exponential_change(b[wp.tid()])
        change_out[wp.tid()] = change
        phi_out[wp.tid()] = phi

    rng = np.random.default_rng(5)
    matrices = [size * rng.normal(size=(3, 3)) for size in (1e-9, 1e-3, 0.1, 1.0, 5.0)]
    matrices += [np.zeros((3, 3)), np.array([[0.0, 0, 40.0], [0, 0, 0], [0, 0, 0]])]
    found = [wp.zeros(len(matrices), dtype=wp.mat33d, device="cpu") for _ in range(2)]
    given = wp.array(np.array(matrices), dtype=wp.mat33d, device="cpu")
    wp.launch(apply, dim=len(matrices), inputs=[given, *found], device="cpu")
    for b, change, phi in zip(matrices, found[0].numpy(), found[1].numpy(), strict=True):
        whole = rr.exponential(b)
        size = np.abs(whole).max()
        assert np.abs(np.eye(3) + change - whole).max() < 1e-14 * 40.0 * size
        assert np.abs(b @ phi - change).max() <= 1e-14 * 40.0 * max(np.abs(change).max(), 0.0)
    small = matrices[0]
    assert np.abs(found[0].numpy()[0] - (small + 0.5 * small @ small)).max() < 1e-15 * 1e-8

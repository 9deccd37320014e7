"""Stiff fibers turn like the rigid line of beads, for every number of segments and closure.

Source of the numbers: `tests.reference.rigid`, exact periods of the rigid chain with inertia.
Tolerances: the step is first order, and a fiber of finite E stretches. Relative error of
t_1 for r_f = 10: -(22/E + 0.04 dt), of t_2 - t_1: at most 0.01 dt (measured at two E and two dt):
the bounds 30/E + 0.05 dt and 0.02 dt.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from tests.cell import Kind, straight_fiber
from tests.reference import rigid
from warpfiber.build import device_groups
from warpfiber.simulation import Simulation

Start = Callable[..., Simulation]
SHEAR = {"kind": "simple_shear", "shear_rate": 1.0, "viscosity": 1.0}


def half_turn_times(sim: Simulation, strain: float, every: int = 8) -> list[list[float]]:
    """Strains at which the end-to-end vector of each fiber passes -x, x, ... , by cubics."""
    start = sim.fiber_node_start
    first, last = start[:-1], start[1:] - 1
    passages: list[list[float]] = [[] for _ in first]

    def look() -> tuple[np.ndarray, np.ndarray]:
        x, v = sim.node_pos, sim.node_velocity
        return x[last] - x[first], v[last] - v[first]

    axis, speed = look()
    while sim.strain < strain:
        begin = sim.time
        sim.step(every)
        new_axis, new_speed = look()
        for f in range(len(first)):
            sign = (-1.0) ** (len(passages[f]) + 1)
            if new_axis[f, 0] * sign > 0 and axis[f, 2] * sign > 0 >= new_axis[f, 2] * sign:
                values = (axis[f, 2], speed[f, 2], new_axis[f, 2], new_speed[f, 2])
                passages[f].append(rigid.hermite_root(begin, sim.time - begin, *values))
        axis, speed = new_axis, new_speed
    return passages


def expected_turns(r_f: float, density: float, torque: str = "end_weighted") -> list[float]:
    moment, torques = rigid.bead_moment(r_f), rigid.torque_count(r_f, torque)
    return rigid.half_turns(moment, torques, density=density, dt=2e-3)


@pytest.mark.parametrize("closure", ["paper", "consistent"])
@pytest.mark.parametrize("torque", ["end_weighted", "plain"])
def test_half_turns(start: Start, closure: str, torque: str) -> None:
    """r_f = 10 with 1, 3 and 9 segments: t_1 and the period 2 (t_2 - t_1)."""
    modulus, dt = 1e5, 1e-3
    kinds = [Kind(n, 9.0 / n, modulus=modulus) for n in (1, 3, 9)]
    fibers = [straight_fiber(kind, (1, 0, 0), (0, 0, 0)) for kind in kinds]
    sim = start(
        kinds,
        fibers,
        [0, 1, 2],
        velocity=np.zeros((16, 3)),
        flow=SHEAR,
        numerics={"closure": closure, "torque_weights": torque, "dt": dt},
    )
    t1, t2 = expected_turns(10.0, 0.1, torque)
    for passages in half_turn_times(sim, t2 + 0.3):
        assert len(passages) == 2
        assert abs(passages[0] / t1 - 1.0) < 30.0 / modulus + 0.05 * dt
        assert abs((passages[1] - passages[0]) / (t2 - t1) - 1.0) < 0.02 * dt


def test_period_without_closure(start: Start) -> None:
    """`none` takes the moment of the nodes alone: 3 segments turn 24 % too fast; within 5e-5."""
    kind = Kind(3, 3.0, modulus=1e5)
    sim = start(
        [kind],
        [straight_fiber(kind, (1, 0, 0), (0, 0, 0))],
        velocity=np.zeros((4, 3)),
        flow=SHEAR,
        numerics={"closure": "none", "dt": 1e-3},
    )
    moment, torques = rigid.node_moment(3, 3.0), rigid.torque_count(10.0)
    t1, t2 = rigid.half_turns(moment, torques, dt=2e-3)
    right = np.diff(expected_turns(10.0, 0.1))[0]
    assert (t2 - t1) / right < 0.8
    (passages,) = half_turn_times(sim, t2 + 0.3)
    assert abs((passages[1] - passages[0]) / (t2 - t1) - 1.0) < 5e-5


def test_inertia_vanishes(start: Start) -> None:
    """Re -> 0: half turns tend to pi (r_e + 1/r_e), r_e = sqrt((r_f^2 + 1)/2), as Re^2.

    The deviation at density 1 is compared with the rigid rod's own (5 %) and falls at least
    tenfold for a fourth of the density.
    """
    r_f = 10.0
    r_e = rigid.equivalent_aspect_ratio(rigid.bead_moment(r_f), rigid.torque_count(r_f))
    assert abs(r_e - np.sqrt((r_f**2 + 1.0) / 2.0)) < 1e-12
    ideal = 0.5 * rigid.period(r_e)
    late = []
    for density in (1.0, 0.25):
        kind = Kind(3, 3.0, density=density, modulus=1e6)
        sim = start(
            [kind],
            [straight_fiber(kind, (1, 0, 0), (0, 0, 0))],
            velocity=np.zeros((4, 3)),
            flow=SHEAR,
            numerics={"dt": 5e-4},
        )
        t1, t2 = expected_turns(r_f, density)
        (passages,) = half_turn_times(sim, t2 + 0.3)
        got = passages[1] - passages[0]
        assert abs(got - (t2 - t1)) < 1e-4 * ideal
        late.append(abs(got / ideal - 1.0))
    assert late[0] > 10.0 * late[1]


@pytest.mark.parametrize("closure", ["none", "paper", "consistent"])
def test_torque_drives_the_start(start: Start, closure: str) -> None:
    """A fiber along x feels no drag couple: only the torque of its beads turns it, slowly.

    Angle after a strain of 1 from the rigid equation (with its inertia); finite E and dt: 1e-3 of
    it. Without the torque the angle would be 0; one torque per segment would give an eighth.
    """
    kind = Kind(2, 8.0, modulus=3e5)
    sim = start(
        [kind],
        [straight_fiber(kind, (1, 0, 0), (0, 0, 0))],
        velocity=np.zeros((3, 3)),
        flow=SHEAR,
        numerics={"closure": closure, "dt": 5e-4},
    )
    sim.run(1.0)
    axis = sim.node_pos[-1] - sim.node_pos[0]
    angle = np.arctan2(axis[2], axis[0])
    moment = rigid.node_moment(2, 8.0) if closure == "none" else rigid.bead_moment(17.0)
    r_e = rigid.equivalent_aspect_ratio(moment, 17.0)
    # theta'' = c (theta'_J - theta'), c = 9 eta/(2 rho a^2) (1 + 2 N_t/(3 S) * 2)
    c = 45.0 * (1.0 + 4.0 * 17.0 / (3.0 * moment))
    steady = rigid.jeffery_angle(r_e, 1.0)
    expected = steady * (1.0 - (1.0 - np.exp(-c)) / c)
    assert abs(angle / expected - 1.0) < 1e-3


@pytest.mark.parametrize("closure", ["paper", "consistent"])
def test_orbit_in_space(start: Start, closure: str) -> None:
    """3-D orbit of r_f = 10, 3 segments, from p ~ (.6, .7, .3): direction within 2e-4 to strain 12.

    The reference orbit has inertia; without it the difference would be 9 times the bound.
    """
    kind = Kind(3, 3.0, modulus=1e5)
    p0 = np.array([0.6, 0.7, 0.3])
    sim = start(
        [kind],
        [straight_fiber(kind, p0, (0, 0, 0))],
        flow=SHEAR,
        numerics={"closure": closure, "dt": 5e-4},
    )
    gradient = np.zeros((3, 3))
    gradient[0, 2] = 1.0
    moment, torques = rigid.bead_moment(10.0), rigid.torque_count(10.0)
    times, path = rigid.inertial_orbit(
        p0, gradient, moment, torques, time_end=12.0, dt=2e-3, every=500
    )
    r_e = rigid.equivalent_aspect_ratio(moment, torques)
    inertia = 0.0
    for time, p in zip(times[1:], path[1:], strict=True):
        sim.run(time)
        axis = sim.node_pos[-1] - sim.node_pos[0]
        assert np.abs(axis / np.linalg.norm(axis) - p).max() < 2e-4
        inertia = max(inertia, np.abs(rigid.jeffery_orbit(p0, gradient, r_e, time) - p).max())
    assert inertia > 1.5e-3


def test_without_torque_a_fiber_never_turns_over(start: Start) -> None:
    """r_e is infinite without bead torque: along x it stays, from 45 degrees it only aligns.

    With the torque the same stiff fibers of r_f = 10 pass -x at strain 22.8. Drag alone turns the
    angle theta of a rigid fiber by -sin(theta)^2 per strain: cot(theta) grows by the strain.
    Tolerance: that of the file for t_1 plus the time a start out of balance costs, Re.
    """
    kind = Kind(3, 3.0, modulus=1e4)
    fibers = [
        straight_fiber(kind, (1, 0, 0), (0, 0, 0)),
        straight_fiber(kind, (1, 0, 1), (0, 0, 0)),
    ]
    sim = start([kind], fibers, flow=SHEAR, numerics={"dt": 2e-3})
    rows = [dict(row, torque=0.0) for row in sim.model.group_rows]
    sim.model.groups, sim.model.pivots = device_groups(rows, sim.model.precision, sim.device)
    sim.run(until=60.0)
    nodes = sim.node_pos.reshape(2, 4, 3)
    axis = nodes[:, -1] - nodes[:, 0]
    assert axis[0, 2] == 0.0 and axis[0, 0] > 0.0
    assert axis[1, 0] / axis[1, 2] == pytest.approx(1.0 + 60.0, rel=1e-2)

"""The float64 restatement in motion: rigid periods, time steppers, the tumbling flexible fiber.

Source of the numbers: exact periods of rigid chains of touching beads; tables of Runge-Kutta runs
    of another coding, printed to the digits given.
"""

from __future__ import annotations

import math

import numpy as np
import pytest

from tests.reference import bead_chain as bc
from tests.reference import flexible, rigid
from tests.reference.unit_vector import UNIT_GRADIENT, UNIT_V, UNIT_X, unit_chain


@pytest.mark.parametrize(
    ("aspect_ratio", "torque", "r_e", "period", "first", "second"),
    [
        (10, "end_weighted", 7.1063352018, 0.455345876787, 0.455731516048, 0.455304327337),
        (100, "end_weighted", 70.7142135642, 4.443993608914, 4.444377561408, 4.443933294638),
        (100, "plain", 71.0703876449, 4.466368233484, 4.466752178486, 4.466307909942),
    ],
)
def test_rigid_period(
    aspect_ratio: int, torque: str, r_e: float, period: float, first: float, second: float
) -> None:
    moment = rigid.bead_moment(aspect_ratio)
    torques = rigid.torque_count(aspect_ratio, torque)
    got = rigid.equivalent_aspect_ratio(moment, torques)
    excess = 1 if torque == "end_weighted" else aspect_ratio + 2
    assert got == pytest.approx(math.sqrt((aspect_ratio**2 + excess) / 2), rel=1e-14)
    assert abs(got - r_e) < 1e-10
    assert abs(rigid.period(got, 100.0) - period) < 1e-12
    t1, t2 = rigid.half_turns(moment, torques, dt=2e-3)
    assert abs(2 * t1 / 100 - first) < 1e-11
    assert abs(2 * (t2 - t1) / 100 - second) < 1e-11


def test_rigid_period_without_closure() -> None:
    table = {1: 1.083273, 3: 1.141271, 9: 1.541947, 11: 1.660362, 33: 2.643919}
    for segments, period in table.items():
        moment = rigid.node_moment(segments, 99 / segments)
        (t1,) = rigid.half_turns(moment, 100.0, dt=4e-3, count=1)
        assert abs(2 * t1 / 100 - period) < 6e-7


def test_bead_periods() -> None:
    table = {2: 13.908, 5: 24.397, 10: 45.535, 20: 89.412, 50: 222.37, 100: 444.40}
    for beads, period in table.items():
        r_e = rigid.equivalent_aspect_ratio(rigid.bead_moment(beads), beads)
        assert rigid.period(r_e) == pytest.approx(period, rel=5e-5)
        # A period brings the angle to -2 pi.
        assert rigid.jeffery_angle(r_e, rigid.period(r_e)) == pytest.approx(-2 * math.pi)


def test_jeffery_orbit_is_jeffery_angle() -> None:
    r_e = rigid.equivalent_aspect_ratio(rigid.bead_moment(10), 10)
    for time in (0.0, 0.3, 5.0, 11.4, 40.0):
        p = rigid.jeffery_orbit((1, 0, 0), bc.shear_gradient(1.0), r_e, time)
        theta = rigid.jeffery_angle(r_e, time)
        # The orbit knows the axis up to its sign.
        sine = p[0] * math.sin(theta) - p[2] * math.cos(theta)
        assert abs(sine) < 1e-11


@pytest.mark.parametrize("closure", ["none", "paper", "consistent"])
@pytest.mark.parametrize("torque", bc.TORQUES)
@pytest.mark.parametrize("segments", [1, 3, 19])
def test_chain_turns_like_the_rigid_fiber(segments: int, torque: str, closure: str) -> None:
    """One evaluation: the torque balance of a straight chain in general flow."""
    rng = np.random.default_rng(2)
    chain = bc.Chain(segments, 19 / segments, closure=closure, torque=torque, modulus=30.0)
    axis = rng.normal(size=3)
    axis /= np.linalg.norm(axis)
    omega = np.cross(axis, rng.normal(size=3))
    gradient = rng.normal(size=(3, 3))
    x = bc.straight_nodes(chain, axis, (0, 0, 0))
    dv = bc.acceleration(chain, x, np.cross(omega, x), gradient)
    along = x @ axis
    got = np.cross(axis, along @ dv) / (along @ along)
    if closure == "consistent":
        got = np.cross(axis, along @ chain.matrix @ dv) / (along @ chain.matrix @ along)
    unreduced = closure != "none"
    moment = rigid.bead_moment(20) if unreduced else rigid.node_moment(segments, chain.spacing)
    torques = rigid.torque_count(20, torque)
    expected = rigid.spin_rate(axis, omega, gradient, moment, torques)
    np.testing.assert_allclose(got, expected, rtol=1e-11, atol=1e-11)


def test_inertial_orbit_tends_to_jeffery() -> None:
    """Distance from the Jeffery orbit is of the order of Re and linear in it."""
    gradient, p0 = bc.shear_gradient(1.0), (0.6, 0.7, 0.3)
    moment = rigid.bead_moment(20)
    r_e = rigid.equivalent_aspect_ratio(moment, 20)
    worst = []
    for density, dt in ((0.1, 2e-2), (0.02, 1e-2)):
        time, path = rigid.inertial_orbit(
            p0, gradient, moment, 20, density=density, time_end=90, dt=dt, every=round(0.2 / dt)
        )
        exact = np.array([rigid.jeffery_orbit(p0, gradient, r_e, t) for t in time])
        worst.append(np.abs(path - exact).max())
    assert 4e-3 < worst[0] < 5.5e-3
    assert worst[0] / worst[1] == pytest.approx(5, rel=0.1)


def test_orders_of_the_steppers() -> None:
    """Runge-Kutta 4; drag implicit: 1, from the torque and the first half step. Both +- 0.15."""
    chain = unit_chain("consistent")

    def law(x: np.ndarray, v: np.ndarray, dt: float = 0.0) -> np.ndarray:
        return bc.acceleration(chain, x, v, UNIT_GRADIENT, dt=dt)

    for stepper, order in ((bc.step_rk4, 4), (bc.step_drag_implicit, 1)):
        ends = []
        for steps in (40, 80, 160):
            x, v = UNIT_X, UNIT_V
            for _ in range(steps):
                x, v = stepper(law, x, v, 0.2 / steps)
            ends.append(x)
        ratio = np.linalg.norm(ends[0] - ends[1]) / np.linalg.norm(ends[1] - ends[2])
        assert math.log2(ratio) == pytest.approx(order, abs=0.15)


@pytest.mark.parametrize("viscosity", [0.3, 300.0])
@pytest.mark.parametrize("closure", ["none", "paper", "consistent"])
def test_stability_limit_of_one_segment(closure: str, viscosity: float) -> None:
    """Stable iff omega^2 dt^2 < 4 or, where drag rules, omega^2 dt < 2 c: the larger one."""
    chain = bc.Chain(1, 19.0, closure=closure, modulus=5e4, viscosity=viscosity)
    # Stretching mode (1, -1): A^-1 applied to it, and the drag of a node in beads.
    alpha, beta = {"none": (1.0, 1.0), "paper": (2 / 20, 1.0), "consistent": (None, 1.0)}[closure]
    if alpha is None:
        alpha = 1 / (chain.matrix[0, 0] - chain.matrix[0, 1])
    omega2 = 2 * alpha * chain.stretching_stiffness / chain.mass
    limit = max(2.0 / math.sqrt(omega2), 2.0 * beta * chain.drag / chain.mass / omega2)
    assert (viscosity > 1.0) == (limit > 2.0 / math.sqrt(omega2))  # which of the two it is
    for factor, stable in ((0.99, True), (1.01, False)):
        x = bc.straight_nodes(chain, (1, 0, 0), (0, 0, 0)) * (1 + 1e-9)
        v = np.zeros_like(x)
        for _ in range(1200):
            x, v = bc.step_drag_implicit(
                lambda y, u, dt: bc.acceleration(chain, y, u, np.zeros((3, 3)), dt=dt),
                x,
                v,
                factor * limit,
            )
        size = abs(x[1, 0] - x[0, 0] - chain.length)
        assert bool(size < 1e-10 * chain.length) is stable


def assert_row(
    run: flexible.FlexibleRun, row: str, z_at: tuple, x_at: float, kappa_at: tuple
) -> None:
    """All printed columns of a table row to 1e-7."""
    half, *numbers = (float(cell) for cell in row.split("|"))
    got = [run.at(run.tip[:, 2], strain) for strain in z_at]
    got.append(run.at(run.tip[:, 0], x_at))
    got += [run.at(run.a_kappa, strain) for strain in kappa_at]
    assert abs(run.half - half) < 1e-7
    np.testing.assert_allclose(got, numbers, rtol=0, atol=1e-7)


SHORT_ROWS = {
    (24, "none"): "43.38901417|-0.044435561|-0.157173443|-0.130954664|-0.042618202"
    "|-0.178933407|0.2200132|0.44170742",
    (12, "paper"): "43.39358724|-0.043941059|-0.155199023|-0.132071316|-0.042330085"
    "|-0.183891396|0.23572749|0.37318884",
    (12, "consistent"): "43.41488747|-0.044951935|-0.155963053|-0.129670139|-0.042556686"
    "|-0.180111838|0.23036406|0.37754754",
    (8, "paper"): "43.57636349|-0.042984314|-0.148194955|-0.134714919|-0.042743882"
    "|-0.190148922|0.20983023|0.38059447",
    (8, "consistent"): "43.55226859|-0.045950721|-0.151773598|-0.127770814|-0.042943279"
    "|-0.184849772|0.19147632|0.38077551",
    (6, "paper"): "43.99145321|-0.041024850|-0.141352878|-0.139849604|-0.043820639"
    "|-0.172099941|0.23293408|0.31937597",
    (4, "paper"): "45.91957020|-0.031910252|-0.132823301|-0.112671869|-0.050112599"
    "|-0.033133183|0.08554975|0.22211731",
}


@pytest.mark.parametrize(
    ("segments", "closure"),
    [pytest.param(*key, marks=[] if key[0] >= 12 else [pytest.mark.papers]) for key in SHORT_ROWS],
)
def test_flexible_short_fiber(segments: int, closure: str) -> None:
    """r_f = 25, E = 3125: the same effective stiffness as the flexible case of the paper."""
    chain = flexible.flexible_chain(25, segments, 3125.0, closure)
    run = flexible.run_flexible(chain, dt=4e-3, strain_end=46 if segments < 6 else 44)
    row = SHORT_ROWS[segments, closure]
    assert_row(run, row, (10, 15, 20, 30), 20, (15, 20))


LONG_ROWS = {
    (49, "none"): "90.17607542|-0.015848495|-0.038916905|-0.122312314|-0.142961750|-0.126907798"
    "|-0.023391496|-0.047755157|0.05808571|0.18298900",
    (25, "paper"): "90.08161210|-0.015853531|-0.039257307|-0.125713555|-0.142087103|-0.125938240"
    "|-0.023220900|-0.056823022|0.06078449|0.18561259",
    (25, "consistent"): "90.12785588|-0.015870992|-0.039226075|-0.124817726|-0.142173049"
    "|-0.126334614|-0.023300981|-0.052973696|0.05974107|0.18385490",
}


@pytest.mark.papers
@pytest.mark.parametrize(("segments", "closure"), list(LONG_ROWS))
def test_flexible_long_fiber(segments: int, closure: str) -> None:
    """r_f = 50, E = 0.5 GPa, Re = 0.1 (Sasayama & Inagaki 2018, Fig. 5)."""
    chain = flexible.flexible_chain(50, segments, 5e4, closure)
    run = flexible.run_flexible(chain, dt=2e-3, strain_end=91)
    assert_row(run, LONG_ROWS[segments, closure], (20, 30, 35, 40, 45, 60), 40, (35, 40))
    peak = {"none": (0.24393479, 42.4), "paper": (0.24346611, 42.2)}.get(closure)
    if peak is not None:
        assert abs(run.a_kappa.max() - peak[0]) < 1e-7
        assert run.strain[run.a_kappa.argmax()] == pytest.approx(peak[1])
    if closure == "none":
        assert abs(run.tip[:, 2].min() + 0.164809105) < 1e-7
        assert run.strain[run.tip[:, 2].argmin()] == pytest.approx(37.1)
        assert run.axial_strain.max() == pytest.approx(0.022, abs=5e-4)

"""The float64 restatement, forces and closures: closed forms, printed values, conservation laws.

Source of the numbers: exact results for chains of touching beads; one evaluation on which two
    independent codings agree (unit vector).
"""

from __future__ import annotations

import math

import numpy as np
import pytest

from tests.reference import bead_chain as bc
from tests.reference import rigid
from tests.reference.gradient import central_gradient
from tests.reference.unit_vector import (
    UNIT_ACCELERATION,
    UNIT_ALPHA_R,
    UNIT_BETA_R,
    UNIT_FORCE,
    UNIT_GRADIENT,
    UNIT_V,
    UNIT_X,
    unit_chain,
)


@pytest.mark.parametrize("segments", [1, 2, 3, 4, 8, 13])
@pytest.mark.parametrize("spacing", [1.0, 1.37, 2.0, 49 / 13, 25.0])
def test_straight_factors(segments: int, spacing: float) -> None:
    chain = bc.Chain(segments, spacing)
    nodes = bc.straight_nodes(chain, (0.3, -0.5, 0.8), (1.0, 2.0, 3.0))
    m, n, n_tot = spacing, segments, chain.bead_count
    got = bc.paper_factors(chain, nodes)
    alpha_r = m * (n + 1) * (n + 2) / (n_tot * (n_tot + 1))
    end = (m + 1) * (3 * m * n - 2 * m + 2) / (6 * m * n)
    expected = np.full(n + 1, alpha_r * m)
    expected[0] = expected[-1] = alpha_r * end
    # A node on the center of an even chain has no direction; the rounding decides its factor.
    off_center = np.arange(n + 1) != n / 2
    np.testing.assert_allclose(got.alpha_r, alpha_r, rtol=1e-13)
    np.testing.assert_allclose(got.beta_r[off_center], expected[off_center], rtol=1e-12)
    arm2 = ((nodes - nodes.mean(0)) ** 2).sum(1)
    np.testing.assert_allclose(got.beta_r @ arm2, arm2.sum(), rtol=1e-13)
    if n == 1:
        np.testing.assert_allclose(got.alpha_t, 2 / (m + 1), rtol=1e-15)
        np.testing.assert_allclose(got.alpha_r, 6 * m / ((m + 1) * (m + 2)), rtol=1e-14)
        np.testing.assert_allclose([*got.beta_t, *got.beta_r], 1.0, rtol=1e-14)
    # Transverse drag per force of the straight fiber.
    ratio = (2 * end + (n - 1) * m) / n_tot
    exact = 1 - 2 * (m * m - 1) / (3 * m * n * n_tot)
    np.testing.assert_allclose(ratio, exact, rtol=1e-14)


def test_transverse_drag_numbers() -> None:
    for segments, value, digit in ((1, 0.34, 0.005), (3, 0.927, 5e-4), (9, 0.992, 5e-4)):
        m = 99 / segments
        assert abs(1 - 2 * (m * m - 1) / (3 * m * segments * 100) - value) < digit


def test_unreduced_chain_has_no_correction() -> None:
    rng = np.random.default_rng(1)
    for segments in (1, 3, 4, 9):
        chain = bc.Chain(segments, 1.0, modulus=50.0)
        nodes = bc.walk_nodes(chain, rng)
        factors = bc.paper_factors(chain, nodes)
        every = [factors.alpha_t, factors.alpha_r, *factors.beta_t, *factors.beta_r]
        np.testing.assert_allclose(every, 1.0, rtol=1e-13)
        nodes = nodes + 0.05 * rng.normal(size=nodes.shape)
        vel, gradient = rng.normal(size=nodes.shape), rng.normal(size=(3, 3))
        result = [
            bc.acceleration(
                bc.Chain(segments, 1.0, modulus=50.0, closure=name), nodes, vel, gradient
            )
            for name in ("none", "consistent")
        ]
        np.testing.assert_allclose(result[0], result[1], rtol=1e-13)


def test_mass_matrix() -> None:
    for segments, spacing in ((1, 2), (4, 3), (3, 7)):
        w = bc.bead_weights(segments, spacing)
        np.testing.assert_allclose(bc.mass_matrix(segments, spacing), w.T @ w, atol=1e-14)
    np.testing.assert_array_equal(bc.mass_matrix(5, 1.0), np.eye(6))
    chain = bc.Chain(13, 49 / 13)
    np.testing.assert_allclose(chain.matrix.sum(), chain.bead_count, rtol=1e-14)
    along = np.arange(14) * 2 * chain.spacing - 49
    np.testing.assert_allclose(along @ chain.matrix @ along, rigid.bead_moment(50), rtol=1e-14)


def test_torque_weights() -> None:
    assert bc.Chain(9, 11.0).weights.sum() == pytest.approx(100, rel=1e-15)
    assert bc.Chain(1, 99.0).weights.sum() == pytest.approx(100, rel=1e-15)
    assert bc.Chain(9, 11.0, torque="plain").weights.sum() == pytest.approx(99, rel=1e-15)


def test_unit_vector_factors_and_force() -> None:
    chain = unit_chain("paper")
    assert chain.stretching_stiffness == pytest.approx(25 * np.pi, rel=1e-15)
    assert chain.bending_stiffness == pytest.approx(6.25 * np.pi, rel=1e-15)
    factors = bc.paper_factors(chain, UNIT_X)
    assert abs(factors.alpha_t - 0.555555555555556) < 1e-14
    assert abs(factors.alpha_r - UNIT_ALPHA_R) < 1e-14
    np.testing.assert_allclose(factors.beta_t, [5 / 6, 10 / 9, 10 / 9, 10 / 9, 5 / 6], atol=1e-15)
    np.testing.assert_allclose(factors.beta_r, UNIT_BETA_R, rtol=0, atol=1e-13)
    force = bc.nodal_force(chain, UNIT_X, UNIT_V, UNIT_GRADIENT)
    np.testing.assert_allclose(force, UNIT_FORCE, rtol=0, atol=1e-11)


@pytest.mark.parametrize("closure", bc.CLOSURES)
def test_unit_vector_acceleration(closure: str) -> None:
    got = bc.acceleration(unit_chain(closure), UNIT_X, UNIT_V, UNIT_GRADIENT)
    np.testing.assert_allclose(got, UNIT_ACCELERATION[closure], rtol=0, atol=1e-10)


@pytest.mark.parametrize("spacing", [1.0, 1.96, 3.0])
def test_energy_gradients(spacing: float) -> None:
    rng = np.random.default_rng(3)
    chain = bc.Chain(5, spacing, modulus=10.0, axial_modulus=4.0)
    x = bc.walk_nodes(chain, rng) + 0.1 * rng.normal(size=(6, 3))
    axis, length = bc.segment_geometry(x)
    for force, energy in (
        (bc.stretching_force(chain, axis, length), bc.stretching_energy),
        (bc.bending_force(chain, axis, length), bc.bending_energy),
    ):
        gradient = central_gradient(lambda y, e=energy: e(chain, y), x, 2e-3)
        np.testing.assert_allclose(force, -gradient, atol=2e-9 * np.abs(force).max() + 1e-9)
        np.testing.assert_allclose(force.sum(0), 0, atol=1e-13 * np.abs(force).max())
        np.testing.assert_allclose(np.cross(x, force).sum(0), 0, atol=1e-12 * np.abs(force).max())


def test_bending_of_straight_and_folded() -> None:
    chain = bc.Chain(3, 2.0, modulus=10.0)
    x = bc.straight_nodes(chain, (1, 0, 0), (0, 0, 0))
    axis, length = bc.segment_geometry(x)
    np.testing.assert_array_equal(bc.bending_force(chain, axis, length), 0.0)
    x[3] = x[2] + np.array([4 * math.cos(3.1), 0, 4 * math.sin(3.1)])
    assert bc.bending_energy(chain, x) == pytest.approx(0.5 * chain.bending_stiffness * 3.1**2)


def test_cantilever() -> None:
    """Compliance of the linearized joints; printed error against L_e^3/3EI."""
    for segments, error, digit in (
        (49, -1e-4, 0.5e-4),
        (25, -4e-4, 0.5e-4),
        (13, -1.6e-3, 0.5e-4),
        (7, -6e-3, 5e-4),
    ):
        chain = bc.Chain(segments, 49 / segments, modulus=1.0)
        k = np.arange(1, segments)
        exact = np.sum((chain.rest_length * k) ** 2) / chain.bending_stiffness
        stiffness = chain.bending_stiffness * chain.rest_length  # E I
        free = chain.length - chain.spacing
        assert abs(exact / (free**3 / (3 * stiffness)) - 1 - error) < digit
        x = bc.straight_nodes(chain, (1, 0, 0), (0, 0, 0))
        columns = []
        for node in range(2, segments + 1):
            y = x.copy()
            y[node, 2] += 1e-6
            columns.append(bc.bending_force(chain, *bc.segment_geometry(y))[2:, 2] / 1e-6)
        load = np.zeros(segments - 1)
        load[-1] = 1.0
        tip = np.linalg.solve(-np.array(columns).T, load)[-1]
        assert tip == pytest.approx(exact, rel=1e-6)


def test_uniform_curvature_energy() -> None:
    chain = bc.Chain(7, 7.0, modulus=2.0)
    angle = 0.9
    turn = angle / chain.segments
    nodes = bc.arc_nodes(chain, angle)
    np.testing.assert_allclose(bc.joint_angles(nodes), turn, rtol=1e-12)
    continuum = 0.5 * chain.bending_stiffness * chain.rest_length * angle**2 / chain.length
    assert bc.bending_energy(chain, nodes) / continuum == pytest.approx(6 / 7, rel=1e-12)


def test_torque_couple() -> None:
    """The couple carries the part of T across the segment, spelled out with vector products."""
    rng = np.random.default_rng(4)
    chain = bc.Chain(4, 2.5, viscosity=0.7)
    x, v = bc.walk_nodes(chain, rng), rng.normal(size=(5, 3))
    gradient = rng.normal(size=(3, 3))
    axis, length = bc.segment_geometry(x)
    vorticity = 0.5 * np.array(
        [
            gradient[2, 1] - gradient[1, 2],
            gradient[0, 2] - gradient[2, 0],
            gradient[1, 0] - gradient[0, 1],
        ]
    )
    omega = np.cross(axis, (v[1:] - v[:-1]) / length[:, None])
    torque = 8 * np.pi * 0.7 * chain.weights[:, None] * (vorticity - omega)
    couple = np.cross(torque, axis) / length[:, None]
    force = np.zeros((5, 3))
    force[1:] += couple
    force[:-1] -= couple
    got = bc.torque_force(chain, axis, length, v, gradient)
    np.testing.assert_allclose(got, force, rtol=1e-12, atol=1e-12)
    across = torque - (torque * axis).sum(1)[:, None] * axis
    np.testing.assert_allclose(np.cross(x[1:] - x[:-1], couple), across, rtol=1e-11, atol=1e-11)
    np.testing.assert_allclose(np.cross(x, got).sum(0), across.sum(0), rtol=1e-11, atol=1e-11)


@pytest.mark.parametrize(("segments", "spacing"), [(1, 5), (2, 3), (5, 2), (7, 7)])
def test_consistent_balances_unreduced_fiber(segments: int, spacing: int) -> None:
    """Linear and angular momentum of the unreduced beads, any shape and force."""
    rng = np.random.default_rng(5)
    chain = bc.Chain(segments, spacing, closure="consistent", modulus=10.0)
    w = bc.bead_weights(segments, spacing)
    for _ in range(20):
        x = bc.walk_nodes(chain, rng) + 0.2 * rng.normal(size=(segments + 1, 3))
        v, extra = rng.normal(size=x.shape), rng.normal(size=x.shape)
        gradient, gravity = rng.normal(size=(3, 3)), rng.normal(size=3)
        nodal = bc.nodal_force(chain, x, v, gradient, extra)
        dv = bc.acceleration(chain, x, v, gradient, extra, gravity)
        bead_x, bead_v = w @ x, w @ v
        drag = chain.drag * (bead_x @ gradient.T - bead_v) + bc.gravity_force(chain, gravity)
        inertia = chain.mass * (w @ dv)
        scale = np.abs(inertia).sum()
        reach = np.abs(x).max()
        np.testing.assert_allclose(inertia.sum(0), drag.sum(0) + nodal.sum(0), atol=1e-13 * scale)
        np.testing.assert_allclose(
            np.cross(bead_x, inertia).sum(0),
            np.cross(bead_x, drag).sum(0) + np.cross(x, nodal).sum(0),
            atol=1e-13 * scale * reach,
        )
        # Interior rows too: the power of any nodal motion.
        np.testing.assert_allclose(w.T @ inertia, w.T @ drag + nodal, atol=1e-13 * scale)
        energy = 0.5 * chain.mass * (bead_v**2).sum()
        assert bc.kinetic_energy(chain, v) == pytest.approx(energy, rel=1e-13)


def test_internal_forces_do_not_drift() -> None:
    """An arc relaxing in still fluid: `consistent` stays, `paper` drifts."""
    drift = {}
    for closure in ("consistent", "paper"):
        chain = bc.Chain(3, 49 / 3, closure=closure, modulus=1e4)
        x = bc.arc_nodes(chain, 2.0)
        v = np.zeros_like(x)
        share = chain.matrix.sum(0) / chain.bead_count
        start = share @ x
        for _ in range(1500):
            x, v = bc.step_rk4(
                lambda y, u, c=chain: bc.acceleration(c, y, u, np.zeros((3, 3))), x, v, 2e-2
            )
        drift[closure] = np.linalg.norm(share @ x - start) / chain.length
    assert drift["consistent"] < 1e-14
    assert drift["paper"] > 1e-4


def test_translation_at_one_segment() -> None:
    """`consistent` with one segment: equal node forces give F/(r_f m) each."""
    chain = bc.Chain(1, 24.0, closure="consistent")
    x = bc.straight_nodes(chain, (1, 0, 0), (0, 0, 0))
    pull = np.tile([0.0, 0.0, 0.5], (2, 1))
    dv = bc.acceleration(chain, x, np.zeros((2, 3)), np.zeros((3, 3)), pull)
    np.testing.assert_allclose(dv[:, 2], 1 / (25 * chain.mass), rtol=1e-13)


def test_gravity_settles_like_a_bead() -> None:
    """Straight and free-draining: W/zeta of one bead in every direction, every closure."""
    for closure in bc.CLOSURES:
        chain = bc.Chain(5, 3.0, closure=closure, fluid_density=0.04)
        x = bc.straight_nodes(chain, (1, 2, 3), (0, 0, 0))
        gravity = np.array([0.3, 0.0, -9.0])
        settle = bc.gravity_force(chain, gravity) / chain.drag
        dv = bc.acceleration(chain, x, np.tile(settle, (6, 1)), np.zeros((3, 3)), gravity=gravity)
        np.testing.assert_allclose(dv, 0, atol=1e-12 * np.abs(gravity).max())


def torque_lever(chain: bc.Chain, x: np.ndarray) -> np.ndarray:
    """c_i (n, 3): lever about G of a force interpolated linearly over the beads from node i."""
    axis, _ = bc.segment_geometry(x)
    m, n_r = chain.spacing, chain.reduced_beads
    arm = x - x.mean(0)
    k = chain.radius / 3 * n_r * (n_r + 2)
    lever = m * arm
    lever[1:-1] += k * (axis[1:] - axis[:-1])
    lever[0] = (m + 1) / 2 * arm[0] + k * axis[0]
    lever[-1] = (m + 1) / 2 * arm[-1] - k * axis[-1]
    return lever


@pytest.mark.parametrize(("segments", "spacing"), [(1, 4), (3, 3), (5, 2), (8, 6)])
def test_paper_translation_inertia_torque(segments: int, spacing: int) -> None:
    """What the factors of the paper hold exactly, against a bead-by-bead sum."""
    rng = np.random.default_rng(6)
    chain = bc.Chain(segments, spacing, closure="paper")
    w = bc.bead_weights(segments, spacing)
    for _ in range(10):
        x = bc.walk_nodes(chain, rng)
        arm = x - x.mean(0)
        bead = w @ arm
        force = rng.normal(size=x.shape)
        bead_force = w @ force
        factors = bc.paper_factors(chain, x)
        # Mean acceleration of the nodes = that of the beads (B.1 = B.2), drag and nodal force.
        np.testing.assert_allclose(
            (factors.beta_t @ force) / (segments + 1), bead_force.mean(0), atol=1e-14
        )
        np.testing.assert_allclose(factors.alpha_t / (segments + 1), 1 / len(bead), rtol=1e-14)
        # alpha^R = node inertia / bead inertia about the mean of the nodes.
        ratio = (arm**2).sum() / (bead**2).sum()
        np.testing.assert_allclose(factors.alpha_r, ratio, rtol=1e-13)
        # Torque (B.14), nodal part: only what is across r^G counts, and alpha^R scales it.
        radial = arm / np.linalg.norm(arm, axis=1)[:, None]
        scaled = bc.correct(force, radial, factors.alpha_t, factors.alpha_r)
        np.testing.assert_allclose(
            np.cross(arm, scaled).sum(0),
            factors.alpha_r * np.cross(arm, force).sum(0),
            atol=1e-13 * np.abs(arm).sum(),
        )
        # beta^R is the projection of the true lever on r^G.
        lever = torque_lever(chain, x)
        np.testing.assert_allclose(
            np.cross(lever, force).sum(0),
            np.cross(bead, bead_force).sum(0),
            atol=1e-13 * np.abs(bead).sum() * len(bead),
        )
        np.testing.assert_allclose(
            factors.beta_r,
            factors.alpha_r * bc.dot(lever, arm) / bc.dot(arm, arm),
            rtol=1e-11,
            atol=1e-11,
        )


def test_paper_torque_of_drag() -> None:
    """B.14, drag part: exact for straight fibers, wrong for bent ones by the printed amounts."""
    rng = np.random.default_rng(7)

    def errors(chain: bc.Chain, x: np.ndarray) -> np.ndarray:
        factors = bc.paper_factors(chain, x)
        arm, lever = x - x.mean(0), torque_lever(chain, x)
        found = []
        for _ in range(300):
            force = rng.normal(size=x.shape)
            got = np.cross(factors.beta_r[:, None] * arm, force).sum(0)
            right = factors.alpha_r * np.cross(lever, force).sum(0)
            found.append(np.linalg.norm(got - right) / np.linalg.norm(right))
        return np.array(found)

    table = {(0.5, 3): 5e-2, (0.5, 7): 1e-2, (0.5, 25): 1e-3}
    table |= {(3.0, 3): 0.25, (3.0, 7): 0.045, (3.0, 25): 5e-3}
    for (angle, segments), printed in table.items():
        chain = bc.Chain(segments, 99 / segments)
        x = bc.straight_nodes(chain, (1, 0, 0), (0, 0, 0))
        assert np.median(errors(chain, x)) < 1e-13
        median = np.median(errors(chain, bc.arc_nodes(chain, angle)))
        assert printed / 2 < median < 2 * printed

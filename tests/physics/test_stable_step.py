"""The printed limits of dt are the true ones; steps above them are refused or end in a report."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from tests.cell import Kind, cell_scene, straight_fiber
from warpfiber.methods.stability import step_limits
from warpfiber.scene import SceneError
from warpfiber.simulation import Diverged, Simulation

Start = Callable[..., Simulation]


def is_stable(start: Start, kind: Kind, closure: str, dt: float) -> bool:
    """Whether a slightly disturbed straight fiber in a fluid at rest calms down.

    It is disturbed more across than along: the line from the center to a middle node, which decides
    over its published factors, shall not turn with the mode that grows.
    """
    rng = np.random.default_rng(1)
    nodes = straight_fiber(kind, (1, 0, 0), (0, 0, 0))
    sim = start(
        [kind],
        [nodes + (1e-9, 1e-3, 1e-3) * rng.normal(size=nodes.shape)],
        velocity=np.zeros_like(nodes),
        numerics={"closure": closure, "dt": dt, "allow_unstable_dt": True},
    )
    try:
        sim.step(1500)
    except Diverged:
        return False
    return bool(np.abs(sim.node_velocity).max() < 1e-4)  # 1e-3 and more if unstable


CASES = [
    (24, 1.0, "none", 3125.0),
    (12, 2.0, "paper", 3125.0),
    (12, 2.0, "consistent", 3125.0),
    (12, 2.0, "none", 3125.0),
    (3, 8.0, "consistent", 3125.0),
    (5, 4.8, "paper", 3125.0),
    (3, 8.0, "paper", 3125.0),  # inner nodes are damped across the fiber by alpha^R M
    (2, 12.0, "paper", 3125.0),  # the middle node lies on the center
    (4, 6.0, "paper", 3125.0),
    (1, 24.0, "consistent", 3125.0),
    (15, 49.0 / 15.0, "consistent", 5e4),
    (15, 49.0 / 15.0, "paper", 5e4),
    (5, 3.0, "consistent", 30.0),  # damping decides
]


@pytest.mark.parametrize(("segments", "spacing", "closure", "modulus"), CASES)
def test_limit_is_the_true_one(
    start: Start, segments: int, spacing: float, closure: str, modulus: float
) -> None:
    """Bisection between half and twice the limit: within 10 % of the printed one."""
    kind = Kind(segments, spacing, modulus=modulus)
    limit = step_limits(cell_scene([kind], [0], numerics={"closure": closure}))[0].dt
    low, high = 0.5 * limit, 2.0 * limit
    assert is_stable(start, kind, closure, low)
    assert not is_stable(start, kind, closure, high)
    while high / low > 1.02:
        middle = np.sqrt(low * high)
        if is_stable(start, kind, closure, middle):
            low = middle
        else:
            high = middle
    assert 0.9 < low / limit < 1.1


FLEXIBLE = Kind(12, 2.0, modulus=3125.0)


def test_refused_above_the_limit(start: Start) -> None:
    """Without the flag a larger dt is a fault that names the key, the limit and its term."""
    with pytest.raises(SceneError) as caught:
        start([FLEXIBLE], [straight_fiber(FLEXIBLE, (1, 0, 0), (0, 0, 0))], numerics={"dt": 0.02})
    text = str(caught.value)
    assert "numerics.dt" in text and "stretching" in text and "allow_unstable_dt" in text


def test_refused_by_the_flow(start: Start) -> None:
    """A step of more than 0.02 strain would be stable here: the fault says that it is accuracy."""
    heavy = Kind(2, 2.0, density=10.0, modulus=1.0)
    nodes = straight_fiber(heavy, (1, 0, 0), (0, 0, 0))
    flow = {"kind": "simple_shear", "shear_rate": 1.0, "viscosity": 1.0}
    sim = start([heavy], [nodes], flow=flow, numerics={"dt": 0.02})
    assert [limit.kind for limit in sim.limits] == ["accurate", "stable", "stable"]
    with pytest.raises(SceneError) as caught:
        start([heavy], [nodes], flow=flow, numerics={"dt": 0.021})
    assert "accurate, 0.02 s, set by flow" in str(caught.value)
    assert "stable," not in str(caught.value)


def test_divergence_names_fiber_term_and_limit(start: Start) -> None:
    """With the flag the run goes on until a fiber tears; the state stays that before the tear."""
    slack = Kind(12, 2.0, modulus=30.0)
    sim = start(
        [slack, FLEXIBLE],
        [
            straight_fiber(slack, (1, 0, 0), (0, 0, 0)),
            straight_fiber(FLEXIBLE, (1, 0.2, 0.1), (0, 90, 0)),
        ],
        [0, 1],
        flow={"kind": "simple_shear", "shear_rate": 1.0, "viscosity": 1.0},
        numerics={"dt": 0.02, "allow_unstable_dt": True},
    )
    limit = sim.limits[0]
    assert limit.dt < 0.02 and limit.group == 1
    with pytest.raises(Diverged) as caught:
        sim.step(100_000)
    report = caught.value.report
    assert report["fiber"] == 1
    assert report["largest_term"] == "stretching"
    assert report["stretch"] >= 2.0 or not np.isfinite(report["stretch"])
    for part in ("fiber 1", "stretching", f"{limit.dt:.4g}", "diverged at step"):
        assert part in str(caught.value)
    assert sim.step_count < 100_000
    assert np.isfinite(sim.node_pos[:13]).all()

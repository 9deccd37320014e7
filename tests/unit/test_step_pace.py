"""How long the next step of a cell with contact is, by the overlap that the last one left.

Tolerance: rounding of a root, 1e-12.
"""

from __future__ import annotations

import numpy as np
import pytest
import warp as wp

from warpfiber.passes.contact_verdict import make_contact_verdict
from warpfiber.passes.step_control import AGAIN, HALVE, KEEP

LIMIT = 0.05


def judged(overlap: float, crossed: int = 0, need: int = 0) -> tuple[int, float]:
    """Verdict and pace of a step that left this overlap."""
    kernel = make_contact_verdict()["judge_contacts"]

    def ints(*values: int) -> wp.array:
        return wp.array(values, dtype=wp.int32, device="cpu")

    verdict, pace = ints(-1, -1), wp.zeros(1, dtype=wp.float64, device="cpu")
    found = ints(crossed, 1, 2, 1, 2)
    largest = wp.array([overlap], dtype=wp.float64, device="cpu")
    inputs = [wp.float64(LIMIT), ints(need), ints(0), largest, found, ints(0, 7, 8)]
    inputs += [wp.zeros(16, dtype=wp.int32, device="cpu"), verdict, pace]
    wp.launch(kernel, dim=1, inputs=inputs, device="cpu")
    return int(verdict.numpy()[0]), float(pace.numpy()[0])


@pytest.mark.parametrize(
    ("overlap", "verdict", "pace"),
    [
        (0.0, KEEP, 2.0),
        (0.25 * LIMIT, KEEP, 1.8),  # twice the step would leave all of the limit
        (0.64 * LIMIT, KEEP, 1.125),
        (0.999 * LIMIT, KEEP, 1.0),  # one that is kept is not followed by a shorter one
        (1.001 * LIMIT, HALVE, 0.9),
        (1.44 * LIMIT, HALVE, 0.75),
        (10.0 * LIMIT, HALVE, 0.5),
        (1e30, HALVE, 0.5),
    ],
)
def test_overlaps_grow_with_the_square_of_a_step(overlap: float, verdict: int, pace: float) -> None:
    found = judged(overlap)
    assert found[0] == verdict
    # 1.001 and 0.999 times a limit: 0.05 percent of a root
    assert found[1] == pytest.approx(pace, rel=1e-3 if 0.99 < overlap / LIMIT < 1.01 else 1e-12)


def test_lines_that_crossed_halve_the_step() -> None:
    assert judged(0.0, crossed=1) == (HALVE, 0.5)


def test_rows_that_do_not_fit_ask_for_the_same_step() -> None:
    assert judged(3.0 * LIMIT, need=9)[0] == AGAIN


def test_what_is_aimed_at_is_within_the_limit() -> None:
    """A shorter step by this law leaves an overlap of the second order below the limit."""
    for overlap in np.linspace(1.01, 3.0, 20) * LIMIT:
        _, pace = judged(float(overlap))
        assert overlap * pace**2 < 0.9 * LIMIT

"""What the contacts of a step decide: go on, halve it, or repeat it with a larger list or rows.

Source: a step is kept if at its end no pair overlaps by more than a given share of the radius and
    no center lines passed through each other or a wall. Rows are linear in the motion of a step, so
    what they leave grows with its square: the next step, or the same again, is dt times
    CAUTION sqrt(limit / overlap), not below half and not beyond twice of it.
"""

from functools import cache

import warp as wp

from warpfiber.model import EXPIRED, HALT
from warpfiber.passes.step_control import AGAIN, HALVE, KEEP

CAUTION = 0.9  # sqrt of the share of the limit that is aimed at
SHORTER = 0.5, 0.9  # least and most of a step that is taken again
LONGER = 2.0  # most of one after a step that was shortened


@cache
def make_contact_verdict(module: str = "unique"):
    """Kernels `gate_list` and `judge_contacts`, one thread each, by name."""

    @wp.kernel(module=module, enable_backward=False, grid_stride=False)
    def gate_list(
        list_short: wp.array(dtype=wp.int32),
        status: wp.array(dtype=wp.int32),
        rejected_out: wp.array(dtype=wp.int32),
    ):
        """A list that may miss a pair ends the step before its rows are made."""
        if status[wp.static(HALT)] == 0 and list_short[0] != 0:
            status[wp.static(EXPIRED)] = 1
            status[wp.static(HALT)] = 1
            rejected_out[0] = 1

    @wp.kernel(module=module, enable_backward=False, grid_stride=False)
    def judge_contacts(
        most_overlap: wp.float64,
        first_need: wp.array(dtype=wp.int32),
        second_need: wp.array(dtype=wp.int32),
        largest: wp.array(dtype=wp.float64),
        found: wp.array(dtype=wp.int32),
        segment_fiber: wp.array(dtype=wp.int32),
        status: wp.array(dtype=wp.int32),
        verdict_out: wp.array(dtype=wp.int32),
        pace_out: wp.array(dtype=wp.float64),
    ):
        """`pace`: the next step over this one, as far as the largest step allows."""
        if status[wp.static(HALT)] != 0:
            return
        verdict_out[0] = wp.static(KEEP)
        if first_need[0] + second_need[0] > 0:
            verdict_out[0] = wp.static(AGAIN)
            return
        ratio = most_overlap / wp.max(largest[0], wp.float64(1e-30))
        pace = wp.float64(wp.static(CAUTION)) * wp.sqrt(ratio)
        pace_out[0] = wp.clamp(pace, wp.float64(1.0), wp.float64(wp.static(LONGER)))
        if largest[0] > most_overlap:
            pace_out[0] = wp.clamp(
                pace,
                wp.float64(wp.static(SHORTER[0])),
                wp.float64(wp.static(SHORTER[1])),
            )
            verdict_out[0] = wp.static(HALVE)
            verdict_out[1] = segment_fiber[wp.max(found[1], 0)]
        if found[0] > 0:
            pace_out[0] = wp.float64(wp.static(SHORTER[0]))
            verdict_out[0] = wp.static(HALVE)
            verdict_out[1] = segment_fiber[wp.max(found[3], 0)]

    return {"gate_list": gate_list, "judge_contacts": judge_contacts}

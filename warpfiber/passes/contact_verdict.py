"""What the contacts of a step decide: go on, halve it, or repeat it with a larger list or rows.

Source: a step is kept if at its end no pair overlaps by more than a given share of the radius and
    no center lines passed through each other or a wall.
"""

from functools import cache

import warp as wp

from warpfiber.model import EXPIRED, HALT
from warpfiber.passes.step_control import AGAIN, HALVE, KEEP


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
    ):
        if status[wp.static(HALT)] != 0:
            return
        verdict_out[0] = wp.static(KEEP)
        if first_need[0] + second_need[0] > 0:
            verdict_out[0] = wp.static(AGAIN)
            return
        if largest[0] > most_overlap:
            verdict_out[0] = wp.static(HALVE)
            verdict_out[1] = segment_fiber[wp.max(found[1], 0)]
        if found[0] > 0:
            verdict_out[0] = wp.static(HALVE)
            verdict_out[1] = segment_fiber[wp.max(found[3], 0)]

    return {"gate_list": gate_list, "judge_contacts": judge_contacts}

"""Memories of friction by listed pair: handed over along fibers, and from list to list.

A memory is what a pair had a step ago: two sides of the arrays, written in turn, so that a pair can
read its neighbors' while these are written. It counts if it is of the last step.
Source: a contact that slides over a node goes to the next pair of segments with its displacement.
Symbols: (h, d) of law `friction` in one vector; side = step modulo 2; step in which it was written.
"""

from functools import cache
from typing import Any

import warp as wp

from warpfiber.model import precision

NEVER = -2  # a step that is no pair's last one


@cache
def make_hand_over(name: str):
    """`neighbors_memory`: what a pair that begins to act takes over from those beside it."""
    p = precision(name)
    real, vec4 = p.real, p.vec4
    zero, one = real(0.0), real(1.0)

    @wp.func
    def memory_of(
        i: wp.int32,
        j: wp.int32,
        image: wp.int32,
        last: wp.int32,
        out_start: wp.array(dtype=wp.int32),
        pair_j: wp.array(dtype=wp.int32),
        pair_image: wp.array(dtype=wp.int32),
        pair_memory: wp.array2d(dtype=vec4),
        pair_step: wp.array2d(dtype=wp.int32),
    ) -> vec4:
        """Memory of a pair after the step `last`; without depth where it had none."""
        side = last & 1
        for k in range(out_start[i], out_start[i + 1]):
            if pair_j[k] == j and pair_image[k] == image and pair_step[side, k] == last:
                return pair_memory[side, k]
        return vec4(zero, zero, zero, zero)

    @wp.func
    def neighbors_memory(
        i: wp.int32,
        j: wp.int32,
        image: wp.int32,
        last: wp.int32,
        s: real,
        t: real,
        length_i: real,
        length_j: real,
        on_i: wp.int32,
        on_j: wp.int32,
        out_start: wp.array(dtype=wp.int32),
        pair_j: wp.array(dtype=wp.int32),
        pair_image: wp.array(dtype=wp.int32),
        pair_memory: wp.array2d(dtype=vec4),
        pair_step: wp.array2d(dtype=wp.int32),
    ) -> vec4:
        """The nearest one's, over the nearer node of one segment or of both.

        on_i, on_j: the segments there, or i and j themselves at the end of a fiber.
        """
        far_i = length_i * wp.min(s, one - s)
        far_j = length_j * wp.min(t, one - t)
        found = vec4(zero, zero, zero, zero)
        for turn in range(3):
            a = on_i
            b = on_j
            if turn < 2:
                if (turn == 0) == (far_i <= far_j):
                    b = j
                else:
                    a = i
            if found[3] == zero and (a != i or b != j):
                found = memory_of(
                    a, b, image, last, out_start, pair_j, pair_image, pair_memory, pair_step
                )
        return found

    return neighbors_memory


@cache
def make_carry_memory(name: str, has_friction: bool):
    """Kernel `carry_memory`: what pairs of the list before had, for the pairs of the new one."""
    p = precision(name)
    vec3, vec4 = p.vec3, p.vec4

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False)
    def carry_memory(
        step: wp.array(dtype=wp.int64),
        old_start: wp.array(dtype=wp.int32),
        old_j: wp.array(dtype=wp.int32),
        old_image: wp.array(dtype=wp.int32),
        old_acts: wp.array(dtype=wp.uint8),
        old_force: wp.array(dtype=vec3),
        old_arms: wp.array(dtype=vec4),
        old_memory: wp.array2d(dtype=vec4),
        old_step: wp.array2d(dtype=wp.int32),
        out_start: wp.array(dtype=wp.int32),
        pair_j: wp.array(dtype=wp.int32),
        pair_image: wp.array(dtype=wp.int32),
        acts_out: wp.array(dtype=wp.uint8),
        force_out: wp.array(dtype=vec3),
        arms_out: wp.array(dtype=vec4),
        memory_out: wp.array2d(dtype=vec4),
        step_out: wp.array2d(dtype=wp.int32),
    ):
        i = wp.tid()
        last = wp.int32(step[0])
        side = last & 1
        for k in range(out_start[i], out_start[i + 1]):
            acts = wp.uint8(0)
            written = wp.int32(wp.static(NEVER))
            memory = vec4()
            for m in range(old_start[i], old_start[i + 1]):
                if old_acts[m] != wp.uint8(0):
                    if old_j[m] == pair_j[k] and old_image[m] == pair_image[k]:
                        acts = wp.uint8(1)
                        force_out[k] = old_force[m]
                        arms_out[k] = old_arms[m]
                        if wp.static(has_friction):
                            memory = old_memory[side, m]
                            written = old_step[side, m]
            acts_out[k] = acts
            if wp.static(has_friction):
                memory_out[side, k] = memory
                step_out[side, k] = written

    return carry_memory


def carry_memories(
    kernel: Any, segments: int, step: Any, before: list[Any], after: list[Any], device: str
) -> None:
    """Launch `carry_memory` over all segments; arrays of the list before and of the new one."""
    wp.launch(kernel, dim=segments, inputs=[step, *before, *after], device=device)

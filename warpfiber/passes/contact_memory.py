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
from warpfiber.passes.pairs import NO_IMAGE

NEVER = -2  # a step that is no pair's last one


@cache
def make_hand_over(name: str, closed: bool = False):
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
    def memory_either_way(
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
        """Over the closure of a ring that touches itself its pairs are listed the other way."""
        if i > j or (i == j and image < wp.static(NO_IMAGE)):
            back = wp.static(2 * NO_IMAGE) - image
            kept = memory_of(
                j, i, back, last, out_start, pair_j, pair_image, pair_memory, pair_step
            )
            return vec4(-kept[0], -kept[1], -kept[2], kept[3])
        return memory_of(i, j, image, last, out_start, pair_j, pair_image, pair_memory, pair_step)

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
                if wp.static(closed):
                    found = memory_either_way(
                        a, b, image, last, out_start, pair_j, pair_image, pair_memory, pair_step
                    )
                else:
                    found = memory_of(
                        a, b, image, last, out_start, pair_j, pair_image, pair_memory, pair_step
                    )
        return found

    return neighbors_memory


@cache
def make_carry_memory(name: str, has_friction: bool):
    """Kernels `keep_memory`, before a list is built, and `carry_memory`, after it.

    What the pairs of a segment had that acted is packed at the begin of its row of the old list.
    """
    p = precision(name)
    vec3, vec4 = p.vec3, p.vec4
    options = {"module": "unique", "enable_backward": False, "grid_stride": False}

    @wp.kernel(**options)
    def keep_memory(
        step: wp.array(dtype=wp.int64),
        out_start: wp.array(dtype=wp.int32),
        pair_j: wp.array(dtype=wp.int32),
        pair_image: wp.array(dtype=wp.int32),
        acts: wp.array(dtype=wp.uint8),
        force: wp.array(dtype=vec3),
        arms: wp.array(dtype=vec4),
        memory: wp.array2d(dtype=vec4),
        written: wp.array2d(dtype=wp.int32),
        kept_start_out: wp.array(dtype=wp.int32),
        kept_count_out: wp.array(dtype=wp.int32),
        kept_j_out: wp.array(dtype=wp.int32),
        kept_image_out: wp.array(dtype=wp.int32),
        kept_force_out: wp.array(dtype=vec3),
        kept_arms_out: wp.array(dtype=vec4),
        kept_memory_out: wp.array(dtype=vec4),
        kept_step_out: wp.array(dtype=wp.int32),
    ):
        i = wp.tid()
        side = wp.int32(step[0]) & 1
        found = out_start[i]
        kept_start_out[i] = found
        for k in range(out_start[i], out_start[i + 1]):
            if acts[k] != wp.uint8(0):
                kept_j_out[found] = pair_j[k]
                kept_image_out[found] = pair_image[k]
                kept_force_out[found] = force[k]
                kept_arms_out[found] = arms[k]
                if wp.static(has_friction):
                    kept_memory_out[found] = memory[side, k]
                    kept_step_out[found] = written[side, k]
                found += 1
        kept_count_out[i] = found - out_start[i]

    @wp.kernel(**options)
    def carry_memory(
        step: wp.array(dtype=wp.int64),
        out_start: wp.array(dtype=wp.int32),
        pair_j: wp.array(dtype=wp.int32),
        pair_image: wp.array(dtype=wp.int32),
        acts_out: wp.array(dtype=wp.uint8),
        force_out: wp.array(dtype=vec3),
        arms_out: wp.array(dtype=vec4),
        memory_out: wp.array2d(dtype=vec4),
        written_out: wp.array2d(dtype=wp.int32),
        kept_start: wp.array(dtype=wp.int32),
        kept_count: wp.array(dtype=wp.int32),
        kept_j: wp.array(dtype=wp.int32),
        kept_image: wp.array(dtype=wp.int32),
        kept_force: wp.array(dtype=vec3),
        kept_arms: wp.array(dtype=vec4),
        kept_memory: wp.array(dtype=vec4),
        kept_step: wp.array(dtype=wp.int32),
    ):
        i = wp.tid()
        side = wp.int32(step[0]) & 1
        for k in range(out_start[i], out_start[i + 1]):
            acts_out[k] = wp.uint8(0)
            if wp.static(has_friction):
                written_out[side, k] = wp.int32(wp.static(NEVER))
        for m in range(kept_start[i], kept_start[i] + kept_count[i]):
            for k in range(out_start[i], out_start[i + 1]):
                if pair_j[k] == kept_j[m] and pair_image[k] == kept_image[m]:
                    acts_out[k] = wp.uint8(1)
                    force_out[k] = kept_force[m]
                    arms_out[k] = kept_arms[m]
                    if wp.static(has_friction):
                        memory_out[side, k] = kept_memory[m]
                        written_out[side, k] = kept_step[m]

    return keep_memory, carry_memory


def launch_memories(
    kernel: Any, segments: int, step: Any, listed: list[Any], kept: list[Any], device: str
) -> None:
    """Launch one of them over all segments: arrays of the list, and what is kept."""
    wp.launch(kernel, dim=segments, inputs=[step, *listed, *kept], device=device)

"""What lies in each layer of the box: segments cut exactly at its planes, fibers by their middle.

Layers are of equal thickness between planes that are parallel to the first two box vectors.
By length: a piece of a segment adds its length, its share of the fiber's volume, and l p_i p_j. By
number: a fiber adds one vote, its end-to-end vector, to the layer that holds the mean of its nodes.
Every thread sums a fixed run of fibers, the host adds the few partial sums in order.

Source: a_ij = <p_i p_j>; a straight segment that rises by r layers has the share (part of r inside)
    of its length in a layer, so nothing is sampled.
Symbols: s = n h.(x - x0) place in layers, h normal of the planes over the box height, n layers;
    L length tip to tip.
Limits: what is outside the planes of a box that is not periodic across them is left out. A segment
    that rises by less than FLAT layers lies in the layer of its middle. The closing segment of a
    ring is left out.
"""

from functools import cache

import warp as wp

from warpfiber.model import precision
from warpfiber.passes.precision import group_struct
from warpfiber.passes.tensor_sums import TENSOR, TENSOR4_NAMES, make_tensor_sums

LAYER_SUMS = (
    "length",
    "volume",
    *TENSOR,
    "fibers",
    "fiber_length",
    "fiber_length2",
    *(f"{name}_fiber" for name in TENSOR),
)
LAYER_SUMS4 = (*TENSOR4_NAMES, *(f"{name}_fiber" for name in TENSOR4_NAMES))
FLAT = 1e-12


@cache
def make_measure_layers(name: str, has_tensor4: bool):
    """Kernel: partial sums, row = chunk * layers + layer, columns LAYER_SUMS (+ LAYER_SUMS4)."""
    vec3 = precision(name).vec3
    Group = group_struct(name)
    add_tensor, add_tensor4 = make_tensor_sums()
    first4 = len(LAYER_SUMS)
    first4_fiber = first4 + len(TENSOR4_NAMES)
    flat = wp.float64(FLAT)

    @wp.func
    def layer_of(place: wp.int32, layers: wp.int32, wraps: wp.bool) -> wp.int32:
        """Layer at a place counted beyond the box; -1 for none."""
        layer = place
        if wraps:
            layer = place % layers
            if layer < 0:
                layer += layers
        elif layer < 0 or layer >= layers:
            return -1
        return layer

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False)
    def measure_layers(
        chunks: wp.int32,
        fibers: wp.int32,
        layers: wp.int32,
        wraps: wp.bool,
        origin: wp.vec3d,
        rise: wp.vec3d,
        group_volume: wp.array(dtype=wp.float64),
        groups: wp.array(dtype=Group),
        fiber_node_start: wp.array(dtype=wp.int32),
        fiber_group: wp.array(dtype=wp.int32),
        node_pos: wp.array(dtype=vec3),
        sums_out: wp.array2d(dtype=wp.float64),
    ):
        chunk = wp.tid()
        one, half = wp.float64(1.0), wp.float64(0.5)
        begin = wp.int32(wp.int64(fibers) * wp.int64(chunk) / wp.int64(chunks))
        end = wp.int32(wp.int64(fibers) * wp.int64(chunk + 1) / wp.int64(chunks))
        for fiber in range(begin, end):
            group = fiber_group[fiber]
            g = groups[group]
            first = fiber_node_start[fiber]
            share = group_volume[group] / wp.float64(g.segments)
            x0 = wp.vec3d(node_pos[first]) - origin
            low = wp.dot(rise, x0)
            middle = low
            for k in range(g.segments):
                x1 = wp.vec3d(node_pos[first + k + 1]) - origin
                high = wp.dot(rise, x1)
                middle += high
                d = wp.length(x1 - x0)
                p = (x1 - x0) / d
                bottom = wp.min(low, high)
                top = wp.max(low, high)
                at = wp.int32(wp.floor(bottom))
                last = wp.int32(wp.floor(top))
                if top - bottom < flat:
                    at = wp.int32(wp.floor(half * (bottom + top)))
                    last = at
                while at <= last:
                    part = one
                    if top - bottom >= flat:
                        upper = wp.min(top, wp.float64(at + 1))
                        lower = wp.max(bottom, wp.float64(at))
                        part = (upper - lower) / (top - bottom)
                    layer = layer_of(at, layers, wraps)
                    if layer >= 0:
                        row = chunk * layers + layer
                        sums_out[row, 0] = sums_out[row, 0] + part * d
                        sums_out[row, 1] = sums_out[row, 1] + part * share
                        add_tensor(row, 2, p, part * d, sums_out)
                        if wp.static(has_tensor4):
                            add_tensor4(row, wp.static(first4), p, part * d, sums_out)
                    at += 1
                x0 = x1
                low = high
            middle = wp.floor(middle / wp.float64(g.segments + 1))
            home = layer_of(wp.int32(middle), layers, wraps)
            if home >= 0:
                row = chunk * layers + home
                tips = wp.vec3d(node_pos[first + g.segments]) - wp.vec3d(node_pos[first])
                axis = wp.normalize(tips)
                long = wp.float64(g.rest) * wp.float64(g.segments)
                long += wp.float64(2.0) * wp.float64(g.radius)
                sums_out[row, 8] = sums_out[row, 8] + one
                sums_out[row, 9] = sums_out[row, 9] + long
                sums_out[row, 10] = sums_out[row, 10] + long * long
                add_tensor(row, 11, axis, one, sums_out)
                if wp.static(has_tensor4):
                    add_tensor4(row, wp.static(first4_fiber), axis, one, sums_out)

    return measure_layers

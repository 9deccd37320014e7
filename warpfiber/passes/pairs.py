"""One sweep over listed pairs: capsule repulsion and bead lubrication between two segments.

One thread owns a pair (on the CPU `native_pairs` has blocks of pairs instead): 27 ns per segment in
float64 and 24 in float32 where one thread per segment, whose pairs are none, one or several, took
31 and 29. It stores whether the pair acts and, only then, the force on the owner and where it acts
(a slot that does not act keeps stale values); the node sweep gathers, so nothing is added
atomically and the result does not depend on the number of workers. `closest`: force and the
fractions (s, t) of the one point pair. `arms`: several bead pairs act, so the sums of s F and t F
are stored instead.

Source: Sasayama & Inagaki 2018, Appendix A. One repulsion per local minimum of the distance between
    two fibers (the vertex rule of `is_local_minimum`).
"""

from dataclasses import dataclass
from functools import cache

import warp as wp

from warpfiber.laws.lubrication import OUTER
from warpfiber.laws.repulsion import RANGE, make_repulsion
from warpfiber.laws.segment_distance import make_segment_distance
from warpfiber.model import HALT, PAIR_COUNT, precision
from warpfiber.passes.bead_pairs import make_bead_pairs
from warpfiber.passes.precision import group_struct

IMAGE_BITS = 10  # per axis, offset by half: images -512 ... 511
# How near a fraction counts as the end of a segment: where two fibers cross exactly at a node,
# rounding would otherwise make neither or both of the two segments report the contact.
END_TOLERANCE = {"float32": 1e-5, "float64": 1e-9}


@dataclass(frozen=True)
class PairFeatures:
    """What the pair sweep of a scene contains."""

    repulsion: bool = True
    lubrication: str = "none"  # none, paper, shifted
    periodic: bool = False
    sheared: bool = False  # images move: relative velocity needs the lattice velocity
    closed: bool = False  # some fibers are rings

    @property
    def storage(self) -> str:
        """How forces are stored: `closest` or `arms`."""
        return "closest" if self.lubrication == "none" else "arms"


def image_code(x: int, y: int, z: int) -> int:
    """Three image numbers in one int32."""
    half = 1 << (IMAGE_BITS - 1)
    return (x + half) | (y + half) << IMAGE_BITS | (z + half) << (2 * IMAGE_BITS)


NO_IMAGE = image_code(0, 0, 0)


@cache
def make_image(name: str):
    """Device version of the inverse of `image_code`: three image numbers of a code."""
    p = precision(name)
    real, vec3 = p.real, p.vec3
    half = 1 << (IMAGE_BITS - 1)
    mask = (1 << IMAGE_BITS) - 1
    bits = IMAGE_BITS

    @wp.func
    def unpack_image(code: wp.int32) -> vec3:
        x = (code & wp.static(mask)) - wp.static(half)
        y = ((code >> wp.static(bits)) & wp.static(mask)) - wp.static(half)
        z = ((code >> wp.static(2 * bits)) & wp.static(mask)) - wp.static(half)
        return vec3(real(x), real(y), real(z))

    return unpack_image


@cache
def make_pair_geometry(name: str, features: PairFeatures):
    """Functions shared by the sweep and the measurement: distance vector, local minimum, beads."""
    p = precision(name)
    real, vec2, vec3, mat33 = p.real, p.vec2, p.vec3, p.mat33
    closest_fractions = make_segment_distance(name)
    unpack_image = make_image(name)
    lubricate = make_bead_pairs(name, features.lubrication == "shifted")
    zero, one = real(0.0), real(1.0)
    periodic = features.periodic
    near = real(END_TOLERANCE[name])

    @wp.func
    def image_shift(code: wp.int32, lattice: mat33) -> vec3:
        if wp.static(periodic):
            if code != wp.static(NO_IMAGE):
                return lattice * unpack_image(code)
        return vec3(zero, zero, zero)

    @wp.func
    def is_local_minimum(
        st: vec2,
        c: vec3,
        node_i: wp.int32,
        at_i: wp.int32,
        segments_i: wp.int32,
        node_j: wp.int32,
        at_j: wp.int32,
        segments_j: wp.int32,
        node_pos: wp.array(dtype=vec3),
    ) -> wp.bool:
        """Vertex rule: neighbors along a fiber share a node; only one of them may report it."""
        if st[0] >= one - near and at_i < segments_i - 1:
            return False
        if st[1] >= one - near and at_j < segments_j - 1:
            return False
        if st[0] <= near and at_i > 0:
            back = node_pos[node_i] - node_pos[node_i - 1]
            if wp.dot(c, back) < -near * wp.dot(back, back):
                return False
        if st[1] <= near and at_j > 0:
            back = node_pos[node_j] - node_pos[node_j - 1]
            if wp.dot(c, back) > near * wp.dot(back, back):
                return False
        return True

    return closest_fractions, image_shift, is_local_minimum, lubricate


@cache
def make_pair_law(name: str, features: PairFeatures, is_squeezed: bool = False):
    """`apply_pair_law`: what one pair within the largest reach of the scene does.

    `is_squeezed`: its lubrication is stored already and only the repulsion is to be added.
    """
    p = precision(name)
    real, vec2, vec3, mat33 = p.real, p.vec2, p.vec3, p.mat33
    Group = group_struct(name)
    _, _, is_local_minimum, lubricate = make_pair_geometry(name, features)
    repulsion_size, _ = make_repulsion(name)
    zero = real(0.0)
    repulsion_range, lubrication_range = real(RANGE), real(OUTER)
    has_repulsion = features.repulsion
    has_lubrication = features.lubrication != "none"
    sheared = features.sheared

    @wp.func
    def apply_pair_law(
        k: wp.int32,
        i: wp.int32,
        j: wp.int32,
        node_i: wp.int32,
        node_j: wp.int32,
        a: vec3,
        b: vec3,
        delta: vec3,
        shift: vec3,
        st: vec2,
        dt: real,
        strength: real,
        decay: real,
        groups: wp.array(dtype=Group),
        fiber_node_start: wp.array(dtype=wp.int32),
        fiber_group: wp.array(dtype=wp.int32),
        segment_fiber: wp.array(dtype=wp.int32),
        gradient: wp.array(dtype=mat33),
        node_pos: wp.array(dtype=vec3),
        node_velocity: wp.array(dtype=vec3),
        pair_acts_out: wp.array(dtype=wp.uint8),
        pair_force_out: wp.array(dtype=vec3),
        pair_closest_out: wp.array(dtype=vec2),
        pair_arm_i_out: wp.array(dtype=vec3),
        pair_arm_j_out: wp.array(dtype=vec3),
    ):
        c = delta + st[1] * b - st[0] * a
        dd = wp.length_sq(c)
        fiber_i = segment_fiber[i]
        fiber_j = segment_fiber[j]
        gi = groups[fiber_group[fiber_i]]
        gj = groups[fiber_group[fiber_j]]
        contact = gi.radius + gj.radius
        at_i = node_i - fiber_node_start[fiber_i]
        at_j = node_j - fiber_node_start[fiber_j]
        force = vec3(zero, zero, zero)
        acts = wp.uint8(0)
        if wp.static(has_repulsion):
            reach = repulsion_range * contact
            if dd <= reach * reach:
                if is_local_minimum(
                    st, c, node_i, at_i, gi.segments, node_j, at_j, gj.segments, node_pos
                ):
                    distance = wp.sqrt(dd)
                    direction = wp.normalize(c)
                    if dd == zero:
                        direction = wp.normalize(wp.cross(a, b))
                    force = -repulsion_size(strength, decay, distance, contact) * direction
                    acts = wp.uint8(1)
        if wp.static(has_lubrication):
            arm_i = st[0] * force
            arm_j = st[1] * force
            reach = lubrication_range * contact
            if wp.static(is_squeezed):
                acts |= pair_acts_out[k]
                if pair_acts_out[k] != wp.uint8(0):
                    force += pair_force_out[k]
                    arm_i += pair_arm_i_out[k]
                    arm_j += pair_arm_j_out[k]
            elif dd <= reach * reach:
                moving = vec3(zero, zero, zero)
                if wp.static(sheared):
                    moving = gradient[0] * shift
                squeeze, squeeze_i, squeeze_j, active = lubricate(
                    gi,
                    gj,
                    at_i,
                    at_j,
                    delta,
                    a,
                    b,
                    node_velocity[node_i],
                    node_velocity[node_i + 1],
                    node_velocity[node_j] + moving,
                    node_velocity[node_j + 1] + moving,
                    dt,
                )
                if active > 0:
                    acts = wp.uint8(1)
                    force += squeeze
                    arm_i += squeeze_i
                    arm_j += squeeze_j
            if acts != wp.uint8(0):
                pair_arm_i_out[k] = arm_i
                pair_arm_j_out[k] = arm_j
        elif acts != wp.uint8(0):
            pair_closest_out[k] = st
        pair_acts_out[k] = acts
        if acts != wp.uint8(0):
            pair_force_out[k] = force

    return apply_pair_law


@cache
def make_pair_sweep(name: str, features: PairFeatures):
    """Kernel `pair_sweep` in the given precision with the given features, over all places."""
    p = precision(name)
    real, vec2, vec3, mat33 = p.real, p.vec2, p.vec3, p.mat33
    Group = group_struct(name)
    closest_fractions, image_shift, _, _ = make_pair_geometry(name, features)
    apply_pair_law = make_pair_law(name, features)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False)
    def pair_sweep(
        offset: wp.int32,
        dt: real,
        strength: real,
        decay: real,
        reach_bound: real,
        groups: wp.array(dtype=Group),
        fiber_node_start: wp.array(dtype=wp.int32),
        fiber_group: wp.array(dtype=wp.int32),
        segment_node: wp.array(dtype=wp.int32),
        segment_fiber: wp.array(dtype=wp.int32),
        gradient: wp.array(dtype=mat33),
        lattice: wp.array(dtype=mat33),
        pair_i: wp.array(dtype=wp.int32),
        pair_j: wp.array(dtype=wp.int32),
        pair_image: wp.array(dtype=wp.int32),
        node_pos: wp.array(dtype=vec3),
        node_velocity: wp.array(dtype=vec3),
        status: wp.array(dtype=wp.int32),
        pair_acts_out: wp.array(dtype=wp.uint8),
        pair_force_out: wp.array(dtype=vec3),
        pair_closest_out: wp.array(dtype=vec2),
        pair_arm_i_out: wp.array(dtype=vec3),
        pair_arm_j_out: wp.array(dtype=vec3),
    ):
        if status[wp.static(HALT)] != 0:
            return
        k = wp.tid() + offset
        if k >= status[wp.static(PAIR_COUNT)]:
            return
        i = pair_i[k]
        node_i = segment_node[i]
        xi = node_pos[node_i]
        a = node_pos[node_i + 1] - xi
        j = pair_j[k]
        node_j = segment_node[j]
        xj = node_pos[node_j]
        b = node_pos[node_j + 1] - xj
        shift = image_shift(pair_image[k], lattice[0])
        delta = xj - xi + shift
        st = closest_fractions(delta, a, b)
        # most listed pairs end here, before anything is read of their fibers
        if not (wp.length_sq(delta + st[1] * b - st[0] * a) <= reach_bound * reach_bound):
            pair_acts_out[k] = wp.uint8(0)
            return
        apply_pair_law(
            k,
            i,
            j,
            node_i,
            node_j,
            a,
            b,
            delta,
            shift,
            st,
            dt,
            strength,
            decay,
            groups,
            fiber_node_start,
            fiber_group,
            segment_fiber,
            gradient,
            node_pos,
            node_velocity,
            pair_acts_out,
            pair_force_out,
            pair_closest_out,
            pair_arm_i_out,
            pair_arm_j_out,
        )

    return pair_sweep

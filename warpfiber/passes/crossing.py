"""Whether two segments passed through each other during a step, both moving in straight lines.

Source: four points that move in straight lines are in one plane where a cubic of the time is 0; the
    lines pass through each other there if they meet between their ends. The cubic is split at its
    extrema, its roots are found by bisection. Where it is 0 throughout (motion in a plane, parallel
    lines) the distance is looked at in small steps of the time instead.
Symbols: tau in [0, 1] time within the step; D(tau) from the start of a to the start of b, an image
    with its box vector; V(tau) = D.(a x b).
Limits: all that moves, moves in a straight line over the step.
"""

from functools import cache

import warp as wp

from warpfiber.passes.row_geometry import make_closest_points

BISECTIONS = 52
PLANAR_STEPS = 64
# Volumes of less than this share of contact distance and lengths are only rounding.
PLANAR = {"float32": 1e-5, "float64": 1e-9}
INSIDE = 1e-9  # of a segment: a crossing at a joint is one of both segments
NEAR_ZERO = 0.1  # of the contact distance: center lines this near in a plane have met


@cache
def make_crossing(planar: float):
    """`has_crossed(D, a, b, w, wa, wb, contact)`: whether two moving lines met; float64."""
    closest_points = make_closest_points("float64")
    zero, one, rounding = wp.float64(0.0), wp.float64(1.0), wp.float64(planar)
    low, high = wp.float64(-INSIDE), wp.float64(1.0 + INSIDE)

    @wp.func
    def cubic(c: wp.vec4d, tau: wp.float64) -> wp.float64:
        return c[0] + tau * (c[1] + tau * (c[2] + tau * c[3]))

    @wp.func
    def meet(
        tau: wp.float64,
        delta: wp.vec3d,
        a: wp.vec3d,
        b: wp.vec3d,
        w: wp.vec3d,
        wa: wp.vec3d,
        wb: wp.vec3d,
    ) -> wp.bool:
        """Whether the lines, in one plane at tau, meet between their ends."""
        d = delta + tau * w
        p = a + tau * wa
        q = b + tau * wb
        normal = wp.cross(p, q)
        area2 = wp.dot(normal, normal)
        if not (area2 > zero):
            return False
        s = wp.dot(wp.cross(d, q), normal) / area2
        t = wp.dot(wp.cross(d, p), normal) / area2
        return s >= low and s <= high and t >= low and t <= high

    @wp.func
    def has_crossed(
        delta: wp.vec3d,
        a: wp.vec3d,
        b: wp.vec3d,
        w: wp.vec3d,
        wa: wp.vec3d,
        wb: wp.vec3d,
        contact: wp.float64,
    ) -> wp.bool:
        n0 = wp.cross(a, b)
        n1 = wp.cross(wa, b) + wp.cross(a, wb)
        n2 = wp.cross(wa, wb)
        c = wp.vec4d(
            wp.dot(delta, n0),
            wp.dot(delta, n1) + wp.dot(w, n0),
            wp.dot(delta, n2) + wp.dot(w, n1),
            wp.dot(w, n2),
        )
        size = wp.abs(c[0]) + wp.abs(c[1]) + wp.abs(c[2]) + wp.abs(c[3])
        scale = rounding * contact * (wp.length(a) + wp.length(wa))
        if size <= scale * (wp.length(b) + wp.length(wb)):
            before = zero
            for step in range(wp.static(PLANAR_STEPS + 1)):
                tau = wp.float64(step) / wp.float64(wp.static(PLANAR_STEPS))
                d = delta + tau * w
                p = a + tau * wa
                q = b + tau * wb
                st = closest_points(d, p, q)
                distance = wp.length(d + st[1] * q - st[0] * p)
                if step == 0:
                    before = distance
                near = wp.float64(wp.static(NEAR_ZERO)) * contact
                if distance < near and before >= near:
                    return True
            return False
        # ends of the monotonic parts of the cubic
        first = one
        second = one
        if wp.abs(c[3]) > wp.float64(1e-14) * size:
            root = c[2] * c[2] - wp.float64(3.0) * c[3] * c[1]
            if root > zero:
                # the root without cancellation, and the other by their product
                sum_of = -c[2] - wp.sqrt(root)
                if c[2] < zero:
                    sum_of = -c[2] + wp.sqrt(root)
                first = sum_of / (wp.float64(3.0) * c[3])
                second = first
                if sum_of != zero:
                    second = c[1] / sum_of
        elif wp.abs(c[2]) > zero:
            first = -c[1] / (wp.float64(2.0) * c[2])
            second = first
        left = wp.clamp(wp.min(first, second), zero, one)
        right = wp.clamp(wp.max(first, second), zero, one)
        begin = zero
        for part in range(3):
            end = left
            if part == 1:
                end = right
            if part == 2:
                end = one
            u = begin
            v = end
            begin = end
            at_u = cubic(c, u)
            at_v = cubic(c, v)
            if at_u * at_v <= zero and u < v:
                for _step in range(wp.static(BISECTIONS)):
                    middle = wp.float64(0.5) * (u + v)
                    value = cubic(c, middle)
                    if value * at_u > zero:
                        u = middle
                    else:
                        v = middle
                if meet(v, delta, a, b, w, wa, wb):
                    return True
        return False

    return has_crossed

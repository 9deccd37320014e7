"""Contact with a wall of touching fibers along x that do not move: where a segment meets them.

The fibers lie behind a plane of the box, their crests in it. Seen along x a segment is a line
above a row of circles: six places may touch, each end the two circles that it lies between, and the
line the first circle inward from each end. Between these two the gaps of a straight line to the
circles change evenly, so none of the others is nearer.

Source: nearest point of a line to a point, in the plane across x.
Symbols: `axis` of the normal of the plane, `along` the other one of y and z; w spacing of the
    fibers, R their radius, circle k at (k + 1/2) w; a radius of the segment's fiber, t its
    fraction; normal from the segment to the array.
Limits: the array has no ends; walls of y and z only.
"""

from functools import cache
from typing import Any

import numpy as np
import warp as wp

from warpfiber.model import Model, precision

PLACES = 6
NOWHERE = 1e20  # gap of a place that does not touch
INSIDE = 1e-6  # fraction of a segment: nearer to an end it is the end that touches
KEY = 12  # first key of these rows; planes have those before


@cache
def make_array_rows(name: str):
    """`is_near(...)`, `array_place(...)` -> (t, normal, gap) and `array_key(...)`."""
    p = precision(name)
    real, vec2, vec3 = p.real, p.vec2, p.vec3
    zero, one, half = real(0.0), real(1.0), real(0.5)
    nowhere, inside = real(NOWHERE), real(INSIDE)

    @wp.func
    def above(x: vec3, axis: wp.int32, side: wp.int32, low: vec3, high: vec3) -> real:
        """Height over the crests."""
        if side == 0:
            return x[axis] - low[axis]
        return high[axis] - x[axis]

    @wp.func
    def is_near(
        x0: vec3,
        x1: vec3,
        axis: wp.int32,
        side: wp.int32,
        low: vec3,
        high: vec3,
        reach: real,
    ) -> wp.bool:
        """Whether a segment comes within reach of the crests."""
        first = above(x0, axis, side, low, high)
        return wp.min(first, above(x1, axis, side, low, high)) < reach

    @wp.func
    def circle_of(place: wp.int32, y0: real, y1: real) -> wp.int32:
        """Circle of a place; y0, y1 of the ends in spacings from the first circle."""
        if place < 2:
            return wp.int32(wp.floor(y0)) + place
        if place < 4:
            return wp.int32(wp.floor(y1)) + place - 2
        if (place == 4 and y1 > y0) or (place == 5 and y0 > y1):
            return wp.int32(wp.ceil(wp.where(place == 4, y0, y1)))
        return wp.int32(wp.floor(wp.where(place == 4, y0, y1)))

    @wp.func
    def array_place(
        place: wp.int32,
        x0: vec3,
        x1: vec3,
        axis: wp.int32,
        side: wp.int32,
        low: vec3,
        high: vec3,
        shape: vec2,
        radius: real,
    ):
        """Fraction, normal and gap; `shape` = (w, R)."""
        along = 3 - axis
        y0 = (x0[along] - low[along]) / shape[0] - half
        y1 = (x1[along] - low[along]) / shape[0] - half
        circle = circle_of(place, y0, y1)
        # from the first end to the circle, and to the second end; height over the crests
        height = above(x0, axis, side, low, high)
        c = vec2((real(circle) - y0) * shape[0], -shape[1] - height)
        d = vec2(x1[along] - x0[along], above(x1, axis, side, low, high) - height)
        t = zero
        if place == 2 or place == 3:
            t = one
        exists = wp.bool(True)
        if place >= 4:
            size2 = wp.dot(d, d)
            exists = size2 > inside * inside * wp.length_sq(x1 - x0)
            if exists:
                t = wp.dot(c, d) / size2
                exists = t > inside and t < one - inside
            if place == 5 and circle == circle_of(4, y0, y1):
                exists = False
        normal = vec3(zero, zero, zero)
        gap = nowhere
        if exists:
            way = c - t * d
            distance = wp.length(way)
            gap = distance - shape[1] - radius
            normal[along] = way[0] / distance
            normal[axis] = way[1] / distance
            if side == 1:
                normal[axis] = -normal[axis]
        return t, normal, gap

    @wp.func
    def array_key(
        place: wp.int32,
        x0: vec3,
        x1: vec3,
        axis: wp.int32,
        side: wp.int32,
        low: vec3,
        shape: vec2,
    ) -> wp.int32:
        """The same number for one circle (of every other one) and part of a segment."""
        along = 3 - axis
        y0 = (x0[along] - low[along]) / shape[0] - half
        y1 = (x1[along] - low[along]) / shape[0] - half
        part = place / 2
        if part == 2:
            part = place - 2
        odd = circle_of(place, y0, y1) & 1
        return wp.static(KEY) + 8 * (2 * axis + side) + 2 * part + odd

    return is_near, array_place, array_key


def wall_arrays(model: Model) -> Any:
    """(6,) vec2 of the walls x-, x+, y- ...: spacing and radius of its fibers, 0 for a plane."""
    p, shapes = model.precision, model.domain.arrays
    values = np.asarray(shapes if shapes else np.zeros((0, 2)), dtype=p.numpy)
    return wp.array(values.reshape(-1, 2), dtype=p.vec2, device=model.device)

"""What the block elimination of one fiber is made of: its stored rows and symmetric 3x3 blocks.

Symbols: symmetric matrices as diagonal (xx, yy, zz) and off (xy, xz, yz); D^-1 = [[P, q], [q^T, s]]
    of a node's displacement and the impulse of the segment before it; L lower factor.
"""

from functools import cache
from typing import Any

import warp as wp

from warpfiber.model import precision


@cache
def elimination_row(name: str) -> Any:
    """Warp struct of what the back substitution needs of one node."""
    real, vec3 = precision(name).real, precision(name).vec3

    @wp.struct
    class Row:
        diagonal: vec3  # P
        off: vec3
        q: vec3
        l0: vec3  # rows of L, displacement on displacement
        l1: vec3
        l2: vec3
        lt: vec3  # column of L, displacement on impulse
        move: vec3  # D^-1 y
        impulse: real
        axis: vec3  # n of the segment behind the node

    return Row


@cache
def make_sym_algebra(name: str):
    """`sym_mul(diagonal, off, v)` and `sym_inverse(diagonal, off)` by LDL^T, with its pivots."""
    p = precision(name)
    real, vec3 = p.real, p.vec3
    one = real(1.0)

    @wp.func
    def sym_mul(d: vec3, o: vec3, v: vec3) -> vec3:
        return vec3(
            d[0] * v[0] + o[0] * v[1] + o[1] * v[2],
            o[0] * v[0] + d[1] * v[1] + o[2] * v[2],
            o[1] * v[0] + o[2] * v[1] + d[2] * v[2],
        )

    @wp.func
    def sym_inverse(d: vec3, o: vec3):
        i0 = one / d[0]
        l10 = o[0] * i0
        l20 = o[1] * i0
        d1 = d[1] - l10 * o[0]
        i1 = one / d1
        c = o[2] - l20 * o[0]
        l21 = c * i1
        d2 = d[2] - l20 * o[1] - l21 * c
        i2 = one / d2
        m = l10 * l21 - l20
        t = l21 * i2
        mt = m * i2
        diagonal = vec3(i0 + l10 * l10 * i1 + m * mt, i1 + l21 * t, i2)
        off = vec3(-l10 * i1 - m * t, mt, -t)
        return diagonal, off, vec3(d[0], d1, d2)

    return sym_mul, sym_inverse

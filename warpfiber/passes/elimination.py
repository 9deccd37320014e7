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
        s: real
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
    """`sym_mul(diagonal, off, v)` and `block_inverse` of a node's block."""
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
    def block_inverse(d: vec3, o: vec3, g: vec3, slack: real):
        """Inverse of [[A, g], [g^T, -slack]]: P, q, s, and a number > 0 if all pivots have signs.

        By the adjugate of A: two divisions that do not wait for each other. Leading minors of A
        have the signs of its pivots.
        """
        xx = d[1] * d[2] - o[2] * o[2]
        yy = d[0] * d[2] - o[1] * o[1]
        zz = d[0] * d[1] - o[0] * o[0]
        xy = o[1] * o[2] - o[0] * d[2]
        xz = o[0] * o[2] - o[1] * d[1]
        yz = o[0] * o[1] - d[0] * o[2]
        det = d[0] * xx + o[0] * xy + o[1] * xz
        u = vec3(
            xx * g[0] + xy * g[1] + xz * g[2],
            xy * g[0] + yy * g[1] + yz * g[2],
            xz * g[0] + yz * g[1] + zz * g[2],
        )
        whole = slack * det + wp.dot(g, u)
        inverse = one / det
        q = (one / whole) * u
        diagonal = inverse * vec3(xx - u[0] * q[0], yy - u[1] * q[1], zz - u[2] * q[2])
        off = inverse * vec3(xy - u[0] * q[1], xz - u[0] * q[2], yz - u[1] * q[2])
        sign = wp.min(wp.min(d[0], zz), wp.min(det, whole))
        return diagonal, off, q, -det * (one / whole), sign

    return sym_mul, block_inverse

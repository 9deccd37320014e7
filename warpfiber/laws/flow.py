"""The undisturbed flow at a point.

Source: linear flow u = L (x - x0); angular velocity Omega = curl(u) / 2.
Symbols: L velocity gradient, L_ij = du_i/dx_j (1/s); Omega (1/s).
"""

from functools import cache

import warp as wp

from warpfiber.model import precision


@cache
def make_flow(name):
    """`flow_velocity(L, x0, x)` and `flow_spin(L)` in the given precision."""
    p = precision(name)
    real, vec3, mat33 = p.real, p.vec3, p.mat33

    @wp.func
    def flow_velocity(gradient: mat33, origin: vec3, x: vec3) -> vec3:
        return gradient * (x - origin)

    @wp.func
    def flow_spin(gradient: mat33) -> vec3:
        return real(0.5) * vec3(
            gradient[2, 1] - gradient[1, 2],
            gradient[0, 2] - gradient[2, 0],
            gradient[1, 0] - gradient[0, 1],
        )

    return flow_velocity, flow_spin

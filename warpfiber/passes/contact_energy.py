"""Energies of contacts between segments that are stored now.

One thread per segment and its outgoing pairs, as in the sweep over pairs; sums stay with the
segment, so they do not depend on the number of workers.
Source: laws `capsule_contact` and `friction`. What is dissipated: `contact_losses`.
"""

from functools import cache
from typing import Any

import numpy as np
import warp as wp

from warpfiber.model import precision
from warpfiber.passes.bond_groups import bond_group_struct, pair_group_struct
from warpfiber.passes.capsule_features import CapsuleFeatures
from warpfiber.passes.capsule_touch import make_capsule_touch
from warpfiber.passes.pairs import PairFeatures, make_pair_geometry
from warpfiber.passes.ring_nodes import make_ring_nodes

NORMAL, TANGENTIAL = range(2)  # columns


@cache
def make_contact_energy(name: str, features: CapsuleFeatures):
    """Kernel `contact_energy` (S, 2): what is stored in springs and in memories of friction."""
    p = precision(name)
    real, vec3, vec4, mat33 = p.real, p.vec3, p.vec4, p.mat33
    BondGroup, PairGroup = bond_group_struct(name), pair_group_struct(name)
    geometry = PairFeatures(repulsion=False, periodic=features.periodic)
    closest_fractions, image_shift, _, _ = make_pair_geometry(name, geometry)
    normal_contact = make_capsule_touch(name, features.closed)
    _, _, _, node_after, _, _ = make_ring_nodes(features.closed)
    has_friction = features.friction
    zero, half = real(0.0), real(0.5)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False)
    def contact_energy(
        offset: wp.int32,
        groups: wp.array(dtype=BondGroup),
        pair_groups: wp.array2d(dtype=PairGroup),
        fiber_node_start: wp.array(dtype=wp.int32),
        fiber_group: wp.array(dtype=wp.int32),
        segment_node: wp.array(dtype=wp.int32),
        segment_fiber: wp.array(dtype=wp.int32),
        lattice: wp.array(dtype=mat33),
        out_start: wp.array(dtype=wp.int32),
        pair_j: wp.array(dtype=wp.int32),
        pair_image: wp.array(dtype=wp.int32),
        place: wp.array(dtype=wp.vec3d),
        step: wp.array(dtype=wp.int64),
        pair_memory: wp.array2d(dtype=vec4),
        pair_step: wp.array2d(dtype=wp.int32),
        energy: wp.array2d(dtype=wp.float64),
    ):
        i = wp.tid() + offset
        node_i = segment_node[i]
        fiber_i = segment_fiber[i]
        gi = groups[fiber_group[fiber_i]]
        at_i = node_i - fiber_node_start[fiber_i]
        xi = place[node_i]
        end_i = node_after(node_i, at_i, gi.closed * (gi.segments + 1))
        a = vec3(place[end_i] - xi)
        now = wp.int32(step[0])
        normal = wp.float64(0.0)
        tangential = wp.float64(0.0)
        for k in range(out_start[i], out_start[i + 1]):
            j = pair_j[k]
            node_j = segment_node[j]
            gj = groups[fiber_group[segment_fiber[j]]]
            at_j = node_j - fiber_node_start[segment_fiber[j]]
            xj = place[node_j]
            end_j = node_after(node_j, at_j, gj.closed * (gj.segments + 1))
            b = vec3(place[end_j] - xj)
            delta = vec3(xj - xi) + image_shift(pair_image[k], lattice[0])
            st = closest_fractions(delta, a, b)
            g = pair_groups[fiber_group[fiber_i], fiber_group[segment_fiber[j]]]
            c = delta + st[1] * b - st[0] * a
            if wp.length_sq(c) >= g.reach * g.reach:
                continue
            push, felt, _n, _springs, _on_i, _on_j = normal_contact(
                g, gi, gj, at_i, at_j, delta, a, b, st, c
            )
            if felt[2] <= zero:
                continue
            normal += wp.float64(felt[2])
            if wp.static(has_friction):
                if pair_step[now & 1, k] == now:
                    kept = pair_memory[now & 1, k]
                    h = vec3(kept[0], kept[1], kept[2])
                    tangential += wp.float64(half * g.shear_part * push[1] * wp.length_sq(h))
        energy[i, wp.static(NORMAL)] = normal
        energy[i, wp.static(TANGENTIAL)] = tangential

    return contact_energy


def measure_contact_energy(
    kernel: Any, inputs: list[Any], segments: int, device: str
) -> np.ndarray:
    """(2,) sums of the energies stored normally and tangentially, run units."""
    energy = wp.zeros((segments, 2), dtype=wp.float64, device=device)
    wp.launch(kernel, dim=segments, inputs=[0, *inputs, energy], device=device)
    return np.sum(energy.numpy(), axis=0)

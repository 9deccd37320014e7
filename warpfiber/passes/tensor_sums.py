"""Sums of orientation tensors: w p_i p_j and w p_i p_j p_k p_m added to a row of columns.

Source: Advani & Tucker 1987, a_ij = <p_i p_j>, A_ijkl = <p_i p_j p_k p_l>.
Symbols: p unit vector, w weight. All sums are float64.
"""

from functools import cache

import warp as wp

TENSOR = ("a11", "a22", "a33", "a12", "a13", "a23")
# The 15 different components of the symmetric fourth-order tensor.
TENSOR4 = tuple(
    (i, j, k, m) for i in range(3) for j in range(i, 3) for k in range(j, 3) for m in range(k, 3)
)
TENSOR4_NAMES = tuple("a" + "".join(str(i + 1) for i in index) for index in TENSOR4)


@cache
def make_tensor_sums():
    """`add_tensor(row, first, p, w, out)` and `add_tensor4`, from the column `first` on."""

    @wp.func
    def add_tensor(
        row: wp.int32,
        first: wp.int32,
        n: wp.vec3d,
        w: wp.float64,
        out: wp.array2d(dtype=wp.float64),
    ):
        out[row, first + 0] = out[row, first + 0] + w * n[0] * n[0]
        out[row, first + 1] = out[row, first + 1] + w * n[1] * n[1]
        out[row, first + 2] = out[row, first + 2] + w * n[2] * n[2]
        out[row, first + 3] = out[row, first + 3] + w * n[0] * n[1]
        out[row, first + 4] = out[row, first + 4] + w * n[0] * n[2]
        out[row, first + 5] = out[row, first + 5] + w * n[1] * n[2]

    @wp.func
    def add_tensor4(
        row: wp.int32,
        first: wp.int32,
        n: wp.vec3d,
        w: wp.float64,
        out: wp.array2d(dtype=wp.float64),
    ):
        column = first
        for i in range(3):
            for j in range(i, 3):
                for k in range(j, 3):
                    for m in range(k, 3):
                        out[row, column] = out[row, column] + w * n[i] * n[j] * n[k] * n[m]
                        column += 1

    return add_tensor, add_tensor4

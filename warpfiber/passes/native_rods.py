"""One step of rods of one shape, many at a time, for the CPU: C++ text for `rigid_rods`.

Repeats the plain kernel there where no node has a load.
Symbols: as there.
"""

from warpfiber.passes.native_pair_lanes import row_lanes

TEXT = """
    auto times = [](const auto& m, const V3& v) -> V3 {
        return V3{v.x * m.data[0][0] + v.y * m.data[0][1] + v.z * m.data[0][2],
                  v.x * m.data[1][0] + v.y * m.data[1][1] + v.z * m.data[1][2],
                  v.x * m.data[2][0] + v.y * m.data[2][1] + v.z * m.data[2][2]};
    };
    const V3 origin = same3(flow_origin[0], flow_origin[1], flow_origin[2]);
    const V3 drawn = same3(settling[0], settling[1], settling[2]);
    const V half = V(T(0.5)), reach = V(half_length);
    const V inverse2 = V(T(1) / (half_length * half_length));
    T* const now = (T*)node_pos.data;
    T* const speed = (T*)node_velocity.data;
    int lost = -1;
    for (int f = first; f < last; f += W) {
        R start[W], end[W];
        for (int l = 0; l < W; ++l) {
            const long long at = 6ll * (f + l < last ? f + l : last - 1);
            start[l] = load(now + at);
            end[l] = load(now + at + 2).yzww;  // nothing behind the last is touched
        }
        const int own = f + W < last ? W : last - f;
        if (keeps != 0) {
            const long size = 6l * own * sizeof(T);
            __builtin_memcpy((T*)node_back.data + 6ll * f, now + 6ll * f, size);
            __builtin_memcpy((T*)velocity_back.data + 6ll * f, speed + 6ll * f, size);
        }
        const V3 x0 = transposed(start), x1 = transposed(end), whole = x1 - x0;
        const V3 axis = whole + times(turn, whole);
        const V3 arm = axis * (reach / __builtin_elementwise_sqrt(axis.dot(axis)));
        const V3 middle = (x0 + x1) * half;
        const V3 center = middle + times(move, middle - origin) + times(drift, drawn);
        const V3 velocity = times(gradient, center - origin) + drawn;
        const V3 swung = times(turning, arm);
        const V3 swing = swung - arm * (swung.dot(arm) * inverse2);
        const V3 found[4] = {center - arm, center + arm, velocity - swing, velocity + swing};
        const V sum = center.dot(arm);
        for (int l = 0; l < own; ++l) {
            for (int n = 0; n < 2; ++n) {
                T* const x = now + 6ll * (f + l) + 3 * n;
                T* const v = speed + 6ll * (f + l) + 3 * n;
                x[0] = found[n].x[l];
                x[1] = found[n].y[l];
                x[2] = found[n].z[l];
                v[0] = found[2 + n].x[l];
                v[1] = found[2 + n].y[l];
                v[2] = found[2 + n].z[l];
            }
            if (!(wp::abs(sum[l]) < T(1e30))) lost = f + l;
        }
    }
    return lost;
"""


def rods_text(name: str) -> str:
    """The block in the given precision; it returns a rod that is nowhere, or -1."""
    return row_lanes(name) + TEXT

"""One step of rods of one shape, many at a time, for the CPU: C++ text for `rigid_rods`.

Repeats the plain kernel there where no node has a load.
Symbols: as there.
"""

from warpfiber.passes.native import transpose
from warpfiber.passes.native_pair_lanes import row_lanes

# Two rows of three of every rod of a vector, where they lie in memory: eight rods at a time.
PUT = f"""
    typedef T H __attribute__((ext_vector_type(8)));
    auto put = [&](T* to, const V3& first_rows, const V3& last_rows, int own) {{
        const V* const from[6] = {{&first_rows.x, &first_rows.y, &first_rows.z,
                                  &last_rows.x, &last_rows.y, &last_rows.z}};
        for (int q = 0; q < W && q < own; q += 8) {{
            H r[8] = {{}};
            for (int n = 0; n < 6; ++n) __builtin_memcpy(r + n, (const T*)from[n] + q, sizeof(H));
            {transpose(8, kind="H")}
            for (int l = 0; l < 8 && q + l < own; ++l)
                __builtin_memcpy(to + 6ll * (q + l), r + l, 6 * sizeof(T));
        }}
    }};
"""

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
        put(now + 6ll * f, center - arm, center + arm, own);
        put(speed + 6ll * f, velocity - swing, velocity + swing, own);
        const V sum = center.dot(arm);
        const M found = sum * sum < V(T(1e30));  // not what is no number
        for (int l = 0; l < own; ++l) lost = found[l] ? lost : f + l;
    }
    return lost;
"""


def rods_text(name: str) -> str:
    """The block in the given precision; it returns a rod that is nowhere, or -1."""
    return row_lanes(name) + PUT + TEXT

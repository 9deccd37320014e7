"""CPU only: pieces of segments near each other, by vectors of float32; the law then confirms.

A worker walks along the rows of cells. Around each of its pieces it looks at the runs of cells that
the piece, widened by the reach, can touch, half of them (every pair is met once): first the
distance of the midpoints from the piece, a vector of them at a time, then in the vectors where one
passes the distance of the two pieces. Both tests admit what float32 cannot decide; `confirm_pairs`
settles it with the law in the precision of the run, or pruning where the list is pruned.

What waits for the next test is stored whether it passed or not, and kept by counting on: which one
passes is anybody's guess, and a wrong one costs a processor more than the test. Whole vectors wait,
not single pieces, whose numbers would have to be picked from seven arrays. Measured, ns per segment
(20,000 segments of 5 diameters, V_f = 0.1): 152; 199 with single pieces and branches; 155 with
midpoints in half precision; 155 with a test of the distance of the two lines before; 168 in vectors
of 8; 350 for whole fibers of 10 segments as one capsule each, before their segments are looked at.

`row_search.find_pairs` is the plain version.
"""

from functools import cache

import warp as wp

from warpfiber.laws.segment_distance import make_segment_distance
from warpfiber.model import precision
from warpfiber.passes.cells import GEOMETRY_PLANES, NO_WRAP, WRAP_Y, WRAP_Z, ListFeatures

# Rounding of float32: coordinates to ROUNDING of their size, and the squared distance of nearly
# parallel segments to PARALLEL of their squared half lengths. There sin^2 of the angle is known to
# about 2e-7, so a closest point may be off by d = 1e-6/sin^2, which lengthens the squared distance
# by min(d, 2)^2 sin^2: at most 3e-6.
ROUNDING, PARALLEL = 1e-6, 2e-5
LANES = 16  # two AVX vectors or one of AVX-512

SEARCH = r"""
    typedef float F __attribute__((ext_vector_type(LANES)));
    typedef int I __attribute__((ext_vector_type(LANES)));
    typedef bool B __attribute__((ext_vector_type(LANES)));
    enum { W = LANES, ROOM = 256 };
    struct V {
        static inline F load(const float* p) { F v; __builtin_memcpy(&v, p, sizeof(F)); return v; }
        static inline F low(F a, F b) { return a < b ? a : b; }
        static inline F high(F a, F b) { return a > b ? a : b; }
        static inline F clip(F a) { return low(high(a, (F)-1.0f), (F)1.0f); }
        static inline unsigned bits(I mask) {
            return __builtin_bit_cast(MASK, __builtin_convertvector(mask, B));
        }
        static inline int cell(float x) {
            return (int)__builtin_floorf(x > 1e6f ? 1e6f : (x > -1e6f ? x : -1e6f));
        }
        static inline int boxes(int c, int d) { return c >= 0 ? c / d : -((d - 1 - c) / d); }
        static inline float size(float x) { return __builtin_fabsf(x); }
    };
    I lane;
    for (int l = 0; l < W; ++l) lane[l] = l;
    const float *X = planes.data, *Y = X + stride, *Z = Y + stride;
    const float *AX = Z + stride, *AY = AX + stride, *AZ = AY + stride, *HALF = AZ + stride;
    const float *G = frame.data, *H = G + 9;
    const int dx = cells.data[0][0], dy = cells.data[0][1], dz = cells.data[0][2];
    const float h = (float)sizes.data[0], longest = 0.5f * (float)sizes.data[1];
    float wide[3], slack[3];
    for (int a = 0; a < 3; ++a) {
        const float* g = G + 3 * a;
        wide[a] = __builtin_sqrtf(g[0] * g[0] + g[1] * g[1] + g[2] * g[2]);
        slack[a] = 2e-3f;
    }
    const int first = (int)((long long)total * worker / workers);
    const int last = (int)((long long)total * (worker + 1) / workers);
    const long long region = (long long)worker * region_size;
    int count = 0;
    long long seen = 0, tested = 0;
    int own = first < last ? key.data[order.data[first]] : 0;
    int ox = own % dx, oy = own / dx % dy, oz = own / dx / dy;
// vectors that hold a piece near the owner's line: owner, their first place, which of them,
    // image, and the owner's midpoint in the box of the place and the reach
    int owner[ROOM], place[ROOM], image[ROOM], waiting = 0;
    unsigned which[ROOM];
    float seen_from[4][ROOM];
    int found[ROOM];
    auto compare = [&]() __attribute__((noinline)) {
        int near = 0;
        for (int e = 0; e < waiting; ++e) {
            const int k = owner[e], m = place[e];
            const float ax = AX[k], ay = AY[k], az = AZ[k], far = seen_from[3][e];
            const float aa = ax * ax + ay * ay + az * az + 1e-30f, inverse_aa = 1.0f / aa;
            const F qx = V::load(X + m) - seen_from[0][e], qy = V::load(Y + m) - seen_from[1][e];
            const F qz = V::load(Z + m) - seen_from[2][e];
            const F bx = V::load(AX + m), by = V::load(AY + m), bz = V::load(AZ + m);
            const F bb = bx * bx + by * by + bz * bz + 1e-30f;
            const F ab = ax * bx + ay * by + az * bz;
            const F da = qx * ax + qy * ay + qz * az;
            const F db = qx * bx + qy * by + qz * bz;
            const F den = V::high(aa * bb - ab * ab, 1e-6f * aa * bb);
            F s = V::clip((da * bb - db * ab) / den);
            const F t = V::clip((s * ab - db) / bb);
            s = V::clip((t * ab + da) * inverse_aa);
            const F cx = qx + t * bx - s * ax, cy = qy + t * by - s * ay;
            const F cz = qz + t * bz - s * az;
            tested += __builtin_popcount(which[e]);
            which[e] &= V::bits(
                cx * cx + cy * cy + cz * cz <= far * far + PARALLEL * (aa + bb));
            found[near] = e;
            near += which[e] != 0;
        }
        waiting = 0;
        for (int n = 0; n < near; ++n) {
            const int e = found[n], k = owner[e], i = segment.data[k];
            const int fiber = segment_fiber.data[i];
            for (unsigned bits = which[e]; bits; bits &= bits - 1) {
                const int m = place[e] + __builtin_ctz(bits), j = segment.data[m];
                const int code = image[e] - wrap.data[m] + wrap.data[k];
                const int apart = (i < j ? j - i : i - j) - 1;
                if (code == NO_WRAP && apart < fiber_skip.data[fiber]
                    && segment_fiber.data[j] == fiber) continue;
                if (count < region_size) {
                    const bool swap = LOOSE && (i > j || (i == j && code < NO_WRAP));
                    found_i.data[region + count] = LOOSE ? (i < j ? i : j) : k;
                    found_j.data[region + count] = LOOSE ? (i < j ? j : i) : m;
                    found_image.data[region + count] = swap ? 2 * NO_WRAP - code : code;
                }
                ++count;
            }
        }
    };
    for (int k = first; k < last; ++k) {
        while (k >= cell_start.data[own + 1]) {
            ++own;
            if (++ox == dx) { ox = 0; if (++oy == dy) { oy = 0; ++oz; } }
        }
        const float px = X[k], py = Y[k], pz = Z[k], ax = AX[k], ay = AY[k], az = AZ[k];
        const float aa = ax * ax + ay * ay + az * az + 1e-30f, inverse_aa = 1.0f / aa;
        const float around = h + longest + ROUNDING * (V::size(px) + V::size(py) + V::size(pz));
        int lo[3], hi[3];
        const int d[3] = {dx, dy, dz};
        const int wraps[3] = {WRAPS_X, WRAPS_Y, WRAPS_Z};
        for (int a = 0; a < 3; ++a) {
            const float* g = G + 3 * a;
            const float middle = g[0] * px + g[1] * py + g[2] * pz;
            float reach = V::size(g[0] * ax + g[1] * ay + g[2] * az);
            // longer pieces than the cells hold are not in this list: they call for a new one
            reach = reach < longest * wide[a] ? reach : longest * wide[a];
            reach += around * wide[a] + slack[a];
            lo[a] = V::cell(middle - reach);
            hi[a] = V::cell(middle + reach);
            if (!wraps[a]) {
                lo[a] = lo[a] < 0 ? 0 : (lo[a] < d[a] ? lo[a] : d[a] - 1);
                hi[a] = hi[a] < 0 ? 0 : (hi[a] < d[a] ? hi[a] : d[a] - 1);
            }
        }
        for (int z = lo[2] > oz ? lo[2] : oz; z <= hi[2]; ++z) {
            const int nz = z >= 0 && z < dz ? 0 : V::boxes(z, dz), ez = z - nz * dz;
            for (int y = z == oz && lo[1] < oy ? oy : lo[1]; y <= hi[1]; ++y) {
                const int ny = y >= 0 && y < dy ? 0 : V::boxes(y, dy), ey = y - ny * dy;
                const int row = (ez * dy + ey) * dx;
                const bool mine = z == oz && y == oy;
                int x = mine && lo[0] < ox ? ox : lo[0];
                while (x <= hi[0]) {
                    const int nx = x >= 0 && x < dx ? 0 : V::boxes(x, dx), ex = x - nx * dx;
                    const int stop = hi[0] - nx * dx < dx ? hi[0] - nx * dx : dx - 1;
                    int m = cell_start.data[row + ex];
                    const int end = cell_start.data[row + stop + 1];
                    if (mine && nx == 0 && ex == ox) m = k + 1;
                    x = stop + nx * dx + 1;
                    if (m >= end) continue;
                    seen += end - m;
                    float sx = 0.0f, sy = 0.0f, sz = 0.0f;
                    if (nx | ny | nz) {
                        sx = H[0] * nx + H[1] * ny + H[2] * nz;
                        sy = H[3] * nx + H[4] * ny + H[5] * nz;
                        sz = H[6] * nx + H[7] * ny + H[8] * nz;
                    }
                    const float margin = ROUNDING * (2.0f * around + V::size(px) + V::size(py)
                        + V::size(pz) + V::size(sx) + V::size(sy) + V::size(sz));
                    const float ux = px - sx, uy = py - sy, uz = pz - sz;
                    const int code = CODE(nx, ny, nz);
                    for (; m < end; m += W) {
                        const F qx = V::load(X + m) - ux, qy = V::load(Y + m) - uy;
                        const F qz = V::load(Z + m) - uz;
                        const F s = V::clip((qx * ax + qy * ay + qz * az) * inverse_aa);
                        const F cx = qx - s * ax, cy = qy - s * ay, cz = qz - s * az;
                        const F far = V::load(HALF + m) + (h + margin);
                        const unsigned bits = V::bits((cx * cx + cy * cy + cz * cz <= far * far)
                            & (lane < end - m));
                        if (SLIDES && bits == 0) continue;  // long segments mostly pass by
                        owner[waiting] = k;
                        place[waiting] = m;
                        image[waiting] = code;
                        which[waiting] = bits;
                        seen_from[0][waiting] = ux;
                        seen_from[1][waiting] = uy;
                        seen_from[2][waiting] = uz;
                        seen_from[3][waiting] = h + margin;
                        waiting += bits != 0;
                        if (waiting == ROOM) compare();
                    }
                }
            }
        }
    }
    compare();
    found_count.data[worker] = count;
    tally.data[2 * worker] = seen;
    tally.data[2 * worker + 1] = tested;
"""
_CODE = f"({NO_WRAP} + (nx) + {WRAP_Y} * (ny) + {WRAP_Z} * (nz))"


def _search_text(periodic: tuple[bool, bool, bool], loose: bool, slides: bool) -> str:
    text = SEARCH.replace("CODE(nx, ny, nz)", _CODE).replace("NO_WRAP", str(NO_WRAP))
    text = text.replace("LANES", str(LANES)).replace(
        "MASK", {8: "unsigned char", 16: "unsigned short"}[LANES]
    )
    text = text.replace("LOOSE", str(loose).lower()).replace("SLIDES", str(slides).lower())
    text = text.replace("ROUNDING", f"{ROUNDING}f").replace("PARALLEL", f"{PARALLEL}f")
    for axis, wraps in zip("XYZ", periodic, strict=True):
        text = text.replace(f"WRAPS_{axis}", str(int(wraps)))
    return text


assert GEOMETRY_PLANES == 7


@cache
def make_search_kernels(name: str, features: ListFeatures, module: str = "unique"):
    """`search_pairs` (over workers) and `confirm_pairs` (over found places) as a dict by name.

    The latter is left out of a loose list.
    """
    p = precision(name)
    real, vec3 = p.real, p.vec3
    closest_fractions = make_segment_distance(name)
    pieces, mask = features.pieces, WRAP_Y - 1
    offset_image = WRAP_Y // 2
    options = {"module": module, "enable_backward": False, "grid_stride": False}

    @wp.func_native(_search_text(features.periodic, features.loose, features.slides))
    def search(
        worker: wp.int32,
        workers: wp.int32,
        total: wp.int32,
        stride: wp.int32,
        region_size: wp.int32,
        sizes: wp.array(dtype=wp.float64),
        cells: wp.array(dtype=wp.vec3i),
        frame: wp.array(dtype=wp.float32),
        key: wp.array(dtype=wp.int32),
        order: wp.array(dtype=wp.int32),
        cell_start: wp.array(dtype=wp.int32),
        planes: wp.array(dtype=wp.float32),
        segment: wp.array(dtype=wp.int32),
        wrap: wp.array(dtype=wp.int32),
        segment_fiber: wp.array(dtype=wp.int32),
        fiber_skip: wp.array(dtype=wp.int32),
        found_i: wp.array(dtype=wp.int32),
        found_j: wp.array(dtype=wp.int32),
        found_image: wp.array(dtype=wp.int32),
        found_count: wp.array(dtype=wp.int32),
        tally: wp.array(dtype=wp.int64),
    ): ...

    @wp.kernel(**options)
    def search_pairs(
        offset: wp.int32,
        workers: wp.int32,
        total: wp.int32,
        stride: wp.int32,
        region_size: wp.int32,
        sizes: wp.array(dtype=wp.float64),
        cells: wp.array(dtype=wp.vec3i),
        frame: wp.array(dtype=wp.float32),
        key: wp.array(dtype=wp.int32),
        order: wp.array(dtype=wp.int32),
        cell_start: wp.array(dtype=wp.int32),
        planes: wp.array(dtype=wp.float32),
        segment: wp.array(dtype=wp.int32),
        wrap: wp.array(dtype=wp.int32),
        segment_fiber: wp.array(dtype=wp.int32),
        fiber_skip: wp.array(dtype=wp.int32),
        found_i_out: wp.array(dtype=wp.int32),
        found_j_out: wp.array(dtype=wp.int32),
        found_image_out: wp.array(dtype=wp.int32),
        found_count_out: wp.array(dtype=wp.int32),
        tally_out: wp.array(dtype=wp.int64),
    ):
        search(
            wp.tid() + offset,
            workers,
            total,
            stride,
            region_size,
            sizes,
            cells,
            frame,
            key,
            order,
            cell_start,
            planes,
            segment,
            wrap,
            segment_fiber,
            fiber_skip,
            found_i_out,
            found_j_out,
            found_image_out,
            found_count_out,
            tally_out,
        )

    @wp.kernel(**options)
    def confirm_pairs(
        offset: wp.int32,
        region_size: wp.int32,
        sizes: wp.array(dtype=wp.float64),
        lattice: wp.array(dtype=wp.mat33d),
        start: wp.array(dtype=vec3),
        axis: wp.array(dtype=vec3),
        segment: wp.array(dtype=wp.int32),
        part: wp.array(dtype=wp.int32),
        found_count: wp.array(dtype=wp.int32),
        found_i_out: wp.array(dtype=wp.int32),
        found_j_out: wp.array(dtype=wp.int32),
        found_image_out: wp.array(dtype=wp.int32),
    ):
        """Places of pieces become segments, i <= j, or -1 where the law says they are too far."""
        slot = wp.tid() + offset
        if slot % region_size >= found_count[slot / region_size]:
            return
        k = found_i_out[slot]
        m = found_j_out[slot]
        code = found_image_out[slot]
        i = segment[k]
        j = segment[m]
        if i > j or (i == j and code < wp.static(NO_WRAP)):
            swap = k
            k = m
            m = swap
            swap = i
            i = j
            j = swap
            code = 2 * wp.static(NO_WRAP) - code
        found_i_out[slot] = -1
        delta = start[m] - start[k]
        if code != wp.static(NO_WRAP):
            image = wp.vec3d(
                wp.float64((code & wp.static(mask)) - wp.static(offset_image)),
                wp.float64(
                    ((code / wp.static(WRAP_Y)) & wp.static(mask)) - wp.static(offset_image)
                ),
                wp.float64(code / wp.static(WRAP_Z) - wp.static(offset_image)),
            )
            delta += vec3(lattice[0] * image)
        a = axis[k]
        b = axis[m]
        st = closest_fractions(delta, a, b)
        c = delta + st[1] * b - st[0] * a
        reach = real(sizes[0])
        # a distance that is not a number is no pair
        if not (wp.length_sq(c) <= reach * reach):
            return
        if wp.static(pieces):
            # of all pairs of pieces only the one with the closest points reports the segments
            count_i = part[k] / 65536
            count_j = part[m] / 65536
            if wp.min(wp.int32(st[0] * real(count_i)), count_i - 1) != part[k] % 65536:
                return
            if wp.min(wp.int32(st[1] * real(count_j)), count_j - 1) != part[m] % 65536:
                return
        found_i_out[slot] = i
        found_j_out[slot] = j
        found_image_out[slot] = code

    if features.loose:
        return {"search_pairs": search_pairs}
    return {"search_pairs": search_pairs, "confirm_pairs": confirm_pairs}

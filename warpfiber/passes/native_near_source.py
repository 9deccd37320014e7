"""C++ text that finds near pairs among listed ones (`near_pairs`), sixteen at a time."""

from warpfiber.passes.capsule_features import CapsuleFeatures
from warpfiber.passes.native import lane_types
from warpfiber.passes.native_capsule_rows import DISTANCE, row_source
from warpfiber.passes.native_capsules_source import LANES, capsule_constants

# Of the part's pairs those that are nearer than their reach and the skins of their segments.
_NEAR = """
    const int begin = out_start[part_start[part]], end = out_start[part_start[part + 1]];
    int found = begin;
    auto skin_of = [&](int node) -> T {
        const T one = near_skin[node], other = near_skin[node + 1];
        return one > other ? one : other;
    };
    for (int first = begin; first < end; first += W) {
        const int count = end - first < W ? end - first : W;
        int ks[W], from_i[W], from_j[W];
        V reach;
        I images;
        for (int l = 0; l < W; ++l) {
            const int k = ks[l] = first + (l < count ? l : count - 1);
            from_i[l] = segment_node[pair_i[k]];
            from_j[l] = segment_node[pair_j[k]];
            ((int*)&images)[l] = pair_image[k];
            ((T*)&reach)[l] = largest_reach + skin_of(from_i[l]) + skin_of(from_j[l]);
        }
        V s, t, aa, bb, ab;
        const V3 c = closest(images, from_i, from_j, s, t, aa, bb, ab);
        const M near = c.dot(c) <= reach * reach;
        for (int l = 0; l < count; ++l) {
            near_pair[found] = ks[l];
            near_i[found] = from_i[l] << TIP_BITS | segment_tips[pair_i[ks[l]]];
            near_j[found] = from_j[l] << TIP_BITS | segment_tips[pair_j[ks[l]]];
            near_image[found] = ((const int*)&images)[l];
            found += near[l] ? 1 : 0;
        }
    }
    near_count[part] = found - begin;
"""


def near_list_source(name: str, features: CapsuleFeatures, arrays: list[str]) -> str:
    """Body of a function that makes a part of the list of near pairs."""
    addresses = ", ".join(f"{array} = {array}.data" for array in arrays)
    return f"""
    auto sweep = [=, {addresses}]() __attribute__((noinline)) {{
    #pragma clang fp contract(fast)
    {lane_types(name, LANES)}
    {capsule_constants(name, features)}
    constexpr T TINY = T(1e-30);
    {row_source()}
    auto larger = [](V x, V y) -> V {{ return x > y ? x : y; }};
    auto clamp01 = [](V x) -> V {{
        x = x > T(0) ? x : V(T(0));
        return x < T(1) ? x : V(T(1));
    }};
    {DISTANCE}
    {_NEAR}
    }};
    sweep();
    """

"""Items in portions that take turns, so that workers share them evenly.

A worker has a run of launch indices. Where the first items cost more than the last, as in a half
list whose pairs belong to the segment with the smaller number, or where fibers are sorted by
length, it gets every other portion instead.
"""

import warp as wp

PORTION = 64  # items: whole cache lines of what they write


@wp.func
def portioned(index: wp.int32, items: wp.int32, size: wp.int32) -> wp.int32:
    """Item of a launch index: even portions of `size` items first, then odd ones, then the rest."""
    portions = items / size
    portion = index / size
    if portion >= portions:
        return index
    half = (portions + 1) / 2
    turned = 2 * portion
    if portion >= half:
        turned = 2 * (portion - half) + 1
    return turned * size + index % size

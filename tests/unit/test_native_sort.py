"""Counting sorts of a neighbor list: stable, rows in order, the same for any number of workers."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import warp as wp

from warpfiber.model import OVERFLOW, OVERFLOW_PAIRS, PAIR_COUNT, ROW_NEED
from warpfiber.passes.native_sort import make_sort_kernels
from warpfiber.passes.pairs import image_code

STATUS_SIZE = 8


def _array(values: Any) -> Any:
    return wp.array(np.asarray(values), dtype=wp.int32, device="cpu")


def _keys(kind: str, count: int, bins: int) -> np.ndarray:
    """Keys of all shares: even, most in few bins, all in one."""
    rng = np.random.default_rng(3)
    if kind == "even":
        return rng.integers(0, bins, count)
    if kind == "uneven":
        return (bins * rng.random(count) ** 6).astype(int)
    return np.full(count, bins - 1)


def _run(name: str, workers: int, inputs: list[Any]) -> None:
    kernel = make_sort_kernels()[name]
    for worker in range(workers):
        wp.launch(kernel, dim=1, inputs=[worker, workers, *inputs], device="cpu")


@pytest.mark.parametrize("workers", [1, 2, 3, 7])
@pytest.mark.parametrize("kind", ["even", "uneven", "one bin"])
@pytest.mark.parametrize(("count", "bins"), [(0, 5), (1, 1), (63, 9), (640, 700), (5000, 90)])
def test_starts_and_places(kind: str, count: int, bins: int, workers: int) -> None:
    """As NumPy's stable sort, in every bin and beyond the last one."""
    keys = _keys(kind, count, bins)
    status, total = _array(np.zeros(STATUS_SIZE)), _array([count])
    start, place = _array(np.full(bins + 1, -1)), _array(np.full(max(count, 1), -1))
    room = _array(np.append(keys, 0)[: max(count, 1)])
    _run("index_partners", workers, [bins, status, room, start, place, total])
    assert (start.numpy() == np.searchsorted(np.sort(keys), np.arange(bins + 1))).all()
    assert (place.numpy()[:count] == np.argsort(keys, kind="stable")).all()


@pytest.mark.parametrize("workers", [1, 2, 5])
def test_rows(workers: int) -> None:
    """Found pairs in parts with gaps, some rejected, rows short and long, one pair twice."""
    rng = np.random.default_rng(4)
    bins, stride, counts = 60, 400, [400, 0, 233]
    owner = np.minimum(rng.integers(0, bins, (3, stride)), rng.integers(0, 2 * bins, (3, stride)))
    owner[rng.random((3, stride)) < 0.1] = -1
    partner = rng.integers(0, 12, (3, stride)) + (1 << 30)
    image = rng.choice([image_code(x, 0, z) for x in (-2, 0, 511) for z in (-512, 3)], (3, stride))
    used = np.arange(stride) < np.asarray(counts)[:, None]
    kept = used & (owner >= 0)
    wanted = np.stack([owner[kept], partner[kept], image[kept]])
    wanted = wanted[:, np.lexsort(wanted[::-1])]
    sizes = np.bincount(wanted[0], minlength=bins)
    twice = (np.diff(wanted, axis=1) == 0).all(axis=0).any()
    assert sizes.max() > 8 > sizes.min()  # of both kinds
    assert twice

    found = [_array(values.ravel()) for values in (owner, partner, image)]
    status, start = _array(np.zeros(STATUS_SIZE)), _array(np.full(bins + 1, -1))
    place, *listed = (_array(np.full(900, -1)) for _ in range(4))
    inputs = [3, bins, stride, 900, _array(counts), *found, status, start, place, *listed]
    _run("order_rows", workers, inputs)
    total = wanted.shape[1]
    assert status.numpy()[PAIR_COUNT] == total
    assert (start.numpy() == np.append(0, np.cumsum(sizes))).all()
    for values, expected in zip(listed, wanted, strict=True):
        assert (values.numpy()[:total] == expected).all()


@pytest.mark.parametrize(("counts", "capacity"), [([3, 9], 20), ([8, 8], 15)])
def test_too_many(counts: list[int], capacity: int) -> None:
    """A part, or the list, that is too small: said so, nothing listed."""
    keys = _array(np.zeros(16))
    status, start = _array(np.zeros(STATUS_SIZE)), _array(np.zeros(5))
    place, *listed = (_array(np.full(20, -1)) for _ in range(4))
    inputs = [2, 4, 8, capacity, _array(counts), keys, keys, keys, status, start, place, *listed]
    _run("order_rows", 2, inputs)
    assert status.numpy()[OVERFLOW] == OVERFLOW_PAIRS
    assert status.numpy()[ROW_NEED] == max(counts)
    assert all((values.numpy() == -1).all() for values in (place, *listed))

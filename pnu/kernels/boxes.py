"""A cloud in the order of a tree of boxes: what searches walk along. Memory and time follow the points, not the space
they fill, and points that are equal, on a line or far away are no special case."""

import numpy as np
from numpy.typing import NDArray

from pnu.kernels.compilation import kernel

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


@kernel(exact=True, inner=True)
def _swap(place: Floats, order: Ints, i: int, j: int) -> None:
    order[i], order[j] = order[j], order[i]
    for axis in range(3):
        place[i, axis], place[j, axis] = place[j, axis], place[i, axis]


PATIENCE = 48  # rounds of a selection, of which a million points take some twenty


@kernel(exact=True, inner=True)
def _split(place: Floats, order: Ints, first: int, stop: int, cut: int, axis: int) -> None:
    """Points before `cut` are not above those from it on (Hoare's selection).

    There are orders, sorted clouds among them, in which first, middle and last make a bad pivot again and again. After
    a while others are drawn, lest time grow with the square of the points.
    """
    low, high = first, stop - 1
    rounds, drawn = 0, 1
    while low < high:
        one, two, three = low, (low + high) // 2, high
        rounds += 1
        if rounds > PATIENCE:
            drawn = (1103515245 * drawn + 12345) % 2147483648
            one = low + drawn % (high - low + 1)
            drawn = (1103515245 * drawn + 12345) % 2147483648
            two = low + drawn % (high - low + 1)
            drawn = (1103515245 * drawn + 12345) % 2147483648
            three = low + drawn % (high - low + 1)
        a, b, c = place[one, axis], place[two, axis], place[three, axis]
        pivot = max(min(a, b), min(max(a, b), c))
        i, j = low, high
        while i <= j:
            while place[i, axis] < pivot:
                i += 1
            while place[j, axis] > pivot:
                j -= 1
            if i <= j:
                _swap(place, order, i, j)
                i += 1
                j -= 1
        if cut <= j:
            high = j
        elif cut >= i:
            low = i
        else:
            break


def box_order(points: Floats, leaf: int) -> Ints:
    """An order of points (n, 3) whose every run of 2^i leaves, of `leaf` points each, fills a box of its own: (n,).

    Boxes are halved along their longest side; the first half gets the greatest power of two of leaves that leaves some
    for the second. So leaf l belongs to node l // 2^i of level i.
    """
    order = np.arange(len(points), dtype=np.int64)
    _put_in_order(points, leaf, order)
    return order


@kernel("void(float64[:, ::1], int64, int64[::1])", exact=True)
def _put_in_order(points: Floats, leaf: int, order: Ints) -> None:
    """See `box_order`."""
    n = len(points)
    place = points.copy()
    waiting = np.empty((128, 2), np.int64)
    waiting[0, 0], waiting[0, 1] = 0, n
    depth = 1
    while depth:
        depth -= 1
        first, stop = waiting[depth]
        leaves = (stop - first + leaf - 1) // leaf
        if leaves < 2:
            continue
        half = 1
        while 2 * half < leaves:
            half *= 2
        axis, widest = 0, -1.0
        for a in range(3):
            low = high = place[first, a]
            for i in range(first, stop):
                low, high = min(low, place[i, a]), max(high, place[i, a])
            if high - low > widest:
                axis, widest = a, high - low
        cut = first + half * leaf
        _split(place, order, first, stop, cut, axis)
        waiting[depth, 0], waiting[depth, 1] = first, cut
        waiting[depth + 1, 0], waiting[depth + 1, 1] = cut, stop
        depth += 2

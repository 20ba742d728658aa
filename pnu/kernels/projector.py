"""`pnu.networks.surface.Projector` on LANES queries at once: no array of all queries, neighbors and features is made.

A block of queries goes from neighbors to results through buffers that fit the processor's cache. Features of a neighbor
are a row of `wide` floats, the width of the network filled up with zeros to whole panels; rows of a query begin at a
multiple of the rows of a tile, so that a tile belongs to one query. Exponentials are powers of two, their factor
is in the weights.
"""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pnu.kernels.boxes import Floats, Ints
from pnu.kernels.compilation import by_numba, kernel
from pnu.kernels.frames import (
    FRAME,
    HEIGHT,
    NEAR,
    SPACING,
    WORK,
    X_AXIS,
    Y_AXIS,
    Z_AXIS,
    Buffer,
    f32,
    gather_block,
    gather_messages,
    make_frames,
)
from pnu.kernels.panels import LANES, NARROW, PANEL, VECTORS, pack, padded, panel_of

if by_numba():  # kept machine code has them inside
    from pnu.kernels.tiles import FEW_ROWS, ROWS, tile
    from pnu.kernels.vectors import full, fused, largest, load_vector, power_of_two, store_vector, sum_of_lanes

    def _tile(rows: int, *, relu: bool) -> Any:
        """A tile of either width, NARROW or PANEL columns, as its first argument says."""
        narrow, wide = tile(rows, NARROW // LANES, relu=relu), tile(rows, VECTORS, relu=relu)

        @kernel(inner=True)
        def product(
            columns: int, x: Any, x_at: int, x_row: int, x_column: int, w: Any, w_at: int, depth: int,
            start: Any, start_at: int, out: Any, out_at: int, out_row: int,
        ) -> None:  # fmt: skip
            if columns == NARROW:
                narrow(x, x_at, x_row, x_column, w, w_at, depth, start, start_at, out, out_at, out_row)
            else:
                wide(x, x_at, x_row, x_column, w, w_at, depth, start, start_at, out, out_at, out_row)

        return product

    _first, _layer, _logits = _tile(FEW_ROWS, relu=True), _tile(ROWS, relu=True), _tile(ROWS, relu=False)
    _head, _context = _tile(FEW_ROWS, relu=True), _tile(FEW_ROWS, relu=False)
    _out = tile(FEW_ROWS, 1, relu=False)

OUT = 7  # numbers: position, normal, logarithm of the error
BENT = 7  # of the features: the bent plane, chosen beside 3:6, the normal
LOG2_E = f32(np.log2(np.e))
NOTHING = f32(-1e30)


class PackedWeights(NamedTuple):
    """Packed matrices and their biases, filled up with zeros."""

    first: Buffer
    first_bias: Buffer
    second: Buffer
    second_bias: Buffer
    context: Buffer
    context_bias: Buffer
    third: Buffer
    third_bias: Buffer
    attention: Buffer
    choices: Buffer  # (2, wide)
    head: Buffer
    head_bias: Buffer
    last: Buffer
    last_bias: Buffer
    out: Buffer
    out_bias: Buffer


def packed(parameters: dict[str, NDArray[np.float32]], *, attention: bool) -> PackedWeights:
    """PackedWeights of a projector by the names of its state dict; without attention all neighbors count alike."""
    width = len(parameters["first.bias"])
    wide, panel = padded(width), panel_of(width)
    columns, results = parameters["first.weight"].shape[1], -(-len(parameters["out.bias"]) // LANES) * LANES

    def blocks(matrix: NDArray[np.float32], rows: list[int], columns: int) -> NDArray[np.float32]:
        """Transposed, with blocks of `width` rows and `rows` places for each of them, filled up to `columns`."""
        filled = np.zeros((sum(rows), columns), np.float32)
        source = target = 0
        for place in rows:
            size = min(width, place) if place == wide else place
            filled[target : target + size, : matrix.shape[0]] = matrix.T[source : source + size]
            source, target = source + size, target + place
        return filled

    def bias(name: str, columns: int) -> NDArray[np.float32]:
        filled = np.zeros(columns, np.float32)
        filled[: len(parameters[name])] = parameters[name]
        return filled

    of_head = np.zeros((3 * wide, 2 * wide), np.float32)
    of_head[:, : 2 * wide] = blocks(parameters["head.0.weight"], [wide] * 3, 2 * wide)
    last = np.zeros((2 * wide, wide), np.float32)
    last[: 2 * width, :width] = parameters["head.2.weight"].T
    scale = LOG2_E if attention else f32(0)
    of_features, choices = np.split(parameters["attention.weight"] * scale, [width])
    return PackedWeights(
        pack(blocks(parameters["first.weight"], [columns], wide), panel), bias("first.bias", wide),
        pack(blocks(parameters["second.weight"], [wide], wide), panel), bias("second.bias", wide),
        pack(blocks(parameters["context.weight"], [wide, wide, 1], wide), panel), bias("context.bias", wide),
        pack(blocks(parameters["third.weight"], [wide], wide), panel), bias("third.bias", wide),
        pack(blocks(of_features, [wide], wide), panel), blocks(choices, [wide], 2).T.ravel().copy(),
        pack(of_head, panel), bias("head.0.bias", 2 * wide), pack(last, panel), bias("head.2.bias", wide),
        pack(blocks(parameters["out.weight"], [wide], results), LANES), bias("out.bias", results),
    )  # fmt: skip


@kernel(inner=True)
def _pool(logits: Buffer, scale: np.float32, rows: Buffer, at: int, k: int, wide: int, out: Buffer, place: int) -> None:
    """Maximum of k rows, then their sum weighed by softmax of `scale` x logits, into out[place : place + 2 wide]."""
    zero, factor = full(f32(0)), full(scale)
    for c in range(0, wide, LANES):
        top, most = load_vector(rows, at + c), load_vector(logits, at + c)
        for i in range(1, k):
            top = largest(top, load_vector(rows, at + c + i * wide))
            most = largest(most, load_vector(logits, at + c + i * wide))
        store_vector(out, place + c, top)
        weights, weighed, below = zero, zero, zero - factor * most
        for i in range(k):
            weight = power_of_two(fused(factor, load_vector(logits, at + c + i * wide), below))
            weights, weighed = weights + weight, fused(weight, load_vector(rows, at + c + i * wide), weighed)
        store_vector(out, place + wide + c, weighed / weights)


@kernel(inner=True)
def _chosen(rows: Buffer, at: int, choices: Buffer, k: int, wide: int, shares: Buffer) -> None:
    """Shares of k neighbors twice, softmax of the products of their rows with `choices`: one after the other."""
    half = len(shares) // 2
    for choice in range(2):
        most = NOTHING
        for i in range(k):
            sum_ = full(f32(0))
            for c in range(0, wide, LANES):
                sum_ = fused(load_vector(rows, at + i * wide + c), load_vector(choices, choice * wide + c), sum_)
            shares[choice * half + i] = sum_of_lanes(sum_)
            most = max(most, shares[choice * half + i])
        for i in range(0, half, LANES):
            store_vector(shares, choice * half + i, power_of_two(load_vector(shares, choice * half + i) - full(most)))
        weights = f32(0)
        for i in range(k):
            weights += shares[choice * half + i]
        for i in range(k):
            shares[choice * half + i] /= weights


@kernel(inner=True)
def _finish(
    query: Floats, at: int, lane: int, k: int, frame: Buffer, features: Buffer, shares: Buffer, out: Buffer,
    result: Floats,
) -> None:  # fmt: skip
    """One query's step, normal and messages from what the network gave, in its lane's row of `out`."""
    half, rows = len(shares) // 2, len(features) // (k * LANES)
    bent = x = y = z = f32(0)
    for i in range(k):
        feature = i * rows * LANES + lane
        bent += shares[half + i] * features[feature + BENT * LANES]
        x += shares[i] * features[feature + 3 * LANES]
        y += shares[i] * features[feature + 4 * LANES]
        z += shares[i] * features[feature + 5 * LANES]
    row = lane * (len(out) // LANES)
    step_x, step_y, step_z = out[row], out[row + 1], out[row + 2] + f32(0.5) * bent
    x, y, z = x + out[row + 3], y + out[row + 4], z + out[row + 5]
    spacing = frame[SPACING * LANES + lane]
    length_sq = f32(0)
    for c in range(3):
        first = frame[(X_AXIS + c) * LANES + lane]
        second = frame[(Y_AXIS + c) * LANES + lane]
        third = frame[(Z_AXIS + c) * LANES + lane]
        step = frame[c * LANES + lane] + spacing * (step_x * first + step_y * second + step_z * third)
        normal = x * first + y * second + z * third
        result[at, c], result[at, 3 + c] = query[at, c] + step, normal
        length_sq += normal * normal
    length = max(np.sqrt(length_sq), f32(1e-12))
    for c in range(3):
        result[at, 3 + c] /= length
    result[at, 6] = out[row + 6] + np.log(spacing)
    for c in range(OUT, result.shape[1]):
        result[at, c] = np.tanh(out[row + c])


@kernel(
    "void(float64[:, ::1], float64[:, ::1], int64[:, ::1], boolean, "
    + ", ".join(["float32[::1]"] * len(PackedWeights._fields))
    + ", float64[:, ::1])"
)
def project_queries(
    query: Floats, cloud: Floats, idx: Ints, sphere: bool,
    first: Buffer, first_bias: Buffer, second: Buffer, second_bias: Buffer, context: Buffer, context_bias: Buffer,
    third: Buffer, third_bias: Buffer, attention: Buffer, choices: Buffer, head: Buffer, head_bias: Buffer,
    last: Buffer, last_bias: Buffer, out: Buffer, out_bias: Buffer,
    result: Floats,
) -> None:  # fmt: skip
    """Queries (m, 6) and their neighbors idx (m, k) of a cloud (n, 6 + c), by `PackedWeights` -> result (m, 7 + c):
    points, normals, the logarithm of the expected error, and messages. A cloud without messages has zeros."""
    k, wide, results = idx.shape[1], len(first_bias), len(out_bias)
    columns = len(first) // wide
    panel = NARROW if wide <= NARROW else PANEL
    rows = (k + ROWS - 1) // ROWS * ROWS  # of a query
    scale = f32(0)
    for weight in attention:
        if weight != 0:
            scale = LOG2_E
    near, hint, work = np.empty(k * NEAR * LANES, f32), np.empty(3 * LANES, f32), np.empty(k * WORK * LANES, f32)
    features, frame = np.zeros(k * columns * LANES, f32), np.empty(FRAME * LANES, f32)
    below, middle = np.zeros(LANES * rows * wide, f32), np.empty(LANES * rows * wide, f32)
    above, logits = np.empty(LANES * rows * wide, f32), np.empty(LANES * rows * wide, f32)
    pooled_wide, seen_wide = 2 * wide + 1, 3 * wide
    pooled, seen = np.empty(LANES * pooled_wide, f32), np.empty(LANES * seen_wide, f32)
    contexts, start_third = np.empty(LANES * wide, f32), np.empty(wide, f32)
    nothing, shares = np.zeros(wide, f32), np.full(2 * ((k + LANES - 1) // LANES) * LANES, NOTHING)
    chosen = np.empty((LANES, len(shares)), f32)
    head_rows, last_rows, outs = (
        np.empty(LANES * 2 * wide, f32),
        np.empty(LANES * wide, f32),
        np.empty(LANES * results, f32),
    )
    for start in range(0, len(query), LANES):
        gather_block(cloud, query, idx, start, near, hint)
        make_frames(near, hint, k, sphere, work, frame, features)
        gather_messages(cloud, idx, start, features)
        for i in range(k):
            for q in range(0, LANES, FEW_ROWS):
                for p in range(0, wide, panel):
                    _first(
                        panel, features, i * columns * LANES + q, 1, LANES, first, p * columns, columns,
                        first_bias, p, below, (q * rows + i) * wide + p, rows * wide,
                    )  # fmt: skip
        for p in range(0, wide, panel):
            for r in range(0, LANES * rows, ROWS):
                _layer(
                    panel, below, r * wide, wide, 1, second, p * wide, wide, second_bias, p, middle, r * wide + p, wide
                )  # fmt: skip
        for q in range(LANES):
            _pool(middle, scale, middle, q * rows * wide, k, wide, pooled, q * pooled_wide)
            pooled[q * pooled_wide + 2 * wide] = frame[HEIGHT * LANES + q]
        for p in range(0, wide, panel):
            for q in range(0, LANES, FEW_ROWS):
                _context(
                    panel, pooled, q * pooled_wide, pooled_wide, 1, context, p * pooled_wide, pooled_wide,
                    context_bias, p, contexts, q * wide + p, wide,
                )  # fmt: skip
        for q in range(LANES):
            for c in range(0, wide, LANES):
                store_vector(start_third, c, load_vector(contexts, q * wide + c) + load_vector(third_bias, c))
            for p in range(0, wide, panel):
                for r in range(q * rows, (q + 1) * rows, ROWS):
                    _layer(
                        panel, middle, r * wide, wide, 1, third, p * wide, wide, start_third, p,
                        above, r * wide + p, wide,
                    )  # fmt: skip
        for p in range(0, wide, panel):
            for r in range(0, LANES * rows, ROWS):
                _logits(
                    panel, above, r * wide, wide, 1, attention, p * wide, wide, nothing, p, logits, r * wide + p, wide
                )
        for q in range(LANES):
            _pool(logits, f32(1), above, q * rows * wide, k, wide, seen, q * seen_wide)
            for c in range(0, wide, LANES):
                store_vector(seen, q * seen_wide + 2 * wide + c, load_vector(contexts, q * wide + c))
            _chosen(above, q * rows * wide, choices, k, wide, shares)
            for i in range(len(shares)):
                chosen[q, i] = shares[i]
        for p in range(0, 2 * wide, panel):
            for q in range(0, LANES, FEW_ROWS):
                _head(
                    panel, seen, q * seen_wide, seen_wide, 1, head, p * seen_wide, seen_wide,
                    head_bias, p, head_rows, q * 2 * wide + p, 2 * wide,
                )  # fmt: skip
        for p in range(0, wide, panel):
            for q in range(0, LANES, FEW_ROWS):
                _head(
                    panel, head_rows, q * 2 * wide, 2 * wide, 1, last, p * 2 * wide, 2 * wide,
                    last_bias, p, last_rows, q * wide + p, wide,
                )  # fmt: skip
        for q in range(0, LANES, FEW_ROWS):
            for p in range(0, results, LANES):
                _out(last_rows, q * wide, wide, 1, out, p * wide, wide, out_bias, p, outs, q * results + p, results)
        for lane in range(min(LANES, len(query) - start)):
            _finish(query, start + lane, lane, k, frame, features, chosen[lane], outs, result)

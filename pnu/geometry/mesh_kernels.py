"""Exact closest points on triangle meshes as a Triton kernel: blocks of triangles too far away are passed over.

Imported only where Triton is there, and used on a GPU; in the interpreter as `triton_kernels`. Single precision: of a
query and a face no more than the rounding of their coordinates is lost, however thin the face is.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
import triton
import triton.language as tl
from torch import Tensor

from pnu.geometry.spatial_blocks import along_curve
from pnu.io import Mesh

ROWS = 32  # queries of a program
BLOCK = 32  # triangles of a block: with 64, or 64 queries, registers run out
CHUNK = 64  # blocks whose spheres are looked at together
FLAT = 1e-12  # height of a triangle that counts as a line, as a share of its longest side
LEAST_SQ = tl.constexpr(1e-30)  # squared length of a side that counts as a point
FAR = tl.constexpr(1e18)  # queries with a coordinate beyond, whose squares overflow, or NaN have no closest point


class TriangleBlocks(NamedTuple):
    """Meshes one after another, each along a curve, in blocks of BLOCK triangles; the last one of a mesh has copies."""

    triangles: Tensor  # (t, 9) float32: three corners
    normals: Tensor  # (t, 3) float32: unit length, or zero where a triangle has no area
    spheres: Tensor  # (b, 4) float32: center and radius of what holds a block
    first: Tensor  # (meshes + 1,) int32: blocks before each mesh, and of all

    def to(self, device: torch.device | str) -> "TriangleBlocks":
        """The same on a device."""
        return TriangleBlocks(*(part.to(device) for part in self))


def triangle_blocks(meshes: Sequence[Mesh]) -> TriangleBlocks:
    """Meshes of at least one face each, made ready for `closest_on_meshes`."""
    parts = [_blocks_of(mesh) for mesh in meshes]
    corners = np.concatenate(parts).astype(np.float32)
    exact = corners.astype(np.float64)  # normals and spheres of the triangles as they are rounded
    sides = np.roll(exact, -1, 1) - exact
    normals = np.cross(sides[:, 0], sides[:, 1])
    area, longest_sq = np.linalg.norm(normals, axis=1), np.square(sides).sum(2).max(1)
    normals[area <= FLAT * longest_sq] = 0
    normals /= np.where(area > FLAT * longest_sq, area, 1)[:, None]
    held = exact.reshape(-1, 3 * BLOCK, 3)
    center = ((held.min(1) + held.max(1)) / 2).astype(np.float32)
    radius = np.linalg.norm(held - center[:, None], axis=2).max(1)
    spheres = np.column_stack([center, radius * 1.000002])  # whatever rounding the kernel has
    first = np.cumsum([0, *(len(part) // BLOCK for part in parts)])
    return TriangleBlocks(
        torch.from_numpy(corners.reshape(-1, 9)),
        torch.from_numpy(normals.astype(np.float32)),
        torch.from_numpy(spheres.astype(np.float32)),
        torch.from_numpy(first.astype(np.int32)),
    )


def _blocks_of(mesh: Mesh) -> np.ndarray:
    """Corners (t, 3, 3) of a mesh's triangles along a curve, the last one repeated to fill the last block."""
    order = along_curve(mesh.vertices[mesh.faces].mean(1))
    filled = np.append(order, np.repeat(order[-1], -len(order) % BLOCK))
    corners: np.ndarray = mesh.vertices[mesh.faces[filled]]
    return corners


@triton.jit
def _from_side(x, y, z, ux, uy, uz):
    """Vector to points from the closest points of sides u that start at the origin, and its square."""
    length_sq = ux * ux + uy * uy + uz * uz
    inverse = tl.where(length_sq > LEAST_SQ, 1 / tl.maximum(length_sq, LEAST_SQ), 0.0)
    along = tl.minimum(tl.maximum((x * ux + y * uy + z * uz) * inverse, 0.0), 1.0)
    x, y, z = x - along * ux, y - along * uy, z - along * uz
    return x, y, z, x * x + y * y + z * z


@triton.jit
def _beside(x, y, z, ux, uy, uz, nx, ny, nz):
    """More than zero on the inner side of a side u that starts at the origin, of a triangle with this normal."""
    return x * (ny * uz - nz * uy) + y * (nz * ux - nx * uz) + z * (nx * uy - ny * ux)


@triton.jit
def _from_triangle(x, y, z, triangles, normals, row):
    """Vector to points from the closest points of triangles, its square, and the triangles' normals.

    The nearest of the three sides, or the plane where the point's foot is within all sides. Nothing is divided by an
    area, so that thin triangles do no harm. Points and rows have shapes that go together.
    """
    corner = triangles + row * 9
    ax, ay, az = tl.load(corner), tl.load(corner + 1), tl.load(corner + 2)
    bx, by, bz = tl.load(corner + 3), tl.load(corner + 4), tl.load(corner + 5)
    cx, cy, cz = tl.load(corner + 6), tl.load(corner + 7), tl.load(corner + 8)
    normal = normals + row * 3
    nx, ny, nz = tl.load(normal), tl.load(normal + 1), tl.load(normal + 2)
    px, py, pz = x - ax, y - ay, z - az
    ux, uy, uz = bx - ax, by - ay, bz - az
    dx, dy, dz, square = _from_side(px, py, pz, ux, uy, uz)
    height = px * nx + py * ny + pz * nz
    inside = (_beside(px, py, pz, ux, uy, uz, nx, ny, nz) >= 0) & (nx * nx + ny * ny + nz * nz > 0)
    px, py, pz = x - bx, y - by, z - bz
    ux, uy, uz = cx - bx, cy - by, cz - bz
    ex, ey, ez, other = _from_side(px, py, pz, ux, uy, uz)
    inside = inside & (_beside(px, py, pz, ux, uy, uz, nx, ny, nz) >= 0)
    nearer = other < square
    dx, dy, dz = tl.where(nearer, ex, dx), tl.where(nearer, ey, dy), tl.where(nearer, ez, dz)
    square = tl.where(nearer, other, square)
    px, py, pz = x - cx, y - cy, z - cz
    ux, uy, uz = ax - cx, ay - cy, az - cz
    ex, ey, ez, other = _from_side(px, py, pz, ux, uy, uz)
    inside = inside & (_beside(px, py, pz, ux, uy, uz, nx, ny, nz) >= 0)
    nearer = other < square
    dx, dy, dz = tl.where(nearer, ex, dx), tl.where(nearer, ey, dy), tl.where(nearer, ez, dz)
    square = tl.where(nearer, other, square)
    dx, dy, dz = tl.where(inside, height * nx, dx), tl.where(inside, height * ny, dy), tl.where(inside, height * nz, dz)
    square = tl.where(inside, height * height, square)
    return dx, dy, dz, square, nx, ny, nz


@triton.jit
def _with_block(x, y, z, best, face, triangles, normals, block, BLOCK: tl.constexpr):
    """Least squared distances and their faces, (ROWS, 1), once a block is looked at, too."""
    row = block * BLOCK + tl.arange(0, BLOCK)[None, :]
    _, _, _, square, _, _, _ = _from_triangle(x, y, z, triangles, normals, row)
    least, place = tl.min(square, axis=1, return_indices=True)
    least, place = least[:, None], place[:, None]
    face = tl.where(least < best, block * BLOCK + place, face)
    return tl.minimum(best, least), face


@triton.jit
def _to_center(x, y, z, spheres, block, kept):
    """Distances of a point from the centers of blocks, and the radii."""
    sphere = spheres + block * 4
    dx = x - tl.load(sphere, kept, 0.0)
    dy = y - tl.load(sphere + 1, kept, 0.0)
    dz = z - tl.load(sphere + 2, kept, 0.0)
    return tl.sqrt(dx * dx + dy * dy + dz * dz), tl.load(sphere + 3, kept, 0.0)


@triton.jit
def _farthest_of(best, searched):
    """The largest distance among squared ones, a little more for rounding."""
    return tl.sqrt(tl.max(tl.where(searched, best, 0.0))) * 1.000001


@triton.jit
def _closest(
    points, shape, triangles, normals, spheres, first, closest, closest_normals, m,
    ROWS: tl.constexpr, BLOCK: tl.constexpr, CHUNK: tl.constexpr,
):  # fmt: skip
    cloud = tl.program_id(1).to(tl.int64)
    mesh = tl.load(shape + cloud)
    start, stop = tl.load(first + mesh), tl.load(first + mesh + 1)
    row = tl.program_id(0) * ROWS + tl.arange(0, ROWS)[:, None]
    kept = row < m
    place = (cloud * m + row) * 3
    x = tl.load(points + place, kept, 0.0)
    y = tl.load(points + place + 1, kept, 0.0)
    z = tl.load(points + place + 2, kept, 0.0)
    searched = kept & (tl.abs(x) < FAR) & (tl.abs(y) < FAR) & (tl.abs(z) < FAR)
    x, y, z = tl.where(searched, x, 0.0), tl.where(searched, y, 0.0), tl.where(searched, z, 0.0)
    share = 1 / tl.maximum(tl.sum(searched.to(tl.float32)), 1.0)
    mx, my, mz = tl.sum(x) * share, tl.sum(y) * share, tl.sum(z) * share
    aside = (x - mx) * (x - mx) + (y - my) * (y - my) + (z - mz) * (z - mz)
    reach = _farthest_of(aside, searched)

    lanes = tl.arange(0, CHUNK)
    near = tl.full((CHUNK,), float("inf"), tl.float32)
    of_near = tl.zeros((CHUNK,), tl.int32) + start
    for chunk in range(start, stop, CHUNK):
        block = chunk + lanes
        distance, _ = _to_center(mx, my, mz, spheres, block, block < stop)
        nearer = (distance < near) & (block < stop)
        near = tl.where(nearer, distance, near)
        of_near = tl.where(nearer, block, of_near)
    nearest = tl.min(tl.where(near <= tl.min(near), of_near, stop - 1))

    best = tl.full((ROWS, 1), float("inf"), tl.float32)
    face = tl.zeros((ROWS, 1), tl.int32) + start * BLOCK
    best, face = _with_block(x, y, z, best, face, triangles, normals, nearest, BLOCK)
    bound = _farthest_of(best, searched)
    for chunk in range(start, stop, CHUNK):
        block = chunk + lanes
        distance, radius = _to_center(mx, my, mz, spheres, block, block < stop)
        gap = tl.where(block < stop, distance * 0.999999 - radius - reach, float("inf"))
        if tl.min(gap) <= bound:
            for one in range(chunk, tl.minimum(chunk + CHUNK, stop)):
                to_one, radius_one = _to_center(mx, my, mz, spheres, one, one < stop)
                if (to_one * 0.999999 - radius_one - reach <= bound) & (one != nearest):
                    best, face = _with_block(x, y, z, best, face, triangles, normals, one, BLOCK)
                    bound = _farthest_of(best, searched)

    dx, dy, dz, _, nx, ny, nz = _from_triangle(x, y, z, triangles, normals, face)
    tl.store(closest + place, tl.where(searched, x - dx, float("nan")), kept)
    tl.store(closest + place + 1, tl.where(searched, y - dy, float("nan")), kept)
    tl.store(closest + place + 2, tl.where(searched, z - dz, float("nan")), kept)
    tl.store(closest_normals + place, nx, kept)
    tl.store(closest_normals + place + 1, ny, kept)
    tl.store(closest_normals + place + 2, nz, kept)


def closest_on_meshes(points: Tensor, shape: Tensor, blocks: TriangleBlocks) -> tuple[Tensor, Tensor]:
    """Closest points of surfaces and the normals of their faces, (B, m, 3) float32 each.

    points (B, m, 3), their meshes `shape` (B,) int64, all on one device. Fastest where points that follow each other
    are near each other. Of faces that are equally near any one may be taken. A query that is NaN, or
    farther away than FAR, has NaN as its closest point and some normal.
    """
    points = points.detach().float().contiguous()
    shape = shape.to(points.device, torch.int64).contiguous()
    batch, m, _ = points.shape
    closest, normals = torch.empty_like(points), torch.empty_like(points)
    _closest[(triton.cdiv(m, ROWS), batch)](
        points, shape, *blocks, closest, normals, m, ROWS, BLOCK, CHUNK, num_warps=4
    )
    return closest, normals

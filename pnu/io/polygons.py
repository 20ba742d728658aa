"""Polygons of mesh files, cut into triangles."""

import numpy as np

STRAIGHT = 1e-6  # sine of a turn to the wrong side, from which on a corner is concave


@np.errstate(all="ignore")  # what is not finite is cut as a fan, and refused later
def triangulate(vertices: np.ndarray, counts: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """Triangles (f, 3) int64 of polygons, counts - 2 of each, in their order and with their orientation.

    vertices (v, 3); counts (p,): corners of each polygon; corners: indices into the vertices, all in a row.
    Convex polygons are cut as fans; concave ones in their plane, so that no triangle lies outside. Where a corner is no
    vertex all are fans, for the caller to refuse.
    """
    faces = fan(counts, corners)
    if not len(faces) or counts.max() < 4 or corners.min() < 0 or corners.max() >= len(vertices):
        return faces
    starts = np.cumsum(counts) - counts
    triangles = np.maximum(counts - 2, 0)
    first = np.cumsum(triangles) - triangles
    large = np.flatnonzero(counts > 3)
    for number, normal in zip(*_concave(vertices, counts[large], starts[large], corners), strict=True):
        number = large[number]
        polygon = corners[starts[number] : starts[number] + counts[number]]
        cut = _cut(vertices[polygon], normal)
        if len(cut) == triangles[number]:
            faces[first[number] : first[number] + len(cut)] = polygon[cut]
    return faces


def fan(counts: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """Triangles (f, 3) of polygons, each from its first corner."""
    starts = np.cumsum(counts) - counts
    triangles = np.maximum(counts - 2, 0)
    polygon = np.repeat(np.arange(len(counts)), triangles)
    step = np.arange(triangles.sum()) - np.repeat(np.cumsum(triangles) - triangles, triangles)
    first = starts[polygon]
    return np.stack([corners[first], corners[first + step + 1], corners[first + step + 2]], axis=1).astype(np.int64)


def _concave(
    vertices: np.ndarray, counts: np.ndarray, starts: np.ndarray, corners: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Which of the polygons have a corner that turns against the others, and their normals (Newell's)."""
    begin = np.cumsum(counts) - counts
    polygon = np.repeat(np.arange(len(counts)), counts)
    step = np.arange(len(polygon)) - begin[polygon]
    at = vertices[corners[starts[polygon] + step]]
    at = at - at[begin[polygon]]  # far from the origin a product of coordinates has no digits left
    edge = at[begin[polygon] + (step + 1) % counts[polygon]] - at
    before = edge[begin[polygon] + (step - 1) % counts[polygon]]
    normal = np.add.reduceat(np.cross(at, at + edge), begin)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    turn = (np.cross(before, edge) * normal[polygon]).sum(1)
    wrong = turn < -STRAIGHT * np.linalg.norm(before, axis=1) * np.linalg.norm(edge, axis=1)
    found = np.flatnonzero(np.bincount(polygon[wrong], minlength=len(counts)))
    return found, normal[found]


def _cut(corners: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """Triangles (k - 2, 3) of one polygon (k, 3), seen along its normal."""
    import manifold3d

    first = np.eye(3)[np.argmin(np.abs(normal))]
    along = np.cross(normal, first)
    along /= np.linalg.norm(along)
    flat = (corners - corners[0]) @ np.stack([along, np.cross(normal, along)], 1)
    return np.asarray(manifold3d.triangulate([flat / np.abs(flat).max()]))

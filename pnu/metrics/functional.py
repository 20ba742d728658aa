"""Metrics of one cloud or of a batch of clouds against the truth.

Every function takes clouds as `(n, C)` or `(B, n, C)` tensors or arrays, C = 3 or 6 (points, then normals), and returns
one value a cloud: a 0-d tensor, or `(B,)`. The two clouds may differ in size. Lengths are in the clouds' own unit and
nothing is multiplied by 1000; clouds that are compared with published numbers belong in the truth's unit sphere.
An empty cloud, NaN or infinity is a `ValueError`: a failed computation never gives a good-looking number.

A metric over a data set is the mean over clouds: `mean_update` adds sums and counts, `mean_compute` divides them.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import ArrayLike
from scipy.optimize import linear_sum_assignment
from scipy.spatial import cKDTree
from torch import Tensor

from pnu.io import Mesh
from pnu.ops.nearest import Neighbors, knn, nearest
from pnu.ops.surface import closest_points, face_normals

EMD_LIMIT = 4096

# (mesh, queries (m, 3)) -> closest points (m, 3), distances (m,), faces (m,)
ClosestPoints = Callable[[Mesh, np.ndarray], tuple[np.ndarray, np.ndarray, np.ndarray]]


class NormalErrors(NamedTuple):
    """Angles between predicted and true normals, one value a cloud.

    signed_deg: mean angle, 0..180 degrees. unsigned_deg: mean angle between the lines, 0..90 degrees.
    flipped: share of the normals that point to the wrong side (angle above 90 degrees), 0..1.
    """

    signed_deg: Tensor
    unsigned_deg: Tensor
    flipped: Tensor


def chamfer_sq(prediction: Tensor | ArrayLike, target: Tensor | ArrayLike) -> Tensor:
    """Chamfer distance: mean squared nearest distances to the target and back, added.

    Eq. 1 of the paper with means instead of sums (as in its released code); Fan et al. 2017. Unit: length squared.

    >>> float(chamfer_sq([[0.0, 0, 0], [1, 0, 0]], [[0.0, 0, 0]]))
    0.5
    """
    a, b, one = _pair(prediction, target)
    forth, back = _both_ways(a, b)
    return _squeeze(forth.dist_sq.mean(1) + back.dist_sq.mean(1), one)


def hausdorff_sq(prediction: Tensor | ArrayLike, target: Tensor | ArrayLike) -> Tensor:
    """Squared Hausdorff distance: the larger of the two maxima of squared nearest distances. Unit: length squared.

    >>> float(hausdorff_sq([[0.0, 0, 0], [2, 0, 0]], [[0.0, 0, 0]]))
    4.0
    """
    a, b, one = _pair(prediction, target)
    forth, back = _both_ways(a, b)
    return _squeeze(torch.maximum(forth.dist_sq.amax(1), back.dist_sq.amax(1)), one)


def hausdorff(prediction: Tensor | ArrayLike, target: Tensor | ArrayLike) -> Tensor:
    """Hausdorff distance, the root of `hausdorff_sq`. Unit: length.

    >>> float(hausdorff([[0.0, 0, 0], [2, 0, 0]], [[0.0, 0, 0]]))
    2.0
    """
    return hausdorff_sq(prediction, target).sqrt()


def point_to_mesh(points: Tensor | ArrayLike, mesh: Mesh) -> Tensor:
    """P2F: mean distance of the points to the surface of a triangle mesh, exact. Unit: length.

    >>> triangle = Mesh(np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]]), np.array([[0, 1, 2]]))
    >>> float(point_to_mesh([[0.25, 0.25, 0.5], [0.25, 0.25, -1.5]], triangle))
    1.0
    """
    return compare_mesh(points, mesh)["p2f"]


def normal_error(prediction: Tensor | ArrayLike, truth: Mesh | Tensor | ArrayLike) -> NormalErrors:
    """Angle between each predicted normal and the true surface's normal at the closest point of the surface.

    truth is a mesh (the normal of the closest face), or a cloud (m, 6) (the normal of the nearest point, for want of a
    mesh). Normals need not have unit length; one of length zero counts as 90 degrees off, not flipped.

    >>> error = normal_error([[0.0, 0, 0, 0, 0, 2], [1, 0, 0, 0, 0, -1]], [[0.0, 0, 0, 0, 0, 1]])
    >>> float(error.signed_deg), float(error.unsigned_deg), float(error.flipped)
    (90.0, 0.0, 0.5)
    """
    cloud, one = _clouds(prediction, "prediction", columns=6)
    if isinstance(truth, Mesh):
        found = compare_mesh(prediction, truth)
        return NormalErrors(found["normal_deg"], found["normal_unsigned_deg"], found["flipped"])
    target = _expand(_clouds(truth, "truth", columns=6)[0].to(cloud), cloud)
    reference = _take(target[..., 3:6], nearest(cloud[..., :3], target[..., :3]).idx)
    return NormalErrors(*(_squeeze(value, one) for value in _angles(cloud[..., 3:6], reference)))


def spacing_cv(points: Tensor | ArrayLike) -> Tensor:
    """Evenness of the spacing: standard deviation over mean of the distance to the nearest other point.

    0 on a lattice, about 0.2 for Poisson-disk samples, 0.52 for random samples of a surface. No unit. Needs two points.

    >>> float(spacing_cv([[0.0, 0, 0], [1, 0, 0], [2, 0, 0]]))
    0.0
    """
    cloud, one = _clouds(points, "points")
    if cloud.shape[1] < 2:
        raise ValueError("points: expected at least 2 points for a spacing, found 1")
    spacing = knn(cloud[..., :3], cloud[..., :3], 2).dist_sq[..., 1].sqrt()
    return _squeeze(spacing.std(1, correction=0) / spacing.mean(1), one)


def uniformity(
    points: Tensor | ArrayLike, truth: Tensor | ArrayLike, *, share: float = 0.01, disks: int = 1000
) -> Tensor:
    """Evenness of the density: spread over disks of equal area of (points in the disk) / (points expected there).

    The normalised uniformity coefficient of PU-Net (Yu et al. 2018, section 4.2) for one share p of the surface: the
    standard deviation over the disks of n_i / (n p). A disk is the ball around a truth point that holds the share p of
    the truth (a dense uniform sampling of the surface; p is its share in the ball, ties at the rim included). It stands
    in for PU-Net's geodesic disk and has equal area by construction, also where the surface is curved or thin.
    0 is perfect; no unit. `spacing_cv` sees the distances between neighbours, this one larger clusters and holes.

    >>> line = np.stack([np.arange(100.0), np.zeros(100), np.zeros(100)], axis=1)
    >>> float(uniformity(line, line, share=0.1)), float(uniformity(line[:50], line, share=0.1)) > 0.5
    (0.0, True)
    """
    if not 0 < share < 1:
        raise ValueError(f"share: expected a share of the surface between 0 and 1, found {share}")
    a, b, one = _pair(points, truth)
    k = round(share * b.shape[1])
    if k < 2:
        raise ValueError(f"truth: expected at least {int(np.ceil(1.5 / share))} points, found {b.shape[1]}")
    values = []
    for cloud, surface in zip(_numpy(a), _numpy(b), strict=True):
        centers = surface[np.linspace(0, len(surface) - 1, min(disks, len(surface))).astype(int)]
        radius = cKDTree(surface).query(centers, k=[k])[0][:, 0]
        radius = radius * (1 + 1e-9)  # rounding must not drop the point on the rim
        found, expected = (cKDTree(c).query_ball_point(centers, radius, return_length=True) for c in (cloud, surface))
        values.append(np.std((found / len(cloud)) / (expected / len(surface))))
    return _squeeze(a.new_tensor(values), one)


def emd_exact(prediction: Tensor | ArrayLike, target: Tensor | ArrayLike) -> Tensor:
    """Earth mover's distance: mean distance between partners in the best one-to-one assignment. Unit: length.

    Eq. 2 of the paper with the mean instead of the sum; distances are not squared. Exact (Jonker-Volgenant), cubic
    time: 1024 points take a fraction of a second, 4096, the most that is accepted, several. Equal sizes only.

    >>> float(emd_exact([[0.0, 0, 0], [1, 0, 0]], [[1.0, 0, 0], [0, 0, 3]]))
    1.5
    """
    a, b, one = _pair(prediction, target)
    if a.shape[1] != b.shape[1]:
        raise ValueError(f"prediction, target: expected equally many points, found {a.shape[1]} and {b.shape[1]}")
    if a.shape[1] > EMD_LIMIT:
        raise ValueError(f"prediction: expected at most {EMD_LIMIT} points for the exact EMD, found {a.shape[1]}")
    values = []
    for x, y in zip(_numpy(a), _numpy(b), strict=True):
        cost = np.linalg.norm(x[:, None] - y[None], axis=-1)
        values.append(cost[linear_sum_assignment(cost)].mean())
    return _squeeze(a.new_tensor(values), one)


def compare(prediction: Tensor | ArrayLike, target: Tensor | ArrayLike) -> dict[str, Tensor]:
    """All metrics of two clouds that one search in each direction and one for the spacing can give.

    Returns `chamfer_sq`, `hausdorff_sq`, `spacing_cv`, and where both clouds have normals `normal_deg`,
    `normal_unsigned_deg` and `flipped`, against the normal of the nearest target point.

    >>> sorted(compare(np.eye(3), np.eye(3)))
    ['chamfer_sq', 'hausdorff_sq', 'spacing_cv']
    """
    a, b, one = _pair(prediction, target)
    forth, back = _both_ways(a, b)
    result = {
        "chamfer_sq": forth.dist_sq.mean(1) + back.dist_sq.mean(1),
        "hausdorff_sq": torch.maximum(forth.dist_sq.amax(1), back.dist_sq.amax(1)),
        "spacing_cv": spacing_cv(a),
    }
    if a.shape[2] >= 6 and b.shape[2] >= 6:
        error = _angles(a[..., 3:6], _take(b[..., 3:6], forth.idx))
        result |= {"normal_deg": error[0], "normal_unsigned_deg": error[1], "flipped": error[2]}
    return {name: _squeeze(value, one) for name, value in result.items()}


def compare_mesh(
    prediction: Tensor | ArrayLike, mesh: Mesh, *, closest: ClosestPoints = closest_points
) -> dict[str, Tensor]:
    """All metrics of a cloud against a mesh that one search for the closest points of its surface can give.

    Returns `p2f`, and where the cloud has normals `normal_deg`, `normal_unsigned_deg` and `flipped`, against the normal
    of the closest face. Where several faces share the closest point (a point outside a sharp edge), the search chooses
    which of them counts: `closest` exchanges the search; `raycast.closest_points` is the one that public scripts use.

    >>> sorted(compare_mesh(np.eye(3), Mesh(np.eye(3), np.array([[0, 1, 2]]))))
    ['p2f']
    """
    cloud, one = _clouds(prediction, "prediction")
    found = [closest(mesh, c) for c in _numpy(cloud)]
    result = {"p2f": cloud.new_tensor([distance.mean() for _, distance, _ in found])}
    if cloud.shape[2] >= 6:
        normals = face_normals(mesh)
        reference = torch.as_tensor(np.stack([normals[face] for _, _, face in found])).to(cloud)
        error = _angles(cloud[..., 3:6], reference)
        result |= {"normal_deg": error[0], "normal_unsigned_deg": error[1], "flipped": error[2]}
    return {name: _squeeze(value, one) for name, value in result.items()}


def mean_update(values: Tensor) -> tuple[Tensor, Tensor]:
    """Sum and count of one value a cloud; add them over batches and processes.

    >>> [float(x) for x in mean_update(torch.tensor([1.0, 2.0]))]
    [3.0, 2.0]
    """
    return values.sum(0), torch.tensor(float(values.shape[0]), device=values.device)


def mean_compute(total: Tensor, count: Tensor) -> Tensor:
    """Mean over all clouds that were counted; NaN if there was none, never 0.

    >>> float(mean_compute(torch.tensor(3.0), torch.tensor(2.0)))
    1.5
    """
    return torch.where(count > 0, total / count, torch.nan)


def _clouds(values: Tensor | ArrayLike, name: str, columns: int = 3) -> tuple[Tensor, bool]:
    """A checked (B, n, >= columns) floating tensor, and whether a single (n, C) cloud was given."""
    cloud = values.detach() if isinstance(values, Tensor) else torch.as_tensor(np.asarray(values))
    cloud = cloud if cloud.dtype == torch.float64 else cloud.float()
    if cloud.ndim not in (2, 3) or cloud.shape[-1] < columns:
        raise ValueError(
            f"{name}: expected (n, {columns}) or (B, n, {columns}) with at least {columns} columns,"
            f" found {tuple(cloud.shape)}"
        )
    if cloud.numel() == 0:
        raise ValueError(f"{name}: expected at least one point, found an empty cloud {tuple(cloud.shape)}")
    bad = int((~torch.isfinite(cloud)).sum())
    if bad:
        raise ValueError(f"{name}: expected finite numbers, found {bad} NaN or infinite values")
    return (cloud[None], True) if cloud.ndim == 2 else (cloud, False)


def _pair(prediction: Tensor | ArrayLike, target: Tensor | ArrayLike) -> tuple[Tensor, Tensor, bool]:
    a, one_a = _clouds(prediction, "prediction")
    b, one_b = _clouds(target, "target")
    dtype = torch.promote_types(a.dtype, b.dtype)
    a, b = a.to(dtype), b.to(a.device, dtype)
    return a, _expand(b, a), one_a and one_b


def _expand(target: Tensor, prediction: Tensor) -> Tensor:
    """One target may serve every cloud of a batch; otherwise the batches must be equal."""
    if target.shape[0] not in (1, prediction.shape[0]):
        raise ValueError(f"target: expected a batch of {prediction.shape[0]} clouds, found {target.shape[0]}")
    return target.expand(prediction.shape[0], -1, -1)


def _both_ways(a: Tensor, b: Tensor) -> tuple[Neighbors, Neighbors]:
    a, b = a[..., :3].contiguous(), b[..., :3].contiguous()
    return nearest(a, b), nearest(b, a)


def _take(values: Tensor, idx: Tensor) -> Tensor:
    """values (B, m, 3) at idx (B, n) -> (B, n, 3)."""
    return values.gather(1, idx[..., None].expand(-1, -1, values.shape[-1]))


def _angles(normals: Tensor, reference: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Mean signed and unsigned angle in degrees and share flipped, over the points of (B, n, 3)."""
    # atan2 keeps small angles exact, where the arc cosine loses half of the digits.
    cosine, sine = (normals * reference).sum(-1), torch.linalg.cross(normals, reference).norm(dim=-1)
    known = (cosine != 0) | (sine != 0)
    signed = torch.where(known, torch.atan2(sine, cosine).rad2deg(), 90.0)
    return signed.mean(1), torch.minimum(signed, 180 - signed).mean(1), (cosine < 0).to(signed).mean(1)


def _numpy(cloud: Tensor) -> np.ndarray:
    return cloud[..., :3].double().cpu().numpy()


def _squeeze(values: Tensor, one: bool) -> Tensor:
    return values[0] if one else values

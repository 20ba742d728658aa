"""Metrics of one cloud or of a batch of clouds against the truth.

Every function takes clouds as `(n, C)` or `(B, n, C)` tensors or arrays, C = 3 or 6 (points, then normals), and returns
one value a cloud: a 0-d tensor, or `(B,)`. The two clouds may differ in size. Lengths are in the clouds' own unit and
nothing is multiplied by 1000; clouds that are compared with published numbers belong in the truth's unit sphere.
An empty cloud, NaN or infinity is a `ValueError`: a failed computation never gives a good-looking number.

A metric over a data set is the mean over clouds: `mean_update` adds sums and counts, `mean_compute` divides them.
"""

import functools
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import ArrayLike
from scipy.optimize import linear_sum_assignment
from torch import Tensor

from pnu.geometry.kd_tree import kd_tree
from pnu.geometry.mesh_sampling import closest_points, face_normals
from pnu.geometry.neighbor_search import Neighbors, knn, nearest
from pnu.io import Mesh

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


class Pair:
    """A prediction and the truth; each search is made once, when a metric first asks for it.

    Args:
        prediction: (n, C) or (B, n, C).
        target: points of the truth, (m, C), (1, m, C) or (B, m, C), or None.
        mesh: of the truth, or None; its normals count, not those of the nearest target point.
        closest: search for the closest points of the mesh.
        unit: length of the clouds' unit in that of the file that the mesh came from.
    """

    def __init__(
        self,
        prediction: Tensor | ArrayLike,
        target: Tensor | ArrayLike | None = None,
        mesh: Mesh | None = None,
        *,
        closest: ClosestPoints = closest_points,
        unit: float = 1.0,
    ) -> None:
        self.target: Tensor | None = None
        if target is None:
            self.prediction, self.one = _clouds(prediction, "prediction")
        else:
            self.prediction, self.target, self.one = _pair(prediction, target)
        self.mesh, self.closest, self.unit = mesh, closest, unit
        self.each: Pair | None = None  # both clouds in unit spheres of their own, once something asked for them

    @property
    def has(self) -> set[str]:
        """What metrics may need: "target", "mesh", "normals" of both."""
        true = self.mesh is not None or (self.target is not None and self.target.shape[2] >= 6)
        found = {"target": self.target is not None, "mesh": self.mesh is not None}
        found["normals"] = true and self.prediction.shape[2] >= 6
        return {name for name, there in found.items() if there}

    def result(self, values: Tensor) -> Tensor:
        """values (B,) as they are, or the one value of a single cloud."""
        return _squeeze(values, self.one)

    @functools.cached_property
    def forth(self) -> Neighbors:
        """The nearest target point of each predicted one."""
        return self._nearest(self.prediction, self.target)

    @functools.cached_property
    def back(self) -> Neighbors:
        """The nearest predicted point of each target point."""
        return self._nearest(self.target, self.prediction)

    @staticmethod
    def _nearest(queries: Tensor | None, targets: Tensor | None) -> Neighbors:
        if queries is None or targets is None:
            raise ValueError("target: expected points of the truth, found none")
        return nearest(queries[..., :3].contiguous(), targets[..., :3].contiguous())

    @functools.cached_property
    def on_mesh(self) -> tuple[np.ndarray, Tensor]:
        """Distance (B, n) of the predicted points to the mesh, and the normals (B, n, 3) of the closest faces."""
        if self.mesh is None:
            raise ValueError("mesh: expected the true mesh, found none")
        found = [self.closest(self.mesh, cloud) for cloud in _numpy(self.prediction)]
        normals = face_normals(self.mesh)[np.stack([face for _, _, face in found])]
        return np.stack([distance for _, distance, _ in found]), torch.as_tensor(normals).to(self.prediction)

    @functools.cached_property
    def angles(self) -> NormalErrors:
        """Errors of the predicted normals, (B,) each."""
        if "normals" not in self.has:
            raise ValueError("normals: expected those of the prediction and of the truth, found only one or none")
        if self.mesh is not None:
            reference = self.on_mesh[1]
        else:
            assert self.target is not None
            reference = _take(self.target[..., 3:6], self.forth.idx)
        return NormalErrors(*_angles(self.prediction[..., 3:6], reference))


def chamfer_sq(prediction: Tensor | ArrayLike | Pair, target: Tensor | ArrayLike | None = None) -> Tensor:
    """Chamfer distance: mean squared nearest distances to the target and back, added. A `Pair` stands for both.

    Eq. 1 of the paper with means instead of sums (as in its released code); Fan et al. 2017. Unit: length squared.

    >>> float(chamfer_sq([[0.0, 0, 0], [1, 0, 0]], [[0.0, 0, 0]]))
    0.5
    """
    pair = _as_pair(prediction, target)
    return pair.result(pair.forth.dist_sq.mean(1) + pair.back.dist_sq.mean(1))


def hausdorff_sq(prediction: Tensor | ArrayLike | Pair, target: Tensor | ArrayLike | None = None) -> Tensor:
    """Squared Hausdorff distance: the larger of the two maxima of squared nearest distances. Unit: length squared.

    >>> float(hausdorff_sq([[0.0, 0, 0], [2, 0, 0]], [[0.0, 0, 0]]))
    4.0
    """
    pair = _as_pair(prediction, target)
    return pair.result(torch.maximum(pair.forth.dist_sq.amax(1), pair.back.dist_sq.amax(1)))


def hausdorff(prediction: Tensor | ArrayLike | Pair, target: Tensor | ArrayLike | None = None) -> Tensor:
    """Hausdorff distance, the root of `hausdorff_sq`. Unit: length.

    >>> float(hausdorff([[0.0, 0, 0], [2, 0, 0]], [[0.0, 0, 0]]))
    2.0
    """
    return hausdorff_sq(prediction, target).sqrt()


def point_to_mesh(points: Tensor | ArrayLike | Pair, mesh: Mesh | None = None) -> Tensor:
    """P2F: mean distance of the points to the surface of a triangle mesh, exact. Unit: length.

    >>> triangle = Mesh(np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]]), np.array([[0, 1, 2]]))
    >>> float(point_to_mesh([[0.25, 0.25, 0.5], [0.25, 0.25, -1.5]], triangle))
    1.0
    """
    pair = points if isinstance(points, Pair) else Pair(points, mesh=mesh)
    return pair.result(pair.prediction.new_tensor(pair.on_mesh[0].mean(1)))


def normal_error(prediction: Tensor | ArrayLike | Pair, truth: Mesh | Tensor | ArrayLike | None = None) -> NormalErrors:
    """Angle between each predicted normal and the true surface's normal at the closest point of the surface.

    truth is a mesh (the normal of the closest face), or a cloud (m, 6) (the normal of the nearest point, for want of a
    mesh). Normals need not have unit length; one of length zero counts as 90 degrees off, not flipped.

    >>> error = normal_error([[0.0, 0, 0, 0, 0, 2], [1, 0, 0, 0, 0, -1]], [[0.0, 0, 0, 0, 0, 1]])
    >>> float(error.signed_deg), float(error.unsigned_deg), float(error.flipped)
    (90.0, 0.0, 0.5)
    """
    if not isinstance(prediction, Pair):
        _clouds(prediction, "prediction", columns=6)
        if truth is None:
            raise ValueError("truth: expected a mesh, or a cloud with normals, found none")
        if not isinstance(truth, Mesh):
            _clouds(truth, "truth", columns=6)
        prediction = Pair(prediction, mesh=truth) if isinstance(truth, Mesh) else Pair(prediction, truth)
    return NormalErrors(*(prediction.result(value) for value in prediction.angles))


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

    The normalized uniformity coefficient of PU-Net (Yu et al. 2018, section 4.2) for one share p of the surface: the
    standard deviation over the disks of n_i / (n p). A disk is the ball around a truth point that holds the share p of
    the truth (a dense uniform sampling of the surface; p is its share in the ball, ties at the rim included). It stands
    in for PU-Net's geodesic disk and has equal area by construction, also where the surface is curved or thin.
    0 is perfect; no unit. `spacing_cv` sees the distances between neighbors, this one larger clusters and holes.

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
        radius = kd_tree(surface).query(centers, k=[k])[0][:, 0]
        radius = radius * (1 + 1e-9)  # rounding must not drop the point on the rim
        found, expected = (kd_tree(c).query_ball_point(centers, radius, return_length=True) for c in (cloud, surface))
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


def _as_pair(prediction: Tensor | ArrayLike | Pair, target: Tensor | ArrayLike | None) -> Pair:
    return prediction if isinstance(prediction, Pair) else Pair(prediction, target)


def mean_update(values: Tensor) -> tuple[Tensor, Tensor]:
    """Sum and count of one value a cloud; add them over batches and processes.

    >>> tuple(float(x) for x in mean_update(torch.tensor([1.0, 2.0])))
    (3.0, 2.0)
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

"""Edge-aware resampling: away from the edges first, then point by point towards them."""

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor

from pnu.geometry.kd_tree import kd_tree
from pnu.geometry.noise_level import noise_level
from pnu.geometry.pair_weights import Within, theta, within
from pnu.geometry.spacing import spacing
from pnu.upsamplers.context import Context

GROWTH = 3  # one point in so many wants a new one more than all the others do, in one round
TURNS, NOISY = 2, 0.15  # turns where noise is more than this share of the spacing
OPPOSED = -0.7  # cosine below which two points are on the two sides of a sheet, and nothing is between them


class EAR:
    """Bilateral normals, resampling that keeps off the edges, and insertion that leads up to them.

    Huang, Wu, Gong, Cohen-Or, Ascher and Zhang 2013, "Edge-aware point set resampling". Nothing is random.

    Args:
        angle: sigma_n, degrees between normals from which on a neighbor counts little.
        sensitivity: rho, how much more often points are inserted where normals differ; 0: for density alone.
        radius: h, reach of all weights, in spacings of the cloud.
        turns: of the smoothing of normals and of the resampling; 0: the input's points stay where they are; None: 2
            where the cloud shows noise, else 0.
    """

    def __init__(
        self, angle: float = 25.0, sensitivity: float = 0.0, radius: float = 4.0, turns: int | None = None
    ) -> None:
        if not 0 < angle < 90:
            raise ValueError(f"angle={angle}: expected degrees between 0 and 90")
        if not 0 <= sensitivity <= 10:
            raise ValueError(f"sensitivity={sensitivity}: expected a number from 0 to 10")
        if not 0 < radius < float("inf"):
            raise ValueError(f"radius={radius}: expected a number of spacings > 0")
        if turns is not None and turns < 0:
            raise ValueError(f"turns={turns}: expected at least 0")
        self.angle, self.sensitivity, self.radius, self.turns = angle, sensitivity, radius, turns

    def upsample_cloud(self, cloud: Tensor, count: int, context: Context) -> Tensor:
        """cloud (n, 6) -> (count, 6): n resampled points, then the inserted ones in their order."""
        array = cloud.cpu().double().numpy()
        points, normals = array[:, :3], array[:, 3:]
        apart = spacing(points)
        radius, turns = self.radius * apart, self.turns
        if turns is None:
            turns = TURNS if noise_level(points, normals) > NOISY * apart else 0
        for turn in range(turns):
            context.progress("bilateral normals", turn, turns)
            normals = bilateral_normals(points, normals, radius, self.angle)
        moved = points
        for turn in range(turns):
            context.progress("resampling away from edges", turn, turns)
            moved = resampled(moved, normals, points, radius, first=turn == 0)
            normals = bilateral_normals(moved, normals, radius, self.angle)
        context.progress("resampling away from edges", 1, 1)
        while len(moved) < count:
            context.progress("insertion", len(moved), count)
            moved, normals = inserted(moved, normals, count, radius, self.angle, self.sensitivity)
        context.progress("insertion", count, count)
        return torch.from_numpy(np.hstack([moved, normals]))


def psi(cosine: np.ndarray, angle: float) -> np.ndarray:
    """Weight of a normal beside another, exp(-((1 - n.n') / (1 - cos sigma_n))^2), of their cosine."""
    weight: np.ndarray = np.exp(-(((1 - cosine) / (1 - np.cos(np.radians(angle)))) ** 2))
    return weight


def bilateral_normals(points: np.ndarray, normals: np.ndarray, radius: float, angle: float) -> np.ndarray:
    """Each normal (n, 3) the mean of those near in place and direction, weighted by theta and psi."""
    pairs = within(points, points, radius)
    cosine = (normals[pairs.i] * normals[pairs.j]).sum(1)
    mean, _ = pairs.mean(theta(pairs.dist, radius) * psi(cosine, angle), normals)
    return unit(mean, normals)


def resampled(
    moved: np.ndarray, normals: np.ndarray, points: np.ndarray, radius: float, mu: float = 0.4, *, first: bool = False
) -> np.ndarray:
    """One turn of LOP whose attraction fades along the normal: moved, normals (m, 3), points (n, 3) -> (m, 3).

    A point beside an edge is drawn by its own side alone, hence away from the edge: weights theta / r
    phi, phi = exp(-(n.(x - p))^2 / sigma_p^2), with sigma_p a quarter of the radius. Points repel each other within
    their tangent planes, ours: the normals are known, and across them it would only undo the denoising. The first turn
    is without 1 / r, which holds a point where another is.
    """
    pairs = within(moved, points, radius)
    height = (normals[pairs.i] * (moved[pairs.i] - points[pairs.j])).sum(1)
    weight = theta(pairs.dist, radius) * np.exp(-((4 * height / radius) ** 2))
    mean, found = pairs.mean(weight if first else weight / pairs.dist, points)
    others = within(moved, moved, radius, itself=False)
    away, pushed = others.mean(theta(others.dist, radius) / others.dist, moved)
    push = np.where(pushed[:, None], moved - away, 0)
    push = push - (push * normals).sum(1, keepdims=True) * normals
    new: np.ndarray = np.where(found[:, None], mean, moved) + mu * push
    return new


def inserted(
    points: np.ndarray, normals: np.ndarray, count: int, radius: float, angle: float, sensitivity: float
) -> tuple[np.ndarray, np.ndarray]:
    """Points and normals (n, 3) with new ones at the places that want one most, at most `count` in all.

    Places are the midpoints of neighbors. The paper inserts the one of greatest priority and looks again; here one
    round fills those of the greatest that lie apart from each other.
    """
    tree = kd_tree(points)
    ends = neighbor_pairs(tree)
    facing = (normals[ends[:, 0]] * normals[ends[:, 1]]).sum(1) > OPPOSED
    ends = ends[facing] if facing.any() else ends
    base = points[ends].mean(1)
    priority, clearance = priorities(tree, normals, ends, base, sensitivity)
    order = np.argsort(-priority, kind="stable")[: len(points)]
    chosen = apart_in_order(base[order], clearance[order])
    chosen = order[chosen][: min(count - len(points), -(-len(points) // GROWTH))]
    new, directions = projected(tree, normals, base[chosen], ends[chosen], radius, angle)
    return np.vstack([points, new]), np.vstack([normals, directions])


def neighbor_pairs(tree: cKDTree, k: int = 24) -> np.ndarray:
    """Each two of which one is among the k nearest of the other, once, (e, 2): enough to reach over the gaps of random
    points."""
    near = tree.query(tree.data, k=min(k + 1, tree.n))[1]
    here, there = np.repeat(np.arange(tree.n), near.shape[1]), near.ravel()
    numbers = np.unique((np.minimum(here, there) * tree.n + np.maximum(here, there))[here != there])
    return np.stack(np.divmod(numbers, tree.n), 1)


def priorities(
    tree: cKDTree, normals: np.ndarray, ends: np.ndarray, base: np.ndarray, sensitivity: float, k: int = 8
) -> tuple[np.ndarray, np.ndarray]:
    """How much places (e, 3) want a point, and their clearance, (e,) each.

    The clearance is the least distance from a place to the lines through points along their normals; the priority is
    (2 - n_i.n_j)^rho times it, for the place's two ends i and j.
    """
    near = tree.query(base, k=min(k, tree.n))[1]
    offset = base[:, None] - tree.data[near]
    along = (offset * normals[near]).sum(2, keepdims=True)
    clearance: np.ndarray = np.linalg.norm(offset - along * normals[near], axis=2).min(1)
    cosine = (normals[ends[:, 0]] * normals[ends[:, 1]]).sum(1)
    priority: np.ndarray = (2 - cosine) ** sensitivity * clearance
    return priority, clearance


def apart_in_order(places: np.ndarray, clearance: np.ndarray) -> np.ndarray:
    """Indices of places (e, 3), best first, none of which is nearer to a better one than its clearance."""
    pairs: Within = within(places, places, float(clearance.max()), itself=False)
    worse = (pairs.j < pairs.i) & (pairs.dist < clearance[pairs.i])
    beaten = np.zeros(len(places), bool)
    beaten[pairs.i[worse]] = True
    return np.flatnonzero(~beaten)


def projected(
    tree: cKDTree, normals: np.ndarray, base: np.ndarray, ends: np.ndarray, radius: float, angle: float, k: int = 24
) -> tuple[np.ndarray, np.ndarray]:
    """Places (e, 3) moved along a normal to where the points of its side lie; with that normal.

    The normal is that of the end which explains its neighbors better: the least mean of theta psi (n.(b - s))^2. The
    way along it is the mean of n.(b - s) by the same weights.
    """
    dist, near = tree.query(base, k=min(k, tree.n))
    offset = base[:, None] - tree.data[near]
    places, directions, misfits = [], [], []
    for end in ends.T:
        normal = normals[end]
        cosine = np.einsum("ed,ekd->ek", normal, normals[near])
        weight = theta(dist, radius) * psi(cosine, angle) + 1e-300
        height = np.einsum("ed,ekd->ek", normal, offset)
        total = weight.sum(1)
        misfits.append((weight * height**2).sum(1) / total)
        places.append(base - ((weight * height).sum(1) / total)[:, None] * normal)
        directions.append(unit(np.einsum("ek,ekd->ed", weight, normals[near]), normal))
    second = misfits[1] < misfits[0]
    return np.where(second[:, None], places[1], places[0]), np.where(second[:, None], directions[1], directions[0])


def unit(vectors: np.ndarray, otherwise: np.ndarray) -> np.ndarray:
    """Vectors (n, 3) of length 1; where they have none, the others."""
    length = np.linalg.norm(vectors, axis=1, keepdims=True)
    return np.where(length > 1e-9, vectors / np.maximum(length, 1e-9), otherwise)

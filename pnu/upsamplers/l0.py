"""Denoising by L0 minimization: normals, then points, that differ from few of their neighbors."""

import numpy as np
import torch
from scipy.sparse import csr_matrix, identity
from scipy.sparse.linalg import splu
from torch import Tensor

from pnu.geometry.kd_tree import kd_tree
from pnu.geometry.spacing import spacing
from pnu.upsamplers.context import Context
from pnu.upsamplers.ear import unit
from pnu.upsamplers.midpoints import Midpoint

STEP = 2.0  # by which beta grows
LAST = 1e3  # beta where it ends


class L0:
    """Piecewise smooth normals and points by L0 minimization; midpoints for a ratio.

    Sun, Schaefer and Wang 2015, "Denoising point sets via L0 minimization": as few pairs of neighbors as possible have
    different normals, then as few as possible lie off each other's plane, each point moving along its normal. Their
    last step, which moves points onto sharp edges, is left out. It denoises and adds no points: with a ratio above 1
    `Midpoint` fills between the denoised ones.

    Args:
        neighbors: of a point.
        normal_weight: lambda of the normals; larger ones flatten more.
        point_weight: lambda of the points, in squared spacings.
    """

    def __init__(self, neighbors: int = 10, normal_weight: float = 0.02, point_weight: float = 0.05) -> None:
        if neighbors < 1:
            raise ValueError(f"neighbors={neighbors}: expected at least 1")
        for name, value in (("normal_weight", normal_weight), ("point_weight", point_weight)):
            if not 0 < value < float("inf"):
                raise ValueError(f"{name}={value}: expected a number > 0")
        self.neighbors, self.normal_weight, self.point_weight = neighbors, normal_weight, point_weight

    def upsample_cloud(self, cloud: Tensor, count: int, context: Context) -> Tensor:
        """cloud (n, 6) -> (count, 6): n denoised points, and midpoints between them; nothing is random."""
        array = cloud.cpu().double().numpy()
        edges = directed_edges(array[:, :3], self.neighbors)
        context.progress("L0 normals", 0, 1)
        normals = l0_normals(array[:, 3:], edges, self.normal_weight)
        context.progress("L0 normals", 1, 1)
        context.progress("L0 points", 0, 1)
        points = l0_points(array[:, :3], normals, edges, self.point_weight * spacing(array) ** 2)
        context.progress("L0 points", 1, 1)
        denoised = torch.from_numpy(np.hstack([points, normals]))
        return denoised if count == len(denoised) else Midpoint().upsample_cloud(denoised, count, context)


def directed_edges(points: np.ndarray, k: int) -> np.ndarray:
    """(e, 2): each point and each of its k nearest others."""
    near = kd_tree(points).query(points, k=min(k + 1, len(points)))[1]
    edges = np.stack([np.repeat(np.arange(len(points)), near.shape[1]), near.ravel()], 1)
    found: np.ndarray = edges[edges[:, 0] != edges[:, 1]]
    return found


def l0_minimum(given: np.ndarray, difference: csr_matrix, offset: np.ndarray, weight: float) -> np.ndarray:
    """x (n, d) of about least |x - given|^2 + weight |D x + c|_0, where rows of D x + c (e, d) count if not zero.

    By half-quadratic splitting: differences are set to zero where their square is below
    weight / beta, x solves (I + beta D'D) x = given + beta D'(delta - c), beta doubles.
    """
    x, beta = given, 2 * weight
    square = (difference.T @ difference).tocsc()
    while beta < LAST:
        delta = difference @ x + offset
        delta[(delta**2).sum(1) < weight / beta] = 0
        solver = splu(identity(len(given), format="csc") + beta * square)
        x = solver.solve(given + beta * (difference.T @ (delta - offset)))
        beta *= STEP
    return x


def l0_normals(normals: np.ndarray, edges: np.ndarray, weight: float) -> np.ndarray:
    """Unit normals (n, 3) of which few neighbors, edges (e, 2), differ."""
    difference = edge_matrix(edges, len(normals), np.ones(len(edges)))
    found = l0_minimum(normals, difference, np.zeros((len(edges), 3)), weight)
    return unit(found, normals)


def l0_points(points: np.ndarray, normals: np.ndarray, edges: np.ndarray, weight: float) -> np.ndarray:
    """Points (n, 3) moved along their normals so that few neighbors lie off each other's plane.

    The height of neighbor j over the plane of i is n_i.(p_i + a_i n_i - p_j - a_j n_j).
    """
    i, j = edges.T
    cosine = (normals[i] * normals[j]).sum(1)
    height = (normals[i] * (points[i] - points[j])).sum(1, keepdims=True)
    length = np.sqrt(weight)  # in units in which the weight is 1 / 20, as LAST is made for
    scaled = height / length * np.sqrt(0.05)
    way = l0_minimum(np.zeros((len(points), 1)), edge_matrix(edges, len(points), cosine), scaled, 0.05)
    moved: np.ndarray = points + way / np.sqrt(0.05) * length * normals
    return moved


def edge_matrix(edges: np.ndarray, n: int, second: np.ndarray) -> csr_matrix:
    """The matrix (e, n) with x_i - second x_j for each edge."""
    rows = np.arange(len(edges)).repeat(2)
    return csr_matrix((np.stack([np.ones(len(edges)), -second], 1).ravel(), (rows, edges.ravel())), (len(edges), n))

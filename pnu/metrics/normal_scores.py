"""Scores of normals as a task of its own, as PCPNet's benchmark has them."""

import numpy as np


def angles_deg(normals: np.ndarray, true: np.ndarray, *, oriented: bool) -> np.ndarray:
    """Angles of normals (n, 3) to the true ones, in degrees (n,): 0 to 180, or between the lines, 0 to 90.

    Normals need not have unit length; one of length zero, or NaN, is 90 degrees off.
    """
    cosine = (normals * true).sum(1)
    sine = np.linalg.norm(np.cross(normals, true), axis=1)  # exact for small angles, where the arc cosine is not
    angle = np.degrees(np.arctan2(sine, cosine if oriented else np.abs(cosine)))
    known = np.isfinite(angle) & ((cosine != 0) | (sine != 0))
    return np.where(known, angle, 90.0)


def rms_deg(angles: np.ndarray) -> float:
    """Root mean square of angles (n,) in degrees.

    >>> rms_deg(np.array([0.0, 2.0, 2.0, 4.0]))
    2.449489742783178
    """
    return float(np.sqrt(np.mean(np.square(angles))))


def good_share(angles: np.ndarray, limit_deg: float) -> float:
    """Share of points whose angle (n,) is below a limit: PGP5 and PGP10 are those of 5 and of 10 degrees.

    >>> good_share(np.array([1.0, 4.0, 7.0, 30.0]), 5)
    0.5
    """
    return float(np.mean(angles < limit_deg))


def normal_scores(normals: np.ndarray, true: np.ndarray) -> dict[str, float]:
    """RMS in degrees, PGP5, PGP10 without signs, the same with them, and the share flipped, of normals (n, 3)."""
    found: dict[str, float] = {}
    for name, oriented in (("unoriented", False), ("oriented", True)):
        angles = angles_deg(normals, true, oriented=oriented)
        found |= {f"{name}_rms_deg": rms_deg(angles)}
        found |= {f"{name}_pgp{limit}": good_share(angles, limit) for limit in (5, 10)}
    return {**found, "flipped": float(np.mean((normals * true).sum(1) < 0))}

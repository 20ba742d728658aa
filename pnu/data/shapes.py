"""The procedural shapes that come with pnu: closed meshes from fixed parameters, of two kinds."""

import numpy as np

from pnu.data import cad, organic
from pnu.io import Mesh

VERSION = 2  # of the shapes: a file of patches made from others is not used
KINDS = {"organic": organic.SHAPES, "cad": cad.SHAPES}

BESIDE_MESHES = "procedural/"  # before the names of these shapes where others are of meshes


def names(*kinds: str) -> list[str]:
    """Names of the shapes of the kinds "organic" (smooth) and "cad" (sharp edges); of both by default.

    Raises:
        ValueError: no such kind.
    """
    for kind in kinds:
        if kind not in KINDS:
            raise ValueError(f"data.kinds: expected {' or '.join(KINDS)}, found {kind!r}")
    return sorted(name for kind in kinds or KINDS for name in KINDS[kind])


def make(name: str) -> Mesh:
    """The closed mesh of that name, faces outward, centered in its box, greatest distance from the center 1."""
    for shapes in KINDS.values():
        if name in shapes:
            return unit_mesh(shapes[name]())
    raise ValueError(f"no shape {name!r}; there are {', '.join(names())}")


def unit_mesh(mesh: Mesh) -> Mesh:
    """A mesh moved and scaled: the center of its box is 0 and the greatest distance from it 1."""
    centered = mesh.vertices - (mesh.vertices.min(0) + mesh.vertices.max(0)) / 2
    return Mesh(centered / np.linalg.norm(centered, axis=1).max(), mesh.faces)

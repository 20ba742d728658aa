"""Procedural shapes: closed, outward, distinct, the same every time."""

import functools

import numpy as np
import pytest

from pnu.data import shapes
from pnu.geometry.mesh_sampling import face_areas, signed_volume
from pnu.geometry.mesh_topology import open_edges

made = functools.cache(shapes.make)


def test_there_are_many_of_both_kinds() -> None:
    assert len(shapes.names("organic")) >= 40
    assert len(shapes.names("cad")) >= 25
    assert shapes.names() == sorted(shapes.names("organic") + shapes.names("cad"))


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[pytest.mark.slow] if i % 3 else []) for i, name in enumerate(shapes.names())]
)
def test_closed_outward_unit(name: str) -> None:
    mesh = made(name)
    assert np.isfinite(mesh.vertices).all()
    assert open_edges(mesh) == 0
    assert signed_volume(mesh) > 0.005
    assert np.linalg.norm(mesh.vertices, axis=1).max() == pytest.approx(1)
    assert np.allclose(mesh.vertices.min(0) + mesh.vertices.max(0), 0)


@pytest.mark.slow
def test_distinct() -> None:
    """No two shapes agree in volume and area, and few come close."""
    figures = []
    for name in shapes.names():
        mesh = made(name)
        figures.append((signed_volume(mesh), face_areas(mesh).sum()))
    table = np.array(figures)
    apart = np.abs(table[:, None] - table[None]).max(-1) + np.eye(len(table))
    assert apart.min() > 1e-4
    assert (apart.min(1) > 0.005).mean() > 0.9


def test_same_every_time() -> None:
    for name in ("blob_2", "gear", "rock_1"):
        first, second = shapes.make(name), shapes.make(name)
        assert np.array_equal(first.vertices, second.vertices)
        assert np.array_equal(first.faces, second.faces)


def test_unknown_names_are_refused() -> None:
    with pytest.raises(ValueError, match=r"no shape 'unicorn'; there are apple, .*wrench"):
        shapes.make("unicorn")
    with pytest.raises(ValueError, match="data.kinds: expected organic or cad, found 'metal'"):
        shapes.names("metal")

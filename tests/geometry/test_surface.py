"""Meshes as surfaces: against closed forms, and against trying every face."""

import numpy as np
import pytest
import trimesh
from scipy.spatial import cKDTree

from pnu.geometry.mesh_sampling import (
    closest_points,
    face_areas,
    face_normals,
    sample_area,
    sample_poisson_disk,
    signed_volume,
)
from pnu.io import Mesh
from tests import reference

TETRAHEDRON = Mesh(
    np.array([[0.0, 0, 0], [3, 0, 0], [0, 4, 0], [0, 0, 5]]),
    np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]]),
)


def mesh(shape: trimesh.Trimesh) -> Mesh:
    return Mesh(np.array(shape.vertices, float), np.array(shape.faces, np.int64))


def random_triangles(count: int, seed: int) -> Mesh:
    """A soup of triangles from large to tiny, slivers and faces without area among them."""
    rng = np.random.default_rng(seed)
    size = 10.0 ** rng.uniform(-3, 0.3, (count, 1, 1))
    corners = rng.uniform(-1, 1, (count, 1, 3)) + size * rng.standard_normal((count, 3, 3))
    corners[::7, 2] = corners[::7, 1] + 1e-6  # slivers
    corners[::11, 2] = 0.3 * corners[::11, 0] + 0.7 * corners[::11, 1]  # three corners on a line
    corners[0] = corners[0, 0]  # all in one place
    return Mesh(corners.reshape(-1, 3), np.arange(3 * count).reshape(-1, 3))


def test_areas_normals_and_volume_by_hand() -> None:
    np.testing.assert_allclose(face_areas(TETRAHEDRON), [6, 7.5, 10, 0.5 * np.sqrt(20**2 + 15**2 + 12**2)])
    normals = face_normals(TETRAHEDRON)
    np.testing.assert_allclose(normals[:3], [[0, 0, -1], [0, -1, 0], [-1, 0, 0]])
    np.testing.assert_allclose(normals[3], np.array([20, 15, 12]) / np.sqrt(20**2 + 15**2 + 12**2))
    assert signed_volume(TETRAHEDRON) == pytest.approx(10)
    assert signed_volume(Mesh(TETRAHEDRON.vertices + 100, TETRAHEDRON.faces[:, ::-1])) == pytest.approx(-10)


def test_a_face_without_area_has_no_normal() -> None:
    flat = Mesh(np.array([[0.0, 0, 0], [1, 0, 0], [2, 0, 0]]), np.array([[0, 1, 2]]))
    assert face_normals(flat).tolist() == [[0, 0, 0]]
    assert face_areas(flat).tolist() == [0]


def test_samples_lie_on_the_surface_uniformly_by_area() -> None:
    cloud = sample_area(TETRAHEDRON, 40_000, np.random.default_rng(0))
    assert cloud.shape == (40_000, 6)
    points, normals = cloud[:, :3], cloud[:, 3:]
    areas = face_areas(TETRAHEDRON)
    for face, (area, normal) in enumerate(zip(areas, face_normals(TETRAHEDRON), strict=True)):
        mine = np.abs(normals - normal).max(1) < 1e-9
        assert mine.mean() == pytest.approx(area / areas.sum(), abs=0.01)
        corners = TETRAHEDRON.vertices[TETRAHEDRON.faces[face]]
        np.testing.assert_allclose((points[mine] - corners[0]) @ normal, 0, atol=1e-9)
        # uniform within the face: the mean is the centroid, the share in the half next to a corner is 1/4
        np.testing.assert_allclose(points[mine].mean(0), corners.mean(0), atol=0.05)
        inverse = np.linalg.pinv(np.stack([corners[1] - corners[0], corners[2] - corners[0]], 1))
        barycentric = (points[mine] - corners[0]) @ inverse.T
        assert barycentric.min() > -1e-9
        assert barycentric.sum(1).max() < 1 + 1e-9
        assert (barycentric.sum(1) < 0.5).mean() == pytest.approx(0.25, abs=0.02)


def test_sampling_repeats_with_the_generator() -> None:
    one, two, other = (sample_area(TETRAHEDRON, 50, np.random.default_rng(seed)) for seed in (1, 1, 2))
    np.testing.assert_array_equal(one, two)
    assert not np.array_equal(one, other)


def test_poisson_disk_samples_are_exact_in_number_and_far_apart() -> None:
    sphere = mesh(trimesh.creation.icosphere(3))
    cloud = sample_poisson_disk(sphere, 1000, np.random.default_rng(0))
    assert cloud.shape == (1000, 6)
    apart = cKDTree(cloud[:, :3]).query(cloud[:, :3], k=2)[0][:, 1]
    # the densest packing of 1000 discs has spacing sqrt(2 / sqrt(3) * area / n); blue noise reaches about 0.7 of it
    densest = np.sqrt(2 / np.sqrt(3) * face_areas(sphere).sum() / 1000)
    assert apart.min() > 0.6 * densest
    np.testing.assert_allclose((cloud[:, :3] * cloud[:, 3:]).sum(1), 1, atol=0.02)


@pytest.mark.parametrize("sampler", [sample_area, sample_poisson_disk])
def test_meshes_without_area(sampler) -> None:  # type: ignore[no-untyped-def]
    flat = Mesh(np.zeros((3, 3)), np.array([[0, 1, 2]]))
    with pytest.raises(ValueError, match="mesh: expected faces with an area, found 1 faces without"):
        sampler(flat, 10, np.random.default_rng(0))
    with pytest.raises(ValueError, match="mesh: expected faces with an area, found 0 faces without"):
        sampler(Mesh(np.zeros((3, 3)), np.zeros((0, 3), np.int64)), 10, np.random.default_rng(0))


@pytest.mark.parametrize("seed", [0, 1])
@pytest.mark.parametrize("reach", [0.5, 3.0, 100.0])
def test_closest_points_against_every_face(seed: int, reach: float) -> None:
    soup = random_triangles(60, seed)
    queries = np.random.default_rng(seed).standard_normal((40, 3)) * reach
    points, distance, face = closest_points(soup, queries)
    np.testing.assert_allclose(distance, reference.closest_points(soup.vertices, soup.faces, queries), rtol=1e-6)
    np.testing.assert_allclose(np.linalg.norm(points - queries, axis=1), distance)
    for point, f in zip(points, face, strict=True):
        corners = soup.vertices[soup.faces[f]]
        assert np.linalg.norm(reference.closest_on_triangle(point, corners) - point) < 1e-9


def test_closest_points_on_a_mesh_of_many_faces() -> None:
    shape = trimesh.creation.torus(1.0, 0.3, major_sections=120, minor_sections=60)
    queries = np.random.default_rng(0).uniform(-1.5, 1.5, (1500, 3))
    points, distance, _ = closest_points(mesh(shape), queries)
    expected, expected_distance, _ = trimesh.proximity.closest_point_naive(shape, queries[:40])
    np.testing.assert_allclose(distance[:40], expected_distance, atol=1e-12)
    np.testing.assert_allclose(points[:40], expected, atol=1e-9)
    ring = np.hypot(queries[:, 0], queries[:, 1]) - 1
    np.testing.assert_allclose(distance, np.abs(np.hypot(ring, queries[:, 2]) - 0.3), atol=2e-3)


def test_closest_points_from_the_center_of_a_sphere() -> None:
    sphere = mesh(trimesh.creation.icosphere(3))
    _, distance, _ = closest_points(sphere, np.zeros((20, 3)))  # every face is a candidate of every query
    planes = (face_normals(sphere) * sphere.vertices[sphere.faces[:, 0]]).sum(1)
    np.testing.assert_allclose(distance, planes.min())


def test_points_of_the_surface_are_their_own_closest() -> None:
    shape = mesh(trimesh.creation.box((1.0, 2.0, 0.01)))
    cloud = sample_area(shape, 2000, np.random.default_rng(3))
    points, distance, face = closest_points(shape, cloud[:, :3])
    assert distance.max() < 1e-12
    np.testing.assert_allclose(points, cloud[:, :3], atol=1e-12)
    np.testing.assert_array_equal(face_normals(shape)[face], cloud[:, 3:])


def test_no_queries() -> None:
    points, distance, face = closest_points(TETRAHEDRON, np.zeros((0, 3)))
    assert points.shape == (0, 3)
    assert distance.shape == face.shape == (0,)


def test_closest_points_of_a_mesh_without_faces() -> None:
    with pytest.raises(ValueError, match="mesh: expected at least one face, found none"):
        closest_points(Mesh(np.zeros((3, 3)), np.zeros((0, 3), np.int64)), np.zeros((1, 3)))

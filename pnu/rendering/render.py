"""One panel: a cloud or a mesh, seen by a camera."""

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import minimum_filter

from pnu.geometry.mesh_topology import corner_normals
from pnu.geometry.spacing import spacing
from pnu.io import Mesh
from pnu.rendering import raster, shading
from pnu.rendering.camera import Camera
from pnu.rendering.colors import normal_colors

Array = NDArray[np.float64]
Image = NDArray[np.uint8]

CLAY = (222, 224, 228)  # a surface without colors
BACK = (214, 180, 160)  # the inside of a surface, seen through a hole or because it is inside out
STONE = (130, 142, 160)  # points without colors and normals


def render_cloud(
    cloud: np.ndarray,
    colors: NDArray[np.uint8] | None = None,
    *,
    camera: Camera,
    size: int = 600,
    radius: float | None = None,
    hide: bool = True,
    supersample: int = 2,
) -> Image:
    """A picture `(size, size, 3)` of a cloud `(n, 3)` or `(n, 6)` on white, each point a small ball lit by its normal.

    colors: `(n, 3)` 8-bit sRGB; by default normals as colors, or gray for a cloud without normals. radius: of a ball,
    in units of the points; by default 0.4 of the spacing. hide: leave out points that the surface in front of them
    would cover, although one could see between its points. ValueError if the picture would be blank.
    """
    cloud = np.asarray(cloud, np.float64)
    points, normals = cloud[:, :3], cloud[:, 3:6] if cloud.shape[1] >= 6 else None
    if not len(points) or not np.isfinite(points).all():
        raise ValueError(f"picture: expected finite points, found {len(points)} points, NaN or infinity among them")
    pixels = size * supersample
    center = to_pixels(camera, points, pixels)
    step = spacing(points) / camera.half_size * pixels / 2
    ball = 0.4 * step if radius is None else radius / camera.half_size * pixels / 2
    ball = max(ball, 0.9 * supersample)
    keep = np.flatnonzero(in_front(center, 2 * step, pixels)) if hide else np.arange(len(points))
    found = raster.balls(center[keep], ball, pixels, pixels)
    owner = keep[found.primitive]
    offset = pixel_middle(found.pixel, pixels) - center[owner, :2]
    rise = np.sqrt(np.maximum(ball**2 - (offset**2).sum(1), 0))
    normal = np.stack([offset[:, 0], -offset[:, 1], rise], 1) / ball
    if normals is not None:
        length = np.linalg.norm(normals, axis=1, keepdims=True)
        seen = (normals / np.where(length > 0, length, 1)) @ camera.rotation.T
        normal = 0.35 * normal + 0.65 * np.where(seen[:, 2:] < 0, -seen, seen)[owner]
    if colors is None:
        colors = normal_colors(normals) if normals is not None else np.tile(np.array(STONE, np.uint8), (len(points), 1))
    return develop(found.pixel, center[owner, 2] + rise, normal, np.asarray(colors)[owner] / 255, pixels, supersample)


def render_mesh(
    mesh: Mesh,
    vertex_colors: NDArray[np.uint8] | None = None,
    *,
    camera: Camera,
    size: int = 600,
    smooth: bool = True,
    supersample: int = 2,
) -> Image:
    """A picture `(size, size, 3)` of a triangle mesh on white, smooth or flat shaded; sharp edges stay sharp.

    vertex_colors: `(v, 3)` 8-bit sRGB. Without them the surface is gray and its inside, where it shows, brown.
    ValueError if the picture would be blank.
    """
    vertices, faces = mesh.vertices, mesh.faces
    if not len(faces) or not np.isfinite(vertices).all():
        raise ValueError(
            f"picture: expected a mesh with finite vertices, found {len(vertices)} vertices, {len(faces)} faces"
        )
    pixels = size * supersample
    corners = to_pixels(camera, vertices, pixels)[faces]
    (ax, ay), (bx, by) = ((corners[:, i] - corners[:, 0]).T[:2] for i in (1, 2))
    back = ax * by - ay * bx > 0  # y grows downwards: a face seen from outside turns clockwise
    order = np.argsort(~back, kind="stable")  # where a fold has two faces at one depth, the one that looks here is seen
    found = raster.triangles(corners[order], pixels, pixels)
    face = order[found.primitive]
    weight = raster.barycentric(corners[face], pixel_middle(found.pixel, pixels))[:, :, None]
    normal = (weight * (corner_normals(mesh, smooth) @ camera.rotation.T)[face]).sum(1)
    inside = back[face, None]
    normal = np.where(inside, -normal, normal)
    if vertex_colors is None:
        color = np.where(inside, BACK, CLAY) / 255
    else:
        color = (weight * np.asarray(vertex_colors, np.float64)[faces[face]]).sum(1) / 255
    return develop(found.pixel, (weight[..., 0] * corners[face, :, 2]).sum(1), normal, color, pixels, supersample)


def develop(
    pixel: NDArray[np.int64], depth: Array, normal: Array, color: Array, pixels: int, supersample: int
) -> Image:
    """Shade the visible pixels (flat indices `(m,)`, their depth, normal, color) and average them over white."""
    if not len(pixel):
        raise ValueError("picture: nothing to see; the camera looks past the points or they are smaller than a pixel")
    row, column = np.divmod(pixel, pixels)
    top, left, bottom, right = (
        n // supersample * supersample
        for n in (row.min(), column.min(), row.max() + supersample, column.max() + supersample)
    )
    shape = (bottom - top, right - left)  # the part of the picture that is not white, in whole pixels of the result
    at = (row - top, column - left)
    surface = shading.PixelSurface(
        np.zeros(shape, bool), *(np.zeros((*shape, *k), np.float32) for k in ((), (3,), (3,)))
    )
    surface.covered[at] = True
    surface.depth[at] = depth
    surface.normal[at] = normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
    surface.color[at] = color
    picture = np.full((pixels // supersample, pixels // supersample, 3), 255, np.uint8)
    part = np.s_[top // supersample : bottom // supersample, left // supersample : right // supersample]
    picture[part] = shading.averaged_pixels(shading.shade(surface, pixels), surface.covered, supersample)
    return picture


def to_pixels(camera: Camera, points: Array, pixels: int) -> Array:
    """Points `(n, 3)` in a picture of `pixels` x `pixels`: x right, y down, z towards the viewer, all in pixels."""
    return camera.view(points) * [pixels / 2, -pixels / 2, pixels / 2] + [pixels / 2, pixels / 2, 0]


def pixel_middle(pixel: NDArray[np.int64], width: int) -> Array:
    """The middle of pixels, in pixels."""
    return np.stack([pixel % width, pixel // width], 1).astype(np.float64) + 0.5


def in_front(center: Array, radius: float, pixels: int) -> NDArray[np.bool_]:
    """Which points `(n, 3)` in a picture stand before, or close behind, the surface that all of them make; `(n,)`.

    The surface: each point a disc of `radius`, then its outline drawn in by as much, so that gaps between points are
    closed and silhouettes stay where they are.
    """
    coarse = max(radius / 6, 2.0)  # the filter below costs radius squared
    center, radius, pixels = center / coarse, max(radius / coarse, 1.0), int(np.ceil(pixels / coarse))
    found = raster.balls(center, radius, pixels, pixels)
    surface = np.full((pixels, pixels), -np.inf)
    surface.flat[found.pixel] = center[found.primitive, 2]
    reach = np.arange(-int(radius), int(radius) + 1)
    surface = minimum_filter(surface, footprint=reach[:, None] ** 2 + reach**2 <= radius**2, mode="nearest")
    column, row = np.clip(center[:, :2].astype(np.int64), 0, pixels - 1).T
    seen: NDArray[np.bool_] = center[:, 2] > surface[row, column] - radius / 2
    return seen

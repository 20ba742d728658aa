"""Clouds and surfaces in a page: few bytes a point, packed, for the viewer (viewer.js) to unpack."""

import base64
import gzip
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from pnu.geometry.mesh_topology import split_creases
from pnu.geometry.spacing import spacing
from pnu.io import Mesh

RANGE = 1.25  # of the true radius; what lies farther out is drawn there


class Drawing(NamedTuple):
    """One thing to show in a view: a cloud, a surface, or both."""

    name: str
    cloud: np.ndarray | None = None  # (n, 3) or (n, 6)
    cloud_error: np.ndarray | None = None  # (n,)
    surface: Mesh | None = None
    surface_error: np.ndarray | None = None  # (v,)
    stored: np.ndarray | None = None  # (n, 3) or (v, 3) uint8: own colors of the cloud, or of a surface alone
    found: np.ndarray | None = None  # (n,) uint8: 1 stray, 2 its normal was turned, 3 on the rim of a hole, 0 nothing


class ShapeView(NamedTuple):
    """Drawings of one shape, to be compared: same frame, same scale of errors."""

    shape: str
    kind: str
    drawings: Sequence[Drawing]
    center: np.ndarray  # (3,) of the true shape
    radius: float
    limit: float  # error at the end of the colors, in the unit of the points
    error: str = "errors"  # what it is called on the button
    bar: str = ""  # beside the colors; "": the distance to the true surface, in thousandths of the radius


class Packer:
    """Arrays one after another, each at a multiple of four bytes."""

    def __init__(self) -> None:
        self.parts: list[bytes] = []
        self.size = 0

    def add(self, values: np.ndarray, dtype: str) -> list[int]:
        """Where the values lie: [first byte, number of values]."""
        place = [self.size, values.size]
        data = np.ascontiguousarray(values, np.dtype(dtype)).tobytes()
        data += bytes(-len(data) % 4)
        self.parts.append(data)
        self.size += len(data)
        return place

    def data(self) -> bytes:
        """All arrays."""
        return b"".join(self.parts)


def encode(view: ShapeView) -> dict[str, Any]:
    """The view as JSON, its arrays compressed, as base64 in `data`."""
    head, data = view_arrays(view)
    return head | {"data": base64.b64encode(gzip.compress(data, 6, mtime=0)).decode()}


def view_arrays(view: ShapeView) -> tuple[dict[str, Any], bytes]:
    """The view as JSON that tells where its arrays lie in the bytes.

    Positions to 1/26000 of the radius, normals to half a degree, errors to 1/255 of the limit.
    """
    packer = Packer()
    items = []
    for drawing in view.drawings:
        item: dict[str, Any] = {"name": drawing.name}
        if drawing.cloud is not None:
            points = drawing.cloud[:, :3]
            normals = drawing.cloud[:, 3:6] if drawing.cloud.shape[1] >= 6 else None
            item["cloud"] = vertices(packer, view, points, normals, drawing.cloud_error, drawing.stored)
            item["cloud"]["spacing"] = round(spacing(points) / view.radius, 6)
            if drawing.found is not None:
                item["cloud"]["found"] = packer.add(drawing.found, "u1")
        if drawing.surface is not None:
            points, normals, faces = split_creases(drawing.surface)
            copy_of = np.empty(len(points), np.int64)
            copy_of[faces] = drawing.surface.faces
            error = None if drawing.surface_error is None else drawing.surface_error[copy_of]
            alone = drawing.cloud is None and drawing.stored is not None
            stored = np.asarray(drawing.stored)[copy_of] if alone else None
            item["surface"] = vertices(packer, view, points, normals, error, stored)
            item["surface"]["index"] = packer.add(np.diff(faces.ravel(), prepend=0), "<i4")  # differences pack better
        items.append(item)
    limit = f"{view.limit:.3g}" if view.bar else f"{1e3 * view.limit / view.radius:.3g}"
    bar = view.bar or "distance to the true surface, x 1e3 of its radius"
    head = {"shape": view.shape, "kind": view.kind, "error": view.error, "bar": bar, "limit": limit}
    return head | {"items": items}, packer.data()


def vertices(
    packer: Packer,
    view: ShapeView,
    points: np.ndarray,
    normals: np.ndarray | None,
    error: np.ndarray | None,
    stored: np.ndarray | None,
) -> dict[str, Any]:
    """Points with their normals, errors and colors, packed."""
    unit = (points - view.center) / (RANGE * view.radius)
    places = {"position": packer.add(np.rint((unit.clip(-1, 1) + 1) * 32767.5), "<u2")}
    if normals is not None:
        places["normal"] = packer.add(np.rint(127 * normals.clip(-1, 1)), "i1")
    if error is not None:
        places["error"] = packer.add(np.rint(255 * (error / view.limit).clip(0, 1)), "u1")
    if stored is not None:
        places["stored"] = packer.add(stored, "u1")
    return places

"""Clouds as other libraries hold them in memory: read as a `Cloud`, and made again of the same kind.

No library is imported for it: an object of one can only come from where it is imported already.
"""

import copy
import sys
from typing import Any, Protocol, TypeAlias

import numpy as np

from pnu.io.cloud import Cloud


class Kind(Protocol):
    """A library's class of clouds."""

    where: tuple[str, str]  # module, and the class in it

    def read(self, given: Any) -> Cloud:
        """What an object holds: points, normals, and all else that it says about each point."""
        ...

    def dense(self, given: Any, cloud: Cloud) -> Any:
        """A new object that holds a cloud with normals, on the device and in the types of the given one."""
        ...

    def with_normals(self, given: Any, normals: np.ndarray) -> Any:
        """A copy of an object, with these normals (n, 3)."""
        ...


class _WithPoints(Protocol):  # Open3D, PyVista
    @property
    def points(self) -> Any: ...


class _WithPoint(Protocol):  # Open3D's tensors
    @property
    def point(self) -> Any: ...


class _WithVertices(Protocol):  # trimesh
    @property
    def vertices(self) -> Any: ...


class _WithPos(Protocol):  # PyTorch Geometric
    @property
    def pos(self) -> Any: ...


# for type checkers, which know it by its members where its library is not installed or has no types
LibraryCloud: TypeAlias = _WithPoints | _WithPoint | _WithVertices | _WithPos


class LegacyOpen3D:
    """`open3d.geometry.PointCloud`: points, normals, colors from 0 to 1; a dense one has no covariances."""

    where = ("open3d", "geometry.PointCloud")

    def read(self, given: Any) -> Cloud:
        """As `Kind` says."""
        normals = np.asarray(given.normals) if given.has_normals() else None
        colors = {"colors": np.asarray(given.colors)} if given.has_colors() else {}
        return Cloud(np.asarray(given.points), normals, colors)

    def dense(self, given: Any, cloud: Cloud) -> Any:
        """As `Kind` says."""
        made, vectors = type(given)(), sys.modules["open3d"].utility.Vector3dVector
        made.points, made.normals = vectors(cloud.points), vectors(cloud.normals)
        if "colors" in cloud.attributes:
            made.colors = vectors(cloud.attributes["colors"])
        return made

    def with_normals(self, given: Any, normals: np.ndarray) -> Any:
        """As `Kind` says."""
        made = type(given)(given)
        made.normals = sys.modules["open3d"].utility.Vector3dVector(normals)
        return made


class TensorOpen3D:
    """`open3d.t.geometry.PointCloud`: positions, normals and whatever else stands under `point`."""

    where = ("open3d", "t.geometry.PointCloud")

    def read(self, given: Any) -> Cloud:
        """As `Kind` says."""
        if "positions" not in given.point:
            return Cloud(np.empty((0, 3)), None, {})
        values = {name: value.cpu().numpy() for name, value in given.point.items()}
        return Cloud(values.pop("positions"), values.pop("normals", None), values)

    def dense(self, given: Any, cloud: Cloud) -> Any:
        """As `Kind` says."""
        made = type(given)(given.device)
        made.point.positions = self._tensor(given, cloud.points)
        made.point.normals = self._tensor(given, cloud.normals)
        for name, values in cloud.attributes.items():
            made.point[name] = sys.modules["open3d"].core.Tensor(np.ascontiguousarray(values), device=given.device)
        return made

    def with_normals(self, given: Any, normals: np.ndarray) -> Any:
        """As `Kind` says."""
        made = given.clone()
        made.point.normals = self._tensor(given, normals)
        return made

    def _tensor(self, given: Any, values: Any) -> Any:
        core = sys.modules["open3d"].core
        single = given.point.positions.dtype == core.float32
        return core.Tensor(np.ascontiguousarray(values), core.float32 if single else core.float64, given.device)


class Trimesh:
    """`trimesh.PointCloud`: vertices, colors; normals as `vertex_normals`, which its export writes if asked."""

    where = ("trimesh", "PointCloud")

    def read(self, given: Any) -> Cloud:
        """As `Kind` says."""
        colors = np.asarray(given.colors)
        own = {"colors": colors} if len(colors) == len(given.vertices) else {}
        return Cloud(np.asarray(given.vertices), getattr(given, "vertex_normals", None), own)

    def dense(self, given: Any, cloud: Cloud) -> Any:
        """As `Kind` says."""
        made = type(given)(cloud.points, colors=cloud.attributes.get("colors"), metadata=copy.deepcopy(given.metadata))
        made.vertex_normals = cloud.normals
        return made

    def with_normals(self, given: Any, normals: np.ndarray) -> Any:
        """As `Kind` says."""
        made = given.copy()
        made.vertex_normals = normals
        return made


class PyVista:
    """`pyvista.PolyData` without faces and lines: points, the active normals or those named "Normals", point data."""

    where = ("pyvista", "PolyData")

    def read(self, given: Any) -> Cloud:
        """As `Kind` says."""
        if given.n_cells != given.n_verts:
            raise ValueError(
                "points: expected a cloud, found PolyData with faces or lines; give pyvista.PolyData(mesh.points), or"
                " points sampled on it"
            )
        name = self._normals_name(given)
        own = {key: np.asarray(given.point_data[key]) for key in given.point_data.keys()}  # noqa: SIM118
        normals = own.pop(name, None)
        return Cloud(np.asarray(given.points), normals, own)

    def dense(self, given: Any, cloud: Cloud) -> Any:
        """As `Kind` says."""
        made = type(given)(cloud.points.astype(given.points.dtype))
        for name, values in cloud.attributes.items():
            made.point_data[name] = values
        return self._set_normals(made, self._normals_name(given), cloud.normals)

    def with_normals(self, given: Any, normals: np.ndarray) -> Any:
        """As `Kind` says."""
        return self._set_normals(given.copy(), self._normals_name(given), normals)

    def _normals_name(self, given: Any) -> str:
        return given.point_data.active_normals_name or "Normals"

    def _set_normals(self, made: Any, name: str, normals: Any) -> Any:
        made.point_data[name] = normals.astype(made.points.dtype)
        made.point_data.active_normals_name = name
        return made


class PyG:
    """`torch_geometric.data.Data`: pos, normal and other values of nodes; a dense one has no edges and faces."""

    where = ("torch_geometric.data", "Data")

    def read(self, given: Any) -> Cloud:
        """As `Kind` says."""
        if "ptr" in given:
            raise ValueError(
                f"points: expected one cloud, found a batch of {given.num_graphs}; give each of its to_data_list()"
            )
        own = {name: _numbers(given[name].detach().cpu()) for name in self._of_nodes(given)}
        points = own.pop("pos", np.empty((0, 3)))
        return Cloud(points, own.pop("normal", None), own)

    def dense(self, given: Any, cloud: Cloud) -> Any:
        """As `Kind` says."""
        made = type(given)(**{name: value for name, value in given if not self._is_left_out(given, name)})
        made.pos, made.normal = self._tensor(given, cloud.points), self._tensor(given, cloud.normals)
        for name, values in cloud.attributes.items():
            made[name] = given[name].new_tensor(values)
        return made

    def with_normals(self, given: Any, normals: np.ndarray) -> Any:
        """As `Kind` says."""
        made = given.clone()
        made.normal = self._tensor(given, normals)
        return made

    def _of_nodes(self, given: Any) -> list[str]:
        return [name for name in given.keys() if given.is_node_attr(name) and hasattr(given[name], "detach")]  # noqa: SIM118

    def _is_left_out(self, given: Any, name: str) -> bool:
        return name == "face" or given.is_node_attr(name) or given.is_edge_attr(name)

    def _tensor(self, given: Any, values: Any) -> Any:
        return tensor_like(given.pos, values)


def tensor_like(given: Any, values: Any) -> Any:
    """Values as a tensor on the device of the given one: float32 where it is, else float64."""
    import torch

    kind = torch.float32 if given.dtype == torch.float32 else torch.float64
    return torch.as_tensor(values, dtype=kind, device=given.device)


def _numbers(tensor: Any) -> np.ndarray:
    import torch

    numbers: np.ndarray = (tensor.float() if tensor.dtype == torch.bfloat16 else tensor).numpy()
    return numbers


KINDS: tuple[Kind, ...] = (LegacyOpen3D(), TensorOpen3D(), Trimesh(), PyVista(), PyG())


def kind_of(given: object) -> Kind | None:
    """The kind of a library's cloud; None for anything else, such as arrays."""
    return next((kind for kind in KINDS if isinstance(given, _class_of(kind))), None)


def _class_of(kind: Kind) -> Any:
    """The class, or no class where its library is not imported."""
    module, name = kind.where
    found: Any = sys.modules.get(module)
    for part in name.split("."):
        found = getattr(found, part, ())
    return found

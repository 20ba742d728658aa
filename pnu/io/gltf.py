"""glTF, text (gltf) or binary (glb): meshes and points of all nodes in one place. Read by trimesh."""

import io
import json
import struct
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

BYTES_OF_JSON = 2**26


def read_gltf(path: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray | None, np.ndarray | None]:
    """Vertices (v, 3), triangles (f, 3), normals (v, 3) or None, colors (v, 3) uint8 or None, as the nodes of the scene
    place them. Normals and colors, where all parts have them."""
    try:
        tree = _check(path)
        import trimesh

        with np.errstate(all="ignore"):
            scene = trimesh.load_scene(path, process=False)
            found = [scene.graph[node] for node in scene.graph.nodes_geometry]
            parts = [_placed(matrix, scene.geometry[name]) for matrix, name in found]
            normals = _normals(path, tree, list(scene.graph.nodes_geometry))
        if normals is not None and [len(part) for part in normals] != [len(vertices) for vertices, _, _ in parts]:
            raise ValueError("its normals are not as many as its points")
    except Exception as error:  # it knows many kinds
        reason = (str(error).splitlines() or [""])[0][:80] or type(error).__name__
        raise ValueError(f"{path}: is no glTF that can be read ({reason}); export it again, as ply or obj") from None
    if not parts:
        raise ValueError(f"{path}: expected a scene with meshes or points, found none; export it again")
    sizes = [len(vertices) for vertices, _, _ in parts]
    first = np.cumsum(sizes) - sizes
    colored = all(colors is not None for _, _, colors in parts)
    return (
        np.concatenate([vertices for vertices, _, _ in parts]),
        np.concatenate([faces + start for (_, faces, _), start in zip(parts, first, strict=True)]),
        np.concatenate(normals) if normals is not None else None,
        np.concatenate([colors for _, _, colors in parts if colors is not None]) if colored else None,
    )


def _placed(matrix: np.ndarray, shape: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
    """Vertices, faces and colors of a node."""
    vertices = np.asarray(shape.vertices, np.float64).reshape(-1, 3) @ matrix[:3, :3].T + matrix[:3, 3]
    faces = np.asarray(getattr(shape, "faces", np.empty((0, 3))), np.int64).reshape(-1, 3)
    if np.linalg.det(matrix[:3, :3]) < 0:
        faces = faces[:, ::-1]
    visual = getattr(shape, "visual", None)
    colors = getattr(visual, "vertex_colors", None) if getattr(visual, "kind", None) == "vertex" else None
    colors = getattr(shape, "colors", None) if visual is None or not hasattr(shape, "faces") else colors
    found = None if colors is None or len(colors) != len(vertices) else np.asarray(colors)[:, :3].astype(np.uint8)
    return vertices, faces, found


def _normals(path: Path, tree: Any, nodes: Sequence[str]) -> list[np.ndarray] | None:
    """Normals (v, 3) of each node, of any length; None where a part has none.

    Trimesh reads those of triangles alone, so the file is read once more with the normals in the place of the points.
    """
    parts = [part for mesh in tree.get("meshes", []) for part in mesh["primitives"]]
    if not parts or not all("NORMAL" in part["attributes"] for part in parts):
        return None
    import trimesh

    for part in parts:
        part["attributes"]["POSITION"] = part["attributes"]["NORMAL"]
    text = json.dumps(tree).encode()
    if path.suffix.lower() == ".glb":
        data = path.read_bytes()
        rest = data[20 + int.from_bytes(data[12:16], "little") :]
        text = text.ljust(-(-len(text) // 4) * 4)
        text = data[:8] + struct.pack("<II", 20 + len(text) + len(rest), len(text)) + b"JSON" + text + rest
    scene = trimesh.load_scene(
        io.BytesIO(text),
        file_type=path.suffix[1:].lower(),
        resolver=trimesh.resolvers.FilePathResolver(str(path)),
        process=False,
    )
    placed = []
    for matrix, name in (scene.graph[node] for node in nodes):
        normals = np.asarray(scene.geometry[name].vertices, np.float64).reshape(-1, 3)
        placed.append(normals @ np.linalg.pinv(matrix[:3, :3]))  # the inverse, transposed
    return placed


def _check(path: Path) -> Any:
    """The tree. `ValueError` for counts that the file has no room for: trimesh would allocate them."""
    size = path.stat().st_size
    with path.open("rb") as file:
        head = file.read(20)
        if path.suffix.lower() == ".glb":
            length = int.from_bytes(head[12:16], "little")
            if head[:4] != b"glTF" or head[16:20] != b"JSON" or length > min(size, BYTES_OF_JSON):
                raise ValueError("it does not begin with a header of glb")
            text = file.read(length)
        elif size > BYTES_OF_JSON:
            raise ValueError("it holds too much text; take glb")
        else:
            text = head + file.read()
    tree = json.loads(text)
    linked = [path.parent / item["uri"] for item in tree.get("buffers", []) if "uri" in item]
    for item in linked:
        if not str(item.name).startswith("data:") and item.is_file():
            size += item.stat().st_size
    for item in tree.get("accessors", []):
        if not 0 <= item["count"] <= size:
            raise ValueError(f"an accessor counts {item['count']} items, more than there is room for")
    return tree

"""Files: the only room that knows formats. What is read is checked; what is written appears whole or not at all."""

from pnu.io.atomic import atomic_path, check_writable, read_json, remove_leftovers, write_json
from pnu.io.cloud import CLOUD_SUFFIXES, Cloud, check_cloud, read_cloud
from pnu.io.folder import files_of, meshes_of
from pnu.io.mesh import MESH_OUTPUTS, MESH_SUFFIXES, Mesh, read_mesh, write_mesh
from pnu.io.output import OUTPUT_SUFFIXES, check_output, kept_attributes, write_cloud

__all__ = [
    "CLOUD_SUFFIXES",
    "MESH_OUTPUTS",
    "MESH_SUFFIXES",
    "OUTPUT_SUFFIXES",
    "Cloud",
    "Mesh",
    "atomic_path",
    "check_cloud",
    "check_output",
    "check_writable",
    "files_of",
    "kept_attributes",
    "meshes_of",
    "read_cloud",
    "read_json",
    "read_mesh",
    "remove_leftovers",
    "write_cloud",
    "write_json",
    "write_mesh",
]

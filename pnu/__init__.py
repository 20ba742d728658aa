"""Point cloud upsampling with normal estimation.

A *cloud* is an `(n, 6)` array of points and unit normals; an *upsampler* turns a cloud into a denser one.

    import pnu
    dense = pnu.upsample(points, ratio=4)       # (n, 3), or (n, 6) with normals -> (4 n, 6)
    normals = pnu.normals(points)               # (n, 3) -> (n, 3), oriented
    network = pnu.load("outputs/...")           # a trained network, in eval mode
    upsampler = pnu.PointCloudUpsampler(ratio=4)    # loads weights once: upsampler.transform(points)

Tensors and clouds of Open3D, trimesh, PyVista and PyTorch Geometric go in as arrays do, and come back as such.
"""

import importlib
from typing import TYPE_CHECKING, Any

__version__ = "0.1.0"
__all__ = ["PointCloudUpsampler", "__version__", "load", "normals", "upsample"]

if TYPE_CHECKING:
    from pnu.networks.checkpoints import load
    from pnu.upsamplers.estimator import PointCloudUpsampler
    from pnu.upsamplers.whole_clouds import normals, upsample

HOMES = {
    "PointCloudUpsampler": "pnu.upsamplers.estimator",
    "load": "pnu.networks.checkpoints",
    "normals": "pnu.upsamplers.whole_clouds",
    "upsample": "pnu.upsamplers.whole_clouds",
}


def __getattr__(name: str) -> Any:
    """Import the public functions on first use, so that `import pnu` stays instant."""
    if name in HOMES:
        return getattr(importlib.import_module(HOMES[name]), name)
    raise AttributeError(f"module 'pnu' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})

"""Point cloud upsampling with normal estimation.

A *cloud* is an `(n, 6)` array of points and unit normals; an *upsampler* turns a cloud into a denser one.

    import pnu
    dense = pnu.upsample(points, ratio=4)       # (n, 3), or (n, 6) with normals -> (4 n, 6)
    network = pnu.load("outputs/...")           # a trained network, in eval mode
"""

from typing import TYPE_CHECKING, Any

__version__ = "0.1.0"
__all__ = ["__version__", "load", "upsample"]

if TYPE_CHECKING:
    from pnu.checkpoint import load
    from pnu.inference import upsample


def __getattr__(name: str) -> Any:
    """Import the public functions on first use, so that `import pnu` stays instant."""
    if name == "load":
        from pnu.checkpoint import load

        return load
    if name == "upsample":
        from pnu.inference import upsample

        return upsample
    raise AttributeError(f"module 'pnu' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})

"""What commands write of the points that fill holes: key `holes`."""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import numpy as np

    from pnu.io import Cloud

HOLES = "radius, in the input's unit, up to which holes are filled, with points flagged by `filled`; null: none"


def check_holes(cfg: Any) -> None:
    """`ValueError` for a radius that is none."""
    if cfg.holes is not None and not 0 < cfg.holes < float("inf"):
        raise ValueError(f"holes={cfg.holes:g}: expected a radius above 0 in the unit of the points")


def values_to_write(cfg: Any, path: str, dense: "np.ndarray", cloud: "Cloud", count: int) -> tuple[dict[str, Any], str]:
    """Attributes of a dense cloud (m, 6) that its format keeps, and a line on its points that fill holes, or "".

    Those come after the first `count`.
    """
    from pnu.io import kept_attributes
    from pnu.upsamplers import whole_clouds

    if cfg.holes is None:
        values = whole_clouds.attributes(dense, cloud)
        return {name: values[name] for name in kept_attributes(path, values)}, ""
    values = whole_clouds.attributes_with_filled(dense, cloud, count)
    kept = kept_attributes(path, values)
    told = "flagged by filled" if "filled" in kept else "the last ones; this format has no room for a flag"
    line = f"holes:  {len(dense) - count} points fill them" + (f", {told}" if len(dense) > count else "")
    return {name: values[name] for name in kept}, line

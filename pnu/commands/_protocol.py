"""The protocol of a comparison and its cases, as `pnu compare` and `pnu evaluate` read them from their config."""

from typing import TYPE_CHECKING, Any

from pnu.commands._entry import warn
from pnu.config.instantiate import PACKAGES, instantiate

if TYPE_CHECKING:
    from pnu.benchmark import CaseSource, Protocol

KINDS = (
    "of input: uniform, random, nonuniform, sparse (a quarter of the points), noise_0.5, noise_1, noise_2; "
    "simulated scans: orbit, oneview, depth, lines, photo, flipped, clutter; null: the protocol's"
)

MERGE = (
    "of networks of patches: farthest: the farthest points of all predictions, as in the paper; agreed: on "
    "the spheres that the predictions of overlapping patches fit"
)
KEEP = (
    "of surface and networks of patches: true: the points given are in the result, unmoved; false: all are new; "
    "auto: as pnu upsample"
)


def protocol_source(cfg: Any) -> tuple["Protocol", "CaseSource"]:
    """The protocol, and the cases that it makes of `data`; keys of the command go before what the protocol says."""
    from pnu import benchmark

    protocol: Protocol = instantiate(cfg.protocol, PACKAGES["protocol"], allow=cfg.allow) or benchmark.Protocol()
    points = protocol.points if cfg.points is None else cfg.points
    truth_points = protocol.truth_points(points, cfg.ratio) if cfg.truth_points is None else cfg.truth_points
    source = benchmark.case_source(
        cfg.data, protocol.kinds if cfg.kinds is None else cfg.kinds, part=cfg.part, only=cfg.shapes, points=points,
        truth_points=truth_points, seed=cfg.seed, normals=cfg.normals == "given", columns=cfg.columns, warn=warn,
        inputs=protocol.inputs, noise_limit=protocol.noise_limit,
    )  # fmt: skip
    return protocol, source

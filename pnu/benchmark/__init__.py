"""Whole clouds measured against true surfaces: inputs of several kinds, any upsamplers, tables."""

from pnu.benchmark.case_sources import PARTS, CaseSource, case_source
from pnu.benchmark.cases import KINDS, SCANS, Case, Truth, mesh_cases, pair_cases, truth_of_mesh
from pnu.benchmark.measuring import Method, Row, evaluate, measure, measured_network, network_upsampler, of_kinds
from pnu.benchmark.open3d_chain import open3d_chain
from pnu.benchmark.protocols import Protocol, print_published
from pnu.benchmark.result_tables import (
    columns,
    legend,
    over_seeds,
    print_over_seeds,
    print_tables,
    result_folder,
    summarize,
    write_results,
)

__all__ = [
    "KINDS",
    "PARTS",
    "SCANS",
    "Case",
    "CaseSource",
    "Method",
    "Protocol",
    "Row",
    "Truth",
    "case_source",
    "columns",
    "evaluate",
    "legend",
    "measure",
    "measured_network",
    "mesh_cases",
    "network_upsampler",
    "of_kinds",
    "open3d_chain",
    "over_seeds",
    "pair_cases",
    "print_over_seeds",
    "print_published",
    "print_tables",
    "result_folder",
    "summarize",
    "truth_of_mesh",
    "write_results",
]

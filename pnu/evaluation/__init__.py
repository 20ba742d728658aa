"""Whole clouds measured against true surfaces: inputs of several kinds, any upsamplers, tables."""

from pnu.evaluation.cases import KINDS, Case, Truth, mesh_cases, pair_cases, truth_of_mesh
from pnu.evaluation.measure import Method, Row, evaluate, measure, network_upsampler
from pnu.evaluation.report import columns, legend, print_tables, result_folder, summarize, write_results
from pnu.evaluation.sources import PARTS, Source, source

__all__ = [
    "KINDS",
    "PARTS",
    "Case",
    "Method",
    "Row",
    "Source",
    "Truth",
    "columns",
    "evaluate",
    "legend",
    "measure",
    "mesh_cases",
    "network_upsampler",
    "pair_cases",
    "print_tables",
    "result_folder",
    "source",
    "summarize",
    "truth_of_mesh",
    "write_results",
]

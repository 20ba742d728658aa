"""The examples in docstrings run, and what users call has one."""

import ast
import doctest
import importlib
from pathlib import Path

import pytest
import torch

import pnu
from pnu.io import Mesh

PACKAGE = Path(pnu.__file__).parent
MODULES = {
    ".".join(path.relative_to(PACKAGE.parent).with_suffix("").parts): path
    for path in PACKAGE.rglob("*.py")
    if ">>> " in path.read_text(encoding="utf-8")
}


@pytest.mark.parametrize("name", MODULES)
def test_examples_run(name: str) -> None:
    result = doctest.testmod(importlib.import_module(name), extraglobs={"torch": torch, "Mesh": Mesh})
    assert result.attempted > 0
    assert result.failed == 0


def test_what_users_call_has_an_example() -> None:
    for name in ("upsample", "normals", "load", "PointCloudUpsampler"):
        assert ">>> " in (getattr(pnu, name).__doc__ or ""), name
    for node in ast.parse(MODULES["pnu.metrics.classes"].read_text()).body:
        if isinstance(node, ast.ClassDef) and node.name != "CloudMean":
            assert ">>> " in (ast.get_docstring(node) or ""), node.name
    for node in ast.parse(MODULES["pnu.metrics.functional"].read_text()).body:
        if isinstance(node, ast.FunctionDef) and not node.name.startswith("_"):
            assert ">>> " in (ast.get_docstring(node) or ""), node.name

"""Triton kernels compiled for a GPU that is not here."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

COMPILED = """
import sys
import triton
from triton.backends.compiler import GPUTarget
from triton.compiler import ASTSource

if "nvidia" not in triton.backends.backends:
    sys.exit("nothing compiles here: this Triton has no NVIDIA backend")
FLOAT, INDEX, PLACE, NUMBER = "*fp32", "*i64", "*i32", "i32"

def compiled(kernel, types, warps=4, **constants):
    names = kernel.arg_names
    signature = dict(zip(names, [*types, *["constexpr"] * len(constants)], strict=True))
    source = ASTSource(kernel, signature=signature, constexprs=constants)
    target = GPUTarget("cuda", int(sys.argv[1]), 32)
    print(len(triton.compile(source, target=target, options=dict(num_warps=warps)).asm["cubin"]))
"""


def machine_code_sizes(calls: str, capability: int, cache: Path) -> list[int]:
    """Bytes of machine code of each `compiled(kernel, types, warps, **constants)` in a piece of Python.

    In a process of its own, since the tests' has Triton's interpreter. Skips where Triton cannot compile for NVIDIA.
    """
    environment = {name: value for name, value in os.environ.items() if name != "TRITON_INTERPRET"}
    made = subprocess.run(
        [sys.executable, "-W", "ignore", "-c", COMPILED + calls, str(capability)],
        env=environment | {"TRITON_CACHE_DIR": str(cache)}, capture_output=True, text=True, check=False,
    )  # fmt: skip
    if "nothing compiles here" in made.stderr:
        pytest.skip(made.stderr.strip())
    assert made.returncode == 0, made.stderr
    return [int(line) for line in made.stdout.split()]

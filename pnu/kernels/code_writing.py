"""Machine code of compiled kernels into a file that `code_loading` takes without numba.

Here alone is what numba and llvmlite do not promise: how to get a kernel's module, what its code is called with, and
which two functions it calls for scratch memory. Each is checked, and the file is kept if a process that loads it and
calls it ends well; otherwise numba goes on loading its own files.
"""

import ctypes
import hashlib
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from pnu.io import atomic_path
from pnu.kernels.code_loading import BOOLEAN, POINTER, WORD, load_code, word_types

ALLOWED = {"malloc", "free", "log", "logf", "tanh", "tanhf", "memcpy", "memmove", "memset"}  # of the C library
NAMES = {POINTER: "ptr", WORD: "i64", BOOLEAN: "i8"}
HEAD = 48  # bytes before the numbers of an array: how many use it, two unused words, where they are, their size, unused
PATIENCE = 300  # seconds, on a busy machine


def write_code(path: Path, kernels: Mapping[str, tuple[str, Any]]) -> None:
    """Keep kernels: by name their signatures and what numba made of them.

    Raises where numba did not compile them in this process or from its own files, or not as expected.
    """
    if not sys.platform.startswith("linux") or ctypes.sizeof(ctypes.c_void_p) != 8:
        raise NotImplementedError("tried on Linux of 64 bits alone")
    content = _object_file(kernels)
    with atomic_path(path) as place:
        place.write_bytes(hashlib.sha256(content).digest() + content)
        program = "import sys; from pnu.kernels.code_writing import works; sys.exit(not works(sys.argv[1]))"
        command = [sys.executable, "-c", program, str(place)]
        subprocess.run(command, check=True, capture_output=True, timeout=PATIENCE)


def works(path: str) -> bool:
    """Whether a file can be loaded, and a kernel that takes scratch memory called."""
    code = load_code(Path(path))
    if code is None:
        return False
    put_in_order = code.kernel("boxes._put_in_order", "void(float64[:, ::1], int64, int64[::1])", works)
    before, order = np.arange(1000), np.arange(1000)
    put_in_order(np.random.default_rng(0).normal(size=(1000, 3)), 16, order)
    return not np.array_equal(order, before) and np.array_equal(np.sort(order), before)


def _object_file(kernels: Mapping[str, tuple[str, Any]]) -> bytes:
    """One of all kernels, as numba optimized them, and nothing else."""
    from llvmlite import binding

    whole = binding.parse_assembly(_memory())
    for name, (signature, kernel) in kernels.items():
        (compiled,) = kernel.overloads.values()
        module = binding.parse_bitcode(compiled.library._get_module_for_linking().as_bitcode())
        code = module.get_function(compiled.fndesc.llvm_func_name)
        found = ["ptr" if str(value.type).endswith("*") else str(value.type) for value in code.arguments]
        if found != [NAMES[word] for word in word_types(signature)]:
            raise TypeError(f"{name}: takes {found}")
        code.name, code.linkage = name, "external"
        whole.link_in(module)  # the kernel and what it calls; no wrappers, which may be left out
        machine = compiled.library.codegen._tm
    for value in [*whole.functions, *whole.global_variables]:
        if not value.is_declaration and value.name not in kernels:
            value.linkage = "internal"
    outside = {f.name for f in whole.functions if f.is_declaration and not f.name.startswith("llvm.")}
    outside |= {value.name for value in whole.global_variables if value.is_declaration}
    if not outside <= ALLOWED:
        raise NotImplementedError(f"calls {sorted(outside - ALLOWED)}")
    return bytes(machine.emit_object(whole))


def _memory() -> str:
    """The two functions of numba's runtime that kernels call for scratch arrays, which only they ever hold."""
    from llvmlite import ir

    module, word, pointer = ir.Module(), ir.IntType(64), ir.IntType(8).as_pointer()
    malloc = ir.Function(module, ir.FunctionType(pointer, [word]), "malloc")
    free = ir.Function(module, ir.FunctionType(ir.VoidType(), [pointer]), "free")

    allocate = ir.Function(module, ir.FunctionType(pointer, [word, ir.IntType(32)]), "NRT_MemInfo_alloc_aligned")
    size, align = allocate.args
    builder = ir.IRBuilder(allocate.append_basic_block())
    align = builder.zext(align, word)
    room = builder.add(builder.add(size, align), word(HEAD))
    place = builder.call(malloc, [room])
    with builder.if_then(builder.icmp_unsigned("!=", place, pointer(None))):
        first = builder.add(builder.ptrtoint(place, word), word(HEAD))
        past = builder.urem(first, align)
        data = builder.sub(builder.add(first, align), past)
        words = builder.bitcast(place, word.as_pointer())
        for number, value in enumerate([word(1), word(0), word(0), data, size, word(0)]):
            builder.store(value, builder.gep(words, [word(number)]))
    builder.ret(place)

    release = ir.Function(module, ir.FunctionType(ir.VoidType(), [pointer]), "NRT_MemInfo_call_dtor")
    builder = ir.IRBuilder(release.append_basic_block())
    builder.call(free, [release.args[0]])
    builder.ret_void()
    return str(module)

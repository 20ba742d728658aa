"""Compiled kernels without numba: machine code that `code_writing` kept, loaded by llvmlite and called by ctypes.

What is kept is one object file after its checksum. A kernel in it takes what numba's compiler hands over, of an array
its place, sizes and steps; `code_writing` compares that with what is handed over here.
"""

import ctypes
import hashlib
import re
from functools import update_wrapper
from pathlib import Path
from typing import Any

import numpy as np

DIGEST = 32  # bytes before the object file
POINTER, WORD, BOOLEAN = ctypes.c_void_p, ctypes.c_int64, ctypes.c_uint8
DONE = (0, -2)  # what a kernel returns; else it raised


class KernelArgument:
    """One of a kernel: int64, boolean, or an array like `float64[:, ::1]`, in one piece if that ends in 1."""

    def __init__(self, kind: str, steps: str) -> None:
        self.name = f"{kind}[{steps}]" if steps else kind
        self.dimensions = steps.count(",") + 1 if steps else 0
        self.whole = steps.endswith("1")
        self.dtype = np.dtype(kind) if steps else None
        self.number: type[int] = bool if kind == "boolean" else int

    @property
    def types(self) -> list[Any]:
        """Of the words that the code takes for it; the first two of an array are for numba's own memory."""
        if self.dtype is None:
            return [BOOLEAN if self.number is bool else WORD]
        return [POINTER, POINTER, WORD, WORD, POINTER, *[WORD] * (2 * self.dimensions)]

    def words(self, value: Any) -> list[Any] | None:
        """A value as the code takes it; None where it does not."""
        if self.dtype is None:
            return [self.number(value)] if isinstance(value, int | np.integer | np.bool_) else None
        if not (isinstance(value, np.ndarray) and value.dtype == self.dtype and value.ndim == self.dimensions):
            return None
        if not (value.flags.carray if self.whole else value.flags.behaved):  # aligned, writable
            return None
        return [None, None, value.size, value.itemsize, value.ctypes.data, *value.shape, *value.strides]


def kernel_arguments(signature: str) -> list[KernelArgument]:
    """Those of `void(...)`."""
    found = re.findall(r"(\w+)(?:\[([^]]+)\])?", signature.removeprefix("void"))
    return [KernelArgument(kind, steps) for kind, steps in found]


def word_types(signature: str) -> list[Any]:
    """Of all words that code is called with: two places for what it returns and raises, then its arguments."""
    return [POINTER, POINTER, *(word for argument in kernel_arguments(signature) for word in argument.types)]


class Kernel:
    """Kept code, called as a function of numba: on the same arguments, and without the interpreter's lock.

    Args:
        name: for messages.
        signature: `void(...)` of numba's types.
        address: of the code,
        memory: which lives as long as this.
    """

    def __init__(self, name: str, signature: str, address: int, memory: object) -> None:
        self.memory = memory
        self.name, self.arguments = name, kernel_arguments(signature)
        self.code = ctypes.CFUNCTYPE(ctypes.c_int32, *word_types(signature))(address)

    def __call__(self, *values: Any) -> None:
        if len(values) != len(self.arguments):
            raise TypeError(f"{self.name}: expected {len(self.arguments)} arguments, found {len(values)}")
        returned, raised = ctypes.c_void_p(), ctypes.c_void_p()
        words: list[Any] = [ctypes.addressof(returned), ctypes.addressof(raised)]
        for number, (argument, value) in enumerate(zip(self.arguments, values, strict=True), 1):
            taken = argument.words(value)
            if taken is None:
                raise TypeError(f"{self.name}: argument {number}: expected {argument.name}, found {_told(value)}")
            words += taken
        if self.code(*words) not in DONE:  # kernels raise for nothing else
            raise MemoryError(f"{self.name}: no memory for intermediate results")


class MachineCode:
    """An object file in memory. Raises where llvmlite does not take it."""

    def __init__(self, content: bytes) -> None:
        from llvmlite import binding

        binding.initialize_native_target()
        binding.initialize_native_asmprinter()
        machine = binding.Target.from_default_triple().create_target_machine()
        self.engine = binding.create_mcjit_compiler(binding.parse_assembly(""), machine)
        self.engine.add_object_file(binding.ObjectFileRef.from_data(content))
        self.engine.finalize_object()

    def kernel(self, name: str, signature: str, function: Any) -> Kernel:
        """The kernel that a function was compiled to; KeyError where it is not here."""
        address = self.engine.get_function_address(name)
        if not address:
            raise KeyError(name)
        made = Kernel(name, signature, address, self.engine)
        update_wrapper(made, function)
        return made


def load_code(path: Path) -> MachineCode | None:
    """What a file keeps; None where it is missing or damaged, or cannot be loaded here."""
    try:
        content = _object_file(path)
        return None if content is None else MachineCode(content)
    except Exception:  # no llvmlite, or another one: numba makes the kernels then
        return None


def intact(path: Path) -> bool:
    """Whether a file is there, and as it was written."""
    return _object_file(path) is not None


def _object_file(path: Path) -> bytes | None:
    try:
        content = path.read_bytes()
    except OSError:
        return None
    return content[DIGEST:] if hashlib.sha256(content[DIGEST:]).digest() == content[:DIGEST] else None


def _told(value: Any) -> str:
    if not isinstance(value, np.ndarray):
        return type(value).__name__
    flags = value.flags
    not_so = {"in pieces": flags.c_contiguous, "not aligned": flags.aligned, "read-only": flags.writeable}
    return ", ".join([f"{value.dtype} {value.shape}", *(word for word, good in not_so.items() if not good)])

"""Check this machine, its libraries and compiled kernels: `pnu doctor [--install [--no-system] | --require]`."""

import sys

from pnu.kernels.compilation import compile_all, complete, reason, wanting
from pnu.runtime import system_libraries


def kernels_line(*, install: bool) -> str:
    """Compile the kernels if they are to be installed; whether they are there and, if not, why and what that means."""
    if install and wanting():
        print("compiling kernels for this processor, once: about a minute", flush=True)
        compile_all()
    if complete():
        damaged = "; their machine code is missing or damaged: pnu doctor --install writes it anew" if wanting() else ""
        return f"Compiled kernels are here{damaged}."
    why = reason() or "pnu doctor --install compiles them"
    return f"Compiled kernels are not here ({why}): `surface` takes a few times as long, with the same results."


def main() -> None:
    """`pnu doctor`."""
    if not set(sys.argv[1:]) - system_libraries.OPTIONS:
        print(kernels_line(install="--install" in sys.argv[1:]))
    system_libraries.main()


if __name__ == "__main__":
    main()

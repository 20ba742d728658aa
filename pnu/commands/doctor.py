"""Check this machine, its libraries and compiled kernels: `pnu doctor [--install [--no-system] | --require]`."""

import sys

from pnu.kernels.compilation import compile_all, complete, folder, reason
from pnu.runtime import system_libraries


def kernels_line(*, install: bool) -> str:
    """Compile the kernels if they are to be installed; whether they are there and, if not, why and what that means."""
    if install and not complete() and folder() is not None:
        print("compiling kernels for this processor, once: about a minute", flush=True)
        compile_all()
    if complete():
        return "Compiled kernels are here."
    why = reason() or "pnu doctor --install compiles them"
    return f"Compiled kernels are not here ({why}): `surface` takes a few times as long, with the same results."


def main() -> None:
    """`pnu doctor`."""
    if not set(sys.argv[1:]) - system_libraries.OPTIONS:
        print(kernels_line(install="--install" in sys.argv[1:]))
    system_libraries.main()


if __name__ == "__main__":
    main()

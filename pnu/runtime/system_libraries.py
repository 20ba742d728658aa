"""Check this machine for the system libraries that open3d needs: `pnu doctor [--install | --require]`.

Only open3d's own functions (Poisson reconstruction) and TensorBoard beside an installed open3d need them; training,
data preparation, upsampling and evaluation do not. `--install` installs what is missing where this is Debian and the
user is root, and prints the line to run otherwise, also with `--no-system`; `--require` ends with exit code 1 where
open3d cannot be imported.
"""

import ctypes
import os
import shutil
import subprocess
import sys

# shared library that `import open3d` loads -> Debian's package
LIBRARIES = {
    "libusb-1.0.so.0": "libusb-1.0-0",
    "libGL.so.1": "libgl1",
    "libEGL.so.1": "libegl1",
    "libidn2.so.0": "libidn2-0",  # of open3d 0.20; most systems have it, Debian 13's small images do not
}
OPTIONS = {"--install", "--require", "--no-system"}


def missing_packages() -> list[str]:
    """Debian packages of the libraries that cannot be loaded here; empty on other systems than Linux."""
    if not sys.platform.startswith("linux"):
        return []
    missing = []
    for library, package in LIBRARIES.items():
        try:
            ctypes.CDLL(library)
        except OSError:
            missing.append(package)
    return missing


def install_line(packages: list[str]) -> str:
    """The line that installs Debian packages."""
    return f"apt-get install --no-install-recommends {' '.join(packages)}"


def install(packages: list[str]) -> bool:
    """Install Debian packages as root. False where that is not possible or failed."""
    if getattr(os, "geteuid", lambda: 1)() != 0 or shutil.which("apt-get") is None:
        return False
    print(f"installing system libraries that open3d needs: {install_line(packages)}", flush=True)
    environment = os.environ | {"DEBIAN_FRONTEND": "noninteractive"}
    for command in (["apt-get", "update", "-qq"], ["apt-get", "install", "-qq", "--no-install-recommends", *packages]):
        if subprocess.run(command, env=environment, stdout=subprocess.DEVNULL, check=False).returncode:
            return False
    return True


def open3d_error() -> str | None:
    """Why open3d cannot be imported here, or None. Imports in a child process: a broken one may take it down."""
    run = subprocess.run([sys.executable, "-c", "import open3d"], capture_output=True, text=True, check=False)
    return None if run.returncode == 0 else (run.stderr.strip().splitlines() or ["crashed"])[-1]


def main() -> None:
    """`pnu doctor`."""
    arguments = sys.argv[1:]
    if {"--help", "-h"} & {*arguments}:
        print(__doc__)
        return
    if unknown := sorted({*arguments} - OPTIONS):
        print(f"error: unknown option {unknown[0]}: expected {', '.join(sorted(OPTIONS))}", file=sys.stderr)
        sys.exit(2)
    missing = missing_packages()
    if missing and "--install" in arguments and "--no-system" not in arguments and install(missing):
        missing = missing_packages()
    if missing:
        print(f"open3d needs system libraries that are missing here; run as root:\n  {install_line(missing)}")
        print("Everything but Poisson reconstruction and TensorBoard works without them.")
    if "--install" in arguments and not missing:
        return
    error = open3d_error()
    if error:
        print(f"open3d cannot be imported: {error}", file=sys.stderr)
        if "--require" in arguments:
            sys.exit(1)
    elif not missing:
        print("open3d and the system libraries it needs are here.")


if __name__ == "__main__":
    main()

"""What not every use needs: extras that name themselves, systems without POSIX, a container."""

import ast
import importlib.util
import json
import os
import re
import shlex
import shutil
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from fnmatch import fnmatch
from functools import cache
from pathlib import Path
from types import SimpleNamespace

import pytest
from packaging.requirements import Requirement
from packaging.specifiers import SpecifierSet

import pnu
from pnu import weights
from pnu.benchmark import cost
from pnu.extras import EXTRAS, MissingExtra, needed, require
from pnu.kernels import compilation
from pnu.runtime import system_libraries, threads
from pnu.training import sweeps

ROOT = Path(__file__).resolve().parents[1]
TOML = tomllib.loads((ROOT / "pyproject.toml").read_text())
PROJECT = TOML["project"]
WHEEL = TOML["tool"]["hatch"]["build"]["targets"]["wheel"]
PARTS = {*WHEEL["packages"], *WHEEL["force-include"]}
ALONE = {"las_child.py", "e57_child.py", "poisson_process.py"}  # processes of their own


def top(module: str) -> str:
    return "tensorboard" if module.startswith("torch.utils.tensorboard") else module.split(".")[0]


def bare_imports(path: Path) -> Iterator[str]:
    """Imports of what belongs to an extra that stand outside of `with needed(...)`."""
    tree = ast.parse(path.read_text())
    guarded = set()
    for node in ast.walk(tree):
        named = isinstance(node, ast.With) and ast.unparse(node.items[0]).startswith("needed(")
        typed = isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING"
        if named or typed:
            guarded |= {*ast.walk(node)}
    for node in ast.walk(tree):
        if node not in guarded and isinstance(node, ast.Import | ast.ImportFrom):
            names = [node.module or ""] if isinstance(node, ast.ImportFrom) else [alias.name for alias in node.names]
            yield from (name for name in names if top(name) in EXTRAS)


@pytest.mark.slow
def test_every_optional_import_names_its_extra(tmp_path: Path) -> None:
    found = {path.name: [*bare_imports(path)] for path in (ROOT / "pnu").rglob("*.py") if path.name not in ALONE}
    assert {name: bare for name, bare in found.items() if bare} == {}
    (tmp_path / "a.py").write_text("import h5py\nwith needed('x'):\n    import laspy\nfrom matplotlib import style\n")
    assert [*bare_imports(tmp_path / "a.py")] == ["h5py", "matplotlib"]


def test_extras_bring_what_they_are_said_to_bring() -> None:
    extras = {
        name: {Requirement(line).name for line in lines} for name, lines in PROJECT["optional-dependencies"].items()
    }
    base = {Requirement(line).name for line in PROJECT["dependencies"]}
    package = {"optuna": "hydra-optuna-sweeper", "lazrs": "laspy"}
    for module, extra in EXTRAS.items():
        assert package.get(module, module) in extras[extra], module
        assert package.get(module, module) not in base, module
    developed = next(line for line in PROJECT["optional-dependencies"]["dev"] if line.startswith("pnu["))
    assert Requirement(developed).extras >= {*EXTRAS.values()}  # what `make` installs


def test_what_is_missing_is_said_in_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "h5py", None)
    line = r'^cutting patches needs h5py, which is not installed: pip install "pnu\[train\]"$'
    with pytest.raises(MissingExtra, match=line), needed("cutting patches"):
        import h5py  # noqa: F401
    with pytest.raises(ModuleNotFoundError, match="^No module named 'nothing_of_that_name'$"), needed("x"):
        import nothing_of_that_name  # noqa: F401
    monkeypatch.setattr("importlib.util.find_spec", lambda _: None)
    with pytest.raises(ValueError, match=r'^x needs open3d, .*: pip install "pnu\[poisson\]"$'):
        require("open3d", "x")


BASE = """
import sys
from pnu.extras import EXTRAS
class Absent:
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] in EXTRAS:
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)
sys.meta_path.insert(0, Absent())
import numpy, pnu
from pnu.__main__ import main
points = numpy.random.default_rng(0).normal(size=(200, 3))
points /= numpy.linalg.norm(points, axis=1, keepdims=True)
numpy.savetxt("a.xyz", points)
for arguments in (
    ["upsample", "input=a.xyz", "output=dense.ply", "quiet=true"],
    ["normals", "input=a.xyz", "output=normals.ply", "quiet=true"],
    ["picture", "inputs=[a.xyz]", "output=a.png", "quiet=true"],
    ["train", "quiet=true"], ["prepare", "quiet=true"],
    ["reconstruct", "input=dense.ply", "output=mesh.ply"],
):
    try:
        main(arguments)
        print(arguments[0], "done")
    except SystemExit as stop:
        print(arguments[0], stop.code)
"""


@pytest.mark.slow
def test_the_base_alone_densifies_and_names_what_is_missing(tmp_path: Path) -> None:
    environment = os.environ | {"PYTHONPATH": str(ROOT), "COLUMNS": "200"}
    done = subprocess.run([sys.executable, "-c", BASE], cwd=tmp_path, env=environment, capture_output=True, text=True)
    last = [line for line in done.stdout.splitlines() if re.fullmatch(r"\w+ (done|2)", line)]
    expected = ["upsample done", "normals done", "picture done", "train 2", "prepare 2", "reconstruct 2"]
    assert last == expected, done.stdout + done.stderr
    errors = [line for line in done.stderr.splitlines() if line.startswith("error: ")]
    extras = re.findall(r'pip install "pnu\[(\w+)\]"', "\n".join(errors))
    assert extras == ["train", "train", "poisson"], errors


def test_weights_that_no_wheel_carries_are_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(weights, "FOLDER", tmp_path)
    with pytest.raises(ValueError, match=r"^run=punet: .* take pnu/weights/punet\.safetensors from the repository and"):
        pnu.load("punet")
    assert {path.stem for path in (ROOT / "pnu" / "weights").glob("*.safetensors")} >= {*weights.RIVALS}


POSIX = re.compile(
    r"\b(import (?:fcntl|resource|pwd|grp|termios|tty|pty|posix)\b|os\.(?:fork|kill|killpg|nice|getuid|geteuid|setsid"
    r"|mkfifo|sched_getaffinity|uname|statvfs|getpgid|chown|wait\w*)\b|signal\.(?:SIGKILL|SIGHUP|SIGALRM|SIGUSR\d|SIGQUIT|alarm))"
)
KNOWN = {  # each with a fallback, which a test here runs, or a test of its own
    ("training/sweeps.py", "import fcntl"): "_locked_file",
    ("kernels/compilation.py", "import fcntl"): "ImportError",
    ("kernels/compilation.py", "os.nice"): "AttributeError",
    ("benchmark/cost.py", "import resource"): "ImportError",
    ("runtime/threads.py", "os.sched_getaffinity"): "hasattr",
    ("io/las_child.py", "import resource"): "ImportError",
    ("io/e57_child.py", "import resource"): "ImportError",
    **dict.fromkeys((("app/jobs.py", "os.killpg"), ("app/jobs.py", "signal.SIGKILL")), 'hasattr(os, "killpg")'),
    **dict.fromkeys(
        (("commands/_worker.py", "os.killpg"), ("commands/_worker.py", "signal.SIGKILL")), 'hasattr(os, "killpg")'
    ),
}


def test_calls_that_only_posix_has_have_a_fallback(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    found = {
        (path.relative_to(ROOT / "pnu").as_posix(), call)
        for path in (ROOT / "pnu").rglob("*.py")
        for call in POSIX.findall(path.read_text())
    }
    assert found == KNOWN.keys()
    assert all(fallback in (ROOT / "pnu" / place).read_text() for (place, _), fallback in KNOWN.items())

    taken: list[int] = []

    def locking(descriptor: int, _mode: int, _count: int) -> None:
        if taken:
            raise OSError("taken")
        taken.append(descriptor)

    monkeypatch.setitem(sys.modules, "fcntl", None)
    monkeypatch.setitem(sys.modules, "msvcrt", SimpleNamespace(locking=locking, LK_NBLCK=2))
    os.close(sweeps.locked(tmp_path))
    with pytest.raises(ValueError, match="another process runs this job"):
        sweeps.locked(tmp_path)
    assert compilation._taken(None, wait=False)
    monkeypatch.setattr(cost, "resource", None)
    assert len(cost.children()) == 2
    monkeypatch.delattr(os, "sched_getaffinity")
    assert threads.processor_count() == os.cpu_count()
    monkeypatch.delattr(os, "geteuid")
    assert not system_libraries.install(["libgl1"])


DOCKERFILE = (ROOT / "Dockerfile").read_text()
BROUGHT = {"libX11.so.6": "libgl1", "libudev.so.1": "libusb-1.0-0"}  # by packages that are asked for
EVERYWHERE = re.compile(r"(lib(c|m|gcc_s|stdc\+\+)|ld-linux-x86-64)\.so\.\d")  # apt itself needs them


@pytest.mark.skipif(shutil.which("readelf") is None, reason="no readelf")
def test_the_libraries_that_open3d_is_linked_to_are_known() -> None:
    (place,) = importlib.util.find_spec("open3d").submodule_search_locations
    found = {path for path in Path(place).glob("libOpen3D.so*") if not path.is_symlink()}
    if not found:
        pytest.skip("another build of open3d")
    dynamic = subprocess.run(["readelf", "-d", *found], capture_output=True, text=True, check=True).stdout
    needed = set(re.findall(r"\(NEEDED\).*\[(.*)\]", dynamic))
    own = {path.name for path in Path(place).glob("*.so*")}
    asked = {name for name in needed - own if not EVERYWHERE.fullmatch(name)}
    assert asked - BROUGHT.keys() <= system_libraries.LIBRARIES.keys()
    assert {*BROUGHT.values()} <= {*system_libraries.LIBRARIES.values()}


def sent(path: str) -> bool:
    """Whether .dockerignore lets a file of the repository through: the last line that fits decides."""
    passes = True
    parts = Path(path).parts
    for line in (ROOT / ".dockerignore").read_text().split():
        pattern, back = line.removeprefix("!"), line.startswith("!")
        anywhere = pattern.removeprefix("**/")
        starts = range(len(parts)) if anywhere != pattern else [0]
        fits = [fnmatch("/".join(parts[i:j]), anywhere) for i in starts for j in range(i + 1, len(parts) + 1)]
        passes = back if any(fits) else passes
    return passes


@cache
def parsed_by_pip(*arguments: str) -> bool:
    """Whether pip knows these options; `--help` ends it before it does anything."""
    return not subprocess.run([sys.executable, "-m", "pip", *arguments, "--help"], capture_output=True).returncode


def faults(text: str) -> Iterator[str]:
    """What would stop a build of the container, or make one that does not work."""
    user, made, copied, installed = "root", set(), set(), False
    for word, rest in re.findall(r"^([A-Z]+) (.*)$", text.replace("\\\n", " "), re.M):
        if word == "FROM":
            python = re.fullmatch(r"python:(3\.\d+)-slim(-\w+)?", rest)
            if python is None or python[1] not in SpecifierSet(PROJECT["requires-python"]):
                yield f"another Python: {rest}"
        elif word == "COPY":
            *sources, _ = rest.split()
            copied |= {*sources}
            for source in sources:
                inside = [path for path in (ROOT / source).rglob("*") if "__pycache__" not in path.parts]
                files = [path.relative_to(ROOT).as_posix() for path in inside if path.is_file()] or [source]
                if not (ROOT / source).exists() or not all(map(sent, files)):
                    yield f"not sent to the builder: {source}"
        elif word == "USER":
            user = rest
            if user not in made:
                yield f"nobody made the user {user}"
        elif word == "ENTRYPOINT" and json.loads(rest) != [*PROJECT["scripts"]]:
            yield f"starts {rest}"
        elif word == "RUN":
            for program, *arguments in (shlex.split(part) for part in rest.split("&&")):
                as_root = program in ("apt-get", "useradd", "install") or program == "pip"
                if as_root is not (user == "root") and program not in ("rm", "chmod"):
                    yield f"{program} as {user}"
                if program == "apt-get" and arguments[0] == "install":
                    packages = {argument for argument in arguments[1:] if not argument.startswith("-")}
                    for package in packages ^ {*system_libraries.LIBRARIES.values()}:
                        yield f"system library: {package}"
                elif program == "pip":
                    if not parsed_by_pip(*arguments):
                        yield f"pip does not know {arguments}"
                    if "--constraint" in arguments and not copied & {arguments[arguments.index("--constraint") + 1]}:
                        yield "constraints are not there yet"
                    for extras in re.findall(r"^\.\[(.*)\]$", arguments[-1]):
                        installed = True
                        wheel = {"pyproject.toml", PROJECT["readme"], *PROJECT["license-files"], *PARTS}
                        for name in wheel - copied:
                            yield f"the wheel is made without {name}"
                        for extra in {*extras.split(",")} - PROJECT["optional-dependencies"].keys():
                            yield f"no extra {extra}"
                elif program == "useradd":
                    made.add(arguments[-1])
                elif program == "pnu" and not (installed and {*arguments} <= {"doctor"} | system_libraries.OPTIONS):
                    yield f"pnu {arguments}"
    if user in ("root", "0"):
        yield "runs as root"
    if not re.search(r"^RUN pnu doctor --install.* && pnu doctor --require\b", text, re.M):
        yield "nobody sees whether it works"


def test_the_container_can_be_built_and_does_not_run_as_root() -> None:
    assert [*faults(DOCKERFILE)] == []
    assert sent("pnu/weights/surface.safetensors")  # and the wheel has them, see test_wheel.py
    assert not sent("outputs/run.json")
    assert not sent("pnu/__pycache__/train.pyc")


@pytest.mark.parametrize(
    ("line", "faulty", "fault"),
    [
        ("COPY conf conf\n", "", "the wheel is made without conf"),
        ("COPY pnu pnu", "COPY pnu tests pnu", "not sent to the builder: tests"),
        ("README.md LICENSE", "LICENSE", "the wheel is made without README.md"),
        ("USER pnu\n", "", "runs as root"),
        ("USER pnu\n", "", "pnu as root"),
        ("useradd --create-home pnu", "useradd --create-home somebody", "nobody made the user pnu"),
        ("libegl1 ", "", "system library: libegl1"),
        ("poisson,las", "poison,las", "no extra poison"),
        ("--no-deps", "--no-depends", "pip does not know"),
        ("COPY constraints.txt ./\n", "", "constraints are not there yet"),
        ("--no-system", "--nosystem", "pnu ['doctor', '--install', '--nosystem']"),
        (" && pnu doctor --require", "", "nobody sees whether it works"),
        ("python:3.13", "python:3.9", "another Python"),
        ('["pnu"]', '["python"]', 'starts ["python"]'),
    ],
)
def test_faults_of_a_container_are_found(line: str, faulty: str, fault: str) -> None:
    assert line in DOCKERFILE
    assert any(found.startswith(fault) for found in faults(DOCKERFILE.replace(line, faulty)))


def test_make_leaves_the_system_alone_if_asked() -> None:
    def steps(*given: str) -> str:
        command = ["make", "--dry-run", "--always-make", "setup", f"PYTHON={sys.executable}", *given]
        outside = {name: value for name, value in os.environ.items() if name not in ("MAKEFLAGS", "MFLAGS", "SYSTEM")}
        return subprocess.run(command, cwd=ROOT, env=outside, capture_output=True, text=True, check=True).stdout

    assert "doctor --install --no-system" in steps("SYSTEM=no")
    assert "--no-system" not in steps()

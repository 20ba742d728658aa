"""The house: imports point one way, and `import pnu` stays light."""

import ast
import re
import subprocess
import sys
from collections import Counter
from collections.abc import Collection, Iterable, Iterator
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

PACKAGE = Path(__file__).resolve().parents[1] / "pnu"

# From the ground up. A file imports only from rooms before its own, and from its own.
ROOMS = [
    *(
        "extras",
        "io",
        "config",
        "weights",
        "runtime",
        "kernels",
        "geometry",
        "data",
        "networks",
        "cleaning",
        "losses",
        "metrics",
        "fast",
        "rendering",
    ),
    *("reconstruction", "upsamplers", "training", "benchmark", "report", "app", "commands", "train", "__main__"),
]
HEAVY = {"torch", "lightning", "hydra", "open3d", "tensorboard", "torchmetrics", "scipy", "h5py", "trimesh", "numba"}


WHOLE = {
    "docs",
    "examples",
    "extending",
    "extras",
    "layers",
    "nightly",
    "notebooks",
    "side_effects",
    "wheel",
}  # tests of no room alone


def test_tests_mirror_the_rooms() -> None:
    tests = Path(__file__).parent
    assert {path.stem.removeprefix("test_") for path in tests.glob("test_*.py")} == WHOLE
    assert {path.parent.name for path in tests.rglob("test_*.py") if path.parent != tests} <= set(ROOMS)


def modules() -> dict[str, Path]:
    names = {}
    for path in PACKAGE.rglob("*.py"):
        parts = ("pnu", *path.relative_to(PACKAGE).with_suffix("").parts)
        names[".".join(parts).removesuffix(".__init__")] = path
    return names


def room(module: str) -> str:
    return ".".join(module.split(".")[:2])


def place(module: str) -> int:
    """Of a module's room in the order of the house."""
    name = room(module).removeprefix("pnu.")
    assert name in ROOMS, f"{module}: give its room a place in ROOMS"
    return ROOMS.index(name)


def imported(path: Path) -> set[str]:
    """Modules of pnu that a file imports, in functions too; imports for type checkers alone do not count."""
    tree = ast.parse(path.read_text())
    for node in ast.walk(tree):
        if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING":
            node.body = []
    found: set[str] = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
            found |= {node.module} | {f"{node.module}.{alias.name}" for alias in node.names}
    return {name for name in found if name.startswith("pnu.")}


def violations(names: dict[str, Path]) -> list[str]:
    found = []
    for module, path in names.items():
        if module == "pnu":
            continue
        for target in imported(path) & names.keys():
            if room(target) != room(module) and place(target) >= place(module):
                found.append(f"{module} imports {target}")
    return found


def test_imports_point_down() -> None:
    assert violations(modules()) == []


def test_upward_import_is_found(tmp_path: Path) -> None:
    culprit = tmp_path / "io.py"
    culprit.write_text("def f():\n    from pnu.geometry import nearest\n")
    names = modules() | {"pnu.io": culprit}
    assert "pnu.io imports pnu.geometry" in violations(names)


ENDING = re.compile(r"(ing|ions|ion|ers|er|ed|es|s|e)$")


def alike(names: Iterable[str]) -> list[set[str]]:
    """Names that are equal, or differ by an ending only."""
    found: dict[str, set[str]] = {}
    for name in names:
        found.setdefault(ENDING.sub("", name.strip("_")), set()).add(name)
    return [group for group in found.values() if len(group) > 1]


def test_no_two_names_of_files_differ_by_an_ending_only() -> None:
    paths = [path for path in PACKAGE.rglob("*.py") if not path.stem.startswith("__")]
    inner = [path.stem for path in paths if path.parent != PACKAGE and path.parent.name != "commands"]
    assert len(inner) == len(set(inner))
    rooms = [path.name for path in PACKAGE.iterdir() if path.is_dir() and path.name != "__pycache__"]
    assert alike([*inner, *rooms]) == []
    assert alike(["picture", "pictures", "render"]) == [{"picture", "pictures"}]


PROTOCOLS = {  # names that are the same because the functions can stand for each other, or are started by their file
    *("main", "ball_query", "closest_points", "farthest_points", "knn"),
}


def public(path: Path) -> set[str]:
    """Public functions and classes of a file; without the function of a verb, and without the fast form of a class,
    which is a subclass of the same name."""
    names = set()
    for node in ast.parse(path.read_text()).body:
        if isinstance(node, ast.FunctionDef) and not (path.parent.name == "commands" and node.name == path.stem):
            names.add(node.name)
        if isinstance(node, ast.ClassDef) and node.name not in {
            ast.unparse(base).split(".")[-1] for base in node.bases
        }:
            names.add(node.name)
    return {name for name in names if not name.startswith("_")}


def defined_twice(paths: Iterable[Path]) -> set[str]:
    count = Counter(name for path in paths for name in public(path))
    return {name for name, number in count.items() if number > 1}


def test_a_public_name_is_defined_in_one_file(tmp_path: Path) -> None:
    assert defined_twice(PACKAGE.rglob("*.py")) == PROTOCOLS
    copy = tmp_path / "copy.py"
    copy.write_text("def closing_lines(): ...\n")
    assert "closing_lines" in defined_twice([*PACKAGE.rglob("*.py"), copy])


# Methods whose meaning is a library's, beside its `on_...` and Python's `__...__`.
HOOKS = {
    *("forward", "update", "compute"),
    *("setup", "prepare_data", "train_dataloader", "val_dataloader", "test_dataloader", "configure_optimizers"),
    *("training_step", "validation_step", "test_step", "state_dict", "load_state_dict"),
    *("save_checkpoint", "load_checkpoint", "apply", "revert"),
}
SECTIONS = ["Args", "Update", "Compute", "Returns", "Raises", "Source", "Example"]


def documented(path: Path) -> Iterator[tuple[str, str | None]]:
    """Public functions, classes and their methods but for hooks and overloads, with their docstrings."""
    tree = ast.parse(path.read_text())
    overloads = {n for n in ast.walk(tree) if "overload" in map(ast.unparse, getattr(n, "decorator_list", []))}
    for node in tree.body:
        if node in overloads:
            continue
        if isinstance(node, ast.FunctionDef | ast.ClassDef) and not node.name.startswith("_"):
            yield node.name, ast.get_docstring(node)
            for method in node.body if isinstance(node, ast.ClassDef) else []:
                own = isinstance(method, ast.FunctionDef) and method not in overloads
                named = own and not method.name.startswith(("_", "on_"))
                if named and not (method.name in HOOKS and ast.get_docstring(method) is None):
                    yield f"{node.name}.{method.name}", ast.get_docstring(method)


def undocumented(path: Path) -> list[str]:
    return [name for name, text in documented(path) if text is None]


def test_every_public_definition_says_what_it_is(tmp_path: Path) -> None:
    assert {module: found for module, path in modules().items() if (found := undocumented(path))} == {}
    silent = tmp_path / "a.py"
    silent.write_text("def f(): ...\n\n\ndef _g(): ...\n\n\nclass C:\n    'Said.'\n\n    def m(self): ...\n")
    assert undocumented(silent) == ["f", "C.m"]


def disordered(path: Path) -> list[str]:
    """Definitions whose docstrings have their sections in another order, or two of one."""
    wrong = []
    for name, text in documented(path):
        places = [SECTIONS.index(found) for found in re.findall(rf"^({'|'.join(SECTIONS)}):", text or "", re.M)]
        if places != sorted(set(places)):
            wrong.append(name)
    return wrong


def test_docstrings_have_one_order(tmp_path: Path) -> None:
    assert {module: found for module, path in modules().items() if (found := disordered(path))} == {}
    mixed = tmp_path / "a.py"
    mixed.write_text('def f():\n    """Do.\n\n    Raises:\n        E: x\n\n    Args:\n        y: z\n    """\n')
    assert disordered(mixed) == ["f"]


def names_in(path: Path) -> set[str]:
    """What a file defines: functions, classes, their methods, constants; keys of yaml."""
    text = path.read_text()
    if path.suffix == ".yaml":
        return set(re.findall(r"^ *(\w+):", text, re.M))
    names = set()
    for node in ast.parse(text).body:
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            names.add(node.name)
        if isinstance(node, ast.ClassDef):
            names |= {f"{node.name}.{part.name}" for part in node.body if isinstance(part, ast.FunctionDef)}
        if isinstance(node, ast.Assign | ast.AnnAssign):
            targets = node.targets if isinstance(node, ast.Assign) else [node.target]
            names |= {target.id for target in targets if isinstance(target, ast.Name)}
    return names


def lost(table: str) -> list[str]:
    """Of a table's answers: files that are not there, and names that the file before them does not define."""
    missing = []
    for row in re.findall(r"^\| [A-Z].*?\| (.*) \|$", table, re.M):
        path = Path()
        for told in re.findall(r"`([^` ]+)`", row):
            if "/" in told:
                path = PACKAGE.parent / told
                missing += [told] * (not path.is_file())
            elif not path.is_file() or told not in names_in(path):
                missing.append(told)
    return missing


def test_the_answers_to_where_is_are_right() -> None:
    page = (PACKAGE.parent / "CONTRIBUTING.md").read_text()
    table = page.split("## Where is ...?")[1].split("\n## ")[0]
    assert table.count("? | ") == 11
    assert lost(table) == []
    assert lost("| Where? | `pnu/io/e57.py` `read_e75`, `pnu/io/e75.py` |") == ["read_e75", "pnu/io/e75.py"]


def files_imported(path: Path, names: Collection[str]) -> set[str]:
    """The files behind the imports of a file, those for type checkers too."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom) and node.module:
            inside = {f"{node.module}.{alias.name}" for alias in node.names}
            found |= inside & set(names) or {node.module}
    return found & set(names)


def test_no_file_imports_itself_on_a_round_way() -> None:
    names = modules()
    del names["pnu"]  # names its public functions for type checkers, and all may ask for its version
    graph = {module: files_imported(path, names) - {module} for module, path in names.items()}
    TopologicalSorter(graph).prepare()
    with pytest.raises(CycleError):
        TopologicalSorter(graph | {"pnu.io.atomic": {"pnu.networks.checkpoints"}}).prepare()


@pytest.mark.parametrize("package", ["lightning", "open3d"])
def test_heavy_packages_stay_in_their_rooms(package: str) -> None:
    """lightning is imported at the top only where a class needs it, open3d only inside functions."""
    lightning = {
        "pnu.data.patch_module",
        "pnu.data.crop_module",
        "pnu.training.adversarial_module",
        "pnu.training.lightning_module",
        "pnu.training.callbacks",
    }
    rooms = {"lightning": lightning, "open3d": set()}[package]
    for module, path in modules().items():
        for node in ast.parse(path.read_text()).body:
            names = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
            names += [node.module or ""] if isinstance(node, ast.ImportFrom) else []
            assert module in rooms or package not in {name.split(".")[0] for name in names}, module


def loaded_by(statement: str) -> set[str]:
    code = f"import sys; {statement}; print(*{{m.split('.')[0] for m in sys.modules}})"
    return set(subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.split())


def test_import_is_light() -> None:
    assert not loaded_by("import pnu; dir(pnu)") & HEAVY


def test_the_public_functions_are_listed_before_their_first_use() -> None:
    assert {"PointCloudUpsampler", "load", "normals", "upsample"} <= loaded_by("import pnu; print(*dir(pnu))")


@pytest.mark.slow
def test_only_pictures_and_reports_load_matplotlib(tmp_path: Path) -> None:
    (tmp_path / "cloud.xyz").write_text("\n".join(f"{x} {y} {x * y / 9}" for x in range(8) for y in range(8)))
    keys = [f"input={tmp_path}/cloud.xyz", f"output={tmp_path}/dense.ply", "quiet=true"]
    calls = f"main(['upsample', *{keys}]); pnu.upsample(numpy.random.rand(64, 3))"
    assert "matplotlib" not in loaded_by(f"import pnu, numpy; from pnu.__main__ import main; {calls}")
    assert (tmp_path / "dense.ply").is_file()
    assert "matplotlib" in loaded_by("from pnu.report import plots; plots.plot('', [print])")


@pytest.mark.slow
def test_heavy_import_would_be_seen() -> None:
    assert "torch" in loaded_by("import pnu; import pnu.geometry.neighbor_search") & HEAVY

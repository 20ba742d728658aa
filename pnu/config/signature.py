"""The arguments of a class, read from its source: nothing is imported, so that `--help` need not wait for torch.

An argument's name, type and default stand in the constructor, its words in the docstring's `Args:`, and nowhere else.
"""

import ast
import functools
import importlib.util
import inspect
import re
import types
import typing
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

REQUIRED = inspect.Parameter.empty  # the default of an argument without default
UNREADABLE = object()  # a default that is no literal
SIMPLE = {"bool": bool, "int": int, "float": float, "str": str, "None": type(None), "Any": Any, "Path": str}
LISTS = ("list", "List", "tuple", "Tuple", "Sequence", "Iterable", "Collection")
LIBRARIES = ("torch", "lightning")  # whose public names in annotations are classes: not worth reading their modules
MAPPINGS = ("dict", "Dict", "Mapping", "MutableMapping")


class Argument(NamedTuple):
    """An argument of a constructor."""

    name: str
    hint: Any  # a type as `pnu.config.schema.as_type` takes it; a `Class` where it is made of a group of keys
    default: Any  # REQUIRED, UNREADABLE or the value
    words: str


class Module(NamedTuple):
    """A module's source, parsed."""

    name: str
    is_package: bool
    tree: ast.Module


class Class(NamedTuple):
    """A class where it is defined."""

    module: Module
    node: ast.ClassDef

    @property
    def target(self) -> str:
        """Its dotted name, as `_target_` has it."""
        return f"{self.module.name}.{self.node.name}"


class NotGiveable(Exception):
    """A type whose values a config cannot hold, such as a module."""


@functools.cache
def arguments(target: str) -> dict[str, Argument] | None:
    """What the class of that dotted name takes, by name; None where there is no such class."""
    module_name, _, name = target.rpartition(".")
    found = definition(module_name, name)
    return dict(arguments_of(found)) if isinstance(found, Class) else None


def arguments_of(cls: Class) -> Iterator[tuple[str, Argument]]:
    """Of the nearest constructor; where it takes `**options`, those of the class above too."""
    methods = [node for node in cls.node.body if isinstance(node, ast.FunctionDef)]
    init = next((node for node in methods if node.name == "__init__"), None)
    if init is None:
        yield from inherited(cls)
        return
    words = docstrings(cls, init)
    names, annotated = init.args.posonlyargs + init.args.args, init.args.kwonlyargs
    defaults: list[ast.expr | None] = [None] * (len(names) - len(init.args.defaults)) + list(init.args.defaults)
    for node, default in zip([*names[1:], *annotated], [*defaults[1:], *init.args.kw_defaults], strict=True):
        hint = hint_of(node.annotation, cls.module)
        yield node.arg, Argument(node.arg, hint, literal(default), words.get(node.arg, ""))
    if init.args.kwarg is not None:
        own = {node.arg for node in [*names, *annotated]}
        above = list(inherited(cls))
        if not above:  # it hands them on to something else, such as wandb.init
            yield "**", Argument("**", Any, UNREADABLE, words.get(init.args.kwarg.arg, ""))
        for name, argument in above:
            if name not in own:  # one without default may be what this class gives
                yield name, argument._replace(default=UNREADABLE if argument.default is REQUIRED else argument.default)


def inherited(cls: Class) -> Iterator[tuple[str, Argument]]:
    """The class that a class's constructor comes from."""
    for base in cls.node.bases:
        above = None
        if isinstance(base, ast.Name):
            above = definition(cls.module.name, base.id)
        elif isinstance(base, ast.Attribute) and isinstance(base.value, ast.Name):  # module.Class
            above = definition(module_named(base.value.id, cls.module), base.attr)
        if isinstance(above, Class):
            yield from arguments_of(above)


def literal(node: ast.expr | None) -> Any:
    """The value that a default's expression stands for."""
    if node is None:
        return REQUIRED
    try:
        value = ast.literal_eval(node)
    except ValueError:
        return UNREADABLE
    return list(value) if isinstance(value, tuple) else value


# --- where a name is defined ---


@functools.cache
def definition(module_name: str, name: str) -> Class | tuple[Module, ast.expr] | None:
    """The class, or the module and the right side of an assignment, that a name in a module stands for."""
    module = parsed(module_name)
    if module is None:
        return None
    for node in toplevel(module.tree.body):
        if isinstance(node, ast.ClassDef) and node.name == name:
            return Class(module, node)
        if isinstance(node, ast.Assign) and any(isinstance(t, ast.Name) and t.id == name for t in node.targets):
            return module, node.value
        if isinstance(node, ast.ImportFrom):
            for alias in node.names:
                if (alias.asname or alias.name) == name:
                    return definition(imported_module(node, module), alias.name)
    return None


def module_named(name: str, module: Module) -> str:
    """The dotted name of the module that a name in a module stands for."""
    for node in toplevel(module.tree.body):
        if isinstance(node, ast.Import | ast.ImportFrom):
            for alias in node.names:
                if (alias.asname or alias.name) == name:
                    return f"{imported_module(node, module)}." * isinstance(node, ast.ImportFrom) + alias.name
    return ""


def toplevel(body: list[ast.stmt]) -> Iterator[ast.stmt]:
    """The statements of a module, those under `if` and `try` too."""
    for node in body:
        yield node
        if isinstance(node, ast.If | ast.Try):
            yield from toplevel(node.body)
            yield from toplevel(node.orelse)


def imported_module(node: ast.Import | ast.ImportFrom, module: Module) -> str:
    """What names an import binds, and to which modules."""
    if isinstance(node, ast.Import) or not node.level:
        return getattr(node, "module", None) or ""
    parts = module.name.split(".")
    base = parts[: len(parts) - node.level + module.is_package]
    return ".".join([*base, *([node.module] if node.module else [])])


@functools.cache
def parsed(module_name: str) -> Module | None:
    """A module's syntax tree; None where no Python source of that name is found."""
    top, *parts = module_name.split(".")
    try:
        spec = importlib.util.find_spec(top) if top.isidentifier() else None  # of a top-level name: imports nothing
    except (ImportError, ValueError):
        return None
    if spec is None:
        return None
    path = Path(spec.origin) if spec.origin and spec.origin.endswith(".py") else None
    folders = [Path(folder) for folder in spec.submodule_search_locations or []]
    for part in parts:
        tried = [path for folder in folders for path in (folder / part / "__init__.py", folder / f"{part}.py")]
        path = next((path for path in tried if part.isidentifier() and path.is_file()), None)
        if path is None:
            return None
        folders = [path.parent] if path.name == "__init__.py" else []
    if path is None:
        return None
    try:
        return Module(module_name, path.name == "__init__.py", ast.parse(path.read_text(encoding="utf-8")))
    except (OSError, SyntaxError, ValueError) as error:
        raise ValueError(f"{path}: cannot be read as Python: {error}") from None


# --- types ---


def hint_of(node: ast.expr | None, module: Module) -> Any:
    """The type that an annotation names."""
    try:
        return read_hint(node, module) if node is not None else Any
    except NotGiveable:
        return Any


def read_hint(node: ast.expr, module: Module) -> Any:
    """The type that an annotation says; of a union what a config can hold."""
    if isinstance(node, ast.Constant):
        if isinstance(node.value, str):
            return read_hint(ast.parse(node.value, mode="eval").body, module)
        if node.value is None:
            return type(None)
    if isinstance(node, ast.BinOp):
        return union_hint([node.left, node.right], module)
    if isinstance(node, ast.Subscript):
        name = last_name(node.value)
        inner = list(node.slice.elts) if isinstance(node.slice, ast.Tuple) else [node.slice]
        if name == "Optional":
            return union_hint([*inner, ast.Constant(None)], module)
        if name == "Union":
            return union_hint(inner, module)
        if name == "Literal":
            return typing.Literal[tuple(ast.literal_eval(part) for part in inner)]
        if name in LISTS:
            several = name.lower() == "tuple" and not isinstance(inner[-1], ast.Constant)
            items = [hint_of(part, module) for part in inner]
            return types.GenericAlias(tuple, tuple(items)) if several else types.GenericAlias(list, items[0])
        if name in MAPPINGS:
            return dict
        raise NotGiveable(name)
    name = last_name(node)
    if name in SIMPLE:
        return SIMPLE[name]
    if name in LISTS:
        return list
    if name in MAPPINGS:
        return dict
    top = module.name.partition(".")[0]
    if not isinstance(node, ast.Name) or (top in LIBRARIES and not name.startswith("_")):
        raise NotGiveable(name)
    found = definition(module.name, name)
    if isinstance(found, Class) and found.module.name.partition(".")[0] == top:
        return found
    if found is not None and not isinstance(found, Class):
        return read_hint(found[1], found[0])
    raise NotGiveable(name)


def union_hint(nodes: list[ast.expr], module: Module) -> Any:
    """The types of `a | b`, as one."""
    members: list[Any] = []
    for node in nodes:
        try:
            hint = read_hint(node, module)
        except NotGiveable:
            continue
        members += [part for part in members_of(hint) if part not in members]
    if not members:
        raise NotGiveable
    return Union(tuple(members)) if len(members) > 1 else members[0]


class Union(NamedTuple):
    """One of several types, `Class` among them, which Python's own unions do not take."""

    members: tuple[Any, ...]


def members_of(hint: Any) -> tuple[Any, ...]:
    """The types that a type stands for: those of a union, or itself."""
    if isinstance(hint, Union):
        return hint.members
    if isinstance(hint, types.UnionType) or typing.get_origin(hint) is typing.Union:
        return typing.get_args(hint)
    return (hint,)


def last_name(node: ast.expr) -> str:
    """The last part of a dotted name."""
    return node.attr if isinstance(node, ast.Attribute) else node.id if isinstance(node, ast.Name) else ""


# --- words ---


def docstrings(cls: Class, init: ast.FunctionDef) -> dict[str, str]:
    """Words on each argument: of the class, of its constructor, of an assignment to its `__doc__` (torch.optim)."""
    texts = [ast.get_docstring(node) or "" for node in (cls.node, init)]
    for node in cls.module.tree.body:
        if isinstance(node, ast.Assign) and ast.unparse(node.targets[0]) == f"{cls.node.name}.__doc__":
            strings = [
                n.value for n in ast.walk(node.value) if isinstance(n, ast.Constant) and isinstance(n.value, str)
            ]
            texts.append(inspect.cleandoc("".join(strings)))
    return functools.reduce(lambda words, text: words | described(text), texts, {})


def described(docstring: str) -> dict[str, str]:
    """The words on each argument in a docstring's `Args:`, on one line. "a, b: words" are those of both."""
    words: dict[str, str] = {}
    current: list[str] = []
    indent = None
    inside = False
    for line in docstring.splitlines():
        depth = len(line) - len(line.lstrip())
        if re.fullmatch(r"\s*(Args|Arguments|Parameters):\s*", line):
            inside, section, indent = True, depth, None
            continue
        if not inside or not line.strip():
            continue
        if depth <= section:
            inside = False
            continue
        indent = depth if indent is None else indent
        start = re.match(r"\s*(\*{0,2}\w+(?:, \w+)*)\s*(?:\([^)]*(?:\)[^):]*)*\))?\s*:\s*(.*)", line)
        if depth == indent and start:
            current = [name.lstrip("*") for name in start[1].split(", ")]
            words |= dict.fromkeys(current, start[2])
        else:
            for name in current:
                words[name] = f"{words[name]} {line.strip()}".strip()
    return words


def first_sentence(text: str, longest: int = 110) -> str:
    """The start of a long description, as a line of `--help`."""
    plain = re.sub(r"``?|:\w+:|~(?=\w)", "", text)
    sentence = re.split(r"(?<=[^.\d])\.(?:\s|$)|\s*\(?[Dd]efaults?(?: to)?[:=]? ", plain, maxsplit=1)[0].strip()
    return sentence if len(sentence) <= longest else sentence[:longest].rsplit(" ", 1)[0] + " ..."


def default_arguments(given: Mapping[str, Argument]) -> dict[str, Any]:
    """The defaults that can be written into a config."""
    return {
        name: argument.default
        for name, argument in given.items()
        if argument.default is not REQUIRED and argument.default is not UNREADABLE
    }


def summary(target: str) -> str:
    """The first sentence of a class's docstring."""
    found = definition(*target.rpartition(".")[::2])
    return first_sentence(" ".join((ast.get_docstring(found.node) or "").split())) if isinstance(found, Class) else ""

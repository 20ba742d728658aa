"""Which shapes a network has seen in its training, as far as its run folder or its card tells."""

import fnmatch
import re
from collections.abc import Mapping, Sequence
from os import PathLike
from pathlib import Path
from typing import Any, NamedTuple

import yaml

from pnu import weights
from pnu.benchmark.case_sources import chosen_names
from pnu.data import shapes
from pnu.io import meshes_of

PROCEDURAL = {"procedural:all": "all", "procedural:train": "train"}  # in a card -> part
DEEP = 20  # runs that began with one another


class Trained(NamedTuple):
    """Shapes of a training. `meshes` are names or patterns of names (tds_*); `kept` were not in the training."""

    procedural: frozenset[str] = frozenset()
    meshes: frozenset[str] = frozenset()
    kept: frozenset[str] = frozenset()
    unknown: str = ""  # what of it cannot be told, and why

    def of(self, names: Sequence[str], procedural: bool) -> list[str]:
        """Those of the names that were in the training: of procedural shapes, or of a folder of meshes."""
        patterns = self.procedural if procedural else self.meshes
        return [n for n in names if n not in self.kept and any(fnmatch.fnmatchcase(n, p) for p in patterns)]


def trained_on(source: str | PathLike[str]) -> Trained:
    """The shapes that the network of a run folder, a file of weights or a shipped name was trained on."""
    if (file := weights.find(source)) is not None:
        card = Path(file).with_suffix(".md")
        return of_card(card.read_text(encoding="utf-8")) if card.is_file() else Trained()
    return of_run(Path(source))


def of_card(text: str) -> Trained:
    """From the lines "Shapes trained on: ..." and "Kept for validation: ..." of a model card."""

    def listed(head: str) -> list[str]:
        found = re.search(rf"^{head}: (.*?)\.?$", text, re.M)
        return re.split(r",\s*", found[1]) if found else []

    names = listed("Shapes trained on")
    makers = {name for key in names if key in PROCEDURAL for name in procedural_part({}, PROCEDURAL[key])}
    meshes = frozenset(names) - PROCEDURAL.keys()
    return Trained(frozenset(makers), meshes, frozenset(listed("Kept for validation")))


def of_run(folder: Path, depth: int = 0) -> Trained:
    """From a run's config; of a run that began with another's weights, also what that one has seen."""
    path = folder / "config.yaml"
    config = yaml.safe_load(path.read_text(encoding="utf-8")) if path.is_file() else None
    data = config.get("data") if isinstance(config, Mapping) else None
    own = of_data(data) if isinstance(data, Mapping) else Trained()
    start = config.get("weights") if isinstance(config, Mapping) else None
    if not start or depth > DEEP:
        return own
    if weights.find(start) is None and not Path(start).is_dir():
        return own._replace(unknown=own.unknown or f"it began with {start}, which is not here")
    before = trained_on(start) if weights.find(start) else of_run(Path(start), depth + 1)
    return Trained(
        own.procedural | before.procedural,
        own.meshes | before.meshes,
        own.kept & before.kept,
        own.unknown or before.unknown,
    )


def of_data(data: Mapping[str, Any]) -> Trained:
    """From a run's group `data`."""
    kept = frozenset(str(name) for name in data.get("validation") or ())
    procedural: frozenset[str] = frozenset()
    mixed = data.get("procedural")
    beside = (
        [f"{shapes.BESIDE_MESHES}{name}" for name in shapes.names(*mixed)] if isinstance(mixed, list) and mixed else []
    )
    if mixed is True:  # data=surface: all but those of validation
        procedural = frozenset(shapes.names())
    elif data.get("kinds"):
        procedural = frozenset(procedural_part(data, "train"))
    meshes, unknown = frozenset[str](), ""
    if data.get("root"):
        try:
            names = list(meshes_of(data["root"]))
            whole = "validation" in data  # keeps the meshes that are named, no share of them
            chosen = names if whole else chosen_names([*names, *beside], data, "train", None)
            meshes = frozenset(name for name in chosen if not name.startswith(shapes.BESIDE_MESHES))
            procedural |= {
                name.removeprefix(shapes.BESIDE_MESHES) for name in chosen if name.startswith(shapes.BESIDE_MESHES)
            }
        except ValueError:
            unknown = f"its meshes in {data['root']} are not here"
    elif data.get("path"):
        unknown = f"the shapes in {data['path']} are not looked at"
    return Trained(procedural, meshes, kept, unknown)


def procedural_part(data: Mapping[str, Any], part: str) -> list[str]:
    """The procedural shapes of a part, as training splits them."""
    return chosen_names(shapes.names(*(data.get("kinds") or ())), data, part, None)

"""Names of the authors' released checkpoints, mapped to ours.

| released                                         | ours                                            |
|--------------------------------------------------|-------------------------------------------------|
| `GLOBAL_module.{3 i}`, `.{3 i + 1}`              | `global_features.{i}.linear`, `.norm`           |
| `SA_modules.{l}.mlps.0.layer{i}.conv`            | `local_features.abstractions.{l}.mlp.{i}.linear`|
| `SA_modules.{l}.mlps.0.layer{i}.normlayer.bn`    | `local_features.abstractions.{l}.mlp.{i}.norm`  |
| `FP_modules.{3 - l}.mlp.layer{i}.*`              | `local_features.propagations.{l}.mlp.{i}.*`     |
| `UPSAMPLING_module.{0, 3, 6}`, `.{1, 4, 7}`      | `head.{0, 1, 2}.linear`, `.norm`                |
| `UPSAMPLING_module.{10, 13}`, `.{11, 14}`        | `expansions.0.{0, 1}.linear`, `.norm`           |
| `UPSAMPLING_module.17`, `.18`                    | `expansions.1.0.linear`, `.norm`                |
| `UPSAMPLING_module.20`                           | `regression`                                    |

Two values change beside the names. Weights of 1x1 convolutions lose their trailing axes of size 1. The released x2
reshape gives even channels to the first new point and odd ones to the second; ours gives halves, which needs no copy,
so the channels of the layers before a reshape (`head.2`, `expansions.0.1`) are stored even ones first.
"""

import re
from collections.abc import Mapping

import torch
from torch import Tensor

_UPSAMPLING = {0: "head.0", 3: "head.1", 6: "head.2", 10: "expansions.0.0", 13: "expansions.0.1", 17: "expansions.1.0"}
_SPLIT = ("head.2.", "expansions.0.1.")


def from_released(state: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """The state of `PNU(ratio=4)` from a released `model_state_dict`.

    Raises:
        ValueError: a name or a value is not of the released network.
    """
    ours = {}
    for name, value in state.items():
        if not isinstance(value, Tensor):
            raise ValueError(f"expected a tensor for {name!r}, found {type(value).__name__}")
        new = rename(name.removeprefix("module."))  # of DataParallel
        if new.endswith("linear.weight") or new == "regression.weight":
            value = value.flatten(1)
        if new.startswith(_SPLIT) and value.ndim:
            value = torch.cat([value[0::2], value[1::2]])
        ours[new] = value
    return ours


def rename(name: str) -> str:
    """Our name of a released parameter or statistic; ValueError if the released network has none of that name."""
    if match := re.fullmatch(r"GLOBAL_module\.(\d+)\.(\w+)", name):
        number = int(match[1])
        return f"global_features.{number // 3}.{('linear', 'norm', 'relu')[number % 3]}.{match[2]}"
    if match := re.fullmatch(r"(SA|FP)_modules\.(\d)\.mlps?(?:\.0)?\.layer(\d)\.(conv|normlayer\.bn)\.(\w+)", name):
        kind, level, layer, part, rest = match.groups()
        block = f"abstractions.{level}" if kind == "SA" else f"propagations.{3 - int(level)}"
        return f"local_features.{block}.mlp.{layer}.{'linear' if part == 'conv' else 'norm'}.{rest}"
    if match := re.fullmatch(r"UPSAMPLING_module\.(\d+)\.(\w+)", name):
        number = int(match[1])
        if number == 20:
            return f"regression.{match[2]}"
        if number in _UPSAMPLING:
            return f"{_UPSAMPLING[number]}.linear.{match[2]}"
        if number - 1 in _UPSAMPLING:
            return f"{_UPSAMPLING[number - 1]}.norm.{match[2]}"
    raise ValueError(f"expected the names of the released network, found {name!r}")

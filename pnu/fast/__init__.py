"""Networks and losses made fast: the same results to rounding, values and gradients.

`accelerate` is the one switch. Nothing in `pnu.networks` and `pnu.losses` knows of it.
"""

import os
import sys
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from typing import TypeVar

from torch import nn

from pnu.fast import forms

LOSS = "pnu.losses.compound"
Module = TypeVar("Module", bound=nn.Module)


def accelerate(module: Module) -> Module:
    """The same network or loss, each part of which computes in its fast form from now on.

    A fast form is a subclass with the same parameters, and only the class of a part changes: state dicts, devices,
    copies and pickles stay what they are. Parts without a fast form are left as they are, and all are with
    `PNU_FAST=0` in the environment.
    """
    if os.environ.get("PNU_FAST") != "0":
        known = fast_forms()
        for part in module.modules():
            part.__class__ = known.get(type(part), type(part))
    return module


def fast_forms() -> dict[type[nn.Module], type[nn.Module]]:
    """The fast form of each network's part, and of the loss where that is imported, as it is for training alone."""
    found = list(forms.ALL)
    if LOSS in sys.modules:
        from pnu.fast import terms

        found.append(terms.CompoundLoss)
    return {form.__bases__[0]: form for form in found}


@contextmanager
def accelerated(modules: Iterable[nn.Module]) -> Iterator[None]:
    """`accelerate` for a while."""
    parts = [(part, type(part)) for module in modules for part in module.modules()]
    try:
        for part, _ in parts:
            accelerate(part)
        yield
    finally:
        for part, before in parts:
            part.__class__ = before

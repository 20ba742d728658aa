"""Networks: the released reference, shapes, invariances."""

from pathlib import Path

import numpy as np
import pytest
import torch

from pnu.models import build
from pnu.models.pnu import PNU
from pnu.models.released import from_released


def test_released_reference(shared: Path) -> None:
    reference = np.load(shared / "reference/released_reference.npz")
    state = {name[6:]: torch.as_tensor(reference[name]) for name in reference if name.startswith("state/")}
    network = PNU().eval()
    network.load_state_dict(from_released(state))
    with torch.no_grad():
        output = network(torch.from_numpy(reference["input"]))
    torch.testing.assert_close(output, torch.from_numpy(reference["output"]), rtol=0, atol=1e-6)


@pytest.mark.parametrize("name", ["pnu.PNU", "pnu_paper.PNUPaper"])
@pytest.mark.parametrize("ratio", [2, 4, 8, 16])
def test_shapes(name: str, ratio: int) -> None:
    network = build({"_target_": f"pnu.models.{name}", "ratio": ratio})
    assert network(torch.randn(2, 70, 6) / 3).shape == (2, 70 * ratio, 6)

"""Numbers below 1e-38 are zero where networks work, in all of their threads, and nowhere else."""

import numpy as np
import pytest
import torch

from pnu.runtime import denormals
from pnu.runtime.threads import map_on_threads

pytestmark = pytest.mark.skipif(not torch.set_flush_denormal(False), reason="not on this processor")


def product(_: int = 0) -> float:
    return float(torch.full((8,), 1e-30) @ torch.full((8,), 1e-10))


def test_zero_within_and_as_it_was_before() -> None:
    assert product() > 0
    with denormals.as_zero():
        assert product() == 0
        assert denormals.are_zero()
        with denormals.as_zero():
            pass
        assert product() == 0
    assert product() > 0
    with pytest.raises(KeyError), denormals.as_zero():
        raise KeyError
    assert not denormals.are_zero()


@pytest.mark.parametrize("threads", [1, 2])
def test_threads_take_them_as_the_thread_that_calls(threads: int) -> None:
    before = torch.get_num_threads()
    torch.set_num_threads(threads)
    try:
        assert min(map_on_threads(product, range(8))) > 0
        with denormals.as_zero():
            assert max(map_on_threads(product, range(8))) == 0
        assert min(map_on_threads(product, range(8))) > 0
    finally:
        torch.set_num_threads(before)


def test_other_numbers_are_not_changed() -> None:
    values = torch.from_numpy(np.random.default_rng(0).normal(size=(64, 64)).astype(np.float32))
    plain = values @ values
    with denormals.as_zero():
        assert torch.equal(values @ values, plain)

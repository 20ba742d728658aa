"""ONNX files: onnxruntime computes from them what torch does; searches are inputs."""

from pathlib import Path

import numpy as np
import pytest
import torch
from torch import nn

import pnu
from pnu.commands.export import main
from pnu.geometry import neighbor_search
from pnu.geometry.neighbor_search import ball_query
from pnu.networks import layers, onnx_file
from pnu.networks.ecnet import ECNet
from pnu.networks.onnx_file import WithNeighborhoods, neighborhoods
from pnu.networks.pnu import PNU
from pnu.networks.pnu_paper import PNUPaper
from pnu.networks.pugan import PUGAN
from pnu.networks.pugeo import PUGeo
from pnu.networks.punet import PUNet
from pnu.networks.surface import Surface

PATCH = torch.nn.functional.normalize(torch.randn(2, 64, 3, generator=torch.Generator().manual_seed(3)), dim=-1)


@pytest.mark.parametrize("kind", [PNU, PNUPaper, PUNet, ECNet, PUGeo])
def test_a_network_with_its_neighborhoods_gives_what_it_gives_alone(kind: type[nn.Module]) -> None:
    """Also for patches of other points than those that it was made with."""
    network = kind(ratio=2).eval()  # type: ignore[call-arg]
    patch = torch.cat([PATCH, PATCH], -1)
    found = neighborhoods(network, patch)
    assert all(values.dtype == torch.int64 for values in found.values())
    assert all(values.max() < 64 for values in found.values())
    with torch.no_grad():
        given = WithNeighborhoods(network, [*found])(patch, *found.values())
        torch.testing.assert_close(given, network(patch), rtol=0, atol=1e-6)
        with pytest.raises((StopIteration, RuntimeError)):
            WithNeighborhoods(network, [])(patch)
    assert layers.ball_query is ball_query is neighbor_search.ball_query  # again, after errors too


def test_searches_of_points_that_were_found_are_refused() -> None:
    with pytest.raises(ValueError, match="^format=onnx: PUGAN searches among points that it has found itself"):
        neighborhoods(PUGAN(ratio=2), PATCH)


def test_other_outputs_are_seen(monkeypatch: pytest.MonkeyPatch) -> None:
    """The comparison with onnxruntime can fail."""

    class Session:
        def __init__(self, *_: object, **__: object) -> None: ...

        def run(self, _: None, inputs: dict[str, np.ndarray]) -> list[np.ndarray]:
            with torch.no_grad():
                found = network.projector(*map(torch.from_numpy, inputs.values()))
            return [1.5 * value.numpy() for value in found]

    onnxruntime = pytest.importorskip("onnxruntime")
    network = Surface(neighbors=8, reach=8, width=8).eval()
    monkeypatch.setattr(onnxruntime, "InferenceSession", Session)
    assert onnx_file.difference("", network, onnx_file.example_inputs(network)) == pytest.approx(0.5)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["surface", "pnu", "pugeo"])
def test_files_compute_what_torch_does(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Another number of queries or patches than the file was made with, of other points; nothing else is printed."""
    pytest.importorskip("onnxruntime")
    onnx = pytest.importorskip("onnx")
    monkeypatch.chdir(tmp_path)
    main([f"run={name}", "format=onnx"])
    said = capsys.readouterr()
    assert said.err == ""
    first, second, third = said.out.splitlines()
    assert first.startswith(f"output: {name}.onnx, ")
    assert float(second.split()[-5]) < 1e-5
    assert third.startswith(
        "        in: offsets (any, 24, 3), " if name == "surface" else "        in: patch (any, 64, "
    )
    assert [path.name for path in tmp_path.iterdir()] == [f"{name}.onnx"]
    network = pnu.load(name)
    if name == "surface":
        inputs = {key: value[:7] for key, value in onnx_file.example_inputs(network).items()}
    else:
        patch = torch.cat([PATCH, PATCH], -1)[:1, :, : getattr(network, "channels", 3)]
        inputs = {"patch": patch, **neighborhoods(network, patch)}
    assert onnx_file.difference(f"{name}.onnx", network, inputs) < 1e-5
    assert str(Path(pnu.__file__).parent).encode() not in Path(f"{name}.onnx").read_bytes()
    held = {entry.key: entry.value for entry in onnx.load(f"{name}.onnx").metadata_props}
    assert held["ratio"] == "4"


def test_what_is_missing_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(__import__("sys").modules, "onnx", None)
    with pytest.raises(
        ValueError, match=r'^format=onnx needs onnx, which is not installed: pip install "pnu\[onnx\]"$'
    ):
        onnx_file.write_onnx(tmp_path / "a.onnx", Surface(), {})
    assert list(tmp_path.iterdir()) == []

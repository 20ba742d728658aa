"""Headers of pcd as programs write them."""

from pathlib import Path

import numpy as np
import pytest

from pnu.io import read_cloud

POINTS = np.random.default_rng(0).normal(size=(20, 3)).astype("<f4")


def pcd(mode: str, *, names: str = "x y z", kind: str = "F F F", size: str = "4 4 4", count: str = "1 1 1") -> bytes:
    body = POINTS.tobytes() if mode == "binary" else "".join(f"{x} {y} {z}\n" for x, y, z in POINTS).encode()
    head = f"FIELDS {names}\nSIZE {size}\nTYPE {kind}\nCOUNT {count}\nWIDTH 20\nHEIGHT 1\nPOINTS 20\nDATA {mode}\n"
    return head.encode() + body


HEADERS = {
    "upper case": pcd("ascii", names="X Y Z"),
    "type in lower case": pcd("ascii", kind="f f f"),
    "mode in upper case": pcd("ascii").replace(b"DATA ascii", b"DATA ASCII"),
    "no padding": pcd("binary", names="x y z _", kind="F F F U", size="4 4 4 1", count="1 1 1 0"),
    "no padding in text": pcd("ascii", names="x _ y z", kind="F U F F", size="4 1 4 4", count="1 0 1 1"),
}


@pytest.mark.parametrize("case", HEADERS)
def test_headers(tmp_path: Path, case: str) -> None:
    (tmp_path / "c.pcd").write_bytes(HEADERS[case])
    cloud = read_cloud(tmp_path / "c.pcd")
    np.testing.assert_allclose(cloud.points, POINTS, rtol=1e-6)
    assert cloud.attributes == {}
    assert cloud.notes == ()

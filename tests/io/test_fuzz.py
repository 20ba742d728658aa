"""Damaged and forged files never crash, hang or swell a reader, see `tests/fuzz.py`."""

from pathlib import Path

import pytest

from tests.fuzz import READERS, fuzz


def check(results: list[dict], readers: int, cases: int) -> None:
    assert [line for result in results for line in result["wrong"]] == []
    assert len(results) == readers
    for result in results:
        assert result["cases"] >= cases
        assert 0 < result["refused"] < result["cases"], "some are damaged, some are not"


@pytest.mark.usefixtures("untraced")
def test_a_few_cases_of_every_reader(tmp_path: Path) -> None:
    readers = [name for name in READERS if name not in ("laz", "e57")]  # which take a process a case
    check(fuzz(readers, 2, 7, tmp_path), len(readers), 2)


@pytest.mark.slow
@pytest.mark.parametrize("name", READERS)
def test_thousands_of_cases(name: str, tmp_path: Path) -> None:
    """800 for each reader."""
    check(fuzz([name], 800, 0, tmp_path), 1, 800)


@pytest.mark.parametrize("fault", ["os.abort()", "time.sleep(99)", "bytearray(2**31)", "print(1 / 0)"])
@pytest.mark.slow
def test_the_fuzzer_sees(fault: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A reader that crashes, hangs, takes too much memory or raises something else is found."""
    package = tmp_path / "site" / "sitecustomize.py"
    package.parent.mkdir()
    package.write_text(
        "import os, time, sys\n"
        "def wrong(path):\n"
        f"    if 'case' in path.name: {fault}\n"
        "import pnu.io.cloud\n"
        "pnu.io.cloud.READERS['.xyz'] = wrong\n"
    )
    monkeypatch.setenv("PYTHONPATH", str(package.parent))
    monkeypatch.setenv("PNU_FUZZ_SECONDS", "1")
    (result,) = fuzz(["xyz"], 2, 0, tmp_path / "cases")
    assert result["wrong"], "the fuzzer is blind"

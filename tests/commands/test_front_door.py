"""`pnu VERB`: verbs, mistakes, and what shells complete."""

import shutil
import subprocess
import sys

import pytest

from pnu.__main__ import MEANT, completion, main, verbs
from tests.refusals import refused


def run(*arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, "-m", "pnu", *arguments], capture_output=True, text=True, check=False)


def test_alone_it_lists_every_verb_with_a_line(capsys: pytest.CaptureFixture[str]) -> None:
    main([])
    out = capsys.readouterr().out
    for verb, line in verbs().items():
        assert line
        assert f"  {verb}" in out


def test_a_mistyped_verb_is_one_line() -> None:
    done = run("upsamle", "input=x.ply")
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr == "error: unknown verb 'upsamle': did you mean 'upsample'? `pnu` lists them\n"


def test_other_words_for_a_verb_lead_to_it(capsys: pytest.CaptureFixture[str]) -> None:
    assert {verb for meant in MEANT.values() for verb in meant} <= verbs().keys()
    assert not MEANT.keys() & verbs().keys()
    assert refused(capsys, main, ["mesh", "scan.ply"]).startswith("error: unknown verb 'mesh': did you mean 'scan' or")
    assert refused(capsys, main, ["page"]) == "error: unknown verb 'page': did you mean 'view'? `pnu` lists them"
    assert refused(capsys, main, ["frobnicate"]) == "error: unknown verb 'frobnicate': `pnu` lists them"


@pytest.mark.parametrize("word", ["help", "--help"])
def test_help_on_a_verb_may_be_asked_first(word: str) -> None:
    done = run(word, "scan")
    assert done.stdout.startswith("usage: pnu scan [INPUT] [OUTPUT] [key=value ...]"), done.stderr


def test_the_module_that_trains_and_the_verb_are_one() -> None:
    by_module = subprocess.run(
        [sys.executable, "-m", "pnu.train", "--help"], capture_output=True, text=True, check=True
    )
    by_verb = run("train", "--help")
    assert by_verb.stdout.startswith("usage: pnu train")
    assert by_module.stdout.splitlines()[1:] == by_verb.stdout.splitlines()[1:]


COMPLETED = [
    ("up", ["upsample"]),
    ("re", ["reconstruct", "report"]),
    ("upsample rat", ["ratio="]),
    ("train sched", ["scheduler="]),
]


@pytest.mark.parametrize(("typed", "expected"), COMPLETED)
def test_a_shell_completes_verbs_and_keys(typed: str, expected: list[str]) -> None:
    words = ["pnu", *typed.split()]
    script = f"{completion('bash')}\nCOMP_WORDS=({' '.join(words)}); COMP_CWORD={len(words) - 1}; _pnu\n"
    done = subprocess.run(
        ["bash", "-c", script + 'printf "%s\\n" "${COMPREPLY[@]}"'], capture_output=True, text=True, check=True
    )
    assert done.stdout.split() == expected


@pytest.mark.skipif(shutil.which("zsh") is None, reason="zsh is not here")
@pytest.mark.parametrize(("typed", "expected"), [*COMPLETED, ("upsample input=clo", ["FILES"])])
def test_zsh_completes_verbs_keys_and_files(typed: str, expected: list[str]) -> None:
    words = ["pnu", *typed.split()]
    script = f"""
        compdef() {{ }}
        compadd() {{ print -l -- $@ }}
        compset() {{ [[ $words[CURRENT] == *=* ]] }}
        _files() {{ print FILES }}
        {completion("zsh")}
        words=({" ".join(words)}); CURRENT={len(words)}; _pnu
    """
    done = subprocess.run(["zsh", "-f", "-c", script], capture_output=True, text=True, check=True)
    assert done.stderr == ""
    offered = done.stdout.split()
    assert [word for word in offered if word.startswith(words[-1]) or word == "FILES"] == expected

"""The command line: `pnu VERB key=value ...`, or `python -m pnu VERB ...`; each verb is a file of `commands/`."""

import ast
import difflib
import runpy
import sys
from collections.abc import Sequence
from pathlib import Path

from pnu import __version__

COMMANDS = Path(__file__).parent / "commands"
MEANT = {  # what people call it -> the verbs that do it
    **dict.fromkeys(("mesh", "surface", "poisson"), ("scan", "reconstruct")),
    **dict.fromkeys(("densify", "dense", "upscale", "resample", "clean", "denoise", "outliers"), ("upsample", "scan")),
    **dict.fromkeys(("estimate", "orient"), ("normals",)),
    **dict.fromkeys(("sweep", "ablation", "multirun", "fit", "finetune"), ("train",)),
    **dict.fromkeys(("patches", "data", "dataset"), ("prepare",)),
    **dict.fromkeys(("test", "score", "eval", "metrics", "benchmark"), ("evaluate", "compare")),
    **dict.fromkeys(("show", "open", "display", "page", "share", "send", "html"), ("view",)),
    **dict.fromkeys(("plot", "render", "draw", "image", "figure"), ("picture",)),
    **dict.fromkeys(("gui", "ui", "web", "serve", "browser"), ("app",)),
    **dict.fromkeys(("check", "info", "install", "setup"), ("doctor",)),
    **dict.fromkeys(("onnx", "save"), ("export",)),
}
BASH = """\
_pnu() {{
  local keys
  case ${{COMP_WORDS[1]}} in
{cases}
  esac
  [ "$COMP_CWORD" -gt 1 ] || keys='{verbs}'
  COMPREPLY=($(compgen -W "$keys" -- "${{COMP_WORDS[COMP_CWORD]}}"))
}}
complete -o nospace -o default -F _pnu pnu"""
ZSH = """\
whence compdef > /dev/null || {{ autoload -U compinit && compinit }}
_pnu() {{
  local keys
  case $words[2] in
{cases}
  esac
  if (( CURRENT == 2 )); then
    compadd -- {verbs}
  elif compset -P '*='; then
    _files
  else
    compadd -S '' -- ${{=keys}}
  fi
}}
compdef _pnu pnu"""


def verbs() -> dict[str, str]:
    """What each verb does, in a line: the first of its file's docstring, read without importing it."""
    found = {}
    for path in sorted(COMMANDS.glob("[a-z]*.py")):
        text = ast.get_docstring(ast.parse(path.read_text(encoding="utf-8"))) or ""
        found[path.stem] = text.partition("\n")[0].partition(": `")[0].rstrip(".")
    return found


def overview() -> str:
    """All verbs, each with its line."""
    known = verbs()
    width = max(map(len, known))
    lines = [f"  {verb:<{width}}  {line}" for verb, line in known.items()]
    return "\n".join(
        [
            "usage: pnu VERB [key=value ...]",
            "",
            *lines,
            "",
            "pnu VERB --help explains its keys; pnu --version",
            "source <(pnu --completion bash), or zsh, completes them",
        ]
    )


def completion(shell: str) -> str:
    """What a shell sources to complete verbs, and the keys of each: `source <(pnu --completion bash)`, or zsh."""
    import yaml

    from pnu.config.schema import config_folder

    cases = []
    for verb in verbs():
        path = config_folder() / f"{verb}.yaml"
        config = yaml.safe_load(path.read_text(encoding="utf-8")) if path.is_file() else {}
        groups = [key for entry in config.pop("defaults", []) if isinstance(entry, dict) for key in entry]
        keys = sorted({*config, *groups} - {"hydra"})
        cases.append(f"    {verb}) keys='--help {' '.join(f'{key}=' for key in keys)}' ;;")
    return {"bash": BASH, "zsh": ZSH}[shell].format(verbs=" ".join(verbs()), cases="\n".join(cases))


def main(argv: Sequence[str] | None = None) -> None:
    """Run the verb that argv names, as `python -m pnu.commands.VERB` would, so that processes which start the program
    again (DDP, spawned workers) find it."""
    verb, *rest = [*(sys.argv[1:] if argv is None else argv)] or ["--help"]
    if verb in ("-h", "--help", "help") and rest and rest[0] in verbs():
        verb, rest = rest[0], ["--help"]
    if verb in ("-h", "--help", "help"):
        print(overview())
    elif verb == "--version":
        print(f"pnu {__version__}")
    elif verb == "--completion" and rest in (["bash"], ["zsh"]):
        print(completion(rest[0]))
    elif verb in {path.stem for path in COMMANDS.glob("[a-z]*.py")}:
        sys.argv = [sys.argv[0], *rest]
        runpy.run_module(f"pnu.commands.{verb}", run_name="__main__", alter_sys=True)
    else:
        near = MEANT.get(verb.lower()) or difflib.get_close_matches(verb.lower(), verbs(), 1)
        meant = f"did you mean {' or '.join(f'{other!r}' for other in near)}? " if near else ""
        print(f"error: unknown verb '{verb}': {meant}`pnu` lists them", file=sys.stderr)
        sys.exit(2)


if __name__ == "__main__":
    main()

"""``dronevio completion``: a script that lets a shell complete commands, options and their values."""

import contextlib
import importlib
import io
import os
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Literal

import tyro

from dronevio.cli.dispatch import CommandGroup
from dronevio.cli.terminal import parse

HELP_COLUMNS = 99
"""Width of help texts. Up to this width, tyro prints its groups of options below each other."""
_OPTION = re.compile(r"^│ ((?:-h, )?--.*?)\s*(?:│|\s{2,}.*)$", re.MULTILINE)
"""The line of a help text at which an option begins."""


@dataclass(frozen=True)
class CompletionCommand:
    """Print a script that lets a shell complete the commands, their options and the values of these.

    Write it to the file that the shell reads, and open a new shell:

    Examples:
      dronevio completion bash > ~/.dronevio-completion; echo "source ~/.dronevio-completion" >> ~/.bashrc
      dronevio completion zsh > ~/.dronevio-completion; echo "source ~/.dronevio-completion" >> ~/.zshrc
      dronevio completion fish > ~/.config/fish/completions/dronevio.fish
    """

    shell: Annotated[Literal["bash", "zsh", "fish"], tyro.conf.Positional]
    """Shell that reads the script."""


@dataclass(frozen=True)
class Completions:
    """What can follow the words of a command."""

    words: tuple[str, ...]
    """The command after ``dronevio``, such as ``("book", "imu")``."""
    subcommands: Mapping[str, str]
    """Names that follow with their summaries; for a command that takes a scenario, those of the scenarios."""
    options: Mapping[str, tuple[str, ...]]
    """Options with their possible values; none where these are not a choice."""


def main(arguments: Sequence[str]) -> int:
    """Run the command and return its exit code."""
    from dronevio.cli import COMMANDS

    command = parse(CompletionCommand, arguments, "completion")
    script = fish_script if command.shell == "fish" else bash_script
    found = list(completions(COMMANDS, ()))
    # zsh runs functions of bash
    prefix = "autoload -Uz compinit bashcompinit && compinit && bashcompinit\n" if command.shell == "zsh" else ""
    print(f"{prefix}{script(found)}", end="")
    return 0


def completions(group: CommandGroup, words: tuple[str, ...]) -> Iterator[Completions]:
    """Yield what can follow a group of commands, and each command in it."""
    yield Completions(words, {name: each.summary for name, each in group.subcommands.items()}, {})
    for name, subcommand in group.subcommands.items():
        inner = getattr(importlib.import_module(subcommand.module), "COMMANDS", None)
        if isinstance(inner, CommandGroup):
            yield from completions(inner, (*words, name))
        else:
            yield _of_command((*words, name))


def help_text(words: Sequence[str], option: str = "--help") -> str:
    """Return what a command prints with ``--help`` or ``--help-all``, without colours."""
    from dronevio.cli import main

    printed, environment = io.BytesIO(), dict(os.environ)
    os.environ |= {"COLUMNS": f"{HELP_COLUMNS}", "NO_COLOR": "1", "TERM": "dumb"}
    try:
        with io.TextIOWrapper(printed, encoding="utf-8", write_through=True) as stream:
            with contextlib.redirect_stdout(stream), contextlib.suppress(SystemExit):
                main([*words, option])
            return printed.getvalue().decode()
    finally:
        os.environ.clear()
        os.environ.update(environment)


def _of_command(words: tuple[str, ...]) -> Completions:
    """Return what can follow a command, by its help text."""
    known = _known_values()
    options: dict[str, tuple[str, ...]] = {}
    for line in _OPTION.findall(help_text(words)):
        [*others, last] = line.split(", ")
        name, _, form = last.partition(" ")
        choice = re.fullmatch(r"\{(.+)\}.*", form.removeprefix("{None}|"))
        values = tuple(choice[1].split(",")) if choice else known.get(name, ())
        options |= {each: values for each in (*others, name) if each.startswith("--")}
    names = known["--scenario"] if words in (("run",), ("fly",)) else ()
    return Completions(words, dict.fromkeys(names, "scenario"), options)


def _known_values() -> dict[str, tuple[str, ...]]:
    """Return the names that options take although any other text is allowed, too."""
    from dronevio.models.quadrotor import VEHICLES
    from dronevio.models.rig_presets import RIGS
    from dronevio.sim.scenarios import SCENARIOS
    from dronevio.sim.world import WORLDS

    named: dict[str, Iterable[str]] = {"--scenario": SCENARIOS, "--world": WORLDS, "--rig": RIGS, "--vehicle": VEHICLES}
    return {option: tuple(names) for option, names in named.items()}


def bash_script(found: Sequence[Completions]) -> str:
    """Return the script for bash. File names complete everything else."""
    commands = "\n".join(
        f'        "{" ".join(each.words)}") names="{" ".join(each.subcommands)}" options="{" ".join(each.options)}" ;;'
        for each in found
    )
    values = "\n".join(
        f'        "{" ".join(each.words)} {option}") names="{" ".join(choices)}" ;;'
        for each in found
        for option, choices in each.options.items()
        if choices
    )
    groups = "|".join(f'"{" ".join(each.words)}"' for each in found if not each.options and each.words)
    return f"""\
_dronevio() {{
    local word="${{COMP_WORDS[COMP_CWORD]}}" previous="${{COMP_WORDS[COMP_CWORD-1]}}" command="" names="" options=""
    if [ "$COMP_CWORD" -gt 1 ]; then command="${{COMP_WORDS[1]}}"; fi
    if [ "$COMP_CWORD" -gt 2 ]; then case "$command" in {groups}) command="$command ${{COMP_WORDS[2]}}" ;; esac; fi
    case "$command" in
{commands}
    esac
    case "$command $previous" in
{values}
        *" --"*) names="" ;;
    esac
    case "$word" in -*) names="$options" ;; esac
    COMPREPLY=($(compgen -W "$names" -- "$word"))
}}
complete -o default -F _dronevio dronevio
"""


def fish_script(found: Sequence[Completions]) -> str:
    """Return the script for fish."""
    lines = []
    for each in found:
        seen = [f"__fish_seen_subcommand_from {word}" for word in each.words]
        at = "; and ".join(seen) or "__fish_use_subcommand"
        for name, summary in each.subcommands.items():
            lines.append(f'complete -c dronevio -n "{at}" -a {name} -d "{_quoted(summary)}"')
        for option, values in each.options.items():
            choices = f' -x -a "{" ".join(values)}"' if values else ""
            lines.append(f'complete -c dronevio -n "{at}" -l {option[2:]}{choices}')
    return "\n".join(lines) + "\n"


def _quoted(text: str) -> str:
    """Return text as it is written within double quotes in fish."""
    return re.sub(r'(["\\$])', r"\\\1", text)

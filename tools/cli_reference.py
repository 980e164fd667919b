"""Write the command-line reference: one Markdown page per command, from what the command prints with --help-all, and
one of all settings.

The commands are found by their help texts: a block of indented ``name  summary`` lines lists subcommands.
"""

import argparse
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from dronevio.cli.commands.completion import help_text

PROGRAM = "dronevio"
ALL_SETTINGS = "all-settings.md"
"""File name of the page of all settings."""


@dataclass(frozen=True)
class Command:
    """One command and what it prints with ``--help-all``."""

    words: tuple[str, ...]
    """Names after the program: ``("bench", "sim")`` for `dronevio bench sim`."""
    help: str
    """The help text, without colours."""
    subcommands: dict[str, str]
    """Names of the commands directly below this one, with their summaries."""

    @property
    def title(self) -> str:
        """The command as it is typed."""
        return " ".join((PROGRAM, *self.words))

    @property
    def page(self) -> str:
        """File name of the command's page."""
        return f"{'-'.join(self.words) or 'index'}.md"


@dataclass(frozen=True)
class Group:
    """A group of options in a help text."""

    title: str
    description: str
    options: tuple[tuple[str, str], ...]
    """Each option as it is typed, and its explanation."""


def commands(words: tuple[str, ...] = ()) -> list[Command]:
    """Return a command and all commands below it, in the order in which the help texts list them."""
    text = help_text(words, "--help-all")
    command = Command(words, text, listed_commands(text))
    return [command, *(found for name in command.subcommands for found in commands((*words, name)))]


def listed_commands(text: str) -> dict[str, str]:
    """Return the subcommands that a help text lists, with their summaries."""
    found: dict[str, str] = {}
    for title, lines in indented_blocks(prose(text)):
        if title and title.lower() not in ("examples:", "for example:"):
            rows = [re.fullmatch(r"([a-z][\w-]*)\s{2,}(\S.*)", line) for line in lines]
            if all(rows):
                found |= {row[1]: row[2] for row in rows if row}
    return found


def prose(text: str) -> str:
    """Return the part of a help text between the usage and the first group of options."""
    return re.split(r"^╭", text, maxsplit=1, flags=re.MULTILINE)[0].split("\n", 1)[1].strip("\n")


def indented_blocks(text: str) -> list[tuple[str, list[str]]]:
    """Split text into paragraphs: a title line and the indented lines below it, or "" and the paragraph's lines."""
    blocks: list[tuple[str, list[str]]] = []
    for paragraph in re.split(r"\n\s*\n", text):
        lines = [line for line in paragraph.splitlines() if line.strip()]
        if len(lines) > 1 and all(line.startswith("  ") for line in lines[1:]) and lines[0].endswith(":"):
            blocks.append((lines[0], [line.strip() for line in lines[1:]]))
        elif lines:
            blocks.append(("", [line.strip() for line in lines]))
    return blocks


def groups(text: str) -> list[Group]:
    """Return the groups of options of a help text: boxes of tyro's."""
    boxes = re.findall(r"^╭─ (.+?) ─*╮\n(.*?)^╰─*╯$", text, re.MULTILINE | re.DOTALL)
    return [_group(title, [line[2:-2].rstrip() for line in body.splitlines()]) for title, body in boxes]


def _group(title: str, lines: list[str]) -> Group:
    description: list[str] = []
    rule = next((i for i, line in enumerate(lines) if line and not line.strip("─")), None)
    if rule is not None:
        description, lines = lines[:rule], lines[rule + 1 :]
    options: list[tuple[list[str], list[str]]] = []
    for line in lines:
        explained = bool(options and options[-1][1])
        if line.startswith(" "):
            options[-1][1].append(line.strip())
            continue
        name, _, explanation = re.sub(r"\s{2,}", "\t", line, count=1).partition("\t")
        if explained or not options:
            options.append(([], []))
        options[-1][0].append(name)
        if explanation:
            options[-1][1].append(explanation)
    named = tuple((" ".join(names), " ".join(explanations)) for names, explanations in options)
    return Group(title, " ".join(line.strip() for line in description), named)


def page(command: Command) -> str:
    """Return the Markdown page of a command."""
    lines = [f"# {command.title}", "", "```text", command.help.splitlines()[0], "```", ""]
    for title, block in indented_blocks(prose(command.help)):
        if not title:
            lines += [*map(markdown, block), ""]
        elif all(line.split()[0] in command.subcommands for line in block):
            lines += ["| command | purpose |", "| --- | --- |"]
            for name in (line.split()[0] for line in block):
                target = Command((*command.words, name), "", {})
                lines.append(f"| [{target.title}]({target.page}) | {markdown(command.subcommands[name])} |")
            lines.append("")
        else:
            lines += [f"**{title.capitalize().rstrip(':')}**", "", "```sh", *block, "```", ""]
    for group in groups(command.help):
        prefix = group.title.removesuffix(" options")
        lines += [f"## `--{prefix}.*`" if prefix != group.title else f"## {group.title.capitalize()}", ""]
        lines += [markdown(group.description), ""] if group.description else []
        for name, explanation in group.options:
            if name == "-h, --help":
                continue
            lines += [f"`{name}`", f":   {markdown(explanation)}", ""]
    return "\n".join(lines)


def settings_page() -> str:
    """Return the Markdown page of all settings, those of ``run`` first."""
    from dronevio.cli.commands.settings import command_named
    from dronevio.cli.settings.listing import listed_settings

    lines = [
        "# All settings",
        "",
        "`--set NAME=VALUE` and `--settings FILE` change them; [Change settings](../../how-to/tune.md) tells how, and"
        " when to change those that are options. `estimate` has the settings of the estimator and of the map,"
        " too, and `fly` those of the scenario, whose defaults here are those of the scenario room.",
        "",
    ]
    for name in ("run", "sfm", "dense"):
        lines += [f"## {PROGRAM} {name}", ""]
        for each in listed_settings(*command_named(name)):
            lines += [f"`{each.field.name} = {each.toml}`", f":   {markdown(each.text)}", ""]
    return "\n".join(lines)


def markdown(text: str) -> str:
    """Return help text with the characters escaped that Markdown would read; code in backticks stays as it is."""
    text = re.sub(r"\((default|required)\b:? ?([^()]*)\)$", _default, text)
    parts = re.split(r"(``.+?``|`.+?`)", text)
    return "".join(part if i % 2 else re.sub(r"([\\*_<>\[\]$|])", r"\\\1", part) for i, part in enumerate(parts))


def _default(match: re.Match[str]) -> str:
    value = match[2].strip()
    if match[1] == "required":
        return "Required."
    return f"Default: `{value}`." if value else "Default: empty."


def write(folder: Path) -> list[Path]:
    """Write the pages of all commands, and SUMMARY.md, which orders them; files that would not change are left."""
    found = commands()
    contents = {command.page: page(command) for command in found}
    contents[ALL_SETTINGS] = settings_page()
    entries = [(" ".join(command.words) or PROGRAM, command.page) for command in found]
    entries.append(("all settings", ALL_SETTINGS))
    contents["SUMMARY.md"] = "".join(f"* [{title}]({name})\n" for title, name in entries)
    return write_changed(folder, contents)


def write_changed(folder: Path, contents: Mapping[str, str | bytes]) -> list[Path]:
    """Make a folder hold these files and no others; write only what changes, so that no rebuild is caused."""
    paths = {folder / name: text.encode() if isinstance(text, str) else text for name, text in contents.items()}
    for path, content in paths.items():
        path.parent.mkdir(parents=True, exist_ok=True)
        if not path.is_file() or path.read_bytes() != content:
            path.write_bytes(content)
    for path in {path for path in folder.rglob("*") if path.is_file()} - set(paths):
        path.unlink()
    return list(paths)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path, help="Folder of the pages.")
    write(parser.parse_args().folder)

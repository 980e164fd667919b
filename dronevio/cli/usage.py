"""Wrong arguments of a command, explained on one line: tyro's messages without boxes, and settings by their options."""

import re
from collections.abc import Sequence

from dronevio.cli.settings.named_fields import named_fields
from dronevio.models.errors import unknown_name
from dronevio.models.ranges import FINITE, RangeError, number_fields

WIDTH = 10_000
"""Number of columns at which tyro formats a message that `usage_message` reads, so that no name is broken."""

_RULE = re.compile(r"^(?:─+|-{10,})$", re.MULTILINE)


def usage_message(printed: str, program: str) -> str:
    """Return tyro's explanation of wrong arguments on one line.

    Args:
        printed: What tyro printed, at a width of `WIDTH`: boxes of sections, of which the first is the explanation.
        program: The command as it is typed, such as ``dronevio fly``.
    """
    sections = [section.strip("\n") for section in _RULE.split("\n".join(_content(printed)))]
    lines = [line for line in sections[0].splitlines() if line.strip()]
    # An indent of four marks the name of an option or argument, and a larger one its explanation.
    names = [line.strip().split(" ")[0] for line in lines if re.match(r"    \S", line)]
    text = " ".join([line.strip() for line in lines if not line.startswith("    ")] + [", ".join(names)]).strip()
    text = re.sub(r"invalid literal for int\(\) with base 10: (.*)", r"\1; expected a whole number", text)
    text = re.sub(r"could not convert string to float: (.*)", r"\1; expected a number", text)
    text = re.sub(r"Error parsing (\S+?): ", r"\1 ", text)
    text = re.sub(
        r"(\S+) no type matching .*?<class '(?:int|float)'>: ('.*?'; expected a (?:whole )?number).*", r"\1 \2", text
    )
    text = re.sub(r"invalid choice '(.*?)' for argument '(\S+)'\. Expected one of \((.*)\)", _choice_message, text)
    similar = re.findall(r"^    (-[^\s,]+)", "\n".join(sections[1:]), re.MULTILINE) if "Perhaps you" in printed else []
    meant = f"; did you mean {' or '.join(similar[:3])}?" if similar else ""
    return f"{text.rstrip('.')}{meant} (see {program} --help)"


def _choice_message(found: re.Match[str]) -> str:
    """Return what is expected of an option in place of an invalid choice, with the choices that are like it."""
    given, option, listed = found.groups()
    choices = [each for each in re.findall(r"'(.*?)'", listed) if each != "None"]
    return f"{option}: {unknown_name('choice', given, sorted(choices))}".replace("unknown", "invalid", 1)


def _content(printed: str) -> list[str]:
    """Return the lines within tyro's box, or below its title where the encoding of the output has no boxes."""
    lines = printed.splitlines()
    if any(line.startswith("╭") for line in lines):
        return [line[2:].rstrip("│ ") for line in lines if line.startswith("│")]
    return [line[2:].rstrip() for line in lines if line.strip()][2:]


def range_message(error: RangeError, command: type, arguments: Sequence[str]) -> str:
    """Return the message of a setting outside its range, with the name of its option.

    Args:
        error: The error.
        command: The dataclass of the command.
        arguments: The words after the command's name; of several options for such a field, those in them count.
    """
    fields = [each for each in named_fields(command) if each.owner is error.settings and each.path[-1] == error.field]
    matching = [f"--{each.name}" if each.is_option else f"--set {each.name}" for each in fields]
    given = {word.partition("=")[0].replace("_", "-") for word in arguments}
    names = [name for name in matching if name in given] or matching
    return f"{' or '.join(names)} {error.problem}" if names else str(error)


def setting_message(command: type, arguments: Sequence[str]) -> str | None:
    """Return what to type in place of the first argument that is a setting, but no option; None if there is none.

    Args:
        command: The dataclass of the command.
        arguments: The words after the command's name.
    """
    others = {each.name: each for each in named_fields(command) if not each.is_option}
    for word in arguments:
        name = word.partition("=")[0].removeprefix("--").replace("_", "-")
        is_off = name.rpartition(".")[2].startswith("no-")
        name = name if name in others or not is_off else name.replace(".no-", ".")
        if word.startswith("--") and name in others:
            return f"--{name} is a setting, but no option; expected --set {name}={'false' if is_off else 'VALUE'}"
    return None


def allowed(command: type, name: str) -> str | None:
    """Return the allowed values of a field as a sentence for its help text; None if it has no range."""
    numbers = next((number for number in number_fields(command) if number.name == name), None)
    return None if numbers is None or numbers.range == FINITE or numbers.kind is bool else f"Allowed: {numbers.range}."

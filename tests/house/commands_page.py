"""Write `docs/reference/commands.md` from the commands: `uv run python tests/house/commands_page.py`."""

from collections.abc import Iterator
from pathlib import Path

import click

from ftdrive.cli import cli

PAGE = Path(__file__).parents[2] / "docs/reference/commands.md"

_HEAD = """\
# Commands

This page is generated: run `uv run python tests/house/commands_page.py` after a change of an option. A module here
reads the options of one command, makes one call and prints text or JSON. Configuration, exit codes and file formats are
described in [files.md](files.md).
"""


def page() -> str:
    """Return the page in Markdown: for each command what it does, and a table of its options."""
    return "\n".join([_HEAD, *_sections(cli, "ftdrive")])


def _sections(command: click.Command, name: str) -> Iterator[str]:
    context = click.Context(command, info_name=name)
    if isinstance(command, click.Group):
        if name == "ftdrive":
            yield from _section(command, context, f"{name} [OPTIONS] COMMAND")
        for child in command.list_commands(context):
            found = command.get_command(context, child)
            if found is not None:
                yield from _sections(found, f"{name} {child}")
        return
    arguments = [one.make_metavar(context) for one in command.params if isinstance(one, click.Argument)]
    yield from _section(command, context, " ".join([name, *arguments]))


def _section(command: click.Command, context: click.Context, usage: str) -> Iterator[str]:
    yield f"## `{usage}`\n"
    yield f"{_paragraphs(command.help or '')}\n"
    yield "| option | meaning |\n|---|---|"
    for parameter in command.params:
        record = parameter.get_help_record(context)
        if record is not None:
            spelled, meaning = (text.replace("|", "\\|") for text in record)
            yield f"| `{spelled}` | {' '.join(meaning.split())} |"
    yield ""


def _paragraphs(text: str) -> str:
    return "\n\n".join(" ".join(part.split()) for part in text.split("\n\n"))


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")

"""Suggestions for a command line that cannot run: another command for a given file, an existing name, a full line."""

import re
import shlex
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from difflib import get_close_matches
from pathlib import Path
from typing import Final, NamedTuple

import click

from ftcalib.files import open_file
from ftdrive.runs import is_run


class Kind(NamedTuple):
    """A kind of file or folder, such as a run, with the commands and options that accept it."""

    words: str
    lines: tuple[str, ...]
    """The usual commands for this kind of file, as typed, with {} for the path."""
    others: tuple[str, ...] = ()
    """Other commands that accept this kind of file, with {} for the path."""

    @property
    def places(self) -> set[str]:
        """Names of the options that accept this kind of file, and of the commands that take it as an argument."""
        heads = (line.partition(" {}")[0] for line in (*self.lines, *self.others))
        return {head.rpartition(" ")[2] if " --" in head else head for head in heads}


KINDS: Final[Mapping[str, Kind]] = {
    "recording": Kind(
        "a recording",
        ("live --replay {}", "compensate {}", "convert {} -o NEW.csv"),
        ("solve {}", "loads check --replay {}"),
    ),
    "run": Kind(
        "a run folder",
        ("solve {}", "report {}", "live --calibration {}"),
        (
            *("replay {}", "bundle {}", "push {}", "diff {}", "export calibration {}", "live --replay {}"),
            *("calibrate --resume {}", "calibrate --from {}", "solve --test {}", "report --parent {}"),
            *("push --restore {}", "loads solve {}", "history {}", "history --index {}"),
            *("fleet index {}", "fleet solve {}"),
        ),
    ),
    "runs": Kind(
        "a folder of runs",
        ("history {}", "fleet solve {}"),
        ("calibrate --runs {}", "fleet index {}", "history --index {}"),
    ),
    "folder": Kind(
        "a folder without a run",
        ("calibrate --runs {}", "history"),
        ("fleet index {}", "history {}"),
    ),
    "calibration": Kind(
        "a calibration",
        ("live --calibration {}", "report {}", "push {}"),
        ("diff {}", "export calibration {}", "calibrate --from {}", "report --parent {}"),
    ),
    "dataset": Kind("a dataset", ("solve {}", "report {}"), ("solve --test {}",)),
    "plan": Kind("a plan", ("calibrate --plan {}", "export plan {} --format urscript")),
    "config": Kind("a configuration", ("doctor --config {}", "calibrate --config {}")),
    "cells": Kind("a list of cells", ("fleet add {}",)),
    "transcript": Kind("a transcript", ("transcript play {}",), ("bundle RUN --transcript {}",)),
    "bundle": Kind("a bundle", ("replay {}", "solve {}")),
    "push": Kind("a receipt of `ftdrive push`", ("push --restore {}",)),
    "table": Kind(
        "a table or bag of another program",
        ("solve {}", "compensate {} --calibration PATH", "live --replay {} --calibration PATH"),
        ("report {}", "solve --wrench {}", "solve --orientation-file {}", "solve --test {}"),
    ),
}
_TEXTS, _BINARIES = {".csv", ".tsv", ".txt", ".dat", ".log"}, {".parquet", ".db3", ".bag", ".mcap"}
_TWO_NUMBERS = re.compile(rb"\d[\s,;]+[-+.]?\d")
_FORMAT = re.compile(rb"ftdrive\.(\w+)/\d")
# Matches the header of a section that a TOML file has only if it is the configuration of a cell.
_CELL = re.compile(rb"^\[(?:robot|sensor|tool|workcell)\]", re.MULTILINE)
_START = 4096
_ALIKE = 0.75


def kind_of(path: Path) -> str | None:
    """Return the kind of a file or folder, a key of `KINDS`, by content and suffix; None if no command accepts it."""
    from ftdrive.recording.foreign import is_bag, is_recording

    with suppress(OSError):
        if is_bag(path):
            return "table"
        if path.is_dir():
            return "run" if is_run(path) else "runs" if next(_runs_in(path), None) else "folder"
        if not path.is_file():
            return None
        with open_file(path) as file:
            start = file.read(_START)
        if (found := _FORMAT.search(start[:300])) is not None and (name := found[1].decode()) in KINDS:
            return name
        if path.suffix == ".toml":
            return "config" if _CELL.search(start) else None
        if path.suffix == ".zip":
            return "bundle"
        if path.suffix == ".mcap" and is_recording(path):
            return "recording"
        is_table = path.suffix in _BINARIES or (path.suffix in _TEXTS and _TWO_NUMBERS.search(start))
        return "table" if is_table else None
    return None


def _runs_in(folder: Path) -> Iterator[Path]:
    yield from filter(is_run, sorted(folder.iterdir(), reverse=True))


def other_command(group: click.Group, arguments: Sequence[str], about: str = "") -> str:
    """Return a message with commands for the first given file that is not accepted where it is; empty if there is none.

    If `about`, an error message, is not empty, only files that it names are considered.
    """
    for number, place, name, command in _unmatched_arguments(group, arguments):
        path, kind = Path(name), kind_of(Path(name))
        if kind is None or not name.isprintable() or (about and name not in about):
            continue
        if kind == "run" and path.is_file():
            path = path.parent
        elif place in KINDS[kind].places or (place == "--calibration" and kind == "run"):
            continue
        options = {name for one in command.params for name in one.opts} & KINDS[kind].places
        own = [f"{place} {option} {{}}" for option in sorted(options) if not place.startswith("-")]
        if " " in place:
            own += [line for line in (*KINDS[kind].lines, *KINDS[kind].others) if line.split()[0] == place.split()[0]]
        lines = [f"ftdrive {line.format(shlex.quote(str(path)))}" for line in dict.fromkeys([*own, *KINDS[kind].lines])]
        # propose other commands for this file, or, for a folder of runs or a file in a run, this line with the run
        better = path if path != Path(name) else next(_runs_in(path), None) if kind == "runs" else None
        if better is not None:
            given = arguments[number].removesuffix(name) + str(better)
            lines = [shlex.join(["ftdrive", *arguments[:number], given, *arguments[number + 1 :]])]
        which = place if place.startswith("-") else f"`ftdrive {place}`"
        what = "a file of a run folder" if kind == "run" and path != Path(name) else KINDS[kind].words
        return "\n".join([f"{name} is {what}, which {which} does not take. Type", *lines])
    return ""


def _unmatched_arguments(group: click.Group, arguments: Sequence[str]) -> Iterator[tuple[int, str, str, click.Command]]:
    """Yield index, option or command words, text and command of each argument that is an input file or unexpected."""
    command: click.Command = group
    words, option, number_of_place = list[str](), "", 0
    for number, argument in enumerate(arguments):
        options = {name: one for one in command.params if isinstance(one, click.Option) for name in one.opts}
        if option:
            if _is_read(options[option]):
                yield number, option, argument, command
            option = ""
        elif argument.startswith("-"):
            name, _, value = argument.partition("=")
            known = options.get(name)
            if known is not None and value and _is_read(known):
                yield number, name, value, command
            elif known is not None and not (value or known.is_flag or known.count):
                option = name
        elif isinstance(command, click.Group) and (sub := command.get_command(click.Context(command), argument)):
            command = sub
            words.append(argument)
        else:
            places = [one for one in command.params if isinstance(one, click.Argument)]
            # the arguments of `diff` are always checked, although they have no type of a path: they may be ids
            if not places or command.name == "diff" or _is_read(places[min(number_of_place, len(places) - 1)]):
                yield number, " ".join(words), argument, command
            number_of_place += 1


def _is_read(parameter: click.Parameter) -> bool:
    return isinstance(parameter.type, click.Path) and parameter.type.exists


def similar_path(group: click.Group, arguments: Sequence[str]) -> str:
    """Return a question that proposes a path similar to a missing one, or how to find one; empty if there is none."""
    for _, _, name, _ in _unmatched_arguments(group, arguments):
        path = Path(name)
        if path.exists():
            continue
        with suppress(OSError):
            if found := get_close_matches(path.name, [one.name for one in path.parent.iterdir()], 1, _ALIKE):
                return _question([str(path.with_name(found[0]))])
        # by the suffix of runs and results, because `history` lists no plans, tables or lists of cells
        return " `ftdrive history` lists your runs." if path.suffix in {"", ".json"} else ""
    return ""


def close_command(name: str, names: Sequence[str]) -> str:
    """Return a question that proposes the command most similar to a mistyped one; empty if there is none."""
    return _question(get_close_matches(name, names, 1))


def _question(names: Iterable[str]) -> str:
    quoted = [f"'{name}'" for name in names]
    return f" Did you mean {' or '.join(quoted)}?" if quoted else ""


def missing_parameters(error: click.MissingParameter, arguments: Sequence[str]) -> str:
    """Return a message that names all missing parameters (`click` names only the first), with the complete line."""
    context = error.ctx
    if context is None or context.info_name not in arguments:
        return error.format_message()
    command, typed = context.command, list(arguments[arguments.index(context.info_name) + 1 :])
    given, _, _ = command.make_parser(context).parse_args(list(typed))
    # a missing parameter is one whose value is no text or list, because its value depends on the version of `click`
    absent = [
        one for one in command.params if one.required and not isinstance(given.get(one.name or ""), str | tuple | list)
    ]
    names = " and ".join(f"{one.param_type_name} {one.get_error_hint(context)}" for one in absent)
    options = {name: one for one in command.params for name in one.opts}
    if "--simulate" in options and not {"--simulate", "--calibration", "--tool", "--sensor"} & set(typed):
        real = [options[name] for name in ("--calibration", "--sensor") if name in options]
        absent += [one for one in real if one.metavar in {"PATH", "URL"}][:1]
    words = " ".join(_placeholder(one, context) for one in absent)
    return f"Missing {names}. Type\n{' '.join([context.command_path, shlex.join(typed)]).rstrip()} {words}"


def without_value(error: click.BadOptionUsage, group: click.Group, arguments: Sequence[str]) -> str:
    """Return the message of an error about an option without a value, and the line with a placeholder for the value."""
    command: click.Command = group
    words = ["ftdrive"]
    for argument in arguments:
        if isinstance(command, click.Group) and (sub := command.get_command(click.Context(command), argument)):
            command = sub
            words.append(argument)
    for one in command.params:
        if error.option_name in one.opts:
            return f"{error.format_message()} Type\n{' '.join([*words, _placeholder(one, click.Context(command))])}"
    return error.format_message()


def of_subcommand(error: click.NoSuchOption, arguments: Sequence[str]) -> str:
    """Return the message about an unknown option, and if a subcommand has the option, the line with it there."""
    context = error.ctx
    if context is not None and isinstance(group := context.command, click.Group):
        names = group.list_commands(context)
        # if no subcommand was typed, search all of them only in a subgroup, because importing all commands takes 1 s
        for name in [one for one in names if one in arguments] or (names if context.parent else []):
            command = group.get_command(context, name)
            if command is not None and any(error.option_name in one.opts for one in command.params):
                return f"{error.message} Type\n{context.command_path} {name} {error.option_name}"
    return error.format_message()


def _placeholder(parameter: click.Parameter, context: click.Context) -> str:
    value = parameter.make_metavar(context)
    return f"{max(parameter.opts, key=len)} {value}" if isinstance(parameter, click.Option) else value

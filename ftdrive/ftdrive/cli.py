"""The command line `ftdrive`: its commands, imported only when called, and the output of errors."""

import atexit
import gc
import logging
import os
import signal
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from importlib import import_module
from io import StringIO
from types import FrameType
from typing import Any

import click

from ftcalib.errors import DataError, DeviceError, UsageError
from ftdrive import __version__
from ftdrive.errors import SupervisorGone, exit_code, in_a_sentence
from ftdrive.terminal.text import WholeWords, echo
from ftdrive.words.text import COMMANDS, GLUE, in_one_line

_EPILOG = f"""\
Exit codes: 0 ok, 1 unexpected, 2 usage or configuration, 3 cannot open a device, 4 stream failed,
5 device fault, 6 file cannot be read or written, 7{GLUE}check or acceptance failed, 8 recording has gaps,
9 supervisor gone (terminal, reader or input closed; data kept), 130 interrupted (data kept),
141 the reader of the output has ended."""


# Format of all help texts: click reads this class attribute for every command.
click.Context.formatter_class = WholeWords

# Exit code that a shell reports for a program ended by SIGPIPE, whose output lost its reader.
_CLOSED_PIPE = 128 + 13
# Signals received because the terminal was closed. Errors after such a signal are its consequence.
_closed_terminals: list[int] = []


@contextmanager
def _closed_pipe() -> Iterator[None]:
    try:
        yield
    except BrokenPipeError as error:  # left to click, it would always give exit code 1
        from ftdrive.terminal.supervisor import Supervisor

        if any(Supervisor(sys.stdin, stream, "it").absence() for stream in (sys.stdout, sys.stderr)):
            raise click.exceptions.Exit(_CLOSED_PIPE) from None
        raise DeviceError("a device or server closed its connection: check it, then start again") from error


class _LazyGroup(click.Group):
    """A group whose commands are imported only when called: `modules` maps each name to its module and help line.

    The error message for a mistyped command proposes the most similar name.
    """

    def __init__(self, *args: Any, modules: Mapping[str, tuple[str, str]], **options: Any) -> None:
        super().__init__(*args, **options)
        self._modules = modules

    @_closed_pipe()
    def make_context(self, *args: Any, **kwargs: Any) -> click.Context:
        return super().make_context(*args, **kwargs)

    @_closed_pipe()
    def invoke(self, ctx: click.Context) -> Any:
        return super().invoke(ctx)

    def list_commands(self, ctx: click.Context) -> list[str]:
        return list(self._modules)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        if cmd_name in self.commands or cmd_name not in self._modules:
            return self.commands.get(cmd_name)
        module = import_module(f"ftdrive.commands.{self._modules[cmd_name][0]}")
        return next(one for one in vars(module).values() if isinstance(one, click.Command) and one.name == cmd_name)

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        typed = args[0]
        if not (typed.startswith("-") or ctx.resilient_parsing or self.get_command(ctx, typed)):
            from ftdrive.mistakes import close_command

            ctx.fail(f"No such command '{typed}'.{close_command(typed, [*self._modules, *self.commands])}")
        return super().resolve_command(ctx, args)

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        with formatter.section("Commands"):
            formatter.write_dl([(name, line) for name, (_, line) in self._modules.items()])


_MODULES = {name: (name.replace("-", "_"), line) for name, line in COMMANDS.items()}
_FLEET = {
    "add": ("fleet.cells", "Add the cells of CELLS.TOML to the store."),
    "index": ("fleet.cells", "Add the runs in the folders RUNS to the store."),
    "remove": ("fleet.cells", "Remove cells from the store."),
    "serve": ("fleet.status", "Serve the state of all cells to Prometheus, and as a page."),
    "solve": ("fleet.solve", "Solve runs again with this version, and compare."),
    "status": ("fleet.status", "List all cells: what is due, and what drifts."),
    "verify": ("fleet.verify", "Verify cells one after the other, with an operator at each."),
}


@click.command("help")
@click.argument("words", metavar="[COMMAND]...", nargs=-1)
def _help(words: tuple[str, ...]) -> None:
    """Print the help of a command."""
    cli.main([*words, "--help"], prog_name="ftdrive", standalone_mode=False)


@click.group(cls=_LazyGroup, modules=_MODULES, epilog=_EPILOG, context_settings={"help_option_names": ["-h", "--help"]})
@click.option("-v", "--verbose", count=True, help="Print details on stderr; -vv also prints debug messages.")
@click.option("-q", "--quiet", is_flag=True, help="Print only results, errors, and the context of each question.")
@click.version_option(__version__, "-V", "--version", prog_name="ftdrive")
def cli(verbose: int, quiet: bool) -> None:
    """Calibrate a wrist force/torque sensor on a Universal Robots arm, and see the true contact force.

    New here? `ftdrive demo` needs no hardware. `ftdrive help COMMAND` explains a command.
    """
    level = logging.ERROR if quiet else (logging.WARNING, logging.INFO, logging.DEBUG)[min(verbose, 2)]
    logging.basicConfig(level=level, format="%(levelname)s %(name)s: %(message)s", handlers=[_MessageHandler()])
    if quiet or verbose:
        from ftdrive.terminal.console import messages

        messages.quiet, messages.verbose = quiet, bool(verbose)


cli.add_command(_help)


@cli.group(cls=_LazyGroup, modules=_FLEET)
def fleet() -> None:
    """Watch many cells: which are due, which sensors drift, which faults occur in several cells."""


class _MessageHandler(logging.Handler):
    def emit(self, record: logging.LogRecord) -> None:
        from ftdrive.terminal.console import messages

        with suppress(OSError):  # a closed terminal or pipe
            if messages.quiet:
                echo(self.format(record), err=True)
                return
            messages.print(self.format(record))


def main() -> int:
    """Run the command line; return the exit code."""
    # The matrices of a calibration are small: linear-algebra threads would wait for each other longer than they
    # compute. numpy reads this variable later, when it is imported.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    # Ctrl-C, `kill` and a closed terminal all end a command in the same way: the arm is stopped first. Set the handlers
    # even if these signals are inherited as ignored, as in a background job, but leave SIGHUP ignored under `nohup`.
    for name in ("SIGINT", "SIGTERM"):
        signal.signal(getattr(signal, name), signal.default_int_handler)
    if hasattr(signal, "SIGHUP") and signal.getsignal(signal.SIGHUP) != signal.SIG_IGN:
        signal.signal(signal.SIGHUP, _hang_up)
    _open_closed_streams()
    # Garbage collection at exit would take 0.5 s on a busy computer, and the memory is freed anyway.
    atexit.register(gc.freeze)
    code = run(sys.argv[1:])
    is_dead = _leave_dead_streams()
    return _CLOSED_PIPE if is_dead and code == 0 else code


def _hang_up(number: int, frame: FrameType | None) -> None:
    _closed_terminals.append(number)
    signal.default_int_handler(number, frame)


def _leave_dead_streams() -> bool:
    """Redirect stdout and stderr to /dev/null if their reader has ended, because Python flushes them at exit.

    Return whether stdout had lost its reader.
    """
    dead = []
    for stream in (sys.stdout, sys.stderr):
        try:
            stream.flush()
        except (OSError, ValueError):
            dead.append(stream)
            with suppress(OSError, ValueError):
                os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())
    return sys.stdout in dead


def _open_closed_streams() -> None:
    """Open /dev/null as each standard stream that the caller closed, so that no file gets its descriptor later."""
    for name, mode in (("stdin", "r"), ("stdout", "w"), ("stderr", "w")):
        if getattr(sys, name) is None:
            setattr(sys, name, os.fdopen(os.open(os.devnull, os.O_RDWR), mode))


def run(arguments: Sequence[str]) -> int:
    """Run a command line, given without the program's name; print its error, if any, and return the exit code."""
    try:
        code = _run(arguments)
    except Exception:
        if not _closed_terminals:
            raise
        code = 1
    if _closed_terminals:  # report this, because other errors follow from it
        _say("error: the terminal was closed")
        return exit_code(SupervisorGone("")) or code
    return code


def _run(arguments: Sequence[str]) -> int:
    try:
        return int(cli.main(list(arguments), prog_name="ftdrive", standalone_mode=False) or 0)
    except click.ClickException as error:
        _explain_click_error(error, arguments)
        return error.exit_code
    except (click.Abort, KeyboardInterrupt):
        _say("interrupted")
        return 130
    except Exception as error:
        code = exit_code(error)
        if code is None or _closed_terminals:
            raise
        # if a file of the wrong kind may be the cause, name the command that accepts it
        about = str(error) if isinstance(error, UsageError) else ""
        other = _other_command(arguments, about) if isinstance(error, DataError | UsageError | OSError) else ""
        _say(f"error: {in_one_line(other or in_a_sentence(error))}")
        return code


def _explain_click_error(error: click.ClickException, arguments: Sequence[str]) -> None:
    from ftdrive.mistakes import missing_parameters, of_subcommand, similar_path, without_value

    if isinstance(error, click.MissingParameter):
        error = click.UsageError(missing_parameters(error, arguments), error.ctx)
    elif isinstance(error, click.NoSuchOption):
        error = click.UsageError(of_subcommand(error, arguments), error.ctx)
    elif isinstance(error, click.BadOptionUsage):
        error = click.UsageError(without_value(error, cli, arguments), error.ctx)
    elif isinstance(error, click.UsageError):
        if other := _other_command(arguments, error.format_message()):
            _say(f"error: {in_one_line(other)}")
            return
        if isinstance(error, click.BadParameter) and error.param and isinstance(error.param.type, click.Path):
            error = click.UsageError(error.format_message() + similar_path(cli, arguments), error.ctx)
    error.show(message := StringIO())
    echo(message.getvalue(), err=True, nl=False)


def _other_command(arguments: Sequence[str], about: str = "") -> str:
    from ftdrive.mistakes import other_command

    return other_command(cli, arguments, about)


def _say(text: str) -> None:
    with suppress(OSError):
        echo(text, err=True)

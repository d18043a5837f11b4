"""The far ends of a session's streams: which ends count, and that nothing is read beyond a line."""

import io
import os
import pty
import signal
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import TextIO

import pytest
from rich.console import Console

from ftdrive.errors import Declined, SupervisorGone
from ftdrive.session.events import Question
from ftdrive.terminal.keyboard import Keyboard
from ftdrive.terminal.operators import JsonOperator
from ftdrive.terminal.screen import Screen
from ftdrive.terminal.supervisor import Supervisor


def reader(fd: int) -> TextIO:
    return os.fdopen(fd, "r", encoding="utf-8")


class Pipes:
    def __init__(self) -> None:
        stdin, self.answers = os.pipe()
        self.seen, stdout = os.pipe()
        self.stdin, self.stdout = reader(stdin), os.fdopen(stdout, "w", encoding="utf-8")
        self.supervisor = Supervisor(self.stdin, self.stdout, "standard output")

    def close(self) -> None:
        for stream in (self.stdin, self.stdout):
            try:
                stream.close()
            except BrokenPipeError:
                stream.close()
        for fd in (self.answers, self.seen):
            try:
                os.close(fd)
            except OSError:  # closed by the test
                continue


@pytest.fixture
def pipes() -> Iterator[Pipes]:
    pipes = Pipes()
    yield pipes
    pipes.close()


def test_a_reader_that_is_gone_is_seen_without_a_write(pipes: Pipes) -> None:
    assert pipes.supervisor.absence() is None
    os.close(pipes.seen)
    assert "standard output" in str(pipes.supervisor.absence())
    pipes.stdout.write("{}\n")
    with pytest.raises(SupervisorGone, match="standard output"), pipes.supervisor.writing():
        pipes.stdout.flush()


def test_an_error_of_the_disk_stays_what_it_is(pipes: Pipes) -> None:
    with pytest.raises(OSError, match="full"), pipes.supervisor.writing():
        raise OSError("the disk is full")


def test_an_input_counts_once_its_writer_was_there_at_a_question(pipes: Pipes) -> None:
    os.write(pipes.answers, b"yes\nMOVE\n")
    assert pipes.supervisor.read_line("?") == "yes\n"
    assert os.read(pipes.stdin.fileno(), 99) == b"MOVE\n"  # nothing was taken beyond the line
    assert pipes.supervisor.absence() is None
    os.close(pipes.answers)
    assert "standard input" in str(pipes.supervisor.absence())
    with pytest.raises(SupervisorGone, match="standard input"):
        pipes.supervisor.read_line("?")


def test_a_writer_that_leaves_at_the_question_itself_is_gone(pipes: Pipes) -> None:
    class Leaving(io.StringIO):
        def write(self, text: str) -> int:
            os.close(pipes.answers)
            return len(text)

    with pytest.raises(SupervisorGone, match="standard input"):
        JsonOperator(stdin=pipes.stdin, stdout=Leaving()).ask(Question("Go on?"))


def test_a_question_that_waits_ends_with_its_reader(pipes: Pipes) -> None:
    os.close(pipes.seen)
    with pytest.raises(SupervisorGone, match="standard output"):
        pipes.supervisor.read_line("?")


def test_a_terminal_that_closes_is_gone_though_nothing_was_asked() -> None:
    person, program = pty.openpty()
    with os.fdopen(program, "r+b", buffering=0) as device:
        terminal = io.TextIOWrapper(device, write_through=True)
        supervisor = Supervisor(terminal, terminal, "standard error")
        os.write(person, b"yes\nno\n")
        assert supervisor.read_line("?") == "yes\n"
        assert supervisor.absence() is None
        os.close(person)
        assert "terminal" in str(supervisor.absence())
        with pytest.raises(SupervisorGone, match="terminal"):
            supervisor.read_line("?")


def test_files_are_never_gone(tmp_path: Path) -> None:
    with (tmp_path / "log").open("w+") as output, Path(os.devnull).open() as stdin:
        supervisor = Supervisor(stdin, output, "standard output")
        with pytest.raises(Declined, match="no answer"):
            supervisor.read_line("no answer")
        assert supervisor.absence() is None


@pytest.mark.parametrize("ignored", [False, True], ids=["", "nohup"])
def test_a_hang_up_is_noticed_unless_it_is_ignored(ignored: bool, pipes: Pipes) -> None:
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN if ignored else signal.default_int_handler)
    try:
        with pipes.supervisor:
            os.kill(os.getpid(), signal.SIGHUP)
            assert (pipes.supervisor.absence() is None) == ignored
        assert signal.getsignal(signal.SIGHUP) == (signal.SIG_IGN if ignored else signal.default_int_handler)
    finally:
        signal.signal(signal.SIGHUP, before)


def test_a_screen_whose_terminal_closes_at_a_question_reports_it() -> None:
    person, program = pty.openpty()

    def close_at_the_question() -> None:
        said = b""
        while b"Go on?" not in said:
            said += os.read(person, 4096)
        os.close(person)

    with os.fdopen(program, "r+b", buffering=0) as device:
        terminal = io.TextIOWrapper(device, write_through=True)
        screen = Screen(Console(file=terminal, force_terminal=True, width=80), Keyboard(program), stdin=terminal)
        threading.Thread(target=close_at_the_question).start()
        with pytest.raises(SupervisorGone, match="terminal"), screen:
            screen.ask(Question("Go on?"))

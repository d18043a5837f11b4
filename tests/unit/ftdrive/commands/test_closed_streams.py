"""Commands whose caller has closed a standard stream, as some supervisors do."""

import errno
import os
import pty
import select
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from ftdrive import cli
from ftdrive.recording.files import load_recording
from tests.unit.ftdrive.recorded import calibration


@pytest.mark.slow
@pytest.mark.parametrize("closed", [">&-", "<&- >&- 2>&-"])
def test_a_closed_stream_is_no_traceback_and_no_file_gets_its_number(closed: str) -> None:
    """`devices` asks whether stdout is a terminal; `convert` of nothing prints on stderr."""
    for arguments, code in ((["devices"], 0), (["convert", "nothing.csv", "b.csv"], 2)):
        command = [sys.executable, "-m", "ftdrive", *arguments]
        ended = subprocess.run(
            ["sh", "-c", f'exec "$@" {closed}', "sh", *command], capture_output=True, text=True, check=False, timeout=60
        )
        assert ended.returncode == code
        assert "Traceback" not in ended.stderr


@pytest.mark.parametrize(
    "left", [None, KeyboardInterrupt(), OSError(errno.EIO, "Input/output error"), RuntimeError("of a screen")]
)
def test_whatever_a_closed_terminal_leaves_behind_is_exit_code_9(
    left: BaseException | None, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """A command that ends well, one that is interrupted, one that cannot write, and a screen that breaks."""

    def command(*_: object, **__: object) -> int:
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGHUP)
        if left is not None:
            raise left
        return 0

    monkeypatch.setattr(cli, "_closed_terminals", [])
    monkeypatch.setattr(cli.cli, "main", command)
    monkeypatch.setattr(sys, "argv", ["ftdrive", "live"])
    before = {one: signal.getsignal(one) for one in (signal.SIGINT, signal.SIGTERM)}
    before[signal.SIGHUP] = signal.signal(signal.SIGHUP, signal.SIG_DFL)  # `nohup` has it ignored
    try:
        assert cli.main() == 9
    finally:
        for one, handler in before.items():
            signal.signal(one, handler)
    assert capsys.readouterr().err.removeprefix("interrupted\n") == "error: the terminal was closed\n"


def test_the_end_of_a_command_collects_no_garbage() -> None:
    code = "import atexit, gc; atexit.register(lambda: print(gc.get_freeze_count())); import ftdrive.cli as c; c.main()"
    ended = subprocess.run([sys.executable, "-c", code, "-V"], capture_output=True, text=True, check=True, timeout=60)
    assert int(ended.stdout.split()[-1]) > 0


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("setsid") is None, reason="setsid of util-linux gives a process its terminal")
def test_a_closed_terminal_ends_a_command_of_the_stream_well(tmp_path: Path) -> None:
    calibration().save(tmp_path / "calibration.json")
    options = ["--simulate", "--force", "--calibration", "calibration.json"]
    terminal, slave = pty.openpty()
    process = subprocess.Popen(
        ["setsid", "--ctty", sys.executable, "-m", "ftdrive", "record", "-o", "a.mcap", *options],
        stdin=slave,
        stdout=slave,
        stderr=slave,
        cwd=tmp_path,
    )
    os.close(slave)
    shown = ""
    deadline_s = time.monotonic() + 300
    try:
        while " s, " not in shown:
            assert time.monotonic() < deadline_s, shown
            if select.select([terminal], [], [], 0.1)[0]:
                shown += os.read(terminal, 4096).decode(errors="replace")
        os.close(terminal)
        assert process.wait(timeout=300) == 9
    finally:
        process.kill()
        process.wait()
    assert "Traceback" not in shown
    assert load_recording(tmp_path / "a.mcap")

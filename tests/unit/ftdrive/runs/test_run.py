"""A run folder that is damaged or incomplete: the file is named, with what to do; and what to type to go on with it."""

import errno
import os
import platform
import re
import resource
import signal
import subprocess
import sys
import zipfile
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from ftcalib.errors import BadDataset
from ftcalib.routine import PoseRecord, TourPose
from ftdrive.errors import ConfigError
from ftdrive.runs import source
from ftdrive.runs.run import Reading, Run
from ftdrivers.interfaces import FtSamples
from tests.edited_files import edit

CONFIG = {"robot": {"host": "10.0.0.2"}, "sensor": {"url": "ati-can://can0"}, "tool": {"mass_kg": None, "later": 1}}


@pytest.fixture
def run(tmp_path: Path) -> Run:
    """One of one pose."""
    run = Run.create(tmp_path, "calibrate", {"mode": "auto", "config": CONFIG, "devices": {"arm": {"serial": "1"}}})
    reading = Reading(0, np.zeros(6), np.eye(3))
    samples = FtSamples.of(np.arange(20), np.arange(20), np.zeros((20, 6)))
    run.commit(PoseRecord(1, TourPose(1, np.zeros(6)), reading, reading, samples, steady=True))
    return run


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda header: header.pop("devices"), r"has no 'devices'.*from a copy"),
        (lambda header: header.update(devices=[1]), r"'devices' is \[1\].*from a copy"),
        (lambda header: header["devices"].pop("arm"), r"has no 'arm'.*from a copy"),
        (lambda header: header["devices"]["arm"].clear(), r"has no 'serial'.*from a copy"),
        (lambda header: header["devices"]["arm"].update(serial=5), r"'devices\.arm\.serial' is 5.*from a copy"),
        (lambda header: header.update(mode=5), r"'mode' is 5, not one of auto, step.*from a copy"),
        (lambda header: header.update(mode=["auto"]), r"'mode' is \['auto'\].*from a copy"),
        (lambda header: header.update(said=5), r"'said' is 5, not an object.*from a copy"),
        (lambda header: header.update(said={"robot": 5}), r"'said\.robot' is 5, not a string or null.*from a copy"),
        (lambda header: header.update(said={"config": ["a"]}), r"'said\.config' is \['a'\].*from a copy"),
        (
            lambda header: header.update(said={"tool": "0:60:90"}),
            r"'said\.tool' is '0:60:90', not a list.*from a copy",
        ),
        (lambda header: header.update(said={"tool": [5]}), r"'said\.tool' is \[5\].*from a copy"),
        (lambda header: header.update(station=["can"]), r"'station' is \['can'\], not an object.*from a copy"),
        (lambda header: header.update(station={"sensor": 5}), r"'station\.sensor' is 5, not a string.*from a copy"),
        (
            lambda header: header.update(station={"options": "x"}),
            r"'station\.options' is 'x', not a list.*from a copy",
        ),
        (lambda header: header["config"].update(robot=["10.0.0.2"]), r"'config' is .*, not an object.*from a copy"),
        (lambda header: header.update(config=5), r"'config' is 5.*from a copy"),
        (lambda header: header["config"]["robot"].update(host=5), r"\[robot\] host = 5 is not a string"),
        (lambda header: header["config"]["robot"].clear(), r"has no 'host'.*from a copy"),
        (lambda header: header.pop("format"), "not an ftdrive.run file"),
    ],
)
def test_a_damaged_header_names_its_file_and_what_is_wrong(
    change: Callable[[dict[str, Any]], object], words: str, run: Run
) -> None:
    run.plan_path.touch()
    edit(run.folder / "run.json", change)
    with pytest.raises(BadDataset, match=rf"run\.json.*{words}"):
        assert run.header_to_resume()["devices"]["arm"]["serial"]


@pytest.mark.parametrize("mode", ["auto", "step"])
def test_without_its_plan_a_run_cannot_go_on_and_says_how_to_solve_it(mode: str, run: Run) -> None:
    edit(run.folder / "run.json", lambda header: header.update(mode=mode))
    with pytest.raises(BadDataset, match=r"plan\.json .*ftdrive solve "):
        run.header_to_resume()
    edit(run.folder / "run.json", lambda header: header.update(mode="manual"))
    assert run.header_to_resume()["mode"] == "manual"


@pytest.mark.parametrize("part", [0.0, 0.3, 0.9])
def test_a_recording_that_was_cut_is_named(part: float, run: Run) -> None:
    path = run.folder / "poses" / "01.npz"
    whole = path.read_bytes()
    path.write_bytes(whole[: int(part * len(whole))])
    with pytest.raises(BadDataset, match=r"01\.npz .*--resume"):
        run.records()


def test_a_recording_that_lacks_something_is_named(run: Run) -> None:
    path = run.folder / "poses" / "01.npz"
    with np.load(path) as file:
        data = {name: file[name] for name in file.files if name != "steady"}
    with path.open("wb") as kept:
        np.savez(kept, **data)
    with pytest.raises(BadDataset, match=r"01\.npz .*'steady'"):
        run.records()


@pytest.mark.parametrize("password", ["secret", "sec/ret", "sec@ret"])
def test_a_password_on_the_command_line_reaches_no_file(
    password: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("sys.argv", ["ftdrive", "fleet", "verify", "--store", f"postgresql://u:{password}@host:1/db"])
    run = Run.create(tmp_path, "verify", {})
    assert run.header()["argv"][-1] == "postgresql://u@host:1/db"


def test_a_pose_is_checked_to_its_last_bit(run: Run) -> None:
    """`numpy.load` alone does not read to the end of an array, where zip files have its CRC."""
    path = run.folder / "poses" / "01.npz"
    whole, content = run.records()[0].samples, path.read_bytes()
    refused, rng = list[str](), np.random.default_rng(4)
    for place in rng.integers(0, len(content), 100).tolist():
        damaged = bytearray(content)
        damaged[place] ^= 1 << int(rng.integers(8))
        path.write_bytes(damaged)
        try:
            (found,) = run.records()
        except BadDataset as error:
            refused.append(str(error))
        else:
            np.testing.assert_array_equal(found.samples.wrench, whole.wrench)
            assert (found.stop, found.clock_offset_ns > 10**18, found.steady) == (1, True, True)
    assert len(refused) > 50
    assert all("01.npz" in words for words in refused)


def test_an_array_that_cannot_be_parsed_is_named(run: Run) -> None:
    path = run.folder / "poses" / "01.npz"
    header = b"{'descr': '<f8', 'fortran_order': (".ljust(118) + b"\n"
    with zipfile.ZipFile(path, "w") as file:
        file.writestr("steady.npy", b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little") + header)
    with pytest.raises(BadDataset, match=r"01\.npz .*--resume"):
        run.records()


def test_an_edited_header_is_refused(run: Run) -> None:
    path = run.folder / "run.json"
    path.write_text(path.read_text().replace('"10.0.0.2"', '"10.0.0.3"'))
    with pytest.raises(BadDataset, match=r"run\.json: the content differs from its checksum.*delete its field"):
        run.header()


def events_in(run: Run, text: str) -> list[Any]:
    (run.folder / "events.ndjson").write_text(text)
    return [event["pose"] for event in run.events()]


def test_a_damaged_event_is_refused_and_one_cut_off_by_a_power_failure_is_not(run: Run) -> None:
    for pose in range(3):
        run.append_event({"event": "pose-taken", "pose": pose, "temperature_C": 21.5})
    text = (run.folder / "events.ndjson").read_text()
    assert events_in(run, text) == [0, 1, 2]
    assert events_in(run, text[:-30]) == [0, 1]
    assert events_in(run, text[:-1] + "\v") == [0, 1, 2]
    for damaged in (text.replace("21.5", "61.5", 1), text.replace("{", "[", 1), text.replace("\n", "\v", 1)):
        with pytest.raises(BadDataset, match=r"events\.ndjson: line 1 is damaged.*copy"):
            events_in(run, damaged)


def test_half_an_event_never_stands_before_another(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    run.append_event({"pose": 1})
    with (run.folder / "events.ndjson").open("a") as file:
        file.write('{"pose": 2')
    with run:  # resumed after a power failure
        run.append_event({"pose": 3})
    limit = resource.getrlimit(resource.RLIMIT_FSIZE)
    monkeypatch.setattr(signal, "SIGXFSZ", signal.signal(signal.SIGXFSZ, signal.SIG_IGN))
    size = (run.folder / "events.ndjson").stat().st_size
    resource.setrlimit(resource.RLIMIT_FSIZE, (size + 10, limit[1]))
    try:
        with pytest.raises(OSError, match="too large"):
            run.append_event({"pose": 4})
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limit)
    run.append_event({"pose": 5})
    assert list(run.events()) == [{"pose": 1}, {"pose": 3}, {"pose": 5}]


HOLDER = """
import sys, time
from pathlib import Path
from ftdrive.errors import ConfigError
from ftdrive.runs.run import Run
with Run(Path(sys.argv[1])):
    print("locked", flush=True)
    time.sleep(60)
"""


@pytest.mark.slow
def test_a_second_process_that_resumes_a_run_is_refused_and_a_crash_leaves_no_lock(run: Run) -> None:
    holder = subprocess.Popen([sys.executable, "-c", HOLDER, run.folder], stdout=subprocess.PIPE, text=True)
    assert holder.stdout is not None
    assert holder.stdout.readline() == "locked\n"
    try:
        with pytest.raises(ConfigError) as refusal, run:
            pass
    finally:
        holder.kill()
        holder.communicate()
    held = rf"in use by process {holder.pid} on {re.escape(platform.node())} since \d{{4}}-.* UTC: wait until it ends"
    assert re.search(held, str(refusal.value))
    with run, pytest.raises(ConfigError, match=rf"in use by process {os.getpid()} on"), Run(run.folder):
        pass
    with Run(run.folder):
        pass


def test_without_room_for_the_result_the_poses_are_safe(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    solved = SimpleNamespace(dataset=SimpleNamespace(save=full))
    monkeypatch.setattr(source, "solve_records", lambda *_: solved)
    with pytest.raises(OSError, match=r"No space left .*not saved, but all poses are.*ftdrive solve .* --output"):
        source.solve_and_save(run)

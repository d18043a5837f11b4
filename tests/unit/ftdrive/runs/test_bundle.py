"""A bundle gives the result of its run without its addresses, and a damaged or hostile one does nothing."""

import io
import json
import os
import shutil
import zipfile
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner

from ftcalib import CalibrationResult, Parameters
from ftcalib.errors import BadDataset
from ftcalib.model import predict
from ftcalib.poses.information import special
from ftcalib.routine import PoseRecord, TourPose
from ftcalib.sensor_matrix import SensorMatrix
from ftdrive.cli import cli
from ftdrive.cli import run as run_command
from ftdrive.errors import BadBundle
from ftdrive.runs import bundle
from ftdrive.runs.bundle import unpack, write_bundle
from ftdrive.runs.calibration import sensor_files
from ftdrive.runs.run import Reading, Run
from ftdrive.runs.source import solve_and_save
from ftdrivers.interfaces import FtSamples

TRUTH = Parameters(np.eye(3), np.array([0.0, 0, -12]), np.ones(3), np.array([0.0, 0, 0.06]), np.ones(3))
SERIAL_PORT = "/dev/serial/by-id/usb-FTDI_USB-RS485_FT6ABC12-if00-port0"
SECRETS = ("192.168.7.31", "ur5e-hall3", "example.org", "alice", "fe80::a00:27ff", "08:00:27:12:34:56", "10.9.8.7")
CONFIG = {
    "robot": {"host": "ur5e-hall3.example.org", "driver": "ur"},
    "sensor": {"url": "ati-netft://192.168.7.31?onrobot=0"},
    "sampling": {"average_s": 0.1},
    "site": {"g_m_s2": 9.81},
}
DEVICES = {"arm": {"serial": "20235501234", "firmware": "5.15.0.17"}, "sensor": {"serial": "FT12345"}}


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Run:
    """A solved one of 8 poses; its files give away hosts and a person."""
    header = {"config": CONFIG, "devices": DEVICES, "said": {"robot": "ur5e-hall3", "config": "/home/alice/cell.toml"}}
    run = Run.create(tmp_path_factory.mktemp("runs"), "gripper", header)
    rng, n = np.random.default_rng(1), 50
    for stop, R in enumerate(special([1, 5, 9, 11, 14, 18, 20, 23]), 1):
        reading = Reading(stop * 10**9, np.full(6, 0.1 * stop), R)
        wrench = predict(TRUTH, R[None]) + rng.normal(0, 0.01, (n, 6))
        t_ns = stop * 10**9 + np.arange(n) * 10**6
        samples = FtSamples.of(t_ns, np.arange(n), wrench)
        run.commit(PoseRecord(stop, TourPose(stop, reading.q_rad), reading, reading, samples, steady=True))
    run.append_event({"event": "noted", "words": f"alice@ur5e-hall3 lost 10.9.8.7, by {SERIAL_PORT}"})
    run.append_event({"event": "noted", "words": "fe80::a00:27ff on 08:00:27:12:34:56, 127.0.0.1, 12:30:45"})
    with (run.folder / "events.ndjson").open("a") as file:
        file.write('{"event": "noted", "words": "cut off at 192.168.7.31')
    solve_and_save(run)
    return run


@pytest.fixture(scope="module")
def bundled(run: Run, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Its bundle, which names what was redacted."""
    path = tmp_path_factory.mktemp("bundle") / "a.zip"
    redacted, _ = write_bundle(run.folder, path)
    assert json.loads(contents(path)["bundle.json"])["redacted"] == redacted
    return path


def contents(path: Path) -> dict[str, bytes]:
    with zipfile.ZipFile(path) as archive:
        return {name: archive.read(name) for name in archive.namelist()}


def test_no_text_of_a_bundle_has_an_address_or_a_name_and_serial_numbers_stay(run: Run, bundled: Path) -> None:
    files = contents(bundled)
    texts = {name: content.decode() for name, content in files.items() if not name.endswith(".npz")}
    assert not [(name, secret) for name, text in texts.items() for secret in SECRETS if secret in text]
    everything = "".join(texts.values())
    for kept in (SERIAL_PORT, "FT12345", "20235501234", "5.15.0.17", "127.0.0.1", "12:30:45", "ati-netft://<ip-1>?"):
        assert kept in everything, kept
    done = json.loads(files["bundle.json"])["redacted"]
    assert done["home"] == done["mac"] == 1
    header = json.loads(texts[f"{run.folder.name}/run.json"])
    assert header["config"]["robot"]["host"].startswith("<host-")
    assert header["said"]["config"].startswith("<home-1>/")
    assert json.loads(texts["environment.json"])["packages"]["numpy"] == np.__version__


@pytest.mark.slow
def test_a_bundle_gives_the_result_of_its_run_to_the_last_digit(run: Run, bundled: Path) -> None:
    saved = CalibrationResult.load(run.calibration_path)
    for command in ("replay", "solve"):
        answer = CliRunner().invoke(cli, [command, str(bundled), "--json"])
        assert answer.exit_code == 0, answer.output
        again = json.loads(answer.stdout)
        expected = json.loads(json.dumps(saved.to_dict()))
        assert {key: again[key] for key in expected if key != "provenance"} == {
            key: value for key, value in expected.items() if key != "provenance"
        }
    with unpack(bundled) as folder:
        assert len(Run(folder).records()) == 8
    assert not folder.exists()


def test_a_bundle_has_the_matrix_by_which_contacts_are_decoded_here(
    run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    made = {"serial": "FT12345", "runs": ["/home/alice/runs/tool"]}
    for file in ("sensor.json", "sensor-2.json"):
        replace(SensorMatrix.usual(), source="loads", provenance=made).save(file)
    write_bundle(run.folder, Path("a.zip"))
    with unpack(Path("a.zip")) as folder:
        newest = SensorMatrix.load(sensor_files(folder.parent)[-1])
    np.testing.assert_array_equal(newest.covariance, SensorMatrix.usual().covariance)
    assert newest.provenance == {"serial": "FT12345", "runs": ["<home-1>/runs/tool"]}


def test_the_bytes_of_a_transcript_keep_their_number(run: Run, tmp_path: Path) -> None:
    page = "GET /netftapi2.xml HTTP/1.1\r\nHost: 192.168.7.31\r\n\r\n"
    lines = [
        {"sensor": "ati-netft://192.168.7.31"},
        {"request": page.encode().hex()},
        {"hex": "c0a8071f00ff" + b"alice".hex()},
    ]
    transcript = tmp_path / "netft.jsonl"
    transcript.write_text("".join(json.dumps(line) + "\n" for line in lines))
    write_bundle(run.folder, tmp_path / "a.zip", [transcript])
    header, request, raw = map(json.loads, contents(tmp_path / "a.zip")["transcripts/1-netft.jsonl"].splitlines())
    assert header == {"sensor": "ati-netft://<ip-1>"}
    assert bytes.fromhex(request["request"]).decode() == page.replace("192.168.7.31", "x" * 12)
    assert raw == lines[2]


def test_what_cannot_be_redacted_is_left_out_and_named(run: Run, tmp_path: Path) -> None:
    binary, link = run.folder / "peg.mcap", run.folder / "secrets.txt"
    binary.write_bytes(b"\x89MCAP0\r\n\0 192.168.7.31")
    link.symlink_to(tmp_path / "elsewhere.txt")
    (tmp_path / "elsewhere.txt").write_text("password")
    try:
        _, left_out = write_bundle(run.folder, tmp_path / "a.zip")
    finally:
        binary.unlink()
        link.unlink()
    assert left_out == ["peg.mcap", "secrets.txt"]
    assert not [name for name in contents(tmp_path / "a.zip") if "peg" in name or "secrets" in name]


def test_a_damaged_run_can_be_bundled_and_a_folder_without_a_run_cannot(tmp_path: Path) -> None:
    (tmp_path / "run").mkdir()
    with pytest.raises(BadDataset, match=r"no run\.json"):
        write_bundle(tmp_path / "run", tmp_path / "a.zip")
    (tmp_path / "run" / "run.json").write_text('{"format": "ftdrive.run/1", "config": ')
    write_bundle(tmp_path / "run", tmp_path / "a.zip")
    assert "not valid JSON" in json.loads(contents(tmp_path / "a.zip")["environment.json"])["error"]


def test_a_bundle_never_replaces_a_file(run: Run, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "a.zip"
    path.write_text("mine")
    assert run_command(["bundle", str(run.folder), "-o", str(path)]) == 2
    assert "never overwritten" in capfd.readouterr().err
    with pytest.raises(FileExistsError):
        write_bundle(run.folder, path)
    assert [file.name for file in tmp_path.iterdir()] == ["a.zip"]
    assert path.read_text() == "mine"


def zipped(path: Path, files: Mapping[str, Any]) -> Path:
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in files.items():
            archive.writestr(name, content)
    return path


ABOUT = json.dumps({"format": bundle.FORMAT, "run": "r"})


@pytest.mark.parametrize(
    ("files", "words"),
    [
        ({"../evil": "", "bundle.json": ABOUT}, "leads out of its folder"),
        ({"r/../../evil": "", "bundle.json": ABOUT}, "leads out of its folder"),
        ({"/tmp/evil": "", "bundle.json": ABOUT}, "leads out of its folder"),
        ({"C:/evil": "", "bundle.json": ABOUT}, "leads out of its folder"),
        ({"r/run.json": "{}"}, "has no bundle.json"),
        ({"bundle.json": ABOUT}, "has no run 'r'"),
        ({"bundle.json": ABOUT.replace('"r"', '"../r"'), "r/run.json": "{}"}, "has no run '../r'"),
        ({"bundle.json": ABOUT.replace("/1", "/2"), "r/run.json": "{}"}, "version '2'"),
        ({"bundle.json": "[]", "r/run.json": "{}"}, "not an object"),
        ({"bundle.json": ABOUT, "r/run.json": "{}", "r/zeros": bytes(2_000_000)}, "its unpacked content exceeds"),
    ],
)
def test_a_hostile_or_damaged_bundle_is_refused(
    files: Mapping[str, Any], words: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(bundle, "MOST_BYTES", 1_000_000)
    path = zipped(tmp_path / "a.zip", files)
    with pytest.raises(BadBundle, match=words), unpack(path):
        pass
    assert [file.name for file in tmp_path.iterdir()] == ["a.zip"]


def test_a_file_larger_than_any_bundle_is_not_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = zipped(tmp_path / "a.zip", {"bundle.json": ABOUT, "r/run.json": "{}"})
    monkeypatch.setattr(bundle, "MOST_BYTES", 100)
    with pytest.raises(BadBundle, match="above the limit of 1e-07 GB: check the name"), unpack(path):
        pass


def test_shapes_larger_than_memory_are_refused_in_a_line(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    array = io.BytesIO()
    np.lib.format.write_array_header_1_0(array, {"descr": "<f8", "fortran_order": False, "shape": (10**30, 6)})
    zipped(tmp_path / "motion.npz", {"format.npy": array.getvalue()})
    header = Run.create(tmp_path, "r", {"config": CONFIG, "devices": DEVICES}).folder
    files = {f"{header.name}/run.json": (header / "run.json").read_bytes()}
    files[f"{header.name}/motion.npz"] = (tmp_path / "motion.npz").read_bytes()
    path = zipped(tmp_path / "a.zip", {"bundle.json": ABOUT.replace('"r"', f'"{header.name}"'), **files})
    assert run_command(["solve", str(path)]) == 6
    assert "is not a recording in motion" in capfd.readouterr().err


def test_a_pipe_in_a_run_is_left_out(tmp_path: Path) -> None:
    folder = Run.create(tmp_path, "r", {"config": CONFIG, "devices": DEVICES}).folder
    os.mkfifo(folder / "calibration.json")
    assert write_bundle(folder, tmp_path / "a.zip")[1] == ["calibration.json"]


def test_a_bundle_without_end_is_refused(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "a.zip").symlink_to("/dev/zero")
    for command in (["solve"], ["transcript", "play"]):
        assert run_command([*command, str(tmp_path / "a.zip")]) == 6
        assert "is a pipe or a device" in capfd.readouterr().err


@pytest.mark.slow
def test_a_flipped_bit_is_refused_or_changes_no_number(run: Run, bundled: Path, tmp_path: Path) -> None:
    path, content = tmp_path / "a.zip", bundled.read_bytes()
    rng, refused = np.random.default_rng(2), 0
    wrenches = [record.samples.wrench for record in run.records()]
    for place in rng.integers(0, len(content), 40).tolist():
        damaged = bytearray(content)
        damaged[place] ^= 1 << int(rng.integers(8))
        path.write_bytes(damaged)
        try:
            with unpack(path) as folder:
                found = Run(folder)
                assert [record.samples.wrench.tolist() for record in found.records()] == [w.tolist() for w in wrenches]
                assert found.header()["config"]["site"] == {"g_m_s2": 9.81}
        except (BadBundle, BadDataset):
            refused += 1
    assert refused > 25


def test_a_bundle_of_a_damaged_run_keeps_the_damage_visible(run: Run, tmp_path: Path) -> None:
    """Redaction changes texts and their checksums, but makes no new checksum for what did not fit the old one."""
    folder = tmp_path / "runs" / "damaged"
    shutil.copytree(run.folder, folder)
    path = folder / "run.json"
    path.write_text(path.read_text().replace("9.81", "9.83"))
    write_bundle(folder, tmp_path / "a.zip")
    with unpack(tmp_path / "a.zip") as found, pytest.raises(BadDataset, match="differs from its checksum"):
        Run(found).header()

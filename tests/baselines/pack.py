"""Write and unpack `old_files.tar.xz`: files of a version of ftdrive, from commands on an emulated cell.

Run it only to add files of a later version: `uv run python -m tests.baselines.pack NEW.tar.xz`.
"""

import shutil
import sys
import tarfile
from pathlib import Path

from ftdrive.cell.emulated import Station
from ftdrive.runs import load
from tests.system.command_line import CommandLine

ARCHIVE = Path(__file__).with_name("old_files.tar.xz")
YES = "yes\n" * 8 + "MOVE\n" + "yes\n" * 4
LOAD_KG = 2.0


def unpack(folder: Path) -> CommandLine:
    """Unpack the old files into a folder, and return a command line there."""
    with tarfile.open(ARCHIVE) as packed:
        packed.extractall(folder, filter="data")
    return CommandLine(folder)


def write_files(ftdrive: CommandLine) -> None:
    """Calibrate, verify, record, weigh and find the matrix of an emulated sensor, as a user would."""
    options = ("--seed", "5", "--gain", "2", "--cross-talk", "1")
    with Station("robotous-serial", options) as station:
        path = ftdrive.connect(station)
        # The emulated sensor measures about the flange.
        path.write_text(path.read_text().replace("[sensor]\n", "[sensor]\nheight_mm = 0\n"))
        cell = ("--config", path.name)

        def called(name: str, *command: str, typed: str = YES) -> str:
            run = ftdrive.json(*command, *cell, typed=typed)["run"]
            shutil.move(ftdrive.folder / run, ftdrive.folder / name)
            return name

        ftdrive.json("plan", "--quick", "--output", "plan.json", *cell)
        tool = called("quick", "calibrate", "--quick")
        called("minimal", "calibrate", "--minimal")
        called("new-tool", "calibrate", "--from", tool)
        ftdrive.run("verify", "--calibration", tool, "--quick", "--update", "no", *cell, typed=YES)
        record = ("record", "--count", "400", "--calibration", tool, *cell)
        ftdrive.json(*record, "-o", "rest.mcap", "-o", "rest.csv", "-o", "rest.parquet")
        station.control(do="push", wrench=[0, 4, -8, 0, 0, 0], axes="base")
        ftdrive.json(*record, "-o", "pushed.mcap")
        station.control(do="push", wrench=[0] * 6)
        ftdrive.json("weigh", "--once", "--calibration", tool, *cell)
        station.control(do="set-payload", payload_kg=station.truth["payload_kg"] + LOAD_KG)
        station.control(do="hang", mass_kg=LOAD_KG, at_mm=(100, 0, 50))
        loaded = called("loaded", "calibrate", "--load", f"{LOAD_KG}", "--at", "side=100,0,50")
        ftdrive.json("loads", "solve", tool, loaded)
        ftdrive.json(*record, "--track", "apply", "-o", "held.mcap")
        station.control(do="hand-guide", rest_s=1)
        ftdrive.json(*record, "-o", "moving.csv")
    run = ftdrive.json(
        "calibrate", "--simulate", "--sensor", "emulated://robotiq", "--sweep", "--seconds", "10", "--yes"
    )["run"]
    shutil.move(ftdrive.folder / run, ftdrive.folder / "sweep")


def main() -> None:
    packed, sys.argv = Path(sys.argv[1]).absolute(), ["ftdrive"]
    vars(load)["_SWING_S"] = 0.5  # the emulated weight swings as much faster as the emulated arm moves
    folder = Path("/tmp/cell")  # its name is in the files
    folder.mkdir()
    write_files(CommandLine(folder))
    with tarfile.open(packed, "x:xz", preset=9) as archive:
        archive.add(folder, "", filter=lambda file: None if Path(file.name).name == "lock" else file)
    shutil.rmtree(folder)


if __name__ == "__main__":
    main()

"""`fleet serve` as a process: its end reaches the shop floor."""

import json
import re
import signal
from pathlib import Path

import pytest

from tests.mosquitto import Mosquitto
from tests.system.command_line import CommandLine, end_of, listen_for
from tests.wire.waiting import wait_until


@pytest.mark.slow
@pytest.mark.parametrize(("by", "code"), [(signal.SIGINT, 130), (signal.SIGKILL, -9)])
def test_the_end_of_the_server_reaches_the_shop_floor(
    by: signal.Signals, code: int, tmp_path: Path, ftdrive: CommandLine
) -> None:
    with Mosquitto(tmp_path, user="cell", password="top-secret") as mosquitto:

        def is_online() -> bool:
            found = mosquitto.retained()
            return bool(found) and json.loads(found["ftdrive/server"])["online"]

        url = f"mqtt://cell:top-secret@127.0.0.1:{mosquitto.port}"
        process = ftdrive.start("fleet", "serve", "--metrics", "127.0.0.1:0", "--mqtt", url)
        said = listen_for(process, "Ctrl-C ends.")
        wait_until(is_online)
        process.send_signal(by)
        ended, more = end_of(process)
        wait_until(lambda: not is_online())
    assert ended == code, more
    assert "secret" not in said + more
    folder = Path(re.findall(r"dashboard are in (.+)", said)[0])
    assert {one.name for one in folder.iterdir()} >= {"alerts.yml", "dashboard.json"}

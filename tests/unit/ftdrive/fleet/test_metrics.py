"""/metrics as a scrape sees it."""

import shutil
import subprocess
import urllib.error
import urllib.request
from collections.abc import Iterator
from contextlib import closing
from dataclasses import replace
from datetime import timedelta

import pytest
from prometheus_client.parser import text_string_to_metric_families

from ftdrive.errors import BadStore, ConfigError
from ftdrive.fleet.metrics import MetricsServer
from ftdrive.fleet.state import FleetFinding
from tests.unit.ftdrive.fleet.fleet_records import weighed
from tests.unit.ftdrive.fleet.fleets import DRIFTING, NOW, cell, never_calibrated, reading

pytestmark = pytest.mark.usefixtures("quick_shutdown")

Samples = dict[tuple[str, str], float]


@pytest.fixture
def server() -> Iterator[MetricsServer]:
    with closing(MetricsServer("127.0.0.1", 0, str)) as server:
        yield server


def test_pages_of_others_cannot_read_the_state(server: MetricsServer) -> None:
    for name, value in (("Origin", "https://evil.example"), ("Host", "evil.example")):
        foreign = urllib.request.Request(f"http://127.0.0.1:{server.port}/metrics", headers={name: value})
        with pytest.raises(urllib.error.HTTPError, match="403"):
            urllib.request.urlopen(foreign, timeout=30)


def scraped(server: MetricsServer) -> str:
    with urllib.request.urlopen(f"http://127.0.0.1:{server.port}/metrics", timeout=30) as answer:
        text: str = answer.read().decode()
    return text


def samples(server: MetricsServer) -> Samples:
    """Values by metric and cell, without those that describe a cell."""
    families = text_string_to_metric_families(scraped(server))
    return {(one.name, one.labels.get("cell", "")): one.value for family in families for one in family.samples}


def test_the_page_is_made_for_each_load() -> None:
    pages = iter(["<p>one</p>", "<p>two</p>"])

    def page() -> str:
        if (text := next(pages, None)) is None:
            raise BadStore("the store is locked")
        return text

    with closing(MetricsServer("127.0.0.1", 0, page)) as server:
        address = f"http://127.0.0.1:{server.port}"
        for text in ("<p>one</p>", "<p>two</p>"):
            with urllib.request.urlopen(f"{address}/", timeout=30) as answer:
                assert (answer.read().decode(), answer.headers["Cache-Control"]) == (text, "no-store")
        with pytest.raises(urllib.error.HTTPError, match="503"):
            urllib.request.urlopen(f"{address}/", timeout=30)
        server.update(*reading(cell("A")))
        assert "ftdrive_cell_info" in scraped(server)


def test_every_field_of_a_cell_is_a_metric_and_what_is_unknown_is_absent(server: MetricsServer) -> None:
    warm = cell("A", passed=False, drift=DRIFTING, temperature_C=31.5)
    silent = cell("B", drift=None, verified=None, passed=None)
    base = FleetFinding("base", ("B",), "…")
    server.update(*reading(warm, silent, never_calibrated("C"), findings=(base, base), store_up=False))
    assert samples(server) == {
        ("ftdrive_store_up", ""): 0,
        ("ftdrive_state_timestamp_seconds", ""): NOW.timestamp(),
        **{("ftdrive_cell_info", name): 1 for name in "ABC"},
        **{("ftdrive_calibration_timestamp_seconds", name): (NOW - timedelta(days=30)).timestamp() for name in "AB"},
        **{
            ("ftdrive_verification_due_timestamp_seconds", name): (NOW + timedelta(days=6)).timestamp() for name in "AB"
        },
        **{("ftdrive_tool_mass_kilograms", name): 1.25 for name in "AB"},
        ("ftdrive_verification_timestamp_seconds", "A"): (NOW - timedelta(days=1)).timestamp(),
        ("ftdrive_verification_passed", "A"): 0,
        ("ftdrive_bias_drift_sigmas", "A"): 6.5,
        ("ftdrive_bias_drift_found", "A"): 1,
        ("ftdrive_sensor_temperature_celsius", "A"): 31.5,
        ("ftdrive_finding", "B"): 1,
    }


def test_a_cell_that_disappears_disappears(server: MetricsServer) -> None:
    assert samples(server) == {}
    server.update(*reading(cell("A"), cell("B")))
    assert {name for _, name in samples(server)} == {"", "A", "B"}
    server.update(*reading(cell("B")))
    assert {name for _, name in samples(server)} == {"", "B"}


def test_labels_have_no_control_characters(server: MetricsServer) -> None:
    server.update(*reading(replace(cell("a", "grip\x1b[2Jper"), sensor_model="ATI\x07")))
    text = scraped(server)
    assert not set(text) & set(map(chr, [*range(10), *range(11, 32), 127]))
    assert 'tool="grip\\\\x1b[2Jper"' in text


def test_names_and_units_are_those_prometheus_asks_for(server: MetricsServer) -> None:
    promtool = shutil.which("promtool")
    if promtool is None:
        pytest.skip("promtool is not installed")
    weighings = weighed("A", 0, weighings=40, refusals={"cable": 3}, last_utc=NOW.isoformat())
    server.update(*reading(cell("A", temperature_C=30.0, weighings=weighings)))
    command = [promtool, "check", "metrics"]
    checked = subprocess.run(command, input=scraped(server), capture_output=True, text=True, check=False)
    assert checked.stdout == ""
    names = ("tool_mass", "weighing_mass", "weighing_sigma")
    assert checked.stderr.splitlines() == [
        f'ftdrive_{name}_kilograms use base unit "grams" instead of "kilograms"' for name in names
    ]


@pytest.mark.parametrize("host", ["127.0.0.1", "203.0.113.7"])
def test_an_address_that_cannot_be_used_is_one_sentence(host: str, server: MetricsServer) -> None:
    with pytest.raises(ConfigError, match=rf"/metrics cannot be served at {host}:{server.port} \(.+\): choose"):
        MetricsServer(host, server.port, str)

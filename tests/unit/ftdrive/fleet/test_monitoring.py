"""Alert rules and dashboard: valid, about metrics that exist, and firing when they should."""

import json
import re
import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml

import ftdrive.fleet
from ftdrive.fleet.metrics import NAMES

MONITORING = Path(ftdrive.fleet.__file__).parent / "monitoring"
ALERTS = MONITORING / "alerts.yml"
DASHBOARD: dict[str, Any] = json.loads((MONITORING / "dashboard.json").read_text(encoding="utf-8"))


@pytest.fixture(scope="module")
def promtool() -> str:
    """Prometheus' own checker."""
    found = shutil.which("promtool")
    if found is None:
        pytest.skip("promtool is not installed")
    return found


def run(*command: str | Path) -> str:
    outcome = subprocess.run(command, capture_output=True, text=True, check=False)
    assert outcome.returncode == 0, outcome.stdout + outcome.stderr
    return outcome.stdout


def expressions() -> Iterator[str]:
    """Yield what the panels of the dashboard ask for."""
    for panel in DASHBOARD["panels"]:
        yield from (target["expr"].replace("$cell", ".*") for target in panel["targets"])


@pytest.mark.slow
def test_the_rules_are_valid_and_fire_when_they_should(promtool: str) -> None:
    assert "6 rules found" in run(promtool, "check", "rules", ALERTS)
    assert "SUCCESS" in run(promtool, "test", "rules", Path(__file__).with_name("alerts_test.yml"))


def test_every_rule_is_tested() -> None:
    rules = {rule["alert"] for group in yaml.safe_load(ALERTS.read_text())["groups"] for rule in group["rules"]}
    tested = yaml.safe_load(Path(__file__).with_name("alerts_test.yml").read_text())["tests"]
    cases = [case for one in tested for case in one["alert_rule_test"]]
    assert {case["alertname"] for case in cases if case.get("exp_alerts")} == rules
    assert {case["alertname"] for case in cases if not case.get("exp_alerts")} == rules


@pytest.mark.parametrize(
    "text", [ALERTS.read_text(encoding="utf-8"), "\n".join(expressions())], ids=["rules", "panels"]
)
def test_every_metric_that_is_asked_for_exists(text: str) -> None:
    asked = set(re.findall(r"\bftdrive_\w+", text))
    assert len(asked) > 5
    assert asked <= set(NAMES)


def test_the_dashboard_asks_valid_questions(promtool: str, tmp_path: Path) -> None:
    rules = [{"record": f"panel:n{n}", "expr": expression} for n, expression in enumerate(expressions())]
    (tmp_path / "panels.yml").write_text(yaml.safe_dump({"groups": [{"name": "panels", "rules": rules}]}))
    assert f"{len(rules)} rules found" in run(promtool, "check", "rules", tmp_path / "panels.yml")

"""Prometheus metrics of the state of a fleet."""

from collections.abc import Callable, Iterator, Mapping
from datetime import datetime
from typing import Any, Final

from ftdrive.errors import BadStore, ConfigError
from ftdrive.fleet.state import CellState, Fleet
from ftdrive.servers.http_gate import PassingGate, hidden_host
from ftdrive.words.text import visible
from ftdrivers.installation import missing_extra

try:
    from prometheus_client import CollectorRegistry, start_http_server
    from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily
    from prometheus_client.registry import Collector
except ImportError:
    raise ConfigError(missing_extra("`fleet serve`", "prometheus-client", "fleet")) from None


def _seconds(time: datetime | str | None) -> float | None:
    # Export a time, because an age would not grow while the server hangs.
    time = datetime.fromisoformat(time) if isinstance(time, str) else time
    return None if time is None else time.timestamp()


def _labels(*texts: str | None) -> list[str]:
    """Return texts as label values, without the control characters that files and devices may have put into them."""
    return [visible(text or "") for text in texts]


# Metrics of a tool, with the labels `TOOL`: help text, and function that returns the value, or None to leave it out.
OF_TOOL: Final[Mapping[str, tuple[str, Callable[[CellState], float | None]]]] = {
    "ftdrive_calibration_timestamp_seconds": (
        "When the newest accepted calibration was made.",
        lambda one: _seconds(one.calibrated),
    ),
    "ftdrive_verification_timestamp_seconds": (
        "When this calibration was last verified.",
        lambda one: _seconds(one.verified),
    ),
    "ftdrive_verification_passed": ("1 if the last verification passed, else 0.", lambda one: one.passed),
    "ftdrive_verification_due_timestamp_seconds": (
        "When the next verification is due; absent without a calibration.",
        lambda one: _seconds(one.due),
    ),
    "ftdrive_bias_drift_sigmas": (
        "Largest change of a component of the bias since the calibration, in sigmas of one verification.",
        lambda one: None if one.drift is None else one.drift.level_sigmas,
    ),
    "ftdrive_bias_drift_found": (
        "1 if a component of the bias has begun to drift, else 0.",
        lambda one: None if one.drift is None else one.drift.found,
    ),
    "ftdrive_tool_mass_kilograms": ("Identified mass of the tool.", lambda one: one.mass_kg),
    "ftdrive_sensor_temperature_celsius": (
        "Temperature of the sensor in its last result; absent if it reports none.",
        lambda one: one.temperature_C,
    ),
    "ftdrive_weighing_mass_kilograms": (
        "Mass of the part that was weighed last.",
        lambda one: None if one.weighings is None else one.weighings.mass_kg,
    ),
    "ftdrive_weighing_sigma_kilograms": (
        "Standard deviation of that mass, without the scale of the sensor.",
        lambda one: None if one.weighings is None else one.weighings.mass_sigma_kg,
    ),
    "ftdrive_weighing_timestamp_seconds": (
        "When that part was weighed.",
        lambda one: _seconds(None if one.weighings is None else one.weighings.last_utc),
    ),
}
TOOL: Final = ("cell", "tool")
CELL_INFO: Final = "ftdrive_cell_info"
CELL_INFO_LABELS: Final = (*TOOL, "arm_serial", "sensor_serial", "sensor_model", "calibration", "verdict", "emulated")
WEIGHINGS: Final = "ftdrive_weighings_total"
REFUSALS: Final = "ftdrive_weighings_refused_total"
FINDING: Final = "ftdrive_finding"
STORE_UP: Final = "ftdrive_store_up"
STATE_TIME: Final = "ftdrive_state_timestamp_seconds"
# Names of all metrics that the server exports.
NAMES: Final = (*OF_TOOL, WEIGHINGS, REFUSALS, CELL_INFO, FINDING, STORE_UP, STATE_TIME)


class MetricsServer(Collector):
    """Server of the newest state at /metrics, without metrics of process or platform.

    With port 0 the system chooses the port, see `port`. `page` returns the page of the fleet for each request of /; it
    may raise `BadStore`. Raises `ConfigError` for an address that cannot be used.
    """

    def __init__(self, host: str, port: int, page: Callable[[], str]) -> None:
        self._page = page
        self._newest: tuple[Fleet, datetime, bool] | None = None
        registry = CollectorRegistry()
        registry.register(self)
        behind = hidden_host()
        self._server, self._thread = start_http_server(0, behind, registry)
        try:
            self._gate = PassingGate((host, port), lambda _: (behind, self._server.server_port))
        except OSError as error:
            self._stop()
            raise ConfigError(
                f"/metrics cannot be served at {host}:{port} ({error.strerror}): choose another address"
            ) from None
        self._metrics = self._server.get_app()
        self._server.set_app(self._answer)
        self.port = self._gate.port

    def update(self, fleet: Fleet, read: datetime, store_up: bool) -> None:
        """Serve this state of the fleet from now on; it was read from the store at time `read`, UTC."""
        self._newest = fleet, read, store_up

    def _answer(self, request: dict[str, Any], start: Any) -> Any:
        if request["PATH_INFO"] not in {"", "/"}:
            return self._metrics(request, start)  # type: ignore[misc]  # set by start_http_server
        try:
            status, text, kind = "200 OK", self._page(), "html"
        except BadStore as error:
            status, text, kind = "503 Service Unavailable", f"{error}\n", "plain"
        start(status, [("Content-Type", f"text/{kind}; charset=utf-8"), ("Cache-Control", "no-store")])
        return [text.encode()]

    def close(self) -> None:
        """Stop the server."""
        self._gate.close()
        self._stop()

    def _stop(self) -> None:
        self._server.shutdown()
        self._server.server_close()
        self._thread.join()

    def collect(self) -> Iterator[GaugeMetricFamily | CounterMetricFamily]:
        """Yield the metrics; a thread calls this for each scrape."""
        # `update` may replace the state meanwhile.
        if (newest := self._newest) is None:
            return
        fleet, read, store_up = newest
        yield GaugeMetricFamily(STORE_UP, "1 if the store could be read, else 0.", value=store_up)
        yield GaugeMetricFamily(STATE_TIME, "When the state was read from the store.", value=read.timestamp())
        cells = fleet.cells
        info = GaugeMetricFamily(CELL_INFO, "1 for each tool of each cell.", labels=CELL_INFO_LABELS)
        for state in cells:
            about = (state.arm_serial, state.sensor_serial, state.sensor_model, state.calibration_id, state.verdict)
            info.add_metric(_labels(state.cell, state.tool, *about, "true" if state.emulated else "false"), 1)
        yield info
        for name, (help_text, value_of) in OF_TOOL.items():
            family = GaugeMetricFamily(name, help_text, labels=TOOL)
            for state in cells:
                if (value := value_of(state)) is not None:
                    family.add_metric(_labels(state.cell, state.tool), value)
            yield family
        weighings = CounterMetricFamily(WEIGHINGS, "Parts weighed on the last day with weighings.", labels=TOOL)
        refusals = CounterMetricFamily(REFUSALS, "Refusals on the last day with weighings.", labels=(*TOOL, "code"))
        for state in cells:
            if state.weighings is not None:
                weighings.add_metric(_labels(state.cell, state.tool), state.weighings.weighings)
                for code, number in state.weighings.refusals.items():
                    if number:
                        refusals.add_metric(_labels(state.cell, state.tool, code), number)
        yield weighings
        yield refusals
        finding = GaugeMetricFamily(FINDING, "1 for each cell of a finding.", labels=("kind", "cell"))
        for kind, cell in sorted({(state.kind, cell) for state in fleet.findings for cell in state.cells}):
            finding.add_metric(_labels(kind, cell), 1)
        yield finding

"""`ftdrive fleet serve`: the state of all cells for Prometheus and MQTT."""

from contextlib import ExitStack, closing
from functools import partial
from pathlib import Path
from threading import Event
from typing import TYPE_CHECKING

import click

from ftdrive.commands.common import STORE, open_store

if TYPE_CHECKING:
    from ftdrive.fleet.serve import Sink
    from ftdrive.store.store import Store

PORT = 10018
"""Prometheus has assigned all ports from 9100 to 9999."""
MONITORING = Path(__file__).parents[2] / "fleet" / "monitoring"


@click.command()
@click.option(
    "--metrics",
    "address",
    metavar="HOST:PORT",
    default=f"127.0.0.1:{PORT}",
    show_default=True,
    help="Address of /metrics; port 0 is a free one. A host that is not loopback is unprotected.",
)
@click.option(
    "--mqtt",
    "broker_url",
    metavar="URL",
    envvar="FTDRIVE_MQTT",
    show_envvar=True,
    help="Also publish to the broker mqtt[s]://[USER:PASSWORD@]HOST[:PORT][/PREFIX].",
)
@STORE
def serve(address: str, broker_url: str | None, url: str | None) -> None:
    """Serve the state of all cells to Prometheus, to an MQTT broker, and as a page.

    The store is read every 60 s. If it cannot be read later, the last state stays, with its age. Alert rules and a
    dashboard for Grafana come with ftdrive: their folder is printed. Nothing moves. Ctrl-C ends.
    """
    from ftdrive.fleet.metrics import MetricsServer
    from ftdrive.fleet.serve import serve as serve_fleet
    from ftdrive.fleet.status import fleet_state
    from ftdrive.servers.address import host_and_port, is_loopback, with_port
    from ftdrive.terminal.console import messages, print_address
    from ftdrivers.clock import REAL

    host, port = host_and_port("--metrics", address, f"127.0.0.1:{PORT}", lowest=0)
    found = open_store(url)
    wake = Event()
    with ExitStack() as stack:
        metrics = stack.enter_context(closing(MetricsServer(host, port, partial(_page, found))))
        sinks: list[Sink] = [metrics]
        print_address(f"Serving {found.name} at ", f"http://{with_port(host, metrics.port)}/metrics")
        print_address("The page of the fleet is at ", f"http://{with_port(host, metrics.port)}/")
        if not is_loopback(host):
            messages.print(
                f"Unprotected: any computer that reaches port {metrics.port} can read the state of all cells."
            )
        if broker_url is not None:
            from ftdrive.fleet.mqtt import Broker, Messages

            broker = Broker.of(broker_url)
            sinks.append(stack.enter_context(closing(Messages(broker, wake, messages.print))))
            messages.print(f"Publishing at the MQTT broker {broker}, topics {broker.prefix}ftdrive/#")
        messages.print(f"Alert rules and a dashboard are in {MONITORING}")
        messages.print("Ctrl-C ends.")
        serve_fleet(partial(fleet_state, found), sinks, REAL, wake, say=messages.print)


def _page(store: "Store") -> str:
    """Return the page of the fleet as it is now."""
    from datetime import UTC, datetime

    from ftdrive.fleet.observed import Observed
    from ftdrive.fleet.page import page
    from ftdrive.fleet.status import fleet_of

    observed = Observed.read(store, datetime.now(UTC))
    return page(fleet_of(observed, store), observed, store.name)

"""`ftdrive stream`: serve the compensated wrench to Foxglove, Lichtblick and PlotJuggler."""

import socket
from contextlib import ExitStack
from typing import Any

import click

from ftdrive.commands.options import FRAME, SOURCE, STAGES, TRACK, SourceOptions
from ftdrive.servers.foxglove import FoxgloveServer
from ftdrive.servers.http_gate import host_and_port, is_loopback, with_port
from ftdrive.servers.udp import UdpSender
from ftdrive.stream.samples import Tracking, WrenchFrame
from ftdrive.stream.stream import RECOVER_S, Sink, Stream, pump
from ftdrive.terminal.console import messages, print_address


@click.command()
@SOURCE
@TRACK
@FRAME
@STAGES
@click.option(
    "--host",
    default="127.0.0.1",
    show_default=True,
    help="Address of the server. An address other than loopback is unprotected.",
)
@click.option(
    "--port", type=click.IntRange(0, 65535), default=8765, show_default=True, help="Server port; 0 for a free one."
)
@click.option("--allow-origin", "origins", metavar="URL", multiple=True, help="Also accept pages from this origin.")
@click.option("--allow-control", is_flag=True, help="Let pages tare and change frame and stages, as programs can.")
@click.option("--udp", metavar="HOST:PORT", help="Also send JSON to PlotJuggler before 3.16 (its port: 9870).")
def stream(
    source: SourceOptions,
    track: Tracking,
    frame: WrenchFrame,
    stages: dict[str, Any],
    host: str,
    port: int,
    origins: tuple[str, ...],
    allow_control: bool,
    udp: str | None,
) -> None:
    """Serve the raw and the compensated wrench to viewers.

    Foxglove, Lichtblick and PlotJuggler from 3.16 connect to a WebSocket server. They receive every sample, poses,
    joint angles, frames, arrows and events. Programs can tare and change frame and stages. In a browser, only pages of
    Foxglove and Lichtblick are accepted. The arm is only read, never moved. Press Ctrl-C to stop.
    """
    udp_address = None if udp is None else host_and_port("--udp", udp, "127.0.0.1:9870")
    with ExitStack() as stack:
        opened = source.open(stack, frame, track, stages)
        sinks: list[Sink] = [] if udp_address is None else [UdpSender(opened.info, *udp_address)]
        server = FoxgloveServer(opened, host, port, origins=origins, allow_control=allow_control)
        _introduce(opened, server, host, udp_address)
        meanwhile = f"Viewers stay connected for {RECOVER_S:g} s."
        for _ in pump(opened, [server, *sinks], say=messages.print, meanwhile=meanwhile):
            pass


def _introduce(source: Stream, server: FoxgloveServer, host: str, udp: tuple[str, int] | None) -> None:
    name = socket.gethostname() if host in ("0.0.0.0", "::") else host
    url = f"ws://{with_port(name, server.port)}"
    messages.print(f"Serving the wrench in {source.frame}; {source.info.calibration_name}.")
    print_address("  Foxglove, Lichtblick:  Open connection > Foxglove WebSocket > ", url)
    print_address("  PlotJuggler from 3.16: Streaming > Foxglove Bridge > ", url)
    if udp is not None:
        messages.print(f"  PlotJuggler before:    Streaming > UDP Server > port {udp[1]}, JSON, use the timestamp")
    if is_loopback(host):
        print_address("  In a browser:          ", server.app_url)
    else:
        messages.print(
            f"Unprotected: a program on any computer that reaches port {server.port} can read the stream, tare it and "
            "change its frame and stages. There is no password and no encryption."
        )
    messages.print("Press Ctrl-C to stop.")

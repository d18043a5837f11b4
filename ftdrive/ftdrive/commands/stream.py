"""`ftdrive stream`: the compensated wrench for Foxglove, Lichtblick and PlotJuggler."""

import socket
from collections.abc import Sequence
from contextlib import ExitStack, closing
from typing import TYPE_CHECKING

import click

from ftdrive.commands.common import FRAME, SOURCE, TRACK, Source, read_frame

if TYPE_CHECKING:
    from ftdrive.live.samples import Axes, Sink, Tracking
    from ftdrive.live.stream import CompensatedStream, ProcessedStream
    from ftdrive.servers.foxglove import FoxgloveServer


@click.command()
@SOURCE
@TRACK
@FRAME
@click.option(
    "--host",
    default="127.0.0.1",
    show_default=True,
    help="Address to serve at. One that is not loopback is unprotected.",
)
@click.option(
    "--port", type=click.IntRange(0, 65535), default=8765, show_default=True, help="Port to serve at; 0 is a free one."
)
@click.option("--allow-origin", "origins", metavar="URL", multiple=True, help="Also serve pages of this origin.")
@click.option("--allow-control", is_flag=True, help="Pages may tare and change frame and stages; programs always may.")
@click.option("--udp", metavar="HOST:PORT", help="Also send JSON to a PlotJuggler before 3.16, which listens on 9870.")
def stream(
    source: Source,
    track: "Tracking",
    axes: "Axes",
    about: str,
    host: str,
    port: int,
    origins: tuple[str, ...],
    allow_control: bool,
    udp: str | None,
) -> None:
    """Serve the raw and the compensated wrench to viewers.

    Foxglove, Lichtblick and PlotJuggler from 3.16 connect to one WebSocket server. They receive every sample of the
    sensor, poses, joint angles, frames, arrows and events. Programs can tare and change frame and stages. A page in a
    browser is served if it is of Foxglove or Lichtblick. The arm is only read, never moved. Ctrl-C ends.
    """
    from ftdrive.commands.live_source import open_source
    from ftdrive.http_gate import host_and_port
    from ftdrive.servers.foxglove import FoxgloveServer
    from ftdrive.servers.udp import UdpSender

    frame = read_frame(axes, about)
    udp_address = None if udp is None else host_and_port("--udp", udp, "127.0.0.1:9870")
    with ExitStack() as stack:
        opened = open_source(source, frame, stack, track)
        server = stack.enter_context(
            closing(FoxgloveServer(opened, host, port, origins=origins, allow_control=allow_control))
        )
        sinks: list[Sink] = [server]
        if udp_address is not None:
            sinks.append(stack.enter_context(closing(UdpSender(opened.info, *udp_address))))
        _introduce(opened, server, host, udp_address)
        serve(opened, sinks)


def serve(source: "CompensatedStream", sinks: Sequence["Sink"]) -> None:
    """Send blocks and events until Ctrl-C is pressed, or a device is silent for `RECOVER_S`."""
    from ftdrive.live.stream import RECOVER_S, BlockReader
    from ftdrive.terminal.console import messages

    meanwhile = f"Viewers stay connected for {RECOVER_S:g} s."
    try:
        for block in BlockReader(source, say=messages.print, meanwhile=meanwhile):
            if block is not None:
                for sink in sinks:
                    sink.write(block)
            _send_events(source, sinks)
    finally:
        _send_events(source, sinks)


def _send_events(source: "CompensatedStream", sinks: Sequence["Sink"]) -> None:
    for event in source.take_events():
        for sink in sinks:
            sink.event(event)


def _introduce(source: "ProcessedStream", server: "FoxgloveServer", host: str, udp: tuple[str, int] | None) -> None:
    from ftdrive.http_gate import is_loopback, with_port
    from ftdrive.terminal.console import messages, print_address

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
    messages.print("Ctrl-C ends.")

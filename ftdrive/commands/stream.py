"""`ftdrive stream`: the compensated wrench for Foxglove, Lichtblick and PlotJuggler."""

import ipaddress
import socket
from collections.abc import Sequence
from contextlib import ExitStack, closing
from pathlib import Path
from typing import TYPE_CHECKING

import click

from ftdrive.commands.common import CELL, check_simulate, simulate
from ftdrive.errors import ConfigError
from ftdrive.terminal.console import talk

if TYPE_CHECKING:
    from ftdrive.live.stream import CompensatedStream
    from ftdrive.servers.foxglove import FoxgloveServer
    from ftdrive.servers.udp import UdpSender


@click.command()
@click.option("--host", default="127.0.0.1", show_default=True, help="Address to serve at. Another one is unprotected.")
@click.option("--port", type=click.IntRange(0, 65535), default=8765, show_default=True, help="Port; 0 is a free one.")
@click.option("--udp", metavar="HOST:PORT", help="Also send JSON to a PlotJuggler before 3.16, which listens on 9870.")
def stream(host: str, port: int, udp: str | None) -> None:
    """Serve the raw and the compensated wrench to viewers.

    Foxglove, Lichtblick and PlotJuggler from 3.16 connect to one WebSocket server. They receive every sample of the
    sensor, poses, joint angles, frames, arrows and events, and can tare and change frame and stages. The arm is only
    read, never moved. Ctrl-C ends.
    """
    from ftdrive.servers.foxglove import FoxgloveServer
    from ftdrive.servers.udp import UdpSender

    with ExitStack() as stack:
        source = stack.enter_context(open_stream())
        server = stack.enter_context(closing(FoxgloveServer(source, host, port)))
        sinks: list[FoxgloveServer | UdpSender] = [server]
        if udp is not None:
            sinks.append(stack.enter_context(closing(UdpSender(source.info, *_address(udp)))))
        _introduce(source, server, host, udp)
        serve(source, sinks)


def serve(source: "CompensatedStream", sinks: Sequence["FoxgloveServer | UdpSender"]) -> None:
    """Send blocks and events until a device fails or Ctrl-C is pressed; the last events are sent too."""
    try:
        while True:
            block = source.read()
            for sink in sinks:
                sink.write(block)
            _send_events(source, sinks)
    finally:
        _send_events(source, sinks)


def _send_events(source: "CompensatedStream", sinks: Sequence["FoxgloveServer | UdpSender"]) -> None:
    for event in source.take_events():
        for sink in sinks:
            sink.event(event)


def _address(text: str) -> tuple[str, int]:
    host, _, port = text.rpartition(":")
    if not host or not port.isdecimal() or not 0 < int(port) < 65536:
        raise ConfigError(f"--udp is '{text}': give HOST:PORT, such as 127.0.0.1:9870")
    return host.strip("[]"), int(port)


def _introduce(source: "CompensatedStream", server: "FoxgloveServer", host: str, udp: str | None) -> None:
    """Print what is served, and how to open it."""
    reached_as = socket.gethostname() if host in ("0.0.0.0", "::") else host
    url = f"ws://{f'[{reached_as}]' if ':' in reached_as else reached_as}:{server.port}"
    info = source.info
    talk.print(f"Serving {source.frame}, compensated with {info.calibration_name or 'a new calibration'}.")
    talk.print(f"  Foxglove, Lichtblick   Open connection > Foxglove WebSocket > {url}")
    talk.print(f"  PlotJuggler from 3.16  Streaming > Foxglove Bridge > {url}")
    if udp is not None:
        talk.print(
            f"  PlotJuggler before     Streaming > UDP Server > port {udp.rpartition(':')[2]}, JSON, use its timestamp"
        )
    if _is_loopback(host):
        talk.print(f"  Foxglove in a browser  {server.app_url}")
    else:
        talk.print(
            f"Unprotected: any computer that reaches port {server.port} can read the stream, tare it and change its "
            "frame and stages. There is no password and no encryption."
        )
    talk.print("Ctrl-C ends.")


def _is_loopback(host: str) -> bool:
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"

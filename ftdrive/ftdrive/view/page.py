"""The server of a command's page, its address, and who looks at it."""

import logging
import os
import secrets
import socket
import sys
import threading
import webbrowser
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, closing, contextmanager, redirect_stdout, suppress
from io import StringIO
from time import monotonic
from typing import TYPE_CHECKING, Any, Final

from ftcalib.model import Array
from ftdrive.errors import ConfigError
from ftdrive.http_gate import Address, Gate, hidden_host, is_loopback, with_port
from ftdrivers.installation import missing_extra

if TYPE_CHECKING:
    from viser import GuiEvent, ViserServer

log = logging.getLogger(__name__)

# Only this computer can open the page.
LOCAL: Final[Address] = ("127.0.0.1", 8080)


# A busy computer, which is late at times, still draws 20 times a second.
_PERIOD_S: Final = 0.045


class Page:
    """A page that browsers show, with a scene of its own and controls beside it.

    Attributes
    ----------
    gui, scene
        Those of viser.
    url : str
        With the token, without which nothing is served.
    """

    def __init__(self, server: "ViserServer", url: str) -> None:
        self._server, self.url = server, url
        self.gui, self.scene = server.gui, server.scene

    def at_once(self) -> AbstractContextManager[None]:
        """Let browsers show all changes of a `with` block together."""
        changes: AbstractContextManager[None] = self._server.atomic()
        return changes

    def look(self, at_m: Array, from_m: Array) -> None:
        """Place the camera of every browser, also of those that open the page later; (3,) each, base axes."""
        self._server.initial_camera.look_at, self._server.initial_camera.position = at_m, from_m
        for viewer in self._server.get_clients().values():
            # A new position takes the point with it.
            viewer.camera.position, viewer.camera.look_at = from_m, at_m

    @property
    def viewers(self) -> int:
        """Number of browsers that show the page."""
        return len(self._server.get_clients())

    def add_stop(self, stop: Callable[[str], object]) -> None:
        """Add a Stop button; `stop` is called in another thread, with the name of the viewer who pressed it."""
        button = self.gui.add_button("Stop", color="red", hint="Stops the arm, as a key in the terminal does.")

        # Not in the pool of threads, which may be busy.
        async def pressed(event: "GuiEvent[Any]") -> None:
            stop(f"viewer {event.client_id}")

        button.on_click(pressed)


@contextmanager
def serve(title: str, address: Address | None = None) -> Iterator[Page]:
    """Serve a page while the block runs. Needs the extra `viz`.

    Parameters
    ----------
    title : str
    address : tuple of str and int, optional
        Host and port. Without it only this computer is served: at port 8080, or another one if that is taken.

    Raises
    ------
    ConfigError
        The address cannot be used, or viser is missing.
    """
    try:
        from viser import ViserServer
    except ImportError:
        raise ConfigError(missing_extra("a view", "viser", "viz")) from None
    behind, token = hidden_host(), secrets.token_urlsafe(12)
    # It prints a banner; our stdout is data.
    with redirect_stdout(StringIO()):
        server = ViserServer(host=behind, label=title, verbose=False)
    try:
        server.gui.configure_theme(show_logo=False, show_share_button=False)
        server.gui.main_panel.dock_right()
        with closing(_gate(address, (behind, server.get_port()), token)) as gate:
            host = _reached_at((address or LOCAL)[0])
            yield Page(server, f"http://{with_port(host, gate.port)}/?token={token}")
    finally:
        with redirect_stdout(StringIO()):
            server.stop()


def _reached_at(host: str) -> str:
    """Return the address by which others reach a server that listens at `host`: a tablet may not know our name."""
    if host not in ("0.0.0.0", "::"):
        return host
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe, suppress(OSError):
        # Sends nothing: an address for documentation chooses the interface.
        probe.connect(("192.0.2.1", 9))
        return str(probe.getsockname()[0])
    return socket.gethostname()


def _gate(address: Address | None, behind: Address, token: str) -> Gate:
    bound = address or LOCAL
    try:
        return Gate(bound, lambda _: behind, token=token)
    except OSError as error:
        if address is not None:
            raise ConfigError(f"--view-address {with_port(*address)} cannot be used: {error.strerror}") from error
        return Gate((LOCAL[0], 0), lambda _: behind, token=token)


def announce(page: Page, address: Address | None = None) -> None:
    """Print the address of a page, as a QR code too for another device; open it where this computer has a screen."""
    from ftdrive.terminal.console import messages, print_address

    print_address("The page is shown until this command ends, at ", page.url)
    if address is not None and not is_loopback(address[0]):
        import segno

        code = StringIO()
        segno.make(page.url, error="l").terminal(code, border=1, compact=True)
        messages.print(code.getvalue(), end="")
        messages.print("Who has this address sees the page and can press its buttons. There is no encryption.")
    elif sys.platform != "linux" or os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"):
        webbrowser.open(page.url)


@contextmanager
def drawing(draw: Callable[[], None]) -> Iterator[None]:
    """Call `draw` 22 times a second in a thread of its own while the block runs."""
    ended = threading.Event()

    def run() -> None:
        due_s = monotonic()
        try:
            # after a pause of the computer nothing is made up for
            while not ended.wait(max(0.0, due_s - monotonic())):
                due_s = max(due_s + _PERIOD_S, monotonic())
                draw()
        except Exception:  # only a picture: the stream goes on
            log.exception("the page cannot be drawn")

    thread = threading.Thread(target=run, name="page", daemon=True)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()

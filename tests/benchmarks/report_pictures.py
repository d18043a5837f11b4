"""Pictures of a report in headless Chromium: light and dark, at the width of a desk and of a phone. Run by hand.

    uv run ftdrive report RUN -o report.html
    uv run python -m tests.benchmarks.report_pictures report.html --out pictures

Prints a line per picture. The exit code is 1 if the browser reports a message of the console, a request to anything but
the page, or a page wider than its window. Needs the command `chromium`.
"""

import base64
import json
import subprocess
import sys
import time
from argparse import ArgumentParser
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import product
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any
from urllib.request import urlopen

from websockets.sync.client import connect
from websockets.sync.connection import Connection

WIDTHS_PX = (1200, 400)
SCHEMES = ("light", "dark")
OPTIONS = (
    *("--headless", "--no-sandbox", "--disable-gpu", "--no-first-run", "--disable-sync", "--disable-quic"),
    *("--disable-background-networking", "--disable-component-update", "--remote-debugging-port=0"),
)
LONGEST_S = 30


class Browser:
    """One tab of Chromium, by its debugging protocol; events other than answers are kept."""

    def __init__(self, socket: Connection) -> None:
        self._socket = socket
        self._sent = 0
        self.events: list[dict[str, Any]] = []

    def call(self, method: str, **parameters: Any) -> dict[str, Any]:
        """Send a command and return its result."""
        self._sent += 1
        self._socket.send(json.dumps({"id": self._sent, "method": method, "params": parameters}))
        while (message := self._receive()).get("id") != self._sent:
            self.events.append(message)
        if "error" in message:
            raise RuntimeError(f"{method}: {message['error']['message']}")
        return dict(message["result"])

    def wait_for(self, method: str) -> None:
        """Return when this event arrives."""
        while (message := self._receive()).get("method") != method:
            self.events.append(message)

    def _receive(self) -> dict[str, Any]:
        return dict(json.loads(self._socket.recv(timeout=LONGEST_S)))


@contextmanager
def chromium() -> Iterator[Browser]:
    """Start Chromium with a profile of its own and connect to its tab."""
    with TemporaryDirectory(ignore_cleanup_errors=True) as profile:
        command = ["chromium", *OPTIONS, f"--user-data-dir={profile}", "about:blank"]
        process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        try:
            port_file = Path(profile) / "DevToolsActivePort"
            for _ in range(10 * LONGEST_S):
                if port_file.exists() and port_file.read_text():
                    break
                time.sleep(0.1)
            port = port_file.read_text().split()[0]
            with urlopen(f"http://127.0.0.1:{port}/json") as answer:
                tab = next(one for one in json.load(answer) if one["type"] == "page")
            with connect(tab["webSocketDebuggerUrl"], max_size=None) as socket:
                yield Browser(socket)
        finally:
            process.terminate()
            process.wait()


def pictures(browser: Browser, page: Path, out: Path) -> Iterator[str]:
    """Write the pictures of a page; yield each fault."""
    for domain in ("Page", "Runtime", "Log", "Network"):
        browser.call(f"{domain}.enable")
    for width, scheme in product(WIDTHS_PX, SCHEMES):
        browser.events.clear()
        metrics = {"width": width, "height": 900, "deviceScaleFactor": 1, "mobile": False}
        browser.call("Emulation.setDeviceMetricsOverride", **metrics)
        browser.call("Emulation.setEmulatedMedia", features=[{"name": "prefers-color-scheme", "value": scheme}])
        browser.call("Page.navigate", url=page.absolute().as_uri())
        browser.wait_for("Page.loadEventFired")
        size = browser.call("Page.getLayoutMetrics")["cssContentSize"]
        browser.call("Emulation.setDeviceMetricsOverride", **(metrics | {"height": int(size["height"])}))
        picture = out / f"{page.stem}-{scheme}-{width}.png"
        picture.write_bytes(base64.b64decode(browser.call("Page.captureScreenshot")["data"]))
        sys.stdout.write(f"{picture}  {width} x {size['height']:.0f} px\n")
        if size["width"] > width:
            yield f"{picture}: the page is {size['width']:.0f} px wide"
        for event in browser.events:
            said, parameters = event.get("method", ""), event.get("params", {})
            if said in ("Log.entryAdded", "Runtime.consoleAPICalled", "Runtime.exceptionThrown"):
                yield f"{picture}: {said} {json.dumps(parameters)[:300]}"
            url = parameters.get("request", {}).get("url", "") if said == "Network.requestWillBeSent" else ""
            if not url.startswith(("file:", "data:")) and url:
                yield f"{picture}: the page requests {url}"


def main() -> int:
    """Draw every page of the command line."""
    parser = ArgumentParser(description="Pictures of reports in headless Chromium.")
    parser.add_argument("pages", nargs="+", type=Path)
    parser.add_argument("--out", type=Path, default=Path("pictures"))
    options = parser.parse_args()
    options.out.mkdir(exist_ok=True)
    with chromium() as browser:
        faults = [fault for page in options.pages for fault in pictures(browser, page, options.out)]
    sys.stdout.write("\n".join([*faults, f"{len(faults)} faults"]) + "\n")
    return 1 if faults else 0


if __name__ == "__main__":
    sys.exit(main())

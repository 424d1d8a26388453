"""A headless Chromium without network access, controlled through a pipe (Chrome DevTools Protocol)."""

from __future__ import annotations

import base64
import io
import itertools
import json
import os
import select
import shutil
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import PIL.Image
import pytest

NAMES = ("chromium", "chromium-browser", "google-chrome")
SIZE = (640, 480)


class Tab:
    """Tab of the browser; ``events`` lists the browser's reports about the tab."""

    def __init__(self, write: int, read: int) -> None:
        self.write, self.read, self.count, self.session, self.said = write, read, itertools.count(1), "", b""
        self.events: list[dict[str, Any]] = []
        target = self.send("Target.createTarget", url="about:blank")["targetId"]
        self.session = self.send("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]
        for domain in ("Page", "Runtime", "Network", "Log"):
            self.send(f"{domain}.enable")
        self.send(
            "Network.emulateNetworkConditions", offline=True, latency=0, downloadThroughput=0, uploadThroughput=0
        )
        self.resize(*SIZE)

    def send(self, method: str, **params: Any) -> dict[str, Any]:
        number = next(self.count)
        message = {"id": number, "method": method, "params": params}
        os.write(
            self.write, json.dumps(message | ({"sessionId": self.session} if self.session else {})).encode() + b"\0"
        )
        while True:
            while b"\0" not in self.said:
                assert select.select([self.read], [], [], 30)[0], f"no answer to {method} in 30 s"
                part = os.read(self.read, 1 << 20)
                assert part, "the browser has gone"
                self.said += part
            text, _, self.said = self.said.partition(b"\0")
            reply: dict[str, Any] = json.loads(text)
            if reply.get("id") == number:
                assert "error" not in reply, reply
                return dict(reply["result"])
            self.events.append(reply)

    def evaluate(self, expression: str) -> Any:
        answer = self.send("Runtime.evaluate", expression=expression, awaitPromise=True, returnByValue=True)
        assert "exceptionDetails" not in answer, answer
        return answer["result"].get("value")

    def resize(self, width: int, height: int) -> None:
        self.send("Emulation.setDeviceMetricsOverride", width=width, height=height, deviceScaleFactor=1, mobile=False)

    def open(self, page: Path, ready: str | None = "drawn") -> None:
        """Load a page and wait until the page reports that it is ready."""
        self.events.clear()
        self.send("Page.navigate", url=page.as_uri())
        for _ in range(600):
            done = self.evaluate("document.readyState") == "complete"
            if done and (ready is None or self.evaluate("document.documentElement.dataset.ready") == ready):
                return
            time.sleep(0.05)
        pytest.fail(f"{page} is not '{ready}' after 30 s: {self.complaints()}")

    def picture(self, selector: str) -> np.ndarray:
        """Return the pixels of an element as displayed, shape (height, width, 3)."""
        self.evaluate("new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)))")
        box = self.evaluate(
            f"(({{x, y, width, height}}) => ({{x: x + scrollX, y: y + scrollY, width, height, scale: 1}}))"
            f"(document.querySelector('{selector}').getBoundingClientRect())"
        )
        data = self.send("Page.captureScreenshot", format="png", clip=box, captureBeyondViewport=True)["data"]
        return np.asarray(PIL.Image.open(io.BytesIO(base64.b64decode(data))).convert("RGB"), dtype=int)

    def complaints(self) -> list[str]:
        """Return script errors, violations of the security policy, and requests to addresses outside the page."""
        complaints = []
        for event in self.events:
            kind, about = event.get("method"), event.get("params", {})
            if kind == "Runtime.exceptionThrown" or (kind == "Log.entryAdded" and about["entry"]["level"] == "error"):
                complaints.append(str(about))
            if kind == "Network.requestWillBeSent" and not about["request"]["url"].startswith(
                ("file:", "data:", "blob:")
            ):
                complaints.append(about["request"]["url"])
        return complaints


@contextmanager
def browser(folder: Path) -> Iterator[Tab]:
    """Start Chromium with a separate profile folder; skip the test if no browser is installed."""
    program = next((path for name in NAMES if (path := shutil.which(name))), None)
    if program is None:
        pytest.skip(f"no browser is installed ({', '.join(NAMES)})")
    flags = ("--headless=new", "--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader",
             "--hide-scrollbars", "--no-first-run", "--disable-extensions", "--disable-background-networking",
             "--disable-component-update", "--disable-dev-shm-usage", "--remote-debugging-pipe",
             f"--user-data-dir={folder}")  # fmt: skip
    (theirs_in, ours_out), (ours_in, theirs_out) = os.pipe(), os.pipe()

    def channels() -> None:
        # Chromium reads protocol messages from file descriptor 3 and writes messages to file descriptor 4.
        read, write = os.dup(theirs_in), os.dup(theirs_out)
        os.dup2(read, 3)
        os.dup2(write, 4)

    process = subprocess.Popen(
        [program, *flags], preexec_fn=channels, close_fds=False, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    )
    os.close(theirs_in), os.close(theirs_out)
    try:
        tab = Tab(ours_out, ours_in)
        yield tab
        tab.session = ""
        tab.send("Browser.close")
    finally:
        process.kill()
        process.wait()

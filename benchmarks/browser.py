"""Headless Chromium over its own pipe: open a page, ask it, press keys, take pictures. For tests and measurements.

The DevTools protocol goes over `--remote-debugging-pipe`: JSON messages that end in a zero byte, on the file
descriptors 3 and 4. Nothing is listened on and no further package is needed.
"""

from __future__ import annotations

import base64
import fcntl
import json
import os
import select
import shutil
import subprocess
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
FLAGS = ("--headless=new", "--no-sandbox", "--disable-gpu-sandbox", "--use-angle=swiftshader", "--no-first-run",
         "--enable-unsafe-swiftshader", "--disable-dev-shm-usage", "--hide-scrollbars", "--disable-extensions",
         "--disable-background-networking", "--remote-debugging-pipe")
KEYS = {"Tab": 9, "Home": 36, "ArrowLeft": 37, "ArrowUp": 38, "ArrowRight": 39, "ArrowDown": 40, "+": 187, "-": 189}


def find_chromium() -> str | None:
    """Path of a Chromium, or None where none is installed."""
    return next((path for name in NAMES if (path := shutil.which(name))), None)


class Browser:
    """One tab of one browser."""

    def __init__(self, process: subprocess.Popen[bytes], reading: int, writing: int, patience_s: float) -> None:
        self.process, self.reading, self.writing, self.patience_s = process, reading, writing, patience_s
        self.number, self.buffer, self.session = 0, b"", ""
        self.requests: list[str] = []
        self.complaints: list[str] = []
        target = self.send("Target.createTarget", url="about:blank")["targetId"]
        self.session = self.send("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]
        for domain in ("Page", "Runtime", "Network", "Log"):
            self.send(f"{domain}.enable")

    def send(self, method: str, **parameters: Any) -> dict[str, Any]:
        """Send one command and return its result."""
        self.number += 1
        message: dict[str, Any] = {"id": self.number, "method": method, "params": parameters}
        if self.session:
            message["sessionId"] = self.session
        os.write(self.writing, json.dumps(message).encode() + b"\0")
        end = time.monotonic() + self.patience_s
        while time.monotonic() < end:
            answer = self._receive(end)
            if answer.get("id") == self.number:
                if "error" in answer:
                    raise RuntimeError(f"{method}: {answer['error']['message']}")
                return dict(answer["result"])
        raise TimeoutError(f"chromium did not answer {method} within {self.patience_s:g} s")

    def _receive(self, end: float) -> dict[str, Any]:
        while b"\0" not in self.buffer:
            if not select.select([self.reading], [], [], max(0.0, end - time.monotonic()))[0]:
                return {}
            part = os.read(self.reading, 1 << 20)
            if not part:
                raise RuntimeError("chromium went away")
            self.buffer += part
        message, self.buffer = self.buffer.split(b"\0", 1)
        event: dict[str, Any] = json.loads(message)
        parameters = event.get("params", {})
        if event.get("method") == "Network.requestWillBeSent":
            self.requests.append(parameters["request"]["url"])
        elif event.get("method") == "Runtime.exceptionThrown":
            self.complaints.append(json.dumps(parameters["exceptionDetails"])[:500])
        elif event.get("method") == "Log.entryAdded" and parameters["entry"]["level"] == "error":
            self.complaints.append(parameters["entry"]["text"])
        return event

    def ask(self, expression: str) -> Any:
        """Value of a JavaScript expression; promises are waited for."""
        answer = self.send("Runtime.evaluate", expression=expression, awaitPromise=True, returnByValue=True)
        if "exceptionDetails" in answer:
            raise RuntimeError(json.dumps(answer["exceptionDetails"])[:500])
        return answer["result"].get("value")

    def show(self, page: Path, width: int = 1280, height: int = 900, scheme: str = "light", media: str = "") -> None:
        """Open a file in a window of this size and colour scheme."""
        self.send("Emulation.setDeviceMetricsOverride", width=width, height=height, deviceScaleFactor=1, mobile=False)
        self.emulate(scheme, media)
        self.send("Page.navigate", url=page.resolve().as_uri())

    def emulate(self, scheme: str, media: str = "") -> None:
        """Prefer a colour scheme; `media="print"` shows the page as paper would."""
        self.send("Emulation.setEmulatedMedia", media=media,
                  features=[{"name": "prefers-color-scheme", "value": scheme}])

    def press(self, key: str) -> None:
        """One key, down and up."""
        common = {"key": key, "code": key, "windowsVirtualKeyCode": KEYS[key]}
        text = {"text": key} if len(key) == 1 else {}
        self.send("Input.dispatchKeyEvent", type="keyDown" if text else "rawKeyDown", **common, **text)
        self.send("Input.dispatchKeyEvent", type="keyUp", **common)

    def picture(self, path: Path, whole: bool = True) -> None:
        """A PNG of the page, beyond the window too."""
        shot = self.send("Page.captureScreenshot", captureBeyondViewport=whole)
        path.write_bytes(base64.b64decode(shot["data"]))

    def paper(self) -> bytes:
        """The page as PDF."""
        return base64.b64decode(self.send("Page.printToPDF", printBackground=True)["data"])


def _pipe() -> tuple[int, int]:
    """A pipe whose ends lie above the descriptors that Chromium takes it on."""
    ends = os.pipe()
    moved = tuple(fcntl.fcntl(end, fcntl.F_DUPFD_CLOEXEC, 10) for end in ends)
    for end in ends:
        os.close(end)
    return moved[0], moved[1]


@contextmanager
def browser(patience_s: float = 120.0) -> Iterator[Browser]:
    """A headless Chromium; raises FileNotFoundError where none is installed."""
    program = find_chromium()
    if program is None:
        raise FileNotFoundError("no chromium; install it (Debian: apt-get install chromium)")
    to_read, to_write = _pipe(), _pipe()

    def keep_pipes() -> None:
        os.dup2(to_write[0], 3)
        os.dup2(to_read[1], 4)

    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as profile:
        process = subprocess.Popen([program, *FLAGS, f"--user-data-dir={profile}", "about:blank"],
                                   stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, close_fds=False,
                                   preexec_fn=keep_pipes)
        os.close(to_write[0])
        os.close(to_read[1])
        try:
            yield Browser(process, to_read[0], to_write[1], patience_s)
        finally:
            process.terminate()
            process.wait(20)
            os.close(to_read[0])
            os.close(to_write[1])

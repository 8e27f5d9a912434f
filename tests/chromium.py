"""Chromium without a window, driven over the DevTools protocol through a pipe.

https://chromedevtools.github.io/devtools-protocol: each message is JSON and ends with a zero byte;
commands go in on descriptor 3, answers and events come out on 4. No port, no driver, no library.
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
from collections import Counter
from collections.abc import Callable
from types import TracebackType
from typing import Any, Self

OPTIONS = (
    "--headless=new",
    "--no-sandbox",
    "--no-first-run",
    "--hide-scrollbars",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--remote-debugging-pipe",
)


def find_chromium() -> str | None:
    """The browser's program, if this machine has one."""
    return shutil.which("chromium") or shutil.which("google-chrome")


class Chromium:
    """One browser with one page; use it as a context manager.

    Attributes:
        requests: every address the page asked for.
        errors: what the console called an error, and every exception nobody caught.
        steps: clicks and typed characters on each page, as whoever makes them counts them.
    """

    def __init__(self, width: int = 1600, height: int = 1000, dark: bool = False) -> None:
        program = find_chromium()
        if program is None:
            raise RuntimeError("no chromium on this machine")
        self.requests: list[str] = []
        self.errors: list[str] = []
        self.steps: Counter[tuple[str, str]] = Counter()
        self._profile = tempfile.mkdtemp()
        self._process, self._to, self._from = _start(program, self._profile)
        self._read = b""
        self._count = 0
        self._page = ""
        target = self.send("Target.createTarget", url="about:blank")["targetId"]
        attached = self.send("Target.attachToTarget", targetId=target, flatten=True)
        self._page = attached["sessionId"]
        for domain in ("Page", "Network", "Runtime", "Log"):
            self.send(f"{domain}.enable")
        self.resize(width, height, dark)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._process.kill()
        self._process.wait()
        os.close(self._to)
        os.close(self._from)
        shutil.rmtree(self._profile, ignore_errors=True)

    def resize(self, width: int, height: int, dark: bool = False) -> None:
        """Look as a screen of this size does; below 600 px as a telephone does."""
        size = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": width < 600}
        self.send("Emulation.setDeviceMetricsOverride", **size)
        scheme = {"name": "prefers-color-scheme", "value": "dark" if dark else "light"}
        self.send("Emulation.setEmulatedMedia", features=[scheme])

    def open(self, address: str) -> None:
        """Go to an address."""
        self.send("Page.navigate", url=address)

    def evaluate(self, expression: str) -> Any:
        """The value of a JavaScript expression."""
        answer = self.send("Runtime.evaluate", expression=expression, returnByValue=True)
        if "exceptionDetails" in answer:
            raise RuntimeError(f"{expression}: {answer['exceptionDetails']}")
        return answer["result"].get("value")

    def wait_for(self, expression: str, timeout_s: float) -> Any:
        """Wait until an expression is true; gives its value.

        Raises:
            TimeoutError: it did not come true in time.
        """
        value = None

        def is_true() -> bool:
            nonlocal value
            value = self.evaluate(expression)
            return bool(value)

        try:
            self.wait_until(is_true, expression, timeout_s)
        except TimeoutError as problem:
            said = self.evaluate("document.body.innerText")
            raise TimeoutError(f"{problem}; the page says: {said}") from None
        return value

    def wait_until(self, done: Callable[[], bool], what: str, timeout_s: float) -> None:
        """Let the page work until `done`.

        Raises:
            TimeoutError: it was not done in time.
        """
        deadline = time.monotonic() + timeout_s
        while not done():
            if time.monotonic() > deadline:
                last = self.errors[-3:]
                raise TimeoutError(f"not within {timeout_s:.0f} s: {what}; errors: {last}")
            self.idle(0.2)

    def idle(self, seconds: float) -> None:
        """Take in what happens for a while."""
        deadline = time.monotonic() + seconds
        while (left := deadline - time.monotonic()) > 0:
            self._receive(left)

    def screenshot(self, whole: bool = False) -> bytes:
        """The page as PNG: what is in view, or all of it."""
        shot = self.send("Page.captureScreenshot", format="png", captureBeyondViewport=whole)
        return base64.b64decode(shot["data"])

    def send(self, method: str, **parameters: Any) -> dict[str, Any]:
        """Send a command and wait for its answer."""
        self._count += 1
        message = {"id": self._count, "method": method, "params": parameters}
        if self._page:
            message["sessionId"] = self._page
        os.write(self._to, json.dumps(message).encode() + b"\0")
        while True:
            answer = self._receive(60.0)
            if answer is None:
                raise TimeoutError(f"chromium does not answer {method}")
            if answer.get("id") == self._count:
                if "error" in answer:
                    raise RuntimeError(f"{method}: {answer['error']}")
                result: dict[str, Any] = answer["result"]
                return result

    def _receive(self, timeout_s: float) -> dict[str, Any] | None:
        """The next message, noted if it is an event; None if there is none in time."""
        while b"\0" not in self._read:
            if not select.select([self._from], [], [], timeout_s)[0]:
                return None
            got = os.read(self._from, 1 << 20)
            if not got:
                raise RuntimeError("chromium has ended")
            self._read += got
        text, _, self._read = self._read.partition(b"\0")
        message: dict[str, Any] = json.loads(text)
        self._note(message.get("method", ""), message.get("params", {}))
        return message

    def _note(self, event: str, values: dict[str, Any]) -> None:
        if event == "Network.requestWillBeSent":
            self.requests.append(values["request"]["url"])
        elif event == "Log.entryAdded" and values["entry"]["level"] == "error":
            self.errors.append(f"{values['entry']['text']} {values['entry'].get('url', '')}")
        elif event == "Runtime.consoleAPICalled" and values["type"] == "error":
            self.errors.append(" ".join(str(a.get("value", a)) for a in values["args"]))
        elif event == "Runtime.exceptionThrown":
            self.errors.append(str(values["exceptionDetails"].get("exception", values)))


def _start(program: str, profile: str) -> tuple[subprocess.Popen[bytes], int, int]:
    """Start the browser; the descriptors to write to and to read from."""
    (its_in, ours_out), (ours_in, its_out) = os.pipe(), os.pipe()
    # The browser wants its ends as 3 and 4; bash puts them there, from numbers that do not clash.
    high = [fcntl.fcntl(end, fcntl.F_DUPFD_CLOEXEC, 64) for end in (its_in, its_out)]
    script = f'exec "$0" "$@" 3<&{high[0]} 4>&{high[1]}'
    process = subprocess.Popen(
        ["bash", "-c", script, program, *OPTIONS, f"--user-data-dir={profile}"],
        pass_fds=high,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    for end in (its_in, its_out, *high):
        os.close(end)
    return process, ours_out, ours_in

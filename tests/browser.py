"""A headless Chromium, driven through its own protocol over two pipes: nothing else has to be installed.

https://chromedevtools.github.io/devtools-protocol describes the commands and events.
"""

import contextlib
import json
import os
import select
import shutil
import subprocess
import time
from base64 import b64decode
from pathlib import Path

NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable", "chrome")
KEYS = {"ArrowLeft": 37, "ArrowUp": 38, "ArrowRight": 39, "ArrowDown": 40, "PageUp": 33, "PageDown": 34, "Tab": 9}


def find_browser():
    """Return the path of a Chromium, or None; the variable CHROMIUM names another."""
    named = os.environ.get("CHROMIUM")
    return named or next(filter(None, map(shutil.which, NAMES)), None)


class Browser:
    """A browser with one page.

    Attributes:
        folder: for the browser's own files and what it downloads.
        problems: errors, warnings and messages of the page, in words.
        requests: the addresses that the page asked for.
    """

    def __init__(self, folder, width=1200, height=900):
        to_browser, self._out = os.pipe()
        self._in, from_browser = os.pipe()
        options = ["--headless", "--no-sandbox", "--disable-gpu", "--no-first-run", "--remote-debugging-pipe"]
        options += ["--disable-background-networking", "--hide-scrollbars", f"--user-data-dir={folder}", "about:blank"]
        # The browser reads commands from its file descriptor 3 and writes to 4.
        script = f'exec "$0" "$@" 3<&{to_browser} 4>&{from_browser}'
        self.process = subprocess.Popen(
            ["bash", "-c", script, find_browser(), *options],
            pass_fds=(to_browser, from_browser),
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        os.close(to_browser)
        os.close(from_browser)
        self.folder = Path(folder)
        self._number, self._rest, self._session = 0, b"", None
        self.problems, self.requests = [], []
        target = next(one for one in self.send("Target.getTargets")["targetInfos"] if one["type"] == "page")
        # Downloads belong to the browser, all else from here on to its page.
        self.send("Browser.setDownloadBehavior", behavior="allow", downloadPath=str(folder))
        self._session = self.send("Target.attachToTarget", targetId=target["targetId"], flatten=True)["sessionId"]
        for domain in ("Page", "Runtime", "Log", "Network"):
            self.send(f"{domain}.enable")
        self.resize(width, height)

    def __enter__(self):
        return self

    def __exit__(self, *error):
        self._session = None
        with contextlib.suppress(Exception):  # it may have ended
            self.send("Browser.close")
            self.process.wait(10)
        self.process.kill()
        self.process.wait()
        os.close(self._in)
        os.close(self._out)

    def send(self, method, **params):
        """Return the result of a command."""
        self._number += 1
        message = {"id": self._number, "method": method, "params": params}
        if self._session:
            message["sessionId"] = self._session
        os.write(self._out, json.dumps(message).encode() + b"\0")
        while True:
            answer = self._receive()
            if answer.get("id") == self._number:
                if "error" in answer:
                    raise RuntimeError(f"{method}: {answer['error']}")
                return answer["result"]

    def _receive(self, seconds=60.0):
        end = time.monotonic() + seconds
        while b"\0" not in self._rest:
            if not select.select([self._in], [], [], max(0, end - time.monotonic()))[0]:
                raise TimeoutError(f"the browser did not answer for {seconds:g} s")
            piece = os.read(self._in, 1 << 20)
            if not piece:
                raise RuntimeError("the browser has ended")
            self._rest += piece
        line, _, self._rest = self._rest.partition(b"\0")
        message = json.loads(line)
        self._note(message.get("method"), message.get("params", {}))
        return message

    def _note(self, method, params):
        if method == "Runtime.exceptionThrown":
            details = params["exceptionDetails"]
            self.problems.append(details.get("exception", {}).get("description", details["text"]))
        elif method == "Runtime.consoleAPICalled":
            self.problems.append(" ".join(str(one.get("value")) for one in params["args"]))
        elif method == "Log.entryAdded":
            self.problems.append(params["entry"]["text"])
        elif method == "Network.requestWillBeSent":
            self.requests.append(params["request"]["url"])

    def open(self, path):
        """Open a file and wait until it is there."""
        self.send("Page.navigate", url=Path(path).resolve().as_uri())
        end = time.monotonic() + 60
        ready = "document.readyState === 'complete' && location.href !== 'about:blank' && "
        ready += "document.querySelector('main[aria-busy]') === null"
        while not self.run(ready):
            if time.monotonic() > end:
                raise TimeoutError(f"{path} did not load")
            time.sleep(0.02)
        self.settle()

    def run(self, script):
        """Return the value of an expression in the page."""
        answer = self.send("Runtime.evaluate", expression=script, returnByValue=True, awaitPromise=True)
        if "exceptionDetails" in answer:
            raise RuntimeError(answer["exceptionDetails"])
        return answer["result"].get("value")

    def settle(self):
        """Wait until what was changed has been drawn."""
        self.run("new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(() => done(1))))")

    def resize(self, width, height, scale=1):
        """Give the page another size."""
        size = {"width": width, "height": height, "deviceScaleFactor": scale, "mobile": False}
        self.send("Emulation.setDeviceMetricsOverride", **size)

    def text(self, selector):
        """Return the text of an element."""
        return self.run(f"document.querySelector({json.dumps(selector)}).textContent")

    def box(self, selector):
        """Return x, y, width and height of an element in the window, scrolled to it."""
        return self.run(
            f"(() => {{ const e = document.querySelector({json.dumps(selector)});"
            "e.scrollIntoView({block: 'center'});"
            "const b = e.getBoundingClientRect(); return [b.x, b.y, b.width, b.height]; })()"
        )

    def drag(self, points, shift=False):
        """Press the mouse at the first of the points, in pixels of the window, move along them and let go."""
        common = {"button": "left", "clickCount": 1, "modifiers": 8 if shift else 0}
        x, y = points[0]
        self.send("Input.dispatchMouseEvent", type="mouseMoved", x=x, y=y)
        self.send("Input.dispatchMouseEvent", type="mousePressed", x=x, y=y, buttons=1, **common)
        for x, y in points[1:]:
            self.send("Input.dispatchMouseEvent", type="mouseMoved", x=x, y=y, buttons=1, **common)
        self.send("Input.dispatchMouseEvent", type="mouseReleased", x=x, y=y, buttons=0, **common)
        self.settle()

    def click(self, selector, across=0.5, down=0.5, shift=False):
        """Click on an element, at fractions of its width and height."""
        x, y, width, height = self.box(selector)
        self.drag([(x + across * width, y + down * height)], shift)

    def key(self, name, times=1, shift=False):
        """Press a key."""
        for _ in range(times):
            for kind in ("keyDown", "keyUp"):
                self.send(
                    "Input.dispatchKeyEvent",
                    type=kind,
                    key=name,
                    code=name,
                    windowsVirtualKeyCode=KEYS[name],
                    modifiers=8 if shift else 0,
                )
        self.settle()

    def choose(self, selector, value):
        """Set a slider, a selection or a box, as a reader's hand would."""
        self.run(
            f"(() => {{ const e = document.querySelector({json.dumps(selector)});"
            f"if (e.type === 'checkbox') e.checked = {json.dumps(value)}; else e.value = {json.dumps(value)};"
            "e.dispatchEvent(new Event('input', {bubbles: true})); })()"
        )
        self.settle()

    def picture(self, path, whole=True):
        """Write what the page looks like as PNG."""
        answer = self.send("Page.captureScreenshot", format="png", captureBeyondViewport=whole)
        Path(path).write_bytes(b64decode(answer["data"]))

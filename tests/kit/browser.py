"""A headless Chromium, driven over a pipe by the DevTools protocol."""

import fcntl
import json
import os
import shutil
from pathlib import Path
from typing import Any

from tests.kit.awaited import until

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")

_DIFFERING = """async (...pictures) => {
  const [one, other] = await Promise.all(pictures.map(async (text) => {
    const image = Object.assign(new Image(), { src: `data:image/png;base64,${text}` });
    await image.decode();
    const canvas = new OffscreenCanvas(image.width, image.height).getContext("2d");
    canvas.drawImage(image, 0, 0);
    return canvas.getImageData(0, 0, image.width, image.height).data;
  }));
  if (one.length !== other.length) return 1;
  let differing = 0;
  for (let at = 0; at < one.length; at += 4) {
    differing += [0, 1, 2].some((colour) => Math.abs(one[at + colour] - other[at + colour]) > 32);
  }
  return differing / (one.length / 4);
}"""


class Browser:
    """A headless browser with one page."""

    def __init__(self, home: Path, *drawing: str) -> None:
        """`drawing`: how it draws, by default without a graphics processor."""
        theirs, self._to = (_above(end) for end in os.pipe())
        self._from, back = (_above(end) for end in os.pipe())
        words = [CHROMIUM or "", "--headless", "--no-sandbox", "--remote-debugging-pipe"]
        words += [
            *(drawing or ("--disable-gpu",)),
            f"--user-data-dir={home}",
            "--window-size=1200,900",
            "about:blank",
        ]
        actions = [(os.POSIX_SPAWN_OPEN, end, os.devnull, os.O_RDWR, 0) for end in (0, 1, 2)]
        actions += [(os.POSIX_SPAWN_DUP2, theirs, 3), (os.POSIX_SPAWN_DUP2, back, 4)]
        self._process = os.posix_spawn(words[0], words, os.environ, file_actions=actions)
        os.close(theirs)
        os.close(back)
        self._count, self._session, self._read = 0, "", b""
        self.events: list[dict[str, Any]] = []
        (target, *_) = [one for one in self("Target.getTargets")["targetInfos"] if one["type"] == "page"]
        attached = self("Target.attachToTarget", targetId=target["targetId"], flatten=True)
        self._session = attached["sessionId"]
        for domain in ("Page", "Runtime", "Network", "Log"):
            self(f"{domain}.enable")

    def __call__(self, method: str, **params: object) -> dict[str, Any]:
        self._count += 1
        message: dict[str, object] = {"id": self._count, "method": method, "params": params}
        if self._session:
            message["sessionId"] = self._session
        os.write(self._to, json.dumps(message).encode() + b"\0")
        while (answer := self._message()).get("id") != self._count:
            self.events.append(answer)
        assert "error" not in answer, answer["error"]
        result: dict[str, Any] = answer["result"]
        return result

    def _message(self) -> dict[str, Any]:
        while b"\0" not in self._read:
            received = os.read(self._from, 1 << 20)
            assert received, "the browser ended"
            self._read += received
        one, self._read = self._read.split(b"\0", 1)
        message: dict[str, Any] = json.loads(one)
        return message

    def value(self, expression: str) -> Any:
        """Return the value of an expression in the page, of a promise what it becomes."""
        answer = self("Runtime.evaluate", expression=expression, returnByValue=True, awaitPromise=True)
        assert "exceptionDetails" not in answer, answer["exceptionDetails"]
        return answer["result"].get("value")

    def until(self, condition: str) -> None:
        """Wait until an expression in the page is true."""
        until(lambda: self.value(condition), condition)

    def drag(self, begin: tuple[float, float], end: tuple[float, float]) -> None:
        """Press the mouse at one place, and let it go at another."""
        middle = ((begin[0] + end[0]) / 2, (begin[1] + end[1]) / 2)
        for kind, (x, y), buttons in (
            ("mouseMoved", begin, 0),
            ("mousePressed", begin, 1),
            ("mouseMoved", middle, 1),
            ("mouseMoved", end, 1),
            ("mouseReleased", end, 0),
        ):
            self(
                "Input.dispatchMouseEvent", type=kind, x=x, y=y, button="left", buttons=buttons, clickCount=1
            )

    def place(self, selector: str) -> tuple[float, float, float, float]:
        """Return left, top, width and height of an element in the window."""
        box = self.value(f"document.querySelector({selector!r}).getBoundingClientRect().toJSON()")
        return box["x"], box["y"], box["width"], box["height"]

    def click(self, selector: str) -> None:
        """Press and release the mouse in the middle of an element."""
        left, top, width, height = self.place(selector)
        middle = (left + width / 2, top + height / 2)
        self.drag(middle, middle)

    def open(self, address: str, width: int = 1440, height: int = 900, *, dark: bool = False) -> None:
        """Open a page in a window of this size."""
        size = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": width < 600}
        self("Emulation.setDeviceMetricsOverride", **size)
        features = [{"name": "prefers-color-scheme", "value": "dark" if dark else "light"}]
        self("Emulation.setEmulatedMedia", features=features)
        self("Page.navigate", url=address)

    def picture(self, selector: str = "html") -> str:
        """Return what the window shows of an element, as PNG in base64."""
        clip = dict(zip(("x", "y", "width", "height"), self.place(selector), strict=True)) | {"scale": 1}
        return str(self("Page.captureScreenshot", format="png", clip=clip)["data"])

    def differing(self, first: str, second: str) -> float:
        """Return the share of pixels of two pictures that differ by more than what trembles at an edge."""
        return float(self.value(f"({_DIFFERING})({first!r}, {second!r})"))

    def close(self) -> None:
        os.close(self._to)  # by that it ends
        os.waitpid(self._process, 0)
        os.close(self._from)


def _above(descriptor: int) -> int:
    """Return a descriptor beyond those that the browser gets, in place of one."""
    other = fcntl.fcntl(descriptor, fcntl.F_DUPFD_CLOEXEC, 10)
    os.close(descriptor)
    return other

"""Make docs/images/reem.gif from a real run: a terminal that writes, and the page that shows it, dragged back in time.

    python docs/make_gif.py [FILE]

It starts `reem demo`, types real statements into a real Python console,
and takes pictures of the page in headless Chromium about eight times a second. Needs chromium, playwright and pillow.
"""

from __future__ import annotations

import code
import contextlib
import html
import io
import itertools
import re
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

from PIL import Image
from playwright.sync_api import Page, sync_playwright

OUT = Path(__file__).parent / "images" / "reem.gif"
WIDTH, PAGE_HEIGHT, TERMINAL_HEIGHT = 1080, 476, 118
RATE = 8.0  # pictures a second
COLOURS = 128
TERMINAL = """<body style="margin:0;background:#10171f;color:#d7e0ea;font:15px/21px 'DejaVu Sans Mono',monospace">
<pre style="margin:0;padding:12px 16px">{}<span style="background:#d7e0ea"> </span></pre></body>"""


class Terminal:
    """A Python console; what is typed runs."""

    def __init__(self, page: Page) -> None:
        self.page, self.lines, self.typed = page, [], ""
        self.console = code.InteractiveConsole()

    def enter(self) -> None:
        self.lines.append(f">>> {self.typed}")
        output = io.StringIO()
        with contextlib.redirect_stdout(output), contextlib.redirect_stderr(output):
            self.console.push(self.typed)
        self.lines += output.getvalue().splitlines()
        self.typed = ""

    def picture(self) -> Image.Image:
        shown = [*self.lines, f">>> {self.typed}"][-4:]
        self.page.set_content(TERMINAL.format(html.escape("\n".join(shown))))
        return Image.open(io.BytesIO(self.page.screenshot())).convert("RGB")


class Film:
    """Pictures of both, one above the other, at a steady rate."""

    def __init__(self, terminal: Terminal, page: Page) -> None:
        self.terminal, self.page, self.frames, self.times = terminal, page, [], []
        self.above: Image.Image | None = None
        self.next = time.monotonic()

    def take(self, seconds: float = 0.0, *, typed: bool = False) -> None:
        """Take pictures for so long, one at least."""
        if typed or self.above is None:
            self.above = self.terminal.picture()
        end = time.monotonic() + seconds
        while True:
            below = Image.open(io.BytesIO(self.page.screenshot())).convert("RGB")
            frame = Image.new("RGB", (WIDTH, TERMINAL_HEIGHT + PAGE_HEIGHT))
            frame.paste(self.above, (0, 0))
            frame.paste(below, (0, TERMINAL_HEIGHT))
            self.frames.append(frame)
            self.times.append(time.monotonic())
            self.next = max(self.next + 1 / RATE, time.monotonic() - 1 / RATE)
            self.page.wait_for_timeout(max(0.0, self.next - time.monotonic()) * 1000)
            if time.monotonic() >= end:
                return

    def type(self, text: str) -> None:
        for start in range(0, len(text), 9):
            self.terminal.typed = text[: start + 9]
            self.take(typed=True)
        self.take(0.3)
        self.terminal.enter()
        self.take(0.2, typed=True)

    def drag(self, parts: list[float]) -> None:
        """Drag the slider from the right end to each part of its width in turn."""
        box = self.page.locator("#slider").bounding_box()
        assert box is not None
        y = box["y"] + box["height"] / 2
        self.page.mouse.move(box["x"] + box["width"] - 8, y)
        self.page.mouse.down()
        for part in parts:
            self.page.mouse.move(box["x"] + 8 + (box["width"] - 16) * part, y, steps=2)
            self.take(0.15)
        self.page.mouse.up()
        self.take(1.0)

    def save(self, path: Path) -> None:
        sheet = Image.new("RGB", (WIDTH, 3 * self.frames[0].height))
        for index, frame in enumerate((self.frames[0], self.frames[len(self.frames) // 2], self.frames[-1])):
            sheet.paste(frame, (0, index * frame.height))
        palette = sheet.quantize(COLOURS, dither=Image.Dither.NONE)
        small = [frame.quantize(palette=palette, dither=Image.Dither.NONE) for frame in self.frames]
        spans = [round(1000 * (after - before)) for before, after in itertools.pairwise(self.times)] + [1800]
        small[0].save(path, save_all=True, append_images=small[1:], duration=spans, loop=0, optimize=True)


def demo() -> tuple[subprocess.Popen[str], str, str]:
    """`reem demo`, the address of its page and that of its server."""
    command = [str(Path(sys.executable).parent / "reem"), "demo", "--no-open", "--port", "0", "--page-port", "0"]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    found: dict[str, str] = {}
    for line in process.stdout or ():
        found |= dict(re.findall(r"^ +(page|server) +(\S+)$", line))
        if len(found) == 2:
            return process, found["page"], found["server"]
    raise SystemExit("reem demo did not start")


def main() -> None:
    path = Path(sys.argv[1]) if len(sys.argv) > 1 else OUT
    flags = ["--no-sandbox", "--disable-gpu"]
    chromium = shutil.which("chromium") or shutil.which("google-chrome")
    process, address, server = demo()
    try:
        with sync_playwright() as driver:
            window = driver.chromium.launch(executable_path=chromium, args=flags)
            console = window.new_page(viewport={"width": WIDTH, "height": TERMINAL_HEIGHT})
            page = window.new_page(viewport={"width": WIDTH, "height": PAGE_HEIGHT}, color_scheme="light")
            terminal = Terminal(console)
            terminal.console.push("from reem import KeyValueStore, RedisInterface")
            terminal.console.push(f"kvs = KeyValueStore(RedisInterface({server!r}))")
            terminal.lines = [">>> kvs = KeyValueStore(RedisInterface())"]
            page.goto(address)
            for pane in ("camera.rgb", "arm.joints"):  # pin what is to be seen
                page.locator(f'button.pin[aria-label$="{pane}"]').click()
            page.reload()
            edge = page.locator("#edge").bounding_box()
            assert edge is not None
            page.mouse.move(edge["x"] + 2, 300)
            page.mouse.down()
            page.mouse.move(330, 300, steps=4)  # more room for what is shown
            page.mouse.up()
            page.mouse.move(600, 20)
            page.wait_for_timeout(9000)  # so that there is a past
            film = Film(terminal, page)
            film.take(0.7)
            film.type('kvs["goal"] = {"x": -0.1, "y": -0.4}')
            film.take(3.0)
            film.type('kvs["goal"].read()')
            film.take(0.8)
            film.type('kvs["goal"] = {"x": 0.3, "y": 0.4}')
            film.take(2.5)
            film.drag([0.97, 0.93, 0.88, 0.82, 0.75, 0.67, 0.58, 0.5, 0.42, 0.5, 0.6, 0.7, 0.8])
            page.locator("#live").click()
            film.take(0.7)
            film.save(path)
            window.close()
    finally:
        process.send_signal(signal.SIGINT)
        process.wait()
    print(f"{path}: {path.stat().st_size / 1e6:.1f} MB, {len(film.frames)} pictures")


if __name__ == "__main__":
    main()

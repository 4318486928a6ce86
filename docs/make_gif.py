"""Make docs/images/reem.gif from a real run: a terminal that writes, and the page that shows it, dragged back in time.

    python docs/make_gif.py [FILE]

It starts a server, a simulated arm with a camera, and `reem browse`; types real statements into a real Python console;
and takes pictures of the page in headless Chromium about eight times a second. Needs chromium, playwright and pillow.
"""

from __future__ import annotations

import code
import contextlib
import html
import io
import math
import re
import shutil
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw
from playwright.sync_api import Page, sync_playwright

import reem
from reem.server import EmbeddedServer

OUT = Path(__file__).parent / "images" / "reem.gif"
WIDTH, PAGE_HEIGHT, TERMINAL_HEIGHT = 1080, 476, 118
RATE = 8.0  # pictures a second
COLOURS = 96
TERMINAL = """<body style="margin:0;background:#10171f;color:#d7e0ea;font:15px/21px 'DejaVu Sans Mono',monospace">
<pre style="margin:0;padding:12px 16px">{}<span style="background:#d7e0ea"> </span></pre></body>"""


class Arm:
    """Two links that swing to their target, and a camera that looks at them."""

    def __init__(self, url: str) -> None:
        self.interface = reem.RedisInterface(url)
        self.space, self.running = reem.PublishSpace(self.interface), True
        self.space["arm"] = {"target": [0.4, 0.5], "q": [0.4, 0.5]}
        self.thread = threading.Thread(target=self.run)

    def run(self) -> None:
        with reem.KeyValueStore(self.interface)["arm"]["target"].mirror() as target:
            q, number = np.array([0.4, 0.5]), 0
            while self.running:
                q += 0.12 * (np.array(target.value()) - q)
                wave = 0.04 * math.sin(6 * time.time())
                self.space["arm"]["q"] = [round(float(angle) + wave, 4) for angle in q]
                if number % 2 == 0:
                    self.space["camera"] = {"image": self.picture(*(q + wave)), "stamp": time.time()}
                number += 1
                time.sleep(0.03)

    @staticmethod
    def picture(first: float, second: float) -> np.ndarray:
        image = Image.new("RGB", (320, 240), (38, 50, 64))
        draw = ImageDraw.Draw(image)
        draw.rectangle((0, 200, 320, 240), fill=(58, 74, 92))
        points, angle = [(160.0, 200.0)], 0.0
        for link, turn in ((95, first), (75, second)):
            angle += turn
            x, y = points[-1]
            points.append((x + link * math.sin(angle), y - link * math.cos(angle)))
        draw.line(points, fill=(240, 165, 60), width=13, joint="curve")
        for x, y in points:
            draw.ellipse((x - 10, y - 10, x + 10, y + 10), fill=(236, 240, 245))
        return np.asarray(image)


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
        self.terminal, self.page, self.frames = terminal, page, []
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
        spans = [round(1000 / RATE)] * (len(small) - 1) + [1800]
        small[0].save(path, save_all=True, append_images=small[1:], duration=spans, loop=0, optimize=True)


def browse(url: str) -> tuple[subprocess.Popen[str], str]:
    """`reem browse`, and the address of its page."""
    command = [str(Path(sys.executable).parent / "reem"), "browse", "--no-open", "--port", "0", "--url", url]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    for line in process.stdout:
        if found := re.search(r"http://\S+", line):
            return process, found[0]
    raise SystemExit("reem browse did not start")


def main() -> None:
    path = Path(sys.argv[1]) if len(sys.argv) > 1 else OUT
    flags = ["--no-sandbox", "--disable-gpu"]
    chromium = shutil.which("chromium") or shutil.which("google-chrome")
    with EmbeddedServer() as server, sync_playwright() as driver:
        process, address = browse(server.url)
        arm = Arm(server.url)
        arm.thread.start()
        try:
            window = driver.chromium.launch(executable_path=chromium, args=flags)
            console = window.new_page(viewport={"width": WIDTH, "height": TERMINAL_HEIGHT})
            page = window.new_page(viewport={"width": WIDTH, "height": PAGE_HEIGHT}, color_scheme="light")
            terminal = Terminal(console)
            terminal.console.push("from reem import KeyValueStore, RedisInterface")
            terminal.console.push(f"kvs = KeyValueStore(RedisInterface({server.url!r}))")
            terminal.lines = [">>> kvs = KeyValueStore(RedisInterface())"]
            page.goto(address)
            page.locator('#tree .row[data-address="arm"] .twist').click()
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
            film.type('kvs["arm"]["target"] = [-0.9, 1.4]')
            film.take(2.0)
            film.type('kvs["arm"]["q"].read()')
            film.take(0.8)
            film.type('kvs["arm"]["target"] = [1.1, -1.3]')
            film.take(1.8)
            film.drag([0.97, 0.93, 0.88, 0.82, 0.75, 0.67, 0.58, 0.5, 0.42, 0.5, 0.6, 0.7, 0.8])
            page.locator("#live").click()
            film.take(0.7)
            film.save(path)
            window.close()
        finally:
            arm.running = False
            arm.thread.join()
            arm.interface.close()
            process.terminate()
            process.wait()
    print(f"{path}: {path.stat().st_size / 1e6:.1f} MB, {len(film.frames)} pictures")


if __name__ == "__main__":
    main()

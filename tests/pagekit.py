"""Chromium, headless, as a visitor of the page."""

import shutil

import pytest
from browserkit import live, served

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
if CHROMIUM is None:
    pytest.skip("Chromium is not installed: apt-get install chromium", allow_module_level=True)
playwright = pytest.importorskip("playwright.sync_api", reason="playwright is not installed: pip install playwright")
expect = playwright.expect

FLAGS = [
    "--headless",
    "--no-sandbox",
    "--disable-gpu",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
]


@pytest.fixture(scope="module")
def chromium():
    with playwright.sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=CHROMIUM, args=FLAGS)
        yield browser
        browser.close()


@pytest.fixture(scope="module")
def address(server_url):
    with served(live(server_url), allow_write=True) as (address, _):
        yield address


class Visitor:
    def __init__(self, chromium, address):
        self.chromium = chromium
        self.address = address
        self.contexts = []
        self.said = []
        self.asked = []

    def open(self, path="/", address=None, **options):
        context = self.chromium.new_context(viewport={"width": 1200, "height": 760}, **options)
        context.set_default_timeout(10_000)
        self.contexts.append(context)
        page = context.new_page()
        page.on("console", lambda message: self.said.append(f"{message.type}: {message.text}"))
        page.on("pageerror", lambda error: self.said.append(f"error: {error}"))
        page.on("request", lambda request: self.asked.append(request.url))
        page.goto((address or self.address) + path)
        return page


@pytest.fixture
def visit(chromium, address, key):  # the key, since pages must be closed before what they show is removed
    """Opens pages; at the end nothing was said on the console, and nothing was asked of anybody else."""
    visitor = Visitor(chromium, address)
    yield visitor
    for context in visitor.contexts:
        context.close()
    assert visitor.said == [], visitor.said
    elsewhere = [url for url in visitor.asked if not url.startswith(("http://127.0.0.1:", "blob:http://127.0.0.1:"))]
    assert elsewhere == []


def row(page, address, where="#tree"):
    return page.locator(f'{where} .row[data-address="{address}"]')

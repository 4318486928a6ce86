"""The browser: a page that shows what a server holds, or held, or what a recording says it held.

async with RedisInterface("localhost") as interface:
    app = create_app(LiveSource(interface))
    await PageServer(app, listen("127.0.0.1", 8080)).run_until_stopped()
"""

from .app import create_app
from .live import LiveSource
from .serving import PageServer, listen
from .source import NotKept, Sample, Series, Source, Status

__all__ = ["LiveSource", "NotKept", "PageServer", "Sample", "Series", "Source", "Status", "create_app", "listen"]

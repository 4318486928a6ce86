"""The browser: a page that shows what a server holds, or held, or what a recording says it held.

async with RedisInterface("localhost") as interface:
    app = create_app(LiveSource(interface))
    await PageServer(app, listen("127.0.0.1", 8080)).run_until_stopped()
"""

from .app import PageServer, create_app, listen
from .live import LiveSource
from .source import NotKept, Sample, Series, Source, Status

__all__ = ["LiveSource", "NotKept", "PageServer", "Sample", "Series", "Source", "Status", "create_app", "listen"]
